"""A planned motion: what the MPC gives, the encoder takes and the roll-out is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Motion:
    """A planned motion at the knots of the horizon: (K+1, n) each, SI; ends at rest."""

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    torque: NDArray[np.float64]  # of the motors
