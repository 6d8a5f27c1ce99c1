"""The prediction model: the machine together with the servo loops that track its tracks.

tau = clip(f + Kp (r - q) + (Kd + c)(r' - v)), with r and f the position and torque tracks. c is the
motor's: its voltage is set for the track's speed, so a speed error meets the back-EMF,
c = (gear Kt)^2 / R.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Axis
from headway.models.codegen import Call, compile_functions
from headway.models.dynamics import forward_dynamics, inverse_dynamics
from headway.models.machine import Machine

Array = NDArray[np.float64]

COULOMB_SPEED = 0.03  # [rad/s], over which the friction's sign is smoothed


@dataclass(frozen=True)
class ServoLaw:
    """The servos' gains and limits in SI, by axis."""

    kp: Array  # [Nm/rad]
    kd: Array  # [Nm s/rad]
    emf: Array  # c [Nm s/rad]
    limit: Array  # [Nm]
    coulomb: Array  # [Nm], as far as it is known

    @classmethod
    def of(cls, axes: list[Axis]) -> ServoLaw:
        """From the config's axes."""
        constant = [a.motor.gear * a.motor.torque_constant_Nm_per_A for a in axes]
        return cls(
            np.array([a.servo.kp_Nm_per_rad for a in axes]),
            np.array([a.servo.kd_Nm_s_per_rad for a in axes]),
            np.array([k**2 / a.motor.resistance_ohm for k, a in zip(constant, axes, strict=True)]),
            np.array([a.torque_limit_Nm for a in axes]),
            np.array([a.coulomb_Nm for a in axes]),
        )

    def torque(self, x: Array, tracks: Array) -> Array:
        """Motor torque [Nm], unclipped, at states (m, 2n) under track values (m, 3n)."""
        n = len(self.kp)
        r, rate, f = tracks[..., :n], tracks[..., n : 2 * n], tracks[..., 2 * n :]
        q, v = x[..., :n], x[..., n:]
        torque: Array = f + self.kp * (r - q) + (self.kd + self.emf) * (rate - v)
        return torque


def runge_kutta(derivative: Any, x: Any, start: Any, middle: Any, end: Any, dt: Any) -> Any:
    """One classical fourth-order step; the inputs are given at its start, middle and end."""
    k1 = derivative(x, start)
    k2 = derivative(x + dt / 2 * k1, middle)
    k3 = derivative(x + dt / 2 * k2, middle)
    k4 = derivative(x + dt * k3, end)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


class Prediction:
    """Compiled functions of one machine: closed-loop steps for the estimator and the roll-out,
    open-loop linearization for the optimal control problem, and inverse dynamics.

    States are x = [q, v] (2n); `tracks` are [r, r', f] (3n); d is the disturbance torque (n).
    """

    def __init__(self, machine: Machine, law: ServoLaw, intervals: int, horizon_knots: int) -> None:
        n = len(law.kp)
        self.law, self.n, self.horizon_knots = law, n, horizon_knots
        tree = machine.tree
        x, d, dt = ca.SX.sym("x", 2 * n), ca.SX.sym("d", n), ca.SX.sym("dt")
        u0, u1 = ca.SX.sym("u0", n), ca.SX.sym("u1", n)
        tracks = [ca.SX.sym(f"tracks{i}", 3 * n) for i in range(3)]
        q, v, a = (ca.SX.sym(name, n) for name in "qva")

        def friction(v: Any) -> Any:
            return law.coulomb * ca.tanh(v / COULOMB_SPEED)

        def driven(x: Any, torque: Any) -> Any:
            net = torque + d - friction(x[n:])
            return ca.vertcat(x[n:], forward_dynamics(tree, x[:n], x[n:], net))

        def servoed(x: Any, tracks: Any) -> Any:
            r, rate, f = tracks[:n], tracks[n : 2 * n], tracks[2 * n :]
            torque = f + law.kp * (r - x[:n]) + (law.kd + law.emf) * (rate - x[n:])
            return driven(x, ca.fmin(ca.fmax(torque, -law.limit), law.limit))

        after = runge_kutta(servoed, x, tracks[0], tracks[1], tracks[2], dt)
        jacobian = ca.densify(ca.jacobian(after, ca.vertcat(x, d)))
        step = ca.Function("step", [x, d, *tracks, dt], [after, jacobian])
        advance = ca.Function("advance", [x, d, *tracks, dt], [after])
        rollout = advance.mapaccum("rollout", horizon_knots)
        forced = runge_kutta(driven, x, u0, (u0 + u1) / 2, u1, dt)
        parts = [ca.densify(ca.jacobian(forced, z)) for z in (x, u0, u1)]
        interval = ca.Function("interval", [x, u0, u1, d, dt], [forced, *parts])
        linearize = interval.map("linearize", "serial", intervals, [3, 4], [])
        torque = inverse_dynamics(tree, q, v, a) + friction(v)
        inverse = ca.Function("inverse", [q, v, a], [ca.densify(torque)])
        functions = [step, rollout, linearize, inverse]
        compiled = compile_functions("machine", functions)
        self.step = Call(compiled["step"])
        self.rollout = Call(compiled["rollout"])
        self.linearize = Call(compiled["linearize"])
        self._inverse = Call(compiled["inverse"])

    def inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Motor torques [Nm] of the motion (m, n) by the model."""
        torque = np.empty_like(q)
        for i in range(len(q)):
            for target, value in zip(self._inverse.inputs, (q[i], v[i], a[i]), strict=True):
                target[:, 0] = value
            torque[i] = self._inverse.run()[0][:, 0]
        return torque

    def holding(self, q: Array, disturbance: Array) -> Array:
        """Motor torques (n,) that hold the machine at rest at q (n,)."""
        still = np.zeros_like(q)[None]
        torque: Array = self.inverse_dynamics(q[None], still, still)[0] - disturbance
        return torque
