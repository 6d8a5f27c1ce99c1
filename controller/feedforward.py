"""Streaming the reference itself, with or without the model's torque: what MPC is compared with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from headway.controller.motion import Motion
from headway.controller.prediction import Prediction
from headway.controller.reference import Reference

Array = NDArray[np.float64]

STOP_SHARE = 0.5  # of the horizon, over which the streamed motion comes to rest


class Feedforward:
    """Plans that follow the reference and end at rest, blind to where the machine is."""

    def __init__(self, prediction: Prediction, with_torque: bool) -> None:
        self._prediction, self._with_torque = prediction, with_torque

    def plan(self, reference: Reference, time_s: Array) -> Motion:
        """The reference at times (K+1,), brought to rest along its own path by slowing its time.

        The slowing is a smooth step of the path's speed from one to zero: with s in 0..1 over the
        stop, speed 1 - 3 s^2 + 2 s^3.
        """
        stop_s = STOP_SHARE * (time_s[-1] - time_s[0])
        s = np.clip((time_s - time_s[-1]) / stop_s + 1, 0, None)
        path_s = time_s + stop_s * (s**4 / 2 - s**3)
        speed, slowing = (1 - 3 * s**2 + 2 * s**3)[:, None], (6 * (s**2 - s) / stop_s)[:, None]
        position, v, a = reference.at(path_s)
        velocity = v * speed
        if not self._with_torque:
            return Motion.of(position, velocity, np.zeros_like(position))
        acceleration = a * speed**2 + v * slowing
        torque = self._prediction.inverse_dynamics(position, velocity, acceleration)
        return Motion.of(position, velocity, torque)
