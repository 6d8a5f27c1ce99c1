"""Rules of each axis' drive: encoder, servo, motor and the board's integers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple

import numpy as np

from headway.cli.rules.rule import Rule, Status, at_least, at_most, worst
from headway.cli.rules.subject import Array, Subject
from headway.controller.observable import require_observable
from headway.devices.axis import AxisUnits
from headway.devices.settings import device_settings
from headway.firmware import _core
from headway.models.margin import PHASE_MARGIN_MIN_DEG, phase_margin_deg

RESOLUTION_SHARE = 0.01  # of the acceleration limit: what one quantum of a control point makes
# Of the effort limit: what the servo's damping makes of one encoder count, as noise all the time.
COUNT_SHARE, COUNT_SHARE_FAIL = 0.15, 0.5
PHASE_MARGIN_FAIL_DEG = 10.0
HELD = 1e12  # Nm/rad or N/m


def drive_rules(subject: Subject) -> Iterator[Rule]:
    """All of them."""
    yield _motor(subject)
    if subject.config.machine.bare:
        yield _observable(subject)
    yield _integers(subject)
    yield _counts(subject)
    yield _resolution(subject)
    yield _count_noise(subject)
    yield _phase_margin(subject)
    yield _toppling(subject)
    yield _stop(subject)
    yield _voltage_at_limits(subject)
    yield _voltage_in_task(subject)


def _motor(subject: Subject) -> Rule:
    """Where the model has boards of its own, their motors and encoders are the config's, but for
    what sim.plant changes on purpose."""
    name = "board: motor as in the model"
    for i, axis in subject.driven.items():
        joint = subject.joints[i]
        if joint.board is None:
            continue
        motor = axis.motor
        config = (
            axis.counts_per_unit,
            motor.gear,
            motor.torque_constant_Nm_per_A,
            motor.resistance_ohm,
            motor.supply_V,
        )
        if not np.allclose(config, astuple(joint.board), rtol=1e-6):
            remedy = (
                f"the model's board has counts per {axis.unit}, gear, torque constant, resistance "
                f"and supply {_told(astuple(joint.board))}, the config {_told(config)}"
            )
            return Rule(name, Status.FAIL, axis=axis.joint, remedy=remedy)
    return Rule(name, Status.OK)


def _told(numbers: tuple[float, ...]) -> str:
    return ", ".join(f"{number:.6g}" for number in numbers)


def _observable(subject: Subject) -> Rule:
    """What has no encoder shows in how the others move."""
    name = "estimate: axes without an encoder"
    try:
        start = subject.reference.at(np.zeros(1))[0][0]
        require_observable(subject.config, subject.machine, start)
    except ValueError as error:
        return Rule(name, Status.FAIL, remedy=str(error))
    return Rule(name, Status.OK)


def _integers(subject: Subject) -> Rule:
    """Limits and gains fit the board's fixed-point numbers."""
    config, name = subject.config, "board: limits and gains as integers"
    for axis in config.machine.boards:
        try:
            device_settings(axis, config.device, config.loop, config.sync)
        except ValueError as error:
            text = str(error).removeprefix(f"{axis.joint}: ")
            return Rule(name, Status.FAIL, axis=axis.joint, remedy=f"{axis.joint}: {text}")
    return Rule(name, Status.OK)


def _counts(subject: Subject) -> Rule:
    """Positions as counts fit a control point; those of a continuous axis begin anew."""
    name, most = "encoder: counts over the range", _core.POINT_MAX / (1 << _core.COUNT_BITS)
    rules = [
        at_most(
            name,
            max(abs(axis.lowest), abs(axis.highest)) * axis.counts_per_unit,
            most,
            "counts",
            f"a coarser encoder, or a smaller range of {axis.joint} around zero",
            axis.joint,
        )
        for axis in subject.axes
        if not axis.continuous
    ]
    return worst(rules) if rules else Rule(name, Status.OK)


def _resolution(subject: Subject) -> Rule:
    """A quantum of one control point is next to nothing as acceleration (DESIGN, section 3)."""
    h = subject.config.loop.knot_us * 1e-6
    return worst(
        at_most(
            "encoder: acceleration of one quantum",
            1 / AxisUnits.of(axis, subject.config.loop).pq_per_unit / h**2,
            RESOLUTION_SHARE * axis.acceleration_limit,
            f"{axis.unit}/s^2",
            f"a finer encoder for {axis.joint}, or a longer loop.knot_us",
            axis.joint,
        )
        for axis in subject.driven.values()
    )


def _count_noise(subject: Subject) -> Rule:
    """An encoder that steps by a count makes the servo's damping kick."""
    period_s = subject.config.device.servo_period_us * 1e-6
    return worst(
        at_most(
            "encoder: effort of one count",
            axis.servo.kd / axis.counts_per_unit / period_s,
            COUNT_SHARE * axis.effort_limit,
            axis.effort_unit,
            f"a finer encoder for {axis.joint}, or a lower {axis.servo.key('kd')}",
            axis.joint,
            fail=COUNT_SHARE_FAIL / COUNT_SHARE,
        )
        for axis in subject.driven.values()
    )


def _phase_margin(subject: Subject) -> Rule:
    """Each joint's loop at its largest inertia, others locked, and at its least, others free."""
    lag_s, reach = subject.config.device.servo_period_us * 1e-6, subject.envelope
    rules = []
    for i, axis in subject.driven.items():
        gains = axis.servo
        if axis.steps or gains.kp == gains.kd == gains.ki == 0:
            continue
        margins = [
            phase_margin_deg(gains.kp, gains.kd + axis.motor.damping, gains.ki, inertia, lag_s)
            for inertia in np.geomspace(reach.inertia_min[i], reach.inertia_max[i], 9)
        ]
        key, damping = gains.key("kp"), gains.key("kd")
        rules.append(
            at_least(
                "servo: phase margin",
                min(margins),
                PHASE_MARGIN_MIN_DEG,
                "deg",
                f"{axis.joint} moves {reach.inertia_min[i]:.3g} to {reach.inertia_max[i]:.3g} "
                f"{'kg m^2' if axis.unit == 'rad' else 'kg'}: lower {key} where it swings, lower "
                f"{damping} where it is too fast for device.servo_period_us",
                axis.joint,
                fail=PHASE_MARGIN_FAIL_DEG,
            )
        )
    return worst(rules) if rules else Rule("servo: phase margin", Status.OK)


def _toppling(subject: Subject) -> Rule:
    """The servo alone holds the machine in any pose, as it must when plans no longer come. Of
    passive axes nobody expects that: they count as held."""
    kp = np.full(len(subject.axes), HELD)
    for i, driven in subject.driven.items():
        kp[i] = max(driven.servo.kp, 1e-9)
    toppled, share = subject.envelope.toppling(kp)
    axis = list(subject.driven.values())[int(share[list(subject.driven)].argmax())]
    return at_most(
        "servo: stiffness that gravity takes",
        toppled,
        1.0,
        "",
        f"in some pose {axis.joint} would slowly fall when the host is gone: raise "
        f"{axis.servo.key('kp')}, or keep away from such poses",
        axis.joint,
        warn=0.7,
        fail=np.inf,
    )


def _stop(subject: Subject) -> Rule:
    """The boards' own stop: each axis at its largest inertia, down with its heaviest load; a
    warning, since the task may stay where it needs less."""
    reach = subject.envelope
    return worst(
        at_most(
            "stop: effort for its deceleration",
            float(reach.inertia_max[i] * axis.deceleration + reach.holding_max[i]),
            axis.effort_limit,
            axis.effort_unit,
            f"where {axis.joint} moves and holds most, its effort limit leaves "
            f"{max(axis.effort_limit - reach.holding_max[i], 0) / reach.inertia_max[i]:.3g} "
            f"{axis.unit}/s^2: set a lower {axis.key('stop_deceleration')}",
            axis.joint,
            fail=np.inf,
        )
        for i, axis in subject.driven.items()
    )


def _voltage_at_limits(subject: Subject) -> Rule:
    """Back-EMF at the speed limit and the effort limit at once."""
    driven = subject.driven.values()
    speed = np.array([axis.velocity_limit for axis in driven])
    effort = np.array([axis.effort_limit for axis in driven])
    volts = _volts(subject, speed, effort)
    return _voltage(subject, "motor: voltage at both limits", volts, fail=np.inf)


def _voltage_in_task(subject: Subject) -> Rule:
    """What the task needs at any time."""
    motion, driven = subject.motion, list(subject.driven)
    volts = _volts(subject, motion.velocity[:, driven], motion.effort[:, driven])
    volts = np.abs(volts).max(axis=0)
    return _voltage(subject, "motor: voltage in the task", volts, fail=1.0)


def _volts(subject: Subject, speed: Array, effort: Array) -> Array:
    """Of the driven axes, from their speeds and efforts."""
    motors = [axis.motor for axis in subject.driven.values()]
    constant = np.array([motor.constant for motor in motors])
    resistance = np.array([motor.resistance_ohm for motor in motors])
    volts: Array = constant * speed + resistance * effort / constant
    return volts


def _voltage(subject: Subject, name: str, volts: Array, fail: float) -> Rule:
    return worst(
        at_most(
            name,
            float(volts[i]),
            axis.motor.supply_V,
            "V",
            f"more supply_V, or another gear of {axis.joint}; or lower "
            f"{axis.key('velocity_limit')} or {axis.key('effort_limit')}",
            axis.joint,
            fail=fail,
        )
        for i, axis in enumerate(subject.driven.values())
    )
