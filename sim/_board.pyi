"""A simulated device and its board inside an array, such as MuJoCo's plugin state (module.cpp)."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from headway.firmware._core import DeviceSettings, Status

NODE_NUMBERS: int
RECORD_SETTINGS_A: int
RECORD_BOOTS_A: int
RECORD_FAULTS_A: int
RECORD_MAX: int
OSCILLATOR_PPB_MAX: int

class Oscillator:
    """The counter of a simulated board: the same C code as there. All times are true times [us].

    Its rate is off by a skew that starts as `drift_ppb`, changes by at most `wander_ppb_per_s`,
    evenly for a second and then anew, and never leaves +-`drift_bound_ppb`.
    """

    def __init__(
        self,
        offset: int = 0,
        drift_ppb: int = 0,
        wander_ppb_per_s: int = 0,
        drift_bound_ppb: int = 1_000_000,
        seed: int = 0,
    ) -> None:
        """`offset`: count at true time 0. Raises ValueError for a drift beyond its bound, and for
        a bound or a wander beyond OSCILLATOR_PPB_MAX."""

    def count_at(self, true_us: int) -> int:
        """The count, modulo 2^32. Fast within a second of the last call; a way back further starts
        at true time 0 again."""

    def counts(self, true_us: NDArray[np.int64]) -> NDArray[np.uint32]:
        """The same at times of shape (n,), which had better ascend; also of shape (n,)."""

    def step(self, true_us: int, step_us: int) -> None:
        """The counter jumps at a time, for all that follows."""

class Polled:
    """Boards that no plant steps: each is polled at its servo periods, by its counter as it was
    when it was added, and at random in between."""

    def __init__(self) -> None: ...
    def add(self, node: Node, pause_us: int, random: int) -> None:
        """One that is flashed, before true time goes on. `pause_us`: between random polls, on
        average; 0: there are none. `random`: their generator's state. Raises ValueError for one
        without settings."""

    def run(self, until_us: int, encoders: dict[int, Callable[[int], int]]) -> int | None:
        """Polls all in the order of true time, up to and with `until_us` [us], until one has sent
        something: returns its number, in the order of `add`. None: nobody has. `encoders`: what
        those of some numbers show at a true time; else 0."""

class Node:
    """Refers to the array: all state is in there. All times are true times unless named."""

    def __init__(self, state: NDArray[np.float64]) -> None: ...
    def flash(
        self,
        settings: DeviceSettings,
        count_offset: int = 0,
        drift_ppb: int = 0,
        wander_ppb_per_s: int = 0,
        drift_bound_ppb: int = 1_000_000,
        oscillator_seed: int = 0,
    ) -> None:
        """As a programmer: settings into the memory, then a power cycle. The rest of the memory,
        the boot counter above all, stays. The board gets an Oscillator of these numbers; raises
        ValueError as that does."""

    def restart(self) -> None:
        """A power cycle: what is in memory stays, all else is gone."""

    def memory(self, record: int) -> bytes:
        """What is in non-volatile memory; the record after RECORD_x_A is the other place of x."""

    def set_memory(self, record: int, bytes: bytes) -> None: ...
    def break_encoder(self, defect: int, since_us: int) -> None:
        """0: good, 1: stuck, 2: reversed, 3: jumped, from a true time on."""

    def join_bus(self, phase_ps: int, period_ps: int, seed: int = 0) -> None:
        """From now on the board sees starts of frames: frame n, from 0, at phase_ps + n period_ps
        of true time, number n modulo 2048. `seed`: of what catching them is late by, 100 ns at
        most. Raises ValueError for a negative phase or a period that is not positive."""

    @property
    def sof(self) -> tuple[int, int] | None:
        """Number of the last start of a frame and the board's count at it; None without a bus."""

    def step_clock(self, step_us: int) -> None:
        """The counter jumps, now."""

    def deliver(self, arrival_us: int, packet: bytes, port: int = 0) -> bool: ...
    def collect(self, port: int = 0) -> list[tuple[int, bytes]]:
        """Sent packets with the times at which they left."""

    def setpoint(self, time_us: int) -> tuple[int, int, int]:
        """Position, its rate per knot and torque: at a system time while the device executes its
        tracks, else those of the last servo period."""

    def poll(self, true_us: int, encoder_count: int) -> bool:
        """Runs the board at a true time: its guard and, unless it is hung, its main loop. Returns
        whether there is something to collect."""

    @property
    def state(self) -> int: ...
    @property
    def boots(self) -> int: ...
    @property
    def session(self) -> int | None:
        """Number of the session that the device is in."""

    @property
    def received(self) -> int:
        """The highest counter of a frame that it took in that session."""

    @property
    def settings(self) -> DeviceSettings: ...
    @property
    def synced(self) -> bool: ...
    @property
    def lineage(self) -> int:
        """Whose time it keeps, of boards among themselves."""

    @property
    def excluded(self) -> int:
        """Stamps that contradicted what it knew."""

    @property
    def error_ns(self) -> tuple[int, int]:
        """What its clock is ahead by, at least and at most, as it told itself in its last servo
        period; +-(2^31 - 1): not known."""

    @property
    def true_us(self) -> int: ...
    @property
    def duty_q15(self) -> int: ...
    def steps(self, true_us: int) -> int:
        """Steps that the board has given by a true time, modulo 2^32; not before those of the last
        few servo periods."""

    @property
    def trains(self) -> list[tuple[int, int, int, int]]:
        """The last that it was told to give: the count at which a window begins, how many, when
        the first comes and then each [1/65536 us]."""

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
    digital_in: int
    @property
    def pwm_q15(self) -> list[int]: ...
    @property
    def flips(self) -> list[tuple[int, int, bool]]:
        """The last changes of digital outputs, also those to come: true time, output, on."""

    def flips_from(self, number: int) -> list[tuple[int, int, bool]]:
        """All changes from a number on, they count from 0; output -1: it was forgotten. Raises
        ValueError if some are no longer remembered."""

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

    def truth(self, true_us: int, time_us: int) -> tuple[int, int, int, int, int, int]:
        """Of one instant, by true and by system time: the setpoint, the servo's torque after and
        before its ceiling, and by how much the device's clock is ahead."""
