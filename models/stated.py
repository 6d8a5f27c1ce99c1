"""What a machine's file itself says of its joints: kinds, ranges and limits."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from headway.models.source import OPEN, continuous_joints, is_urdf, read_model, read_spec

PLUGIN = "headway.servo"


@dataclass(frozen=True)
class Board:
    """The true motor and encoder of a joint, where a model was made for our simulator."""

    counts_per_unit: float
    gear: float
    torque_constant_Nm_per_A: float
    resistance_ohm: float
    supply_V: float


@dataclass(frozen=True)
class Joint:
    """One joint, SI at the joint; None is what the file leaves open."""

    name: str
    linear: bool
    continuous: bool  # it turns for ever
    position: tuple[float, float] | None  # rad or m
    velocity: float | None  # rad/s or m/s
    effort: float | None  # Nm or N
    coulomb: float  # Nm or N
    board: Board | None = None


def stated(path: Path, names: tuple[str, ...]) -> list[Joint]:
    """The joints `names` of an MJCF or URDF file that both readers take.

    Ranges and efforts are MuJoCo's reading (pinocchio 4.1 scales the range of a slide by an MJCF's
    angle unit); speed limits, which only a URDF has, pinocchio's. A range or limit of zero width,
    as exporters write where nobody filled it in, counts as left open.
    """
    spec = read_spec(path)
    model = spec.compile()
    boards = {
        actuator.target: Board(*list(actuator.userdata)[:5])
        for actuator in spec.actuators
        if actuator.plugin.plugin_name == PLUGIN
    }
    speeds = {}
    if is_urdf(path):
        urdf = read_model(path)
        speeds = dict(zip(list(urdf.names)[1:], urdf.velocityLimit.tolist(), strict=True))
    endless = continuous_joints(path)
    return [
        _joint(model, name, name in endless, speeds.get(name, 0.0), boards.get(name))
        for name in names
    ]


def _joint(
    model: mujoco.MjModel, name: str, continuous: bool, speed: float, board: Board | None
) -> Joint:
    joint = model.joint(name)
    low, high = joint.range.tolist()
    return Joint(
        name,
        bool(joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE),
        continuous,
        (low, high) if joint.limited[0] and high - low < OPEN else None,
        speed if 0 < speed < np.inf else None,
        _effort(model, joint.id),
        float(model.dof_frictionloss[joint.dofadr[0]]),
        board,
    )


def _effort(model: mujoco.MjModel, joint: int) -> float | None:
    """The joint's own limit or that of its actuators together, whichever is less."""
    limits = []
    if model.jnt_actfrclimited[joint]:
        limits.append(np.abs(model.jnt_actfrcrange[joint]).min())
    on_joint = [
        i
        for i in range(model.nu)
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        and model.actuator_trnid[i, 0] == joint
    ]
    efforts = [_actuator_effort(model, i) for i in on_joint]
    if efforts and None not in efforts:
        limits.append(sum(effort for effort in efforts if effort is not None))
    least = min(limits, default=0.0)
    return float(least) if least > 0 else None


def _actuator_effort(model: mujoco.MjModel, actuator: int) -> float | None:
    """What an actuator can do at its joint: by its force range, and if its force is a multiple of
    its control, by its control range."""
    limits = []
    if model.actuator_forcelimited[actuator]:
        limits.append(np.abs(model.actuator_forcerange[actuator]).min())
    proportional = (
        model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE
        and model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
    )
    if proportional and model.actuator_ctrllimited[actuator]:
        gain = abs(model.actuator_gainprm[actuator, 0])
        limits.append(gain * np.abs(model.actuator_ctrlrange[actuator]).min())
    return float(abs(model.actuator_gear[actuator, 0]) * min(limits)) if limits else None
