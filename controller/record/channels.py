"""The channels of a record: what is in each message, in which unit. The one definition.

The schemas inside run.mcap, the packing of rows, the names of the arrays and the table in
docs/record.md all come from here. Every message also has a time: system time, in MCAP's log time.
A field keeps its number, its place in the list, for good: new ones go to the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from headway.devices.core import STATES

# vector: one number for each axis or state, as many in every message of a run; list: any number.
Kind = Literal["double", "int", "bool", "bytes", "double vector", "int vector", "int list"]


@dataclass(frozen=True)
class Field:
    """One field of a channel's messages."""

    name: str
    kind: Kind
    unit: str  # "" for what has none
    about: str


@dataclass(frozen=True)
class Channel:
    """Messages of one kind."""

    name: str
    about: str
    fields: tuple[Field, ...]
    deterministic: bool = True  # the same config and seed give the same messages


def _channel(name: str, about: str, *fields: Field, deterministic: bool = True) -> Channel:
    return Channel(name, about, fields, deterministic)


_STATES = ", ".join(f"{number} {name}" for number, name in enumerate(STATES))
_SI, _SPEED, _EFFORT = "rad or m", "rad/s or m/s", "Nm or N"
_ESTIMATE = (
    Field("estimate", "double vector", f"{_SI}; .../s; {_EFFORT}", "[q, v, d], d: disturbance"),
    Field("covariance", "double vector", "", "of the estimate, row by row"),
)

_ALL = (
    _channel(
        "received",
        "A packet from a device, at its arrival, and the status in it",
        Field("device", "int", "", "index of the axis"),
        Field("status", "bool", "", "authentic and a status; if not, all but the packet is 0"),
        Field("packet", "bytes", "", "as it arrived"),
        Field("sent_us", "int", "us", "when it left, by the device's clock"),
        Field("state", "int", "", _STATES),
        Field("refusal", "int", "", "why the last refused plan was refused, as in firmware/gate.h"),
        Field("synced", "bool", "", "the device's clock has settled"),
        Field("homed", "bool", "", "the axis knows where it is"),
        Field("epoch", "int", "", "of the plans that the device takes"),
        Field("command_number", "int", "", "last command"),
        Field("command_result", "int", "", "what became of it, as in firmware/command.h"),
        Field("reason", "int", "", "why it stopped last, as in firmware/fault.h"),
        Field("reason_value", "int", "", "what was found then"),
        Field("reason_limit", "int", "", "and what is allowed"),
        Field("plan_seen", "int", "", "highest plan number that arrived"),
        Field("plan_accepted", "int", "", "last plan accepted"),
        Field("accepted_mask", "int", "", "bit i: plan plan_seen - i was accepted"),
        Field("torque_peak_tq", "int", "tq", "largest torque asked for since the last status"),
        Field("torque_clipped", "int", "", "servo periods at the torque limit, ever"),
        Field("plans_accepted", "int", "", "ever"),
        Field("plans_late", "int", "", "refused since a live point would have changed, ever"),
        Field("plans_refused", "int", "", "refused for other reasons, ever"),
        Field("frames_bad", "int", "", "not authentic, malformed or replayed, ever"),
        Field("coasts", "int", "", "times the plans stopped coming, ever"),
        Field("sample_time_us", "int list", "us", "the samples' stamps"),
        Field("sample_count", "int list", "counts", "the encoder at those times"),
        Field("least_error_ns", "int", "ns", "its clock minus the host's is at least this ..."),
        Field("most_error_ns", "int", "ns", "... and at most this, as far as it knows"),
        Field("rate_q32", "int", "2^-32", "its clock's rate over its oscillator's, minus one"),
        Field("stamps_excluded", "int", "", "contradicted what it knew of the host's time, ever"),
    ),
    _channel(
        "sent",
        "A frame to a device, when it was sent",
        Field("device", "int", "", "index of the axis"),
        Field(
            "plan", "bool", "", "a plan; if not, stamps alone: the fields after the packet are 0"
        ),
        Field("packet", "bytes", "", "as it was sent"),
        Field("number", "int", "", "the plan's"),
        Field("first_knot", "int", "knots", "where the points begin"),
        Field("position_pq", "int list", "count/1024", "control points of the position"),
        Field("torque_tq", "int list", "tq", "control points of the torque or force"),
    ),
    _channel(
        "startup",
        "A tick before the task: the clocks settle, the brakes let go",
        Field(
            "phase",
            "int",
            "",
            "0 hello, 1 the clocks settle, 2 the load is taken, 3 a plan is under way",
        ),
        Field("states", "int vector", "", "of the devices, as in received"),
    ),
    _channel(
        "task",
        "The task begins",
        Field("start_us", "int", "us", "system time of the task's time zero"),
    ),
    _channel(
        "tick",
        "A tick of the task, at its now",
        Field("sent_us", "int", "us", "when its frames were sent"),
        Field("in_time", "bool", "", "early enough for its plan; if not, stamps alone were sent"),
        Field("accepted", "bool", "", "a new plan passed all checks"),
        Field("samples", "int", "", "that came in since the last tick"),
        Field("states", "int vector", "", "of the devices, as in received"),
        Field(
            "encoding_error",
            "double vector",
            _EFFORT,
            "largest |encoded - planned|; NaN: not a whole plan",
        ),
        Field("planned_torque", "double vector", _EFFORT, "largest |planned|; NaN: no plan"),
    ),
    _channel("now", "The state at a tick's now", *_ESTIMATE),
    _channel("commit", "The state at the commit knot, predicted by the tick before it", *_ESTIMATE),
    _channel(
        "solver",
        "What the solver did in a tick",
        Field("status", "int", "", "the solver's; OSQP: 1 solved, 2 inaccurate, 7 at its cap"),
        Field("usable", "bool", "", "the answer passed our checks"),
        Field("iterations", "int", "", ""),
        Field("residual", "double", "", "of the constraints, in parts of what is allowed"),
        Field(
            "stationarity",
            "double",
            "cost per SI unit",
            "largest slope of the Lagrangian by a state or torque; NaN: no answer",
        ),
        Field(
            "complementarity",
            "double",
            "cost",
            "largest product of a multiplier and the distance from its limit; NaN: no answer",
        ),
        Field("assumed", "double vector", _EFFORT, "disturbance, as known when it was linearized"),
        Field("committed", "double vector", _EFFORT, "torque that the plan goes on from"),
    ),
    _channel(
        "timing",
        "Computing times of a tick by the wall clock: no part of log_sha256",
        Field("compute_us", "double", "us", "the whole tick"),
        Field("estimate_us", "double", "us", "filter and prediction"),
        Field("prepare_us", "double", "us", "model and factors, before it; NaN: no solver"),
        Field("solve_us", "double", "us", "the solver and our check; NaN: no solver"),
        Field("encode_us", "double", "us", "reference, tracks and gate"),
        deterministic=False,
    ),
    _channel(
        "outlier",
        "A sample that the simulator replaced by nonsense before a tick saw it",
        Field("index", "int", "", "among the samples that the tick had"),
        Field("sample_time_us", "int", "us", "its stamp"),
        Field("axis", "int", "", "index of the axis"),
        Field("position", "double", _SI, "what the controller saw"),
    ),
    _channel(
        "truth",
        "The simulated machine, every millisecond",
        Field("position", "double vector", _SI, "of the axes"),
        Field("velocity", "double vector", _SPEED, "of the axes"),
        Field("torque", "double vector", _EFFORT, "of motor and brake, at the joint"),
        Field("reference", "double vector", _SI, "the task's position"),
    ),
    _channel(
        "actual",
        "The simulated machine at a tick's now",
        Field("position", "double vector", _SI, "of the axes"),
        Field("velocity", "double vector", _SPEED, "of the axes"),
    ),
    _channel(
        "servo",
        "The simulated devices' servos, every millisecond",
        Field("setpoint_pq", "int vector", "count/1024", "position of the track"),
        Field("setpoint_rate_pq", "int vector", "count/1024 per knot", "its rate"),
        Field("setpoint_torque_tq", "int vector", "tq", "torque or force of the track"),
        Field("torque_tq", "int vector", "tq", "asked of the motor"),
        Field("unclipped_tq", "int vector", "tq", "the same before the torque limit"),
        Field("clock_error_us", "int vector", "us", "the device's clock minus the host's"),
    ),
    _channel(
        "entry",
        "A way onto the task's reference begins, from where the machine rests",
        Field("start_s", "double", "s", "its time in the task"),
        Field("position", "double vector", _SI, "of the axes"),
        Field("torque", "double vector", _EFFORT, "that holds them there"),
    ),
    _channel(
        "refused",
        "The host's own gate refuses a tick's new plan",
        Field("axis", "int", "", "the first that it refuses, by its index"),
        Field("sink", "int", "", "the track: 0 position, 1 torque, 2 to 4 gains"),
        Field("result", "int", "", "the check that failed, as in firmware/gate.h"),
        Field("share", "double", "", "of the way to it, which is sent in its place; or 0"),
    ),
    _channel(
        "end",
        "The simulated machine at rest: the run is over",
        Field("ticks", "int", "", "of the task"),
        Field("deadline_misses", "int", "", "ticks skipped, or too late for their plan"),
        Field("frames_sent", "int", "", "to the devices, during the task"),
        Field("frames_lost", "int", "", "of these"),
        Field(
            "plans_late", "int", "", "refused by all devices since a live point would have changed"
        ),
        Field("plans_refused", "int", "", "refused by all devices for other reasons"),
        Field("states", "int vector", "", "of the devices, as in received"),
    ),
)

CHANNELS = {channel.name: channel for channel in _ALL}
