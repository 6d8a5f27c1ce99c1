"""A machine's model as the controller knows it: read from its MJCF or URDF by pinocchio."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin

from headway.models.dynamics import Tree


@dataclass(frozen=True)
class Machine:
    """The joints in the model file's order, and their tree."""

    joints: tuple[str, ...]
    model: pin.Model
    tree: Tree


def load_machine(path: Path) -> Machine:
    """Reads an MJCF (.xml) or URDF (.urdf) file.

    Raises ValueError with the file's name when pinocchio cannot read it, when a joint has more than
    one degree of freedom or when pinocchio reads an MJCF otherwise than MuJoCo does.
    """
    urdf = path.suffix == ".urdf"
    build = pin.buildModelFromUrdf if urdf else pin.buildModelFromMJCF
    try:
        model = build(str(path))
        plant = None if urdf else mujoco.MjModel.from_xml_path(str(path))
        if plant is not None:
            model.gravity.linear = plant.opt.gravity  # which pinocchio does not read
        tree = Tree(model)
        if plant is not None:
            _check_reading(model, plant)
        return Machine(tuple(model.names)[1:], model, tree)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}") from error


def _check_reading(model: pin.Model, plant: mujoco.MjModel) -> None:
    """Pinocchio 4.1 drops without a word all but the first body in the world and the pose of a body
    fixed to it, and mixes up bodies without names. Raises ValueError for such a file."""
    joints = [plant.joint(j).name for j in range(plant.njnt)]
    if list(model.names)[1:] != joints:
        raise ValueError(
            f"pinocchio reads the joints {', '.join(list(model.names)[1:])}, MuJoCo "
            f"{', '.join(joints)}: give every body and joint a name, and hang all bodies from one"
        )
    data, ours, n = mujoco.MjData(plant), model.createData(), plant.nv
    data.qpos[:], data.qvel[:] = np.linspace(0.3, 0.7, n), np.linspace(1.0, -2.0, n)
    mujoco.mj_fwdPosition(plant, data)
    mujoco.mj_fwdVelocity(plant, data)
    mass = np.zeros((n, n))
    mujoco.mj_fullM(plant, data, mass)
    pairs = {
        "mass matrix": (np.triu(pin.crba(model, ours, data.qpos)), np.triu(mass)),
        "bias force": (pin.nonLinearEffects(model, ours, data.qpos, data.qvel), data.qfrc_bias),
        "damping": (model.damping, plant.dof_damping),
    }
    for name, (read, expected) in pairs.items():
        if not np.allclose(read, expected, rtol=1e-6, atol=1e-9 * (1 + np.abs(expected).max())):
            raise ValueError(
                f"pinocchio reads another {name} than MuJoCo: give every body a name, and no pose "
                "to a body that is fixed to the world"
            )
