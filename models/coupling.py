"""What the motors turn, where they are not at the joints: belts, differentials, parallel drives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CONDITION_MAX = 1e6


class Coupling:
    """Positions of the axes, which motors and encoders have, are C times those of the joints; so
    efforts of the joints are C's transpose times the axes'. The same holds for their changes.

    All that the controller plans, estimates and records is of axes.
    """

    def __init__(self, axes_by_joints: Sequence[Sequence[float]] | Array) -> None:
        """C (n, n), a row an axis. Raises ValueError if it cannot be inverted."""
        self.axes_by_joints = np.array(axes_by_joints, dtype=float)
        if len(self.axes_by_joints) and np.linalg.cond(self.axes_by_joints) > CONDITION_MAX:
            raise ValueError(
                "machine.coupling: some axes together move no joint: no row may depend on others"
            )
        self.joints_by_axes: Array = np.linalg.inv(self.axes_by_joints)
        self._none = np.array_equal(self.axes_by_joints, np.eye(len(self.axes_by_joints)))

    @classmethod
    def of(cls, rows: Sequence[Sequence[float]] | None, count: int) -> Coupling:
        """As a config has it; None: a motor at each joint."""
        return cls(np.eye(count) if rows is None else rows)

    def joints(self, axes: Array) -> Array:
        """Positions, speeds or accelerations of the joints (..., n) at those of the axes."""
        rows: Array = axes @ self.joints_by_axes.T
        return rows

    def axes(self, joints: Array) -> Array:
        """The other way; with a motor at each joint they are the same, and this array."""
        if self._none:
            return joints
        rows: Array = joints @ self.axes_by_joints.T
        return rows

    def efforts(self, joints: Array) -> Array:
        """Of the axes (..., n), which do what efforts at the joints (..., n) would."""
        rows: Array = joints @ self.joints_by_axes
        return rows
