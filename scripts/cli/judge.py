"""What a run did that it should not have done, in sentences: an axis, a value, a limit, a time.

Every function gives a list that is empty if all is well. Times are seconds of the task.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.cli.summary import REST_MOVE, REST_SPEED, REST_WINDOW_S, judged
from headway.configs.schema import Config
from headway.controller.reference import ENTRY_S
from headway.devices.axis import AxisUnits, whole_turns
from headway.firmware import _core

Arrays = Mapping[str, NDArray[Any]]
Summary = Mapping[str, Any]
Bound = float | Mapping[str, float]  # for all axes, or by the joint's name

TOO_SHORT = f"nothing to judge: the first {ENTRY_S:g} s, from rest onto the reference, do not count"


def by_axis(name: str, bound: Bound | None, joints: Sequence[str]) -> dict[str, float]:
    """The bound of each joint that has one.

    Raises ValueError if there is no such joint, or a bound that nothing can be below.
    """
    if bound is None:
        return {}
    bounds = dict(bound) if isinstance(bound, Mapping) else dict.fromkeys(joints, bound)
    if not bounds:
        raise ValueError(f"{name}: there is no such axis")
    for joint, value in bounds.items():
        if joint not in joints:
            raise ValueError(f"{name}: {joint} is none of {', '.join(joints) or 'no axes'}")
        if not value > 0:
            raise ValueError(f"{name}: {joint} cannot be below {value!r}")
    return bounds


def beyond_limits(config: Config, arrays: Arrays, margin: float = 0.0) -> list[str]:
    """Where the true position or speed, or the torque that a device asked for, went too far.

    margin: share of each limit, and of the position's range at either end, that must stay free.
    """
    if not 0 <= margin < 0.5:
        raise ValueError(f"margin is a share from 0 to below 0.5 of each limit, not {margin!r}")
    found = []
    share, truth_s, servo_s = 1 - margin, arrays["truth_s"], arrays["servo_s"]
    for i, axis in enumerate(config.machine.axes):
        unit, tq = axis.unit, AxisUnits.of(axis, config.loop).tq_per_effort
        room = 0.0 if axis.continuous else margin * (axis.highest - axis.lowest)
        low, high, speed = axis.lowest + room, axis.highest - room, axis.velocity_limit
        effort_name = "torque" if unit == "rad" else "force"
        effort, effort_tq = share * axis.effort_limit, arrays["servo_torque_tq"][:, i]
        q, v = arrays["truth_position"][:, i], arrays["truth_velocity"][:, i]
        found += [
            f"{axis.joint}: {text}"
            for text in (
                *_beyond("position", unit, truth_s, q, low, high),
                *_beyond("velocity", f"{unit}/s", truth_s, v, -share * speed, share * speed),
                # As the device has it: rounded.
                *_beyond(
                    effort_name,
                    axis.effort_unit,
                    servo_s,
                    effort_tq / tq,
                    -round(effort * tq) / tq,
                    round(effort * tq) / tq,
                ),
            )
        ]
    return found


def _beyond(
    name: str, unit: str, time_s: NDArray[Any], values: NDArray[Any], low: float, high: float
) -> list[str]:
    """Where `values` leave low..high the furthest."""
    excess = np.maximum(low - values, values - high)
    if np.all(excess <= 0):
        return []
    worst = int(np.argmax(excess))
    side, limit = ("below", low) if values[worst] < low else ("above", high)
    return [f"{name} {values[worst]:.6g} {unit} at {time_s[worst]:.3f} s, {side} {limit:.6g}"]


def tracks_badly(
    config: Config,
    summary: Summary,
    arrays: Arrays,
    *,
    rms: dict[str, float],
    largest: dict[str, float],
) -> list[str]:
    """Where the tracking error of a joint, in mrad or mm as in the summary, is not below."""
    truth_s = arrays["truth_s"]
    in_task = judged(truth_s, arrays)
    if not np.any(in_task):
        return [TOO_SHORT]
    way = (arrays["truth_position"] - arrays["truth_reference"])[in_task]
    error = 1e3 * np.abs(way - whole_turns(config.machine.axes, way))
    found, tracking = [], summary["tracking"]
    for i, axis in enumerate(config.machine.axes):
        worst = int(np.argmax(error[:, i]))
        unit, when = tracking["unit"][i], f"at {truth_s[in_task][worst]:.3f} s"
        for which, bounds in (("rms", rms), ("max", largest)):
            value, bound = tracking[which][i], bounds.get(axis.joint)
            if bound is not None and not (value is not None and value < bound):
                at = when if which == "max" else f"(worst {when}: {error[worst, i]:.4g} {unit})"
                found.append(
                    f"{axis.joint}: {which} tracking error {value:.4g} {unit} {at}, "
                    f"not below {bound:g} {unit}"
                )
    return found


def estimates_badly(
    config: Config, summary: Summary, arrays: Arrays, *, rms_counts: dict[str, float]
) -> list[str]:
    """Where the estimated position at now is not close enough to the true one, in counts."""
    now_s, axes = arrays["now_s"], config.machine.axes
    in_task = judged(now_s, arrays)
    if not np.any(in_task):
        return [TOO_SHORT]
    way = (arrays["now_estimate"][:, : len(axes)] - arrays["actual_position"])[in_task]
    error = np.abs(way - whole_turns(axes, way))
    found = []
    for i, axis in enumerate(axes):
        value, bound = summary["estimate"]["rms_now"][i], rms_counts.get(axis.joint)
        if bound is None:
            continue
        per_count = AxisUnits.of(axis, config.loop).unit_per_count
        if not (value is not None and value / per_count < bound):
            worst = int(np.argmax(error[:, i]))
            found.append(
                f"{axis.joint}: rms error of the estimated position {value / per_count:.4g} counts "
                f"(worst at {now_s[in_task][worst]:.3f} s: {error[worst, i] / per_count:.4g} "
                f"counts), not below {bound:g} counts"
            )
    return found


def does_not_rest(config: Config, arrays: Arrays, within_s: float | None) -> list[str]:
    """Which axes do not hold and stand still at the end, or did so too late after the last tick."""
    truth_s, end_s = arrays["truth_s"], float(arrays["tick_s"][-1])
    window = truth_s >= truth_s[-1] - REST_WINDOW_S
    found = []
    for i, axis in config.machine.driven.items():
        position, unit = arrays["truth_position"][:, i], axis.unit
        speed = abs(float(np.mean(arrays["truth_velocity"][window, i])))
        moved = float(np.ptp(position[window]))
        state = _core.STATES[int(arrays["end_states"][-1, i])]
        if state != "HOLD":
            found.append(f"{axis.joint}: its device ends in {state}, not in HOLD")
        if not (speed < REST_SPEED[unit] and moved < REST_MOVE[unit]):
            found.append(
                f"{axis.joint}: still moves at {speed:.3g} {unit}/s at the end, at "
                f"{truth_s[-1]:.3f} s, not below {REST_SPEED[unit]:g}"
            )
        elsewhere = np.abs(position - position[-1]) >= REST_MOVE[unit]
        last_s = float(truth_s[elsewhere][-1]) if np.any(elsewhere) else end_s
        if within_s is not None and not last_s - end_s <= within_s:
            found.append(
                f"{axis.joint}: moves until {last_s:.3f} s, {last_s - end_s:.3f} s after the last "
                f"tick, not within {within_s:g} s"
            )
    return found


def deadlines_missed(config: Config, summary: Summary, arrays: Arrays) -> list[str]:
    """Ticks that were skipped, or too late to send their plan."""
    count, tick_s = summary["deadline_misses"], arrays["tick_s"]
    if not count:
        return []
    knot_s = config.loop.knot_us * 1e-6
    gaps_s = np.diff(tick_s)
    skipped_s = tick_s[:-1][gaps_s > 1.5 * knot_s] + knot_s
    missed_s = np.append(skipped_s, tick_s[~arrays["tick_in_time"]])
    when = f"the first at {np.min(missed_s):.3f} s" if len(missed_s) else "after the last tick"
    text = f"{count} {'deadline' if count == 1 else 'deadlines'} missed, not 0: {when}"
    if len(skipped_s):
        longest = int(np.argmax(gaps_s))
        text += (
            f"; at worst {1e3 * gaps_s[longest]:.1f} ms without a tick, at {tick_s[longest]:.3f} s"
        )
    return [text]


def plans_refused(config: Config, summary: Summary, arrays: Arrays) -> list[str]:
    """Plans that a device did not take, too late or refused by its gate."""
    total = summary["frames"]["late_points"] + summary["frames"]["gate_refused"]
    found, told = [], 0
    for i, axis in enumerate(config.machine.axes):
        rows = np.logical_and(arrays["received_device"] == i, arrays["received_status"])
        late, other = arrays["received_plans_late"][rows], arrays["received_plans_refused"][rows]
        if not np.any(late + other):
            continue
        late_told, other_told = int(np.max(late)), int(np.max(other))
        told += late_told + other_told
        first = int(np.argmax(late + other > 0))
        reason = _core.GATE_RESULTS[int(arrays["received_refusal"][rows][first])]
        found.append(
            f"{axis.joint}: {late_told + other_told} plans refused, not 0: {late_told} too late, "
            f"{other_told} for other reasons; the first, told at "
            f"{arrays['received_s'][rows][first]:.3f} s: {reason}"
        )
    if total > told:
        found.append(f"{total - told} plans refused that no status told of, not 0")
    return found
