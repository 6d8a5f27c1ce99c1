"""The firmware core: codec, gate, tracks, servo and clock, as the board runs them (module.cpp)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FRAME_SYNC: int
FRAME_PLAN: int
FRAME_STATUS: int
FRAME_COMMAND: int
FRAME_FAULTS: int
FRAME_HELLO: int
FRAME_WELCOME: int
FRAME_GROUP: int
FRAME_SETTINGS: int
FRAME_WINDOW: int
INBOX_PACKETS: int
OFFER_PAUSE_US: int
OFFER_VALID_US: int
NAME_MAX: int
TRACK_POSITION: int
TRACK_TORQUE: int
TRACK_KP: int
TRACK_KI: int
TRACK_KD: int
TRACK_POINTS: int
PLAN_POINTS_MAX: int
PACKET_MAX: int  # bytes on the wire, without an ending zero
FRAME_VERSION: int
LIVE_KNOTS: int
COAST_KNOTS: int
MARK_OPEN: int
COUNT_BITS: int
INTEGRAL_BITS: int
POINT_MAX: int
DIFFERENCE_MAX: int
TORQUE_MAX: int
DUTY_MAX: int
GATE_RESULTS: list[str]
STATES: list[str]
EVENTS: list[str]
REASONS: list[str]
RESPONSES: list[str]
COMMANDS: list[str]
COMMAND_RESULTS: list[str]
GAP_POLICIES: list[str]
HOME_METHODS: list[str]

def siphash24(key: bytes, prefix: int, message: bytes) -> int: ...
def cobs_encode(packet: bytes, /) -> bytes: ...
def cobs_decode(packet: bytes, /) -> bytes | None: ...
def frame_header(packet: bytes) -> tuple[int, int, int, int] | None:
    """Version, type, session and counter that a packet claims, authentic or not; None if it is too
    short or no packet. Of HELLO and WELCOME only version and type mean anything."""

class Session:
    """One end of an authenticated session, or of a group."""

    sent: int
    received: int
    def __init__(
        self, send_key: bytes, receive_key: bytes, number: int, at_device: bool = False
    ) -> None: ...
    @property
    def number(self) -> int: ...
    @property
    def send_key(self) -> bytes: ...
    @property
    def receive_key(self) -> bytes: ...
    def seal(self, type: int, payload: bytes) -> bytes:
        """A packet. Raises ValueError for a payload of more than 1000 bytes, OverflowError when the
        counters are used up."""

    def seal_group(self, group: Session) -> bytes:
        """A packet that gives the device the group's key, masked."""

    def open(self, packet: bytes) -> tuple[int, bytes] | str:
        """The frame's type and payload, or the name of the error."""

def crc_of(bytes: bytes, /) -> int: ...
def hello(host_nonce: bytes) -> bytes:
    """The packet of a HELLO with a nonce of 16 bytes, see handshake.h."""

def welcome(key: bytes, host_nonce: bytes, device_nonce: bytes) -> bytes:
    """The packet of a device's answer."""

def welcome_open(
    key: bytes, host_nonce: bytes, packet: bytes
) -> tuple[str, bytes | None, Session | None]:
    """A host's verdict on an answer: "ok" with the device's nonce and the session, or why not."""

def plan_encode(
    stamps_us: tuple[int, int, int],
    number: int,
    epoch: int,
    first_knot: int,
    tracks: dict[int, NDArray[np.int32]],
    mark: tuple[int, int, int] = ...,
) -> bytes: ...
def plan_decode(
    payload: bytes,
) -> tuple[tuple[int, int, int], int, int, int, dict[int, NDArray[np.int32]]] | None:
    """Stamps, number, epoch, first knot and points by sink; None if malformed."""

def command_encode(number: int, kind: int, argument: int = 0, epoch: int = 0) -> bytes: ...
def command_decode(payload: bytes, /) -> tuple[int, int, int, int] | None:
    """Number, kind, argument and epoch; None if malformed."""

def faults_decode(payload: bytes, /) -> list[Fault] | None:
    """The fault log, oldest first; None if malformed."""

def next_state(state: int, event: int, /) -> int:
    """The state after an event, see states.c."""

def gap_policy_valid(sink: int, policy: int, carries_gravity: bool, /) -> bool: ...
def fault_response(reason: int, /) -> int: ...

class Fault:
    """Why a device stopped, see fault.h."""

    @property
    def reason(self) -> int: ...
    @property
    def state(self) -> int: ...
    @property
    def boots(self) -> int: ...
    @property
    def time_us(self) -> int: ...
    @property
    def value(self) -> int: ...
    @property
    def limit(self) -> int: ...
    @property
    def position_pq(self) -> int: ...
    @property
    def torque_tq(self) -> int: ...

def sync_encode(stamps_us: tuple[int, int, int], mark: tuple[int, int, int] = ...) -> bytes: ...
def status_decode(payload: bytes, /) -> Status | None: ...

class Status:
    """What a device tells, see status.h."""

    @property
    def sent_us(self) -> int: ...
    @property
    def sent_count_us(self) -> int: ...
    @property
    def least_error_ns(self) -> int: ...
    @property
    def most_error_ns(self) -> int: ...
    @property
    def rate_q32(self) -> int: ...
    @property
    def heard_us(self) -> int: ...
    @property
    def mark(self) -> tuple[int, int, int]:
        """Number, width and least time [us]; a width of MARK_OPEN: it is not known."""

    @property
    def heard_age_us(self) -> int: ...
    @property
    def stamps_excluded(self) -> int: ...
    @property
    def state(self) -> int: ...
    @property
    def refusal(self) -> int: ...
    @property
    def synced(self) -> bool: ...
    @property
    def homed(self) -> bool: ...
    @property
    def released(self) -> bool: ...
    @property
    def grouped(self) -> bool: ...
    @property
    def epoch(self) -> int: ...
    @property
    def command_number(self) -> int: ...
    @property
    def command_result(self) -> int: ...
    @property
    def holding_tq(self) -> int: ...
    @property
    def fault(self) -> Fault: ...
    @property
    def reason(self) -> int: ...
    @property
    def reason_value(self) -> int: ...
    @property
    def reason_limit(self) -> int: ...
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
        stop_difference: int = 0,
        continuous: bool = False,
    ) -> None: ...
    @property
    def continuous(self) -> bool: ...
    @property
    def point_min(self) -> int: ...
    @property
    def point_max(self) -> int: ...
    @property
    def difference_max(self) -> int: ...
    @property
    def second_difference_max(self) -> int: ...
    @property
    def stop_difference(self) -> int: ...

class ServoSettings:
    """See servo.h."""

    kp_tq: Scale
    ki_tq: Scale
    kd_tq: Scale
    velocity_tq: Scale
    acceleration_tq: Scale
    resistance_mV: Scale
    emf_mV: Scale
    emf_tq: Scale
    supply_duty: Scale
    torque_limit_tq: int
    integrate_running: bool
    ahead_us: int
    def __init__(self) -> None: ...

class MonitorSettings:
    """See monitor.h."""

    following_pq: int
    following_periods: int
    speed_pq: int
    low_pq: int
    high_pq: int
    deceleration_q16: int
    torque_periods: int
    overload: int
    heating_q16: int
    rise_q16: int
    stuck_pq: int
    stuck_periods: int
    spike_counts: int
    supply_min_mV: int
    supply_max_mV: int
    chopper_mV: int
    late_us: int
    bounded: bool
    load_q8: Scale
    def __init__(self) -> None: ...

class HomeSettings:
    """See home.h."""

    method: int
    mark_count: int
    speed_q16: int
    acceleration_q16: int
    torque_tq: int
    way_counts: int
    still_periods: int
    backwards: bool
    def __init__(self) -> None: ...

class DeviceSettings:
    """What a board is flashed with, see settings.h."""

    key: bytes
    knot_shift: int
    servo_period_us: int
    sample_every: int
    name: str
    brake_periods: int
    stop_us: int
    sync_lost_us: int
    dither_us: int
    torque_step_tq: int
    knot_periods: Scale
    offset_count: int
    step_least_q16: int
    carries_gravity: bool
    servo: ServoSettings
    monitor: MonitorSettings
    home: HomeSettings
    sync: SyncSettings
    peer_key: bytes
    neighbours: int
    ask_us: int
    peer_least_us: int
    @property
    def valid(self) -> bool: ...
    def __init__(self) -> None: ...
    def set_limits(self, sink: int, limits: GateLimits, /) -> None: ...
    def limits(self, sink: int, /) -> GateLimits: ...
    def set_gap_policy(self, sink: int, policy: int, /) -> None: ...
    def gap_policy(self, sink: int, /) -> int: ...
    def encode(self, with_key: bool = False) -> bytes:
        """As in a SETTINGS frame; with the key as in memory."""

    @staticmethod
    def decode(bytes: bytes, with_key: bool = False) -> DeviceSettings | None:
        """None if they are no settings. Without a key in the bytes it is zero."""

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
    def past(self, time_us: int, knot_shift: int) -> int | None:
        """The value at a past system time; None if it is not there any more or never was."""

    def evaluate(
        self, times_us: NDArray[np.int64], knot_shift: int
    ) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
        """Value, rate per knot and curve per knot squared at system times."""

def track_points(tracks: Sequence[Track], first_knot: int, count: int) -> NDArray[np.int32]:
    """Control points of k tracks: (k, count)."""

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
    """The map from local count to system time, see clock.h."""

    rate_q32: int
    def __init__(self, count_us: int = 0) -> None: ...
    @property
    def system_us(self) -> int: ...
    @property
    def fraction_q32(self) -> int: ...
    @property
    def count_us(self) -> int: ...
    @property
    def ticks_us(self) -> int: ...
    def advance(self, count_us: int, /) -> None: ...
    def at(self, count_us: int, /) -> int: ...
    def ticks(self, count_us: int, /) -> int: ...
    def offset_q16(self, base_us: int, /) -> int: ...
    def set(self, base_us: int, offset_q16: int, /) -> None: ...

class SyncSettings:
    """How a clock is synchronized, see sync.h."""

    method: int
    among_boards: bool
    drift_ppm: int
    wander_ppb_s: int
    to_device_least_us: int
    to_host_least_us: int
    limit_us: int
    interval_us: int
    phase_gain: int
    skew_gain_q8: int
    def __init__(self) -> None: ...

class Sync:
    """A clock and what keeps it synchronized, see sync.h."""

    def __init__(self, settings: SyncSettings, count_us: int = 0) -> None: ...
    @property
    def clock(self) -> Clock: ...
    @property
    def settled(self) -> bool: ...
    @property
    def excluded(self) -> int: ...
    @property
    def outcast(self) -> int: ...
    @property
    def least_error_ns(self) -> int: ...
    @property
    def most_error_ns(self) -> int: ...
    @property
    def error_us(self) -> int: ...
    def restart(self) -> None: ...
    def take(
        self,
        stamps_us: tuple[int, int, int],
        arrived_us: int,
        now_us: int,
        may_step: bool = True,
        least_error_ns: int = 0,
        most_error_ns: int = 0,
    ) -> bool:
        """Takes (echo, received, sent) that arrived at a count, of a clock that may itself err;
        False if they are not taken."""

    def steer(self, count_us: int, may_step: bool) -> bool:
        """Advances and steers the clock; True if it stepped."""

    def follow(
        self,
        count_us: NDArray[np.uint32],
        arrived_us: NDArray[np.uint32],
        echo_us: NDArray[np.uint32],
        received_us: NDArray[np.int64],
        sent_us: NDArray[np.int64],
        may_step: bool = True,
    ) -> tuple[
        NDArray[np.int64],
        NDArray[np.uint32],
        NDArray[np.int32],
        NDArray[np.int32],
        NDArray[np.uint8],
    ]:
        """Row by row: advances to a count, takes the stamps if sent_us is not 0, steers. Tells
        system_us, fraction_q32, least_error_ns, most_error_ns and settled after each row. Steps
        only until it has settled. Raises ValueError for columns of unequal length."""

class Observation:
    """What one servo period found, see monitor.h."""

    count: int
    position_pq: int
    setpoint_pq: int
    error_pq: int
    torque_tq: int
    torque_limit_tq: int
    feedback_tq: int
    clipped: bool
    supply_mV: int
    late_us: int
    power: bool
    driven: bool
    bounded: bool
    may_stand: bool
    looks: int
    heat_shift: int
    stuck_periods: int
    def __init__(self) -> None: ...

class Monitor:
    """The monitor's state; step() is one servo period and tells the breach."""

    def __init__(self) -> None: ...
    @property
    def chopper(self) -> bool: ...
    @property
    def rise_q16(self) -> int: ...
    @property
    def overload(self) -> int: ...
    @property
    def speed_pq(self) -> int: ...
    def begin(self) -> None: ...
    def step(self, settings: MonitorSettings, seen: Observation) -> tuple[int, int, int]:
        """Reason, value and limit; reason 0 if there is no breach."""

class Stepper:
    """Step and direction pulses along a setpoint, see stepper.h."""

    def __init__(self, position_pq: int) -> None: ...
    def step(self, least_q16: int, target_pq: int, window_us: int) -> tuple[int, int, int]:
        """One window's steps, when the first comes and then each [1/65536 us]."""

    def shift(self, by_count: int, /) -> None: ...
    @property
    def count(self) -> int: ...
    @property
    def target_pq(self) -> int: ...
    @property
    def now_pq(self) -> int: ...

class Ramp:
    """The stop ramp; step() is one servo period."""

    def __init__(
        self, position_pq: int, velocity_pq: int, torque_tq: int, end_torque_tq: int
    ) -> None: ...
    @property
    def position_pq(self) -> int: ...
    @property
    def velocity_pq(self) -> int: ...
    @property
    def position_q16(self) -> int: ...
    @property
    def velocity_q16(self) -> int: ...
    @property
    def torque_tq(self) -> int: ...
    @property
    def resting(self) -> bool: ...
    def step(self, deceleration_q16: int, torque_step_tq: int, /) -> None: ...

FRAME_SIGNALS: int
FRAME_LOGIC: int
FRAME_READINGS: int
PIECES: int
PIECE_LONGEST_US: int
BATCH_PIECES: int
GRAPH_NODES: int
READINGS: int
SOURCE_OF_PIECES: int
SOURCE_OF_INPUTS: int
SOURCE_OF_NODES: int
SOURCE_UNUSED: int
INPUTS: list[str]
NODE_KINDS: list[str]
FEED_KINDS: list[str]
LOGIC_FEEDS: int
FEED_UNKNOWN_MS: int
FRAME_FEED: int
TRIGGER_KINDS: list[str]

# Start [us], end [us], first value, last value; what is None goes on from the piece before.
_Piece = tuple[int | None, int, int | None, int]
_Node = tuple[int, int, int, int, int]  # kind, a, b, low, high
_Trigger = tuple[int, int, int, int]  # kind, source, condition, every
_Feed = tuple[int, int, int, int, int]  # kind, source, number, every, after_us
_Fed = tuple[int, int]  # track, number of the feed

def batch_encode(base_us: int, seen: int, pieces: list[tuple[int, int, _Piece]]) -> bytes:
    """A SIGNALS payload; a piece with track and number. Raises ValueError if it does not fit."""

def logic_encode(
    number: int,
    nodes: list[_Node],
    digital: list[int],
    pwm: list[int],
    triggers: list[_Trigger],
    feeds: list[_Feed] = ...,
    fed: list[_Fed] = ...,
) -> bytes:
    """A LOGIC payload. Raises ValueError for more than a device has."""

def logic_check(
    nodes: list[_Node],
    digital: list[int],
    pwm: list[int],
    triggers: list[_Trigger],
    feeds: list[_Feed] = ...,
    fed: list[_Fed] = ...,
    knot_shift: int = 15,
) -> tuple[str, int]:
    """What a device would say: "good", or what is wrong and with which; nodes are counted first,
    then digital outputs, PWM outputs, triggers, feeds and fed tracks. `knot_shift`: of the device;
    with the longest knots, 15, tracks of motion reach back the longest. Raises ValueError for one
    that is none."""

class Report:
    """A READINGS payload, see report.h."""

    @property
    def logic(self) -> int: ...
    @property
    def result(self) -> str: ...
    @property
    def wrong(self) -> int: ...
    @property
    def next(self) -> list[int]: ...
    @property
    def refused(self) -> int: ...
    @property
    def late(self) -> int: ...
    @property
    def gaps(self) -> int: ...
    @property
    def kept(self) -> int: ...
    @property
    def first(self) -> int: ...
    @property
    def readings(self) -> list[tuple[int, int, int]]:
        """Time [us], value, trigger."""

def report_decode(payload: bytes) -> Report | None: ...

class Pieces:
    """A track of pieces, see piece.h."""

    def __init__(self) -> None: ...
    @property
    def next(self) -> int: ...
    def take(self, number: int, piece: _Piece, now_us: int) -> str: ...
    def at(self, time_us: int) -> int: ...
    def past(self, time_us: int) -> int | None:
        """The same; None where no piece reaches back to."""

    def now(self, time_us: int, /) -> int: ...

class Graph:
    """Nodes that are good; step() is one servo period and tells their values."""

    def __init__(self, nodes: list[_Node]) -> None: ...
    def step(self, values: list[int]) -> list[int]: ...
