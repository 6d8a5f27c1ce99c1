"""A simulated device and its board inside an array, such as MuJoCo's plugin state (module.cpp)."""

import numpy as np
from numpy.typing import NDArray

from headway.firmware._core import DeviceSettings, Status

NODE_NUMBERS: int
RECORD_SETTINGS_A: int
RECORD_BOOTS_A: int
RECORD_FAULTS_A: int
RECORD_MAX: int

class Node:
    """Refers to the array: all state is in there. All times are true times unless named."""

    def __init__(self, state: NDArray[np.float64]) -> None: ...
    def flash(self, settings: DeviceSettings, count_offset: int = 0, drift_ppb: int = 0) -> None:
        """As a programmer: settings into the memory, then a power cycle. The rest of the memory,
        the boot counter above all, stays."""

    def restart(self) -> None:
        """A power cycle: what is in memory stays, all else is gone."""

    def memory(self, record: int) -> bytes:
        """What is in non-volatile memory; the record after RECORD_x_A is the other place of x."""

    def set_memory(self, record: int, bytes: bytes) -> None: ...
    def break_encoder(self, defect: int, since_us: int) -> None:
        """0: good, 1: stuck, 2: reversed, 3: jumped, from a true time on."""

    def deliver(self, arrival_us: int, packet: bytes) -> bool: ...
    def collect(self) -> list[tuple[int, bytes]]:
        """Sent packets with the times at which they left."""

    def setpoint(self, time_us: int) -> tuple[int, int, int]:
        """Position, its rate per knot and torque: at a system time while the device executes its
        tracks, else those of the last servo period."""

    def poll(self, true_us: int, encoder_count: int) -> None:
        """Runs the board at a true time: its guard and, unless it is hung, its main loop."""

    @property
    def state(self) -> int: ...
    @property
    def boots(self) -> int: ...
    @property
    def session(self) -> int | None:
        """Number of the session that the device is in."""

    @property
    def settings(self) -> DeviceSettings: ...
    @property
    def synced(self) -> bool: ...
    @property
    def true_us(self) -> int: ...
    @property
    def duty_q15(self) -> int: ...
    @property
    def brake(self) -> bool: ...
    @property
    def power(self) -> bool: ...
    @property
    def tripped(self) -> bool:
        """The guard has braked, and holds it so."""

    @property
    def chopper(self) -> bool: ...
    stop_line: bool
    hung: bool
    supply_V: float
    feed_V: float
    capacitance_F: float
    encoder_offset: int
    index_every: int
    index_at: int
    switch_from: int
    switch_to: int
    switch_every: int
    random: int
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
