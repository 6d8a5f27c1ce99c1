"""The firmware core: codec, gate, tracks, servo and clock, as the board runs them (module.cpp)."""

import numpy as np
from numpy.typing import NDArray

FRAME_SYNC: int
FRAME_PLAN: int
FRAME_STATUS: int
TRACK_POSITION: int
TRACK_TORQUE: int
TRACK_KP: int
TRACK_KI: int
TRACK_KD: int
TRACK_POINTS: int
PLAN_POINTS_MAX: int
LIVE_KNOTS: int
COAST_KNOTS: int
COUNT_BITS: int
INTEGRAL_BITS: int
POINT_MAX: int
DIFFERENCE_MAX: int
TORQUE_MAX: int
DUTY_MAX: int
GATE_RESULTS: list[str]
STATES: list[str]

def siphash24(key: bytes, prefix: int, message: bytes) -> int: ...
def cobs_encode(packet: bytes, /) -> bytes: ...
def cobs_decode(packet: bytes, /) -> bytes | None: ...

class Session:
    """One end of an authenticated session."""

    sent: int
    received: int
    def __init__(self, key: bytes, number: int, at_device: bool = False) -> None: ...
    def seal(self, type: int, payload: bytes) -> bytes: ...
    def open(self, packet: bytes) -> tuple[int, bytes] | str:
        """The frame's type and payload, or the name of the error."""

def plan_encode(
    stamps_us: tuple[int, int, int],
    number: int,
    first_knot: int,
    tracks: dict[int, NDArray[np.int32]],
) -> bytes: ...
def plan_decode(
    payload: bytes,
) -> tuple[tuple[int, int, int], int, int, dict[int, NDArray[np.int32]]] | None:
    """Stamps, number, first knot and points by sink; None if malformed."""

def sync_encode(stamps_us: tuple[int, int, int]) -> bytes: ...
def status_decode(payload: bytes, /) -> Status | None: ...

class Status:
    """What a device tells, see status.h."""

    @property
    def sent_us(self) -> int: ...
    @property
    def state(self) -> int: ...
    @property
    def refusal(self) -> int: ...
    @property
    def synced(self) -> bool: ...
    @property
    def plan_seen(self) -> int: ...
    @property
    def plan_accepted(self) -> int: ...
    @property
    def accepted_mask(self) -> int: ...
    @property
    def torque_peak_tq(self) -> int: ...
    @property
    def torque_clipped(self) -> int: ...
    @property
    def plans_accepted(self) -> int: ...
    @property
    def plans_late(self) -> int: ...
    @property
    def plans_refused(self) -> int: ...
    @property
    def frames_bad(self) -> int: ...
    @property
    def coasts(self) -> int: ...
    @property
    def samples(self) -> list[tuple[int, int]]: ...

class Scale:
    """The factor mantissa / 2^shift; multiplies integers, rounding down."""

    def __init__(self, mantissa: int = 0, shift: int = 0) -> None: ...
    @property
    def mantissa(self) -> int: ...
    @property
    def shift(self) -> int: ...
    def __mul__(self, value: int, /) -> int: ...

class GateLimits:
    """Limits of one sink's control points, per knot interval."""

    def __init__(
        self,
        point_min: int,
        point_max: int,
        difference_max: int,
        second_difference_max: int,
    ) -> None: ...
    @property
    def point_min(self) -> int: ...
    @property
    def point_max(self) -> int: ...
    @property
    def difference_max(self) -> int: ...
    @property
    def second_difference_max(self) -> int: ...

class ServoSettings:
    """See servo.h."""

    kp_tq: Scale
    ki_tq: Scale
    kd_tq: Scale
    velocity_tq: Scale
    resistance_mV: Scale
    emf_mV: Scale
    emf_tq: Scale
    supply_duty: Scale
    torque_limit_tq: int
    integrate_running: bool
    def __init__(self) -> None: ...

class DeviceSettings:
    """What a board is flashed with, see device.h."""

    key: bytes
    session: int
    knot_shift: int
    servo_period_us: int
    sample_every: int
    servo: ServoSettings
    def __init__(self) -> None: ...
    def set_limits(self, sink: int, limits: GateLimits, /) -> None: ...
    def limits(self, sink: int, /) -> GateLimits: ...

class Track:
    """A uniform cubic B-spline on the knot grid."""

    def __init__(self) -> None: ...
    @property
    def written(self) -> bool: ...
    @property
    def end(self) -> int: ...
    def copy(self) -> Track: ...
    def write(self, first_knot: int, points: NDArray[np.int32]) -> None: ...
    def points(self, first_knot: int, count: int) -> NDArray[np.int32]: ...
    def evaluate(
        self, times_us: NDArray[np.int64], knot_shift: int
    ) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
        """Value, rate per knot and curve per knot squared at system times."""

def gate_check_track(
    limits: GateLimits, stored: Track, first_knot: int, points: NDArray[np.int32], knot: int
) -> str:
    """One of GATE_RESULTS."""

class Servo:
    """The servo's state; step() is one servo period and returns the duty."""

    integral: int
    def __init__(self) -> None: ...
    @property
    def torque_tq(self) -> int: ...
    @property
    def unclipped_tq(self) -> int: ...
    @property
    def saturated(self) -> bool: ...
    def step(
        self,
        settings: ServoSettings,
        position_pq: int,
        velocity_pq: int,
        torque_tq: int,
        encoder_count: int,
        integrate: bool = True,
    ) -> int: ...

class Clock:
    """The map from local count to system time."""

    skew_q32: int
    system_us: int
    count_us: int
    def __init__(self) -> None: ...
    @property
    def synced(self) -> bool: ...
    def advance(self, count_us: int, /) -> None: ...
    def at(self, count_us: int, /) -> int: ...
    def sample(self, offset_us: int, /) -> None: ...
