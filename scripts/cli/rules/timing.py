"""Rules of the loop's timing and of what fits a frame."""

from __future__ import annotations

from collections.abc import Iterator

from headway.cli.rules.rule import Rule, Status, at_least, at_most
from headway.cli.rules.subject import Subject
from headway.controller.equations import COULOMB_SPEED
from headway.controller.loop import plan_points
from headway.controller.prediction import ServoLaw
from headway.devices.axis import AxisUnits, gain_limits, position_limits, torque_limits
from headway.devices.core import PLAN_POINTS_MAX, TRACK_POSITION, TRACK_TORQUE
from headway.devices.widest import fits_a_frame
from headway.sim.profiles import profile_of

RUNGE_KUTTA_STABLE = 2.78  # decay rate times step: Hairer, Wanner, Solving ODEs II, section IV.2


def timing_rules(subject: Subject) -> Iterator[Rule]:
    """All of them."""
    yield _margin(subject)
    yield _compute(subject)
    yield _stiffness(subject)
    yield _plan_points(subject)
    yield _plan_frame(subject)


def _margin(subject: Subject) -> Rule:
    """A plan arrives before the knot at which it begins; with a knot to spare a lost one is made
    good by the next."""
    loop, sim = subject.config.loop, subject.config.sim
    needed_us = sim.compute_us + profile_of(sim).to_device.usual_most_us
    margin_us = loop.margin_knots * loop.knot_us
    losses = max(0, (margin_us - needed_us) // loop.knot_us)
    return at_least(
        f"margin: in time, bridging {losses} lost frame{'' if losses == 1 else 's'}",
        margin_us,
        needed_us + loop.knot_us,
        "us",
        f"loop.margin_us of {needed_us + loop.knot_us} covers sim.compute_us, the wire to the "
        f"device at its slowest and one lost frame; less than {needed_us} is too late even so",
        fail=needed_us,
    )


def _compute(subject: Subject) -> Rule:
    """A tick is done before the next one is due."""
    return at_most(
        "compute: within a knot",
        subject.config.sim.compute_us,
        subject.config.loop.knot_us,
        "us",
        "ticks are skipped while one computes: a longer loop.knot_us, fewer mpc.intervals or a "
        "faster computer",
        fail=4.0,
    )


def _stiffness(subject: Subject) -> Rule:
    """What the prediction steps through stays stable: the machine with its servos in steps of a
    knot, without them in steps of an interval."""
    config, axes = subject.config, subject.axes
    law = ServoLaw.of(axes)
    own = subject.machine.damping + law.coulomb / COULOMB_SPEED
    servos = law.kd + law.emf
    steps = []
    for damping, step_us in (
        (own + servos, config.loop.knot_us),
        (own, config.mpc.horizon_us / config.mpc.intervals),
    ):
        rate, share = subject.envelope.fastest(damping)
        steps.append((rate * step_us * 1e-6, axes[int(share.argmax())]))
    value, axis = max(steps, key=lambda step: step[0])
    gain = "" if axis.passive else f"{axis.servo.key('kd')}, "
    return at_most(
        "prediction: fastest decay in a step",
        value,
        RUNGE_KUTTA_STABLE,
        "",
        f"{axis.joint} moves too little inertia for its damping and friction: lower "
        f"{gain}{axis.key('coulomb')} or mpc.horizon_us / mpc.intervals, or "
        "give the joint an armature in the model (its rotor's inertia times gear squared)",
        axis.joint,
        warn=0.75,
    )


def _plan_points(subject: Subject) -> Rule:
    return at_most(
        "plan: points",
        plan_points(subject.config),
        PLAN_POINTS_MAX,
        "points",
        "a shorter mpc.horizon_us or a longer loop.knot_us",
    )


def _plan_frame(subject: Subject) -> Rule:
    """The largest plan that the gate lets pass fits a frame."""
    loop, points = subject.config.loop, min(plan_points(subject.config), PLAN_POINTS_MAX)
    for axis in subject.driven.values():
        units = AxisUnits.of(axis, loop)
        try:
            limits = {
                TRACK_POSITION: position_limits(axis, units),
                TRACK_TORQUE: torque_limits(axis, units),
            }
            if loop.gains != "off":
                limits.update(gain_limits(axis, subject.config.device, units))
        except ValueError:
            continue  # the rule of the board's integers tells
        if not fits_a_frame(limits, points):
            return Rule(
                "plan: fits a frame",
                Status.FAIL if loop.gains != "off" else Status.WARN,
                axis=axis.joint,
                remedy="a plan that swings as far as the gate allows would not: a shorter "
                "mpc.horizon_us or a longer loop.knot_us"
                + (", or loop.gains: off" if loop.gains != "off" else ""),
            )
    return Rule("plan: fits a frame", Status.OK)
