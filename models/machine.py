"""A machine's model as the controller knows it: read from its MJCF or URDF by pinocchio."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from headway.models.coupling import Coupling
from headway.models.dynamics import Tree
from headway.models.source import is_urdf, read_model, read_spec

Array = NDArray[np.float64]

MEND = {
    False: "give every body a name, and no pose to a body that is fixed to the world",
    True: "give every link mass and an inertia that a body can have",
}


@dataclass(frozen=True)
class Machine:
    """The joints in the model file's order, their tree, and the axes that move them.

    Positions, speeds, accelerations and efforts are those of the axes, unless a name says joints.
    """

    joints: tuple[str, ...]
    model: pin.Model
    tree: Tree
    coupling: Coupling

    @cached_property
    def _data(self) -> pin.Data:
        return self.model.createData()

    def require_axes(self, joints: tuple[str, ...]) -> None:
        """Raises ValueError unless a config's axes are this machine's joints, in their order."""
        if joints != self.joints:
            raise ValueError(
                f"machine.axes name the joints {', '.join(joints)}; the model has "
                f"{', '.join(self.joints)}: list all of them, in that order"
            )

    @property
    def damping(self) -> Array:
        """By axis (n,) [Nm s/rad or N s/m]: no less than what all axes together are damped by, as
        one axis can be by another's speed: its row's sum."""
        turned = self.coupling.joints_by_axes
        rows: Array = np.abs(turned.T @ np.diag(self.model.damping) @ turned).sum(axis=1)
        return rows

    def mass(self, positions: Array) -> Array:
        """Mass matrices (m, n, n) [kg m^2 or kg] at positions (m, n)."""
        rows, turned = self.coupling.joints(positions), self.coupling.joints_by_axes
        upper = np.empty((*positions.shape, self.model.nv))
        for matrix, q in zip(upper, rows, strict=True):
            matrix[...] = pin.crba(self.model, self._data, q)  # the upper half
        whole: Array = np.triu(upper) + np.triu(upper, 1).swapaxes(1, 2)
        return turned.T @ whole @ turned

    def holding(self, positions: Array) -> Array:
        """Efforts (m, n) [Nm or N] that hold the machine against gravity at positions (m, n)."""
        rows = self.coupling.joints(positions)
        model, data = self.model, self._data
        efforts = np.array([pin.computeGeneralizedGravity(model, data, q) for q in rows])
        return self.coupling.efforts(efforts)

    def holding_slope(self, positions: Array) -> Array:
        """Their derivatives (m, n, n) in the positions."""
        rows, turned = self.coupling.joints(positions), self.coupling.joints_by_axes
        model, data = self.model, self._data
        slopes = [np.array(pin.computeGeneralizedGravityDerivatives(model, data, q)) for q in rows]
        whole: Array = turned.T @ np.array(slopes) @ turned
        return whole

    def efforts(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Along a motion (m, n), with damping."""
        rows = [self.coupling.joints(part) for part in (position, velocity, acceleration)]
        moves = zip(*rows, strict=True)
        needed = np.array([pin.rnea(self.model, self._data, q, v, a) for q, v, a in moves])
        return self.coupling.efforts(needed + self.model.damping * rows[1])

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
        axes' positions. Raises ValueError for a name that the model does not have."""
        frame = self.model.frames[self.frame(name)]
        at = ca.SX(np.array(frame.placement.translation))
        if frame.parentJoint == 0:
            return at
        rotation, origin = self.tree.poses(q)[frame.parentJoint - 1]
        return origin + rotation @ at


def load_machine(path: Path, coupling: Sequence[Sequence[float]] | None = None) -> Machine:
    """Reads an MJCF (.xml) or URDF (.urdf) file.

    `coupling`: as of the config's machine. Raises ValueError with the file's name when pinocchio or
    MuJoCo cannot read it, when a joint has more than one degree of freedom, when the two read it
    differently or when it has forces that the model here cannot have.
    """
    try:
        model = read_model(path)
        plant = read_spec(path).compile()
        model.gravity.linear = plant.opt.gravity  # which pinocchio does not read
        moved_by = Coupling.of(coupling, model.nv)
        tree = Tree(model, moved_by)
        _check_reading(model, plant, MEND[is_urdf(path)])
        return Machine(tuple(model.names)[1:], model, tree, moved_by)
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


def _close(read: Array, expected: Array) -> bool:
    return np.allclose(read, expected, rtol=1e-6, atol=1e-9 * (1 + np.abs(expected).max()))
