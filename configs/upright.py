"""Swings a pendulum up and balances it, the second joint from upright: costs for furuta.yaml and
cartpole.yaml."""

import casadi as ca


def objective(s):
    """Zero with the pendulum upright and at rest. swing_s2: its inertia about the joint [kg m^2]
    over its mass times gravity times the way to its centre of mass [Nm]."""
    angle, rate = s.q[1], s.v[1]
    # 2 sin(angle / 2) is the angle near zero, and as far away as can be, but flat, at half a turn.
    away = 2 * ca.sin(angle / 2)
    # What it has to be given, in units of what lifts it from its side to the top.
    energy = s.parameter("swing_s2", 0.02) * rate**2 / 2 + ca.cos(angle) - 1
    upright = ((1 + ca.cos(angle)) / 2) ** 4
    return [
        (away, s.parameter("away", 1.0)),
        (energy, s.parameter("energy", 1.0)),
        (upright * rate, s.parameter("rate", 0.01)),
    ]
