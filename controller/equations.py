"""The machine's equations of motion, with and without its servo loops, as CasADi functions.

x' = [v, a(q, v, tau)] where tau is given ("driven") or the servo's ("servoed"):
tau = clip(f + Kp (r - q) + (Kd + c)(r' - v)), with r and f the position and torque tracks; the
gains may be tracks as well. c is the motor's: its voltage is set for the track's speed, so a speed
error meets the back-EMF, c = (gear Kt)^2 / R.

Each is one function that the generated C calls at every stage of every step: written out in place,
a spatial arm of three joints took most of a minute to compile.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from headway.models.dynamics import Tree, forward_derivatives, forward_dynamics, inverse_dynamics

COULOMB_SPEED = 0.03  # [rad/s], over which the friction's sign is smoothed
TRACK_ROWS = 5  # r, r', f, Kp, Kd + c: what varies in time
LAW_ROWS = 2  # limit, known Coulomb friction: parameters, so that they need no compiler


class Equations:
    """Functions of x = [q, v] (2n), a control, the disturbance torque d (n) and the servo law (2n).

    Servoed, the control is the tracks [r, r', f, Kp, Kd + c] (5n).

    driven_slope, servoed_slope: to x', its velocity rows' Jacobian in x (n, 2n) and in d (n, n).
    servoed: to x' alone. given: of x, the tracks and the law to the servos' torques. inverse: of q,
    v, a and the law to torques.
    """

    def __init__(self, tree: Tree) -> None:
        n = self.n = tree.count
        x, u, d = ca.SX.sym("x", 2 * n), ca.SX.sym("u", n), ca.SX.sym("d", n)
        tracks, law = ca.SX.sym("tracks", TRACK_ROWS * n), ca.SX.sym("law", LAW_ROWS * n)
        q, v, a = x[:n], x[n:], ca.SX.sym("a", n)
        limit, coulomb = ca.vertsplit(law, n)

        friction = coulomb * ca.tanh(v / COULOMB_SPEED)
        torque = servo_torque(ca.vertsplit(tracks, n), q, v)
        servo = ca.fmin(ca.fmax(torque, -limit), limit)

        names = ["x", "control", "d", "law"]

        def slope(name: str, drive: Any, control: Any) -> Any:
            net = drive + d - friction
            a, by_state, by_torque = forward_derivatives(tree, q, v, net)
            by_state += by_torque @ ca.jacobian(net, x)
            result = [ca.vertcat(v, a), ca.densify(by_state), ca.densify(by_torque)]
            outputs = ["rate", "by_state", "by_torque"]
            return ca.Function(name, [x, control, d, law], ca.cse(result), names, outputs)

        self.driven_slope = slope("driven_slope", u, u)
        self.servoed_slope = slope("slope", servo, tracks)
        motion = ca.vertcat(v, forward_dynamics(tree, q, v, servo + d - friction))
        self.servoed = ca.Function("servoed", [x, tracks, d, law], [motion], names, ["rate"])
        needed = inverse_dynamics(tree, q, v, a) + friction
        self.given = ca.Function("given", [x, tracks, law], [servo])
        self.inverse = ca.Function(
            "inverse", [q, v, a, law], [ca.densify(needed)], ["q", "v", "a", "law"], ["effort"]
        )


def servo_torque(tracks: Sequence[Any], q: Any, v: Any) -> Any:
    """Of the motors, unclipped, with q and v under tracks [r, r', f, Kp, Kd + c]: expressions or
    numbers of any shape."""
    r, rate, f, kp, damping = tracks
    return f + kp * (r - q) + damping * (rate - v)


def runge_kutta(derivative: Any, x: Any, start: Any, middle: Any, end: Any, dt: Any) -> Any:
    """One classical fourth-order step; the inputs are given at its start, middle and end."""
    k1 = derivative(x, start)
    k2 = derivative(x + dt / 2 * k1, middle)
    k3 = derivative(x + dt / 2 * k2, middle)
    k4 = derivative(x + dt * k3, end)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
