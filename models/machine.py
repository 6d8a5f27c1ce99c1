"""A machine's model as the controller knows it: read from its MJCF or URDF by pinocchio."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from headway.models.dynamics import Tree
from headway.models.source import is_urdf, read_model, read_spec

MEND = {
    False: "give every body a name, and no pose to a body that is fixed to the world",
    True: "give every link mass and an inertia that a body can have",
}


@dataclass(frozen=True)
class Machine:
    """The joints in the model file's order, and their tree."""

    joints: tuple[str, ...]
    model: pin.Model
    tree: Tree

    def require_axes(self, joints: tuple[str, ...]) -> None:
        """Raises ValueError unless a config's axes are this machine's joints, in their order."""
        if joints != self.joints:
            raise ValueError(
                f"machine.axes name the joints {', '.join(joints)}; the model has "
                f"{', '.join(self.joints)}: list all of them, in that order"
            )

    def frame(self, name: str) -> int:
        """Pinocchio's index of a body or a site. Raises ValueError for a name that the model does
        not have."""
        kinds = pin.FrameType.BODY, pin.FrameType.OP_FRAME
        frames = {f.name: i for i, f in enumerate(self.model.frames) if f.type in kinds}
        if name not in frames:
            raise ValueError(f"the model has no {name}; it has {', '.join(frames)}")
        return frames[name]

    def place(self, name: str, q: Any) -> Any:
        """Where the origin of a body or a site is in the world (3, 1) [m], as an expression of the
        joints' positions. Raises ValueError for a name that the model does not have."""
        frame = self.model.frames[self.frame(name)]
        at = ca.SX(np.array(frame.placement.translation))
        if frame.parentJoint == 0:
            return at
        rotation, origin = self.tree.poses(q)[frame.parentJoint - 1]
        return origin + rotation @ at


def load_machine(path: Path) -> Machine:
    """Reads an MJCF (.xml) or URDF (.urdf) file.

    Raises ValueError with the file's name when pinocchio or MuJoCo cannot read it, when a joint has
    more than one degree of freedom, when the two read it differently or when it has forces that the
    model here cannot have.
    """
    try:
        model = read_model(path)
        plant = read_spec(path).compile()
        model.gravity.linear = plant.opt.gravity  # which pinocchio does not read
        tree = Tree(model)
        _check_reading(model, plant, MEND[is_urdf(path)])
        return Machine(tuple(model.names)[1:], model, tree)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}") from error


def _check_reading(model: pin.Model, plant: mujoco.MjModel, mend: str) -> None:
    """Of an MJCF pinocchio 4.1 drops without a word all but the first body in the world and the
    pose of a body fixed to it, and mixes up bodies without names. Raises ValueError for such a
    file, and for one with forces that are not in our dynamics; `mend`: what to do about it."""
    names, joints = list(model.names)[1:], [plant.joint(j).name for j in range(plant.njnt)]
    if sorted(names) != sorted(joints):
        raise ValueError(
            f"pinocchio reads the joints {', '.join(names)}, MuJoCo "
            f"{', '.join(joints)}: give every body and joint a name, and hang all bodies from one"
        )
    if not names:
        raise ValueError("has no joint that moves")
    order = [joints.index(name) for name in names]  # where branches meet the two may differ
    data, ours, n = mujoco.MjData(plant), model.createData(), plant.nv
    q, v = np.linspace(0.3, 0.7, n), np.linspace(1.0, -2.0, n)
    data.qpos[order], data.qvel[order] = q, v
    mujoco.mj_fwdPosition(plant, data)
    mujoco.mj_fwdVelocity(plant, data)
    mass = np.zeros((n, n))
    mujoco.mj_fullM(plant, data, mass)
    if plant.neq:
        raise ValueError(
            "has constraints between joints or bodies (equality; mimic in a URDF), which the "
            "controller does not know: remove them, and joints that only follow others"
        )
    pairs = {
        "mass matrix": (np.triu(pin.crba(model, ours, q)), np.triu(mass[np.ix_(order, order)])),
        "bias force": (pin.nonLinearEffects(model, ours, q, v), data.qfrc_bias[order]),
        "damping": (model.damping, plant.dof_damping[order]),
    }
    for name, (read, expected) in pairs.items():
        if not _close(read, expected):
            raise ValueError(f"pinocchio reads another {name} than MuJoCo: {mend}")
    if not _close(-model.damping * v, data.qfrc_passive[order]):
        raise ValueError(
            "has springs, gravity compensation or drag (stiffness, gravcomp, density, viscosity), "
            "which the controller does not know: remove them"
        )


def _close(read: NDArray[np.float64], expected: NDArray[np.float64]) -> bool:
    return np.allclose(read, expected, rtol=1e-6, atol=1e-9 * (1 + np.abs(expected).max()))
