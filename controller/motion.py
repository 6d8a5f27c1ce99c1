"""A planned motion: what the MPC gives, the encoder takes and the roll-out is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Motion(NamedTuple):
    """A planned motion at the knots of the horizon, SI; ends at rest."""

    rows: Array  # [q, v, torque of the motors] at each knot: (K+1, 3n)

    @classmethod
    def of(cls, position: Array, velocity: Array, torque: Array) -> Motion:
        """From (K+1, n) each."""
        return cls(np.concatenate((position, velocity, torque), axis=1))

    @property
    def n(self) -> int:
        """Number of axes."""
        return int(self.rows.shape[1]) // 3

    @property
    def position(self) -> Array:
        """(K+1, n)"""
        return self.rows[:, : self.n]

    @property
    def velocity(self) -> Array:
        """(K+1, n)"""
        return self.rows[:, self.n : 2 * self.n]

    @property
    def torque(self) -> Array:
        """Of the motors (K+1, n)."""
        return self.rows[:, 2 * self.n :]

    def later(self, knots: int) -> Motion:
        """The same motion from a later knot on, or from an earlier one where a clock has jumped:
        before its beginning and beyond its end it rests."""
        wanted = np.arange(knots, knots + len(self.rows))
        return Motion(self.rows.take(wanted, axis=0, mode="clip"))
