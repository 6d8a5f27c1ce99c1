"""A simulated device and its board inside an array, such as MuJoCo's plugin state (module.cpp)."""

import numpy as np
from numpy.typing import NDArray

from headway.firmware._core import DeviceSettings, Status

NODE_NUMBERS: int

class Node:
    """Refers to the array: all state is in there. All times are true times unless named."""

    def __init__(self, state: NDArray[np.float64]) -> None: ...
    def flash(
        self, settings: DeviceSettings, count_offset: int = 0, drift_ppb: int = 0
    ) -> None: ...
    def deliver(self, arrival_us: int, packet: bytes) -> bool: ...
    def collect(self) -> list[tuple[int, bytes]]:
        """Sent packets with the times at which they left."""

    def setpoint(self, time_us: int) -> tuple[int, int, int]:
        """Position, its rate per knot and torque at a system time."""

    def poll(self, true_us: int, encoder_count: int) -> None: ...
    @property
    def state(self) -> int: ...
    @property
    def synced(self) -> bool: ...
    @property
    def true_us(self) -> int: ...
    @property
    def duty_q15(self) -> int: ...
    @property
    def brake(self) -> bool: ...
    @property
    def dropped(self) -> int: ...
    @property
    def torque_tq(self) -> int: ...
    @property
    def unclipped_tq(self) -> int: ...
    @property
    def status(self) -> Status: ...
    def system_us(self, true_us: int) -> int:
        """What the device's clock shows at a true time."""
