"""A servoed step of a machine and its Jacobian, in numpy on the compiled slope: an oracle."""

from math import factorial

import numpy as np
from numpy.typing import NDArray

from headway.controller.prediction import Prediction

Array = NDArray[np.float64]


class Servoed:
    """The classical Runge-Kutta step of a state; its Jacobian by powers of the slope's half-way."""

    def __init__(self, prediction: Prediction) -> None:
        self._n, self._call = prediction.n, prediction.call("slope")

    def __call__(self, z: Array, tracks: Array, dt: float) -> tuple[Array, Array]:
        """From z = [q, v, d] (3n,) through tracks (3, 5n) at the step's start, middle and end: to
        [q, v] and its Jacobian in z (2n, 3n)."""
        n = self._n
        start = at = z[: 2 * n]
        slopes, systems = list[Array](), list[Array]()
        for row, share in ((0, 0.5), (1, 0.5), (1, 1.0), (2, 0.0)):
            slope, system = self._slope(at, tracks[row], z[2 * n :])
            slopes.append(slope)
            systems.append(system)
            at = start + share * dt * slope
        k1, k2, k3, k4 = slopes
        end = start + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        powers = [np.linalg.matrix_power(dt * systems[2], k) / factorial(k) for k in range(5)]
        return end, sum(powers)[: 2 * n]

    def _slope(self, x: Array, tracks: Array, d: Array) -> tuple[Array, Array]:
        """x' and the Jacobian of z' = [x', 0] in z."""
        n = self._n
        for target, value in zip(self._call.inputs, (x, tracks, d), strict=True):
            target[:, 0] = value
        rate, by_state, by_torque = self._call.run()
        system = np.zeros((3 * n, 3 * n))
        system[:n, n : 2 * n] = np.eye(n)
        system[n : 2 * n] = np.hstack((by_state, by_torque))
        return rate[:, 0].copy(), system
