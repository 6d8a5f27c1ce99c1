"""A machine's model as the controller knows it: read from its MJCF or URDF by pinocchio."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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

    Raises ValueError with the file's name when pinocchio cannot read it or a joint has more than
    one degree of freedom.
    """
    build = pin.buildModelFromUrdf if path.suffix == ".urdf" else pin.buildModelFromMJCF
    try:
        model = build(str(path))
        return Machine(tuple(model.names)[1:], model, Tree(model))
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}") from error
