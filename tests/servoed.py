"""A servoed step of a machine and its Jacobian, in numpy on the compiled slope: an oracle."""

import numpy as np
from numpy.typing import NDArray

from headway.controller.prediction import Prediction

Array = NDArray[np.float64]


class Servoed:
    """The classical Runge-Kutta step of a state and of what it makes of others beside it."""

    def __init__(self, prediction: Prediction) -> None:
        self._n, self._call = prediction.n, prediction.call("slope")

    def __call__(self, z: Array, tracks: Array, dt: float) -> tuple[Array, Array]:
        """From z = [q, v, d] (3n,) through tracks (3, 5n) at the step's start, middle and end: to
        [q, v] and its Jacobian in z (2n, 3n)."""
        n = self._n
        start = np.column_stack((z[: 2 * n], np.eye(2 * n), np.zeros((2 * n, n))))
        slopes, at = list[Array](), start
        for row, share in ((0, 0.5), (1, 0.5), (1, 1.0), (2, 0.0)):
            slopes.append(self._slope(at, tracks[row], z[2 * n :]))
            at = start + share * dt * slopes[-1]
        k1, k2, k3, k4 = slopes
        end = start + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return end[:, 0], end[:, 1:]

    def _slope(self, at: Array, tracks: Array, d: Array) -> Array:
        n = self._n
        for target, value in zip(self._call.inputs, (at[:, 0], tracks, d), strict=True):
            target[:, 0] = value
        rate, by_state, by_torque = self._call.run()
        others = by_state @ at[:, 1:] + by_torque @ np.eye(3 * n)[2 * n :]
        return np.column_stack((rate[:, 0], np.vstack((at[n:, 1:], others))))
