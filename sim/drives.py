"""A machine's model with our boards on its joints: what the plant steps.

A model that was made for this simulator has an actuator of the plugin headway.servo on each joint,
whose `user` array is the true motor; it is used as it is. Any other MJCF or URDF is prepared: its
own actuators, sensors and keyframes are taken out (they would fight with the boards or refer to
what is gone), each axis of the config gets a board with the config's motor and encoder, and the
solver is set to what the firmware needs. Its contacts stay, but bodies that touch each other where
the task starts never collide: shapes often overlap at the joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from headway.configs.axis import Axis, StepperAxis
from headway.configs.schema import Machine
from headway.models.coupling import Coupling
from headway.models.source import read_spec
from headway.models.stated import PLUGIN
from headway.sim.plugin import load_plugin

STEP_MAX_US, STEP_MIN_US = 250, 50  # of physics
BRAKE_SHARE = 1.5  # of the effort limit that the brake holds
# The brake is a stiff spring with a damper of BRAKE_DAMPING times its strength (plugin.c), stepped
# explicitly: strength * BRAKE_DAMPING * step / inertia may not come near 2. A quarter of that
# leaves room for poses in which the inertia is less than in the model's own.
BRAKE_DAMPING, BRAKE_STABLE = 4.0, 0.5


def driven_model(
    path: Path, machine: Machine, servo_period_us: int, start: Sequence[float]
) -> mujoco.MjModel:
    """The model with a board on every axis but those without an encoder.

    `start`: positions of the axes where the task starts [rad or m]. Raises ValueError where model
    and config do not fit together.
    """
    load_plugin()
    try:
        spec = read_spec(path)
        bare = spec.compile()
        joints = [bare.joint(j).name for j in range(bare.njnt)]
        for axis in machine.axes:
            if axis.joint not in joints:
                raise ValueError(
                    f"there is no joint {axis.joint}; the model's joints are {', '.join(joints)}"
                )
            slides = bare.joint(axis.joint).type[0] == mujoco.mjtJoint.mjJNT_SLIDE
            if slides != (axis.unit == "m"):
                kind, keys = ("slides", "linear") if slides else ("turns", "rotary")
                raise ValueError(f"joint {axis.joint} {kind}: use the keys of a {keys} axis")
        needless = {axis.joint for axis in machine.bare.values()}
        for actuator in [a for a in spec.actuators if a.target in needless]:
            spec.delete(actuator)
        on_board = {a.target for a in spec.actuators if a.plugin.plugin_name == PLUGIN}
        missing = [axis for axis in machine.boards if axis.joint not in on_board]
        for axis in machine.driven.values():
            if axis.steps and axis not in missing:
                raise ValueError(
                    f"joint {axis.joint} has an actuator with a brushed motor: take it out of the "
                    "model, and the axis' stepper takes its place"
                )
        if not missing:
            return spec.compile() if needless else bare
        _strip(spec)
        spec.option.timestep = _step_us(servo_period_us) * 1e-6
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # 4.0.0 errs with a sparse one
        spec.nuser_actuator = 8 if any(axis.steps for axis in machine.driven.values()) else 6
        spec.activate_plugin(PLUGIN)
        coupling = Coupling.of(machine.coupling, len(machine.axes))
        for axis, row in zip(machine.axes, coupling.axes_by_joints, strict=True):
            spec.joint(axis.joint).actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
            pulls = {a.joint: float(c) for a, c in zip(machine.axes, row, strict=True) if c}
            if axis in missing:
                _add_board(spec, axis, pulls, _mobility(bare, pulls))
        model = spec.compile()
        for first, second in _touching(model, machine, start):
            spec.add_exclude(bodyname1=first, bodyname2=second)
        return spec.compile()
    except ValueError as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error


def _strip(spec: mujoco.MjSpec) -> None:
    others = [a for a in spec.actuators if a.plugin.plugin_name != PLUGIN]
    for element in (*others, *spec.sensors, *spec.keys, *spec.tuples):
        spec.delete(element)


def _step_us(servo_period_us: int) -> int:
    """The largest step that divides the servo period, so that no period is longer than another."""
    for step_us in range(STEP_MAX_US, STEP_MIN_US - 1, -1):
        if servo_period_us % step_us == 0:
            return step_us
    raise ValueError(
        f"device.servo_period_us is {servo_period_us}: to be simulated it must be a multiple of "
        f"some {STEP_MIN_US} to {STEP_MAX_US} us"
    )


def _mobility(bare: mujoco.MjModel, pulls: dict[str, float]) -> float:
    """Acceleration per effort of an axis that pulls at joints, in the model's own pose."""
    data, pull, moved = mujoco.MjData(bare), np.zeros((1, bare.nv)), np.zeros((1, bare.nv))
    for joint, share in pulls.items():
        pull[0, bare.joint(joint).dofadr] = share
    mujoco.mj_forward(bare, data)
    mujoco.mj_solveM(bare, data, moved, pull)
    return float((moved @ pull.T).item())


def _add_board(spec: mujoco.MjSpec, axis: Axis, pulls: dict[str, float], mobility: float) -> None:
    """At the axis' joint or, where it pulls at others or in another measure, at a tendon of its
    name."""
    on_joint = pulls == {axis.joint: 1.0}
    if not on_joint:
        tendon = spec.add_tendon(name=axis.joint)
        for joint, share in pulls.items():
            tendon.wrap_joint(joint, share)
    actuator = spec.add_actuator(
        name=f"board of {axis.joint}",
        trntype=mujoco.mjtTrn.mjTRN_JOINT if on_joint else mujoco.mjtTrn.mjTRN_TENDON,
        target=axis.joint,
        userdata=[axis.counts_per_unit, *_motor(axis, spec.option.timestep * mobility)],
    )
    plugin = spec.add_plugin(name=f"board of {axis.joint}", plugin_name=PLUGIN)
    plugin.active = True
    actuator.plugin = plugin


def _motor(axis: Axis, step_mobility: float) -> list[float]:
    """Gear, torque constant, resistance, supply and brake; of a stepper what it holds and its cycle
    as well. A board without a motor has none that
    gives or takes anything."""
    if axis.passive:
        return [1.0, 0.0, 1.0, 1.0, 0.0]
    stable = BRAKE_STABLE / (BRAKE_DAMPING * step_mobility)
    motor = axis.motor
    numbers = [
        motor.gear,
        motor.torque_constant_Nm_per_A,
        motor.resistance_ohm,
        motor.supply_V,
        min(BRAKE_SHARE * axis.effort_limit, stable),
    ]
    return [*numbers, axis.effort_limit, axis.cycle] if isinstance(axis, StepperAxis) else numbers


def _touching(
    model: mujoco.MjModel, machine: Machine, start: Sequence[float]
) -> set[tuple[str, str]]:
    """Pairs of bodies that touch where the task starts."""
    data = mujoco.MjData(model)
    joints = Coupling.of(machine.coupling, len(start)).joints(np.array(start))
    for axis, position in zip(machine.axes, joints, strict=True):
        data.joint(axis.joint).qpos[0] = position
    mujoco.mj_forward(model, data)
    geoms = [sorted(model.geom_bodyid[list(contact.geom)].tolist()) for contact in data.contact]
    return {(model.body(first).name, model.body(second).name) for first, second in geoms}
