"""From places of the tool to positions of the axes."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.optimize import least_squares

from headway.models.machine import Machine

Array = NDArray[np.float64]

NEARNESS = 1e-4  # m/rad: how little a posture near the last one counts beside the tool's place
REACHED_M = 1e-4


def postures(
    machine: Machine, tool: str, places: Array, start: Array, low: Array, high: Array
) -> Array:
    """Positions of the axes (m, n) [rad or m] between `low` and `high` (n,), at which a body's or
    a site's origin is at `places` (m, 3) [m]: each the one near the last, from `start` (n,) on.

    Least squares in the tool's place and, with little weight, the way from the last posture (damped
    least squares: Wampler, IEEE Trans. Systems, Man, and Cybernetics 16, 1986). Raises ValueError
    for a place that is out of reach, with its line in a file whose first place is in line 2, or for
    a name that the model lacks.
    """
    model, data = machine.model, machine.model.createData()
    frame = machine.frame(tool)
    found = np.empty((len(places), len(start)))
    near = np.clip(start, low, high)
    for row, place in enumerate(places):

        def residual(q: Array, place: Array = place, near: Array = near) -> Array:
            pin.forwardKinematics(model, data, machine.coupling.joints(q))
            at = pin.updateFramePlacement(model, data, frame).translation
            return np.concatenate((at - place, NEARNESS * (q - near)))

        def slope(q: Array) -> Array:
            pin.computeJointJacobians(model, data, machine.coupling.joints(q))
            pin.updateFramePlacement(model, data, frame)
            moved = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
            moved = moved @ machine.coupling.joints_by_axes
            return np.vstack((moved, NEARNESS * np.eye(len(q))))

        inside = np.clip(near, low + 1e-9, high - 1e-9)
        answer = least_squares(residual, inside, slope, bounds=(low, high), xtol=1e-12, ftol=1e-15)
        away = float(np.linalg.norm(answer.fun[:3]))
        if away > REACHED_M:
            there = ", ".join(f"{x:.4g}" for x in place)
            raise ValueError(
                f"line {row + 2}: {tool} does not get to ({there}) m, it stays "
                f"{1e3 * away:.3g} mm away"
            )
        near = found[row] = answer.x
    return found
