"""Swings a pole up and balances it: costs for configs/cartpole.yaml."""

import casadi as ca

INERTIA = 8.333e-3  # of the pole about its joint [kg m^2]
WEIGHT = 0.24525  # its mass times gravity times the way to its centre of mass [Nm]


def objective(s):
    """Zero with the pole upright and at rest."""
    angle, rate = s.q[1], s.v[1]
    # 2 sin(angle / 2) is the angle near zero, and as far away as can be, but flat, at half a turn.
    away = 2 * ca.sin(angle / 2)
    # What it has to be given, in units of what lifts it from its side to the top.
    energy = INERTIA / WEIGHT * rate**2 / 2 + ca.cos(angle) - 1
    upright = ((1 + ca.cos(angle)) / 2) ** 4
    return [
        (away, s.parameter("away", 1.0)),
        (energy, s.parameter("energy", 1.0)),
        (upright * rate, s.parameter("rate", 0.01)),
    ]
