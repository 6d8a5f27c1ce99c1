"""Why a device stopped, in words and in the axis' units."""

from __future__ import annotations

import math
from collections.abc import Collection

from headway.configs.axis import Axis
from headway.devices.axis import AxisUnits
from headway.firmware import _core

STATES, REASONS = _core.STATES, _core.REASONS
IDLE = STATES.index("IDLE")
MOVING = {STATES.index(name) for name in ("RUNNING", "COAST")}
LIMIT_MAX_US = 1_000_000  # of sync.limit_us: configs/schema.py

_TEXTS = {
    "HOST": "the host said stop",
    "SYNC_LOST": "no sign of the host's time for {value} us; device.sync_lost_us is {limit}",
    "CLOCK": "its clock may be off by more than sync.limit_us, which is {limit} us",
    "GAP": "a plan left {value} knots open",
    "GAP_FAULT": "a plan left {value} knots open",
    "FOLLOWING": "following error {value:.4g} {unit}, allowed {limit:.4g}",
    "SPEED": "speed {value:.4g} {unit}/s, allowed {limit:.4g}",
    "ROOM": "at {value:.4g} {unit} too fast to stop before {limit:.4g}",
    "TORQUE": "at its effort limit for {value} servo periods, allowed {limit}",
    "HOMING": "no mark within {limit} counts",
    "OUTSIDE": "at {value:.4g} {unit} and moving on outwards; its last limit is {limit:.4g}",
    "I2T": "the motor was overloaded for too long: {value} of {limit}",
    "WINDING": "the winding is too hot: {value:.0%} of the rated rise, allowed {limit:.0%}",
    "UNDERVOLTAGE": "the supply is at {value:.3g} V, at least {limit:.3g} are needed",
    "OVERVOLTAGE": "the supply is at {value:.3g} V, at most {limit:.3g} are allowed",
    "LATE": "its servo ran {value} us late, allowed {limit}",
    "STUCK": "its encoder stands still",
    "REVERSED": "{value:.4g} {unit} from its setpoint and leaving it against its motor: the "
    "encoder counts backwards, or the load is too strong",
    "SPIKE": "its encoder jumped by {value} counts, possible are {limit}",
    "SETTINGS": "it has no good settings",
}


def fit_states(axis: Axis) -> Collection[int]:
    """Those in which the device does its part: executes plans, or tells where a passive axis is."""
    return (IDLE,) if axis.passive else MOVING


def why(status: _core.Status, axis: Axis, units: AxisUnits, servo_period_us: int) -> str:
    """Why the device does not do its part."""
    state, reason = STATES[status.state], REASONS[status.reason]
    if state == "ESTOP":
        return "the emergency line is open"
    if state in ("BOOT", "UNSYNCED", "IDLE"):
        return "the device has restarted"
    if reason == "NONE":
        return "the device came to rest and holds: no plan reached it in time"
    told = words(reason, status.reason_value, status.reason_limit, axis, units, servo_period_us)
    if reason == "CLOCK":
        told = f"{told}: {_remedy(status)}"
    return f"the device stopped: {told}"


def words(
    reason: str, value: float, limit: float, axis: Axis, units: AxisUnits, servo_period_us: int
) -> str:
    """A reason with its two numbers, which are the board's integers."""
    per = {
        "FOLLOWING": units.pq_per_unit,
        "REVERSED": units.pq_per_unit,
        "ROOM": units.pq_per_unit,
        "OUTSIDE": units.pq_per_unit,
        "SPEED": units.pq_per_unit * servo_period_us * 1e-6,
        "WINDING": 65536.0,
        "UNDERVOLTAGE": 1e3,
        "OVERVOLTAGE": 1e3,
    }.get(reason)
    if per is not None:
        value, limit = value / per, limit / per
    return _TEXTS[reason].format(value=value, limit=limit, unit=axis.unit)


def _remedy(status: _core.Status) -> str:
    """What to do about a clock that may be off by too much: by what it told, there and now."""
    worst_us = max(-status.least_error_ns, status.most_error_ns, 1000 * status.reason_value) / 1000
    if worst_us > LIMIT_MAX_US:
        return "what it is told of the time contradicts itself (docs/time.md)"
    room_us = min(math.ceil(2 * worst_us / 100) * 100, LIMIT_MAX_US)
    return (
        f"it may be {worst_us:.0f}. Where that is the wire or a busy computer, allow it twice as "
        f"much: sync.limit_us={room_us}, for the plant and for the controller"
    )
