"""Weights of the optimal control problem and noises of the estimator, by axis.

With an axis' working effort U and acceleration A as units the problem looks alike on every axis.
The sizes were found by trying on the shipped arm and the machines of the tests, with and without
errors in the model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from headway.cli.guess.axes import BUILT_FOR, AxisGuess
from headway.models.envelope import Envelope

Array = NDArray[np.float64]

POSITION, VELOCITY, SOFT = 2.5e9, 5e5, 2.5e10  # times A^2
STEP, START = 15.0, 600.0  # times U^2
ACCELERATION_NOISE, DISTURBANCE_NOISE = 0.003, 0.35  # of A and U, root seconds


@dataclass(frozen=True)
class Weights:
    """By axis, as the config has them."""

    position: Array
    velocity: Array
    soft: Array
    torque_step: Array
    torque_start: Array
    acceleration_noise: Array
    disturbance_noise: Array

    @classmethod
    def of(cls, axes: list[AxisGuess], reach: Envelope) -> Weights:
        """From what each axis has to hold and to move."""
        built_for = np.array([BUILT_FOR[axis.unit] for axis in axes])
        effort = reach.holding_max + reach.inertia_max * built_for
        acceleration = effort / reach.inertia_max
        return cls(
            POSITION / acceleration**2,
            VELOCITY / acceleration**2,
            SOFT / acceleration**2,
            STEP / effort**2,
            START / effort**2,
            ACCELERATION_NOISE * acceleration,
            DISTURBANCE_NOISE * effort,
        )
