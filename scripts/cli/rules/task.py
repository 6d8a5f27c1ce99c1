"""Rules of the task: whether the machine can do what is asked of it, and stop."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.interpolate import make_interp_spline

from headway.cli.rules.rule import Rule, Status, at_least, at_most, worst
from headway.cli.rules.subject import Subject
from headway.controller.ocp import ACCELERATION_SHARE, APPROACH_S, SPEED_SHARE, Limits
from headway.controller.ocp import STOP_SHARE as DECELERATION_SHARE
from headway.controller.reference import Custom

EFFORT_SHARE = 0.85  # of the limit; what is left corrects what the model does not know
STOP_SHARE = 0.6  # of the horizon: shorter ones cost tracking (docs/performance.md)
# The plan gives way to a reference that asks for more than there is; beyond this it is a mistake.
EFFORT_FAIL = 1.5
CONTACT_POSES = 500  # along the task


def task_rules(subject: Subject) -> Iterator[Rule]:
    """All of them."""
    yield from _costs(subject)
    yield _range(subject)
    yield _model_range(subject)
    yield _contacts(subject)
    yield from _hull(subject)
    yield from _soft_limits(subject)
    yield _effort(subject)
    yield _holding_start(subject)
    yield _holding(subject)
    yield _stop_from_limit(subject)
    yield _stop_from_task(subject)


def _costs(subject: Subject) -> Iterator[Rule]:
    """A custom task's file says what costs are."""
    if isinstance(subject.reference, Custom):
        name = "task: costs of its own"
        try:
            subject.reference.costs(subject.machine)
        except ValueError as error:
            yield Rule(name, Status.FAIL, remedy=str(error))
        else:
            yield Rule(name, Status.OK)


def _range(subject: Subject) -> Rule:
    """Start and task inside the range; beyond the room that plans keep to it they are cut."""
    name, limits, rules = "task: room to the position limits", Limits.of(subject.config), []
    for i, axis in enumerate(subject.axes):
        if axis.continuous:
            continue
        points = np.append(subject.motion.position[:, i], subject.start[i])
        low, high = float(limits.soft_min[i]), float(limits.soft_max[i])
        rules.append(
            at_least(
                name,
                float(min(points.min() - axis.lowest, axis.highest - points.max())),
                max(low - axis.lowest, axis.highest - high),
                axis.unit,
                f"{axis.joint} goes from {points.min():.4g} to {points.max():.4g} {axis.unit}; "
                f"plans keep to {low:.4g} to {high:.4g}: change task.axes.{i}, "
                f"sim.start_rad_or_m.{i} or the limits",
                axis.joint,
                fail=0.0,
            )
        )
    return worst(rules) if rules else Rule(name, Status.OK)


def _model_range(subject: Subject) -> Rule:
    """The config's range is not wider than the model's; an axis that turns for ever has none."""
    rules = []
    for axis, joint in zip(subject.axes, subject.joints, strict=True):
        if joint.position is None:
            continue
        low, high = joint.position
        ends = f"the model's joint ends at {low:.6g} and {high:.6g} {axis.unit}"
        if axis.continuous:
            remedy = f"{ends}: {axis.joint} is not continuous; give it position limits within"
            return Rule("range: beyond the model's", Status.FAIL, axis=axis.joint, remedy=remedy)
        beyond = max(low - axis.lowest, axis.highest - high)
        remedy = (
            f"{ends}: keep {axis.key('position_min')} and {axis.key('position_max')} of "
            f"{axis.joint} within"
        )
        tolerance = 1e-6 * (high - low)  # what is written with few digits
        name = "range: beyond the model's"
        rules.append(at_most(name, beyond, tolerance, axis.unit, remedy, axis.joint))
    return worst(rules) if rules else Rule("range: beyond the model's", Status.OK)


def _contacts(subject: Subject) -> Rule:
    """No two bodies meet on the way; the controller does not know of contacts."""
    motion = subject.motion
    step = max(1, len(motion.time_s) // CONTACT_POSES)
    met = subject.touching(motion.position[::step])
    where = [f"{pair} at {motion.time_s[row * step]:.3g} s" for pair, row in met.items()]
    name = "task: bodies that touch on the way"
    return at_most(name, len(met), 0, "pairs", f"{'; '.join(where)}: change task.axes")


def _hull(subject: Subject) -> Iterator[Rule]:
    """Speed and acceleration of the task's control points, which the gate bounds."""
    h = subject.config.loop.knot_us * 1e-6
    extra = 8  # knots on either side, where the spline's ends show
    count = int(subject.motion.time_s[-1] / h) + 2 * extra
    knots = np.arange(count, dtype=np.float64) - extra
    points = make_interp_spline(knots, subject.reference.at(knots * h)[0], k=3).c[extra:-extra]
    speed = np.abs(np.diff(points, axis=0)).max(axis=0) / h
    acceleration = np.abs(np.diff(points, n=2, axis=0)).max(axis=0) / h**2
    for what, per, values, key, share in (
        ("speed", "s", speed, "velocity_limit", SPEED_SHARE),
        ("acceleration", "s^2", acceleration, "acceleration_limit", ACCELERATION_SHARE),
    ):
        yield worst(
            at_most(
                f"task: {what} at the gate",
                float(values[i]),
                getattr(axis, key),
                f"{axis.unit}/{per}",
                f"a plan may use {share:g} of {axis.key(key)}: raise it, or lower "
                f"task.frequency_Hz or the amplitude in task.axes.{i}",
                axis.joint,
                warn=share,
            )
            for i, axis in subject.driven.items()
        )


def _soft_limits(subject: Subject) -> Iterator[Rule]:
    """Between two soft limits a plan is as fast as its distance to one over APPROACH_S; the device
    takes it if the axis could stop before the hard limit behind it."""
    rules = []
    for i, axis in subject.driven.items():
        if axis.soft_min is None or axis.soft_max is None:
            continue
        behind = min(axis.soft_min - axis.lowest, axis.highest - axis.soft_max)
        slowing = DECELERATION_SHARE * axis.deceleration
        lead = slowing * APPROACH_S
        rules.append(
            at_most(
                "soft limits: speed with room to stop behind them",
                float(np.abs(subject.motion.velocity[:, i]).max()),
                float(lead + np.sqrt(lead**2 + 2 * slowing * behind)),
                f"{axis.unit}/s",
                f"plans that bring {axis.joint} near a soft limit faster than that are refused: "
                f"move its soft limits away from the position limits, raise "
                f"{axis.key('stop_deceleration')}, or leave one soft limit out, for plans that "
                "slow down earlier",
                axis.joint,
                fail=np.inf,
            )
        )
    if rules:
        yield worst(rules)


def _effort(subject: Subject) -> Rule:
    """Inverse dynamics along the task."""
    peak = np.abs(subject.motion.effort).max(axis=0)
    return worst(
        at_most(
            "task: effort along it",
            float(peak[i]),
            axis.effort_limit,
            axis.effort_unit,
            f"more than {EFFORT_SHARE:g} of {axis.key('effort_limit')}: the plan gives way where "
            "there is not enough; raise it, or lower task.frequency_Hz",
            axis.joint,
            warn=EFFORT_SHARE,
            fail=EFFORT_FAIL,
        )
        for i, axis in subject.driven.items()
    )


def _holding_start(subject: Subject) -> Rule:
    """Gravity where the task starts; what cannot be held there falls when the brakes let go."""
    still = np.zeros((1, len(subject.axes)))
    load = np.abs(subject.effort(subject.start[None], still, still)[0])
    return worst(
        at_most(
            "start: effort to hold it",
            float(load[i]),
            axis.effort_limit,
            axis.effort_unit,
            f"raise {axis.key('effort_limit')}, or start where {axis.joint} carries less",
            axis.joint,
            warn=EFFORT_SHARE,
        )
        for i, axis in subject.driven.items()
    )


def _holding(subject: Subject) -> Rule:
    """Gravity anywhere in the range: a warning, since the task may stay where it can be held."""
    load = subject.envelope.holding_max
    return worst(
        at_most(
            "range: effort to hold any pose",
            float(load[i]),
            axis.effort_limit,
            axis.effort_unit,
            f"{axis.joint} cannot be held everywhere: raise {axis.key('effort_limit')}, or keep "
            "away from such poses by soft limits",
            axis.joint,
            warn=EFFORT_SHARE,
            fail=np.inf,
        )
        for i, axis in subject.driven.items()
    )


def _stop_from_limit(subject: Subject) -> Rule:
    """From the speed limit at the plan's acceleration limit."""
    horizon_s = subject.config.mpc.horizon_us * 1e-6
    return worst(
        at_most(
            "horizon: to stop from the speed limit",
            axis.velocity_limit / (ACCELERATION_SHARE * axis.acceleration_limit),
            horizon_s,
            "s",
            f"lengthen mpc.horizon_us, or lower {axis.key('velocity_limit')} or raise "
            f"{axis.key('acceleration_limit')} of {axis.joint}",
            axis.joint,
        )
        for axis in subject.driven.values()
    )


def _stop_from_task(subject: Subject) -> Rule:
    """From the task's motion, within the effort limits and against gravity."""
    return at_most(
        "horizon: to stop from the task",
        subject.stop_s(),
        subject.config.mpc.horizon_us * 1e-6,
        "s",
        "lengthen mpc.horizon_us (and mpc.intervals), lower task.frequency_Hz, or raise the "
        "effort limits",
        warn=STOP_SHARE,
    )
