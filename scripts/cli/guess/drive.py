"""An axis' servo, motor and encoder."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from headway.cli.guess.axes import AxisGuess
from headway.models.envelope import Envelope

Array = NDArray[np.float64]

DAMPING_PER_INERTIA = 45.0  # 1/s, at the largest inertia
ZETA = 0.9
EMF_SHARE = 1 / 3  # of the damping
# Of the machine's fastest motion under that damping [1/s], in any pose: 29 degrees of lag at 1 kHz,
# and three quarters of what a Runge-Kutta step of a knot can follow (stable up to 2.78 a step).
RATE_MAX = 500.0
TOPPLED_MAX = 0.4  # share of the servo's stiffness that gravity may take in any pose
STEPS = 200  # of a search, at most
SUPPLY_V, SUPPLY_SHARE = 48.0, 0.85
TORQUE_CONSTANT_Nm_per_A = 0.06
COUNT_SHARE = 0.07  # of the effort limit: what one count may move the servo's damping term by
COUNTS_PER_TURN = (40_000, 100_000, 200_000, 400_000, 1_000_000, 2_000_000, 4_000_000)
COUNTS_PER_M = (1e4, 2e4, 5e4, 1e5, 2e5, 5e5, 1e6, 2e6, 5e6, 1e7, 2e7, 5e7, 1e8)
COUNTS_PER_M_USUAL = 1e6
COUNTS_MAX = 0.9 * 2**20  # over the range, either way


def dampings(reach: Envelope, viscous: Array) -> Array:
    """By joint, servo and back-EMF together: each as its inertia allows, and less for the joints
    that make the fastest motion of all too fast, step by step until it is not.

    `viscous`: the model's own damping (n,).
    """
    damping: Array = DAMPING_PER_INERTIA * reach.inertia_max
    if reach.fastest(viscous)[0] > RATE_MAX / 2:
        viscous = np.zeros_like(viscous)  # no gain can help that: `headway check` tells
    for _ in range(STEPS):
        rate, share = reach.fastest(damping + viscous)
        if rate <= RATE_MAX:
            break
        damping = damping * (RATE_MAX / rate) ** (share / share.max())
    return damping


def stiffnesses(reach: Envelope, damping: Array) -> Array:
    """By joint: damping ratio ZETA at the largest inertia, less where the damping had to be
    lowered, so that the joint does not creep; but more stiffness where gravity would topple it."""
    lowered = damping / (DAMPING_PER_INERTIA * reach.inertia_max)
    zeta = ZETA * lowered**0.25
    stiffness: Array = damping**2 / (4 * zeta**2 * reach.inertia_max)
    for _ in range(STEPS):
        toppled, share = reach.toppling(stiffness)
        if toppled <= TOPPLED_MAX:
            break
        stiffness = stiffness * (toppled / TOPPLED_MAX) ** (share / share.max())
    return stiffness


def guess_drive(
    axis: AxisGuess, stiffness: float, damping: float, most: float, servo_period_s: float
) -> None:
    """`most`: the largest inertia that the joint moves. Needs the axis' limits."""
    bandwidth, zeta = math.sqrt(stiffness / most), damping / (2 * math.sqrt(stiffness * most))
    inertia = f"{most:.3g} kg{'' if axis.joint.linear else ' m^2'}"
    axis.guess("servo.kp", stiffness, f"{bandwidth:.2g} rad/s at the largest inertia, {inertia}")
    axis.guess("servo.kd", damping * (1 - EMF_SHARE), f"damping ratio {zeta:.2g} there")
    _motor(axis, damping * EMF_SHARE)
    _encoder(axis, servo_period_s)


def _motor(axis: AxisGuess, emf: float) -> None:
    """c v + R E / c = c (v + E / emf) with R = c^2 / emf: the supply gives c."""
    board = axis.joint.board
    if board is not None:
        axis.state("motor.gear", board.gear)
        axis.state("motor.torque_constant_Nm_per_A", board.torque_constant_Nm_per_A)
        axis.state("motor.resistance_ohm", board.resistance_ohm)
        axis.state("motor.supply_V", board.supply_V)
        return
    constant = SUPPLY_SHARE * SUPPLY_V / (axis["velocity_limit"] + axis["effort_limit"] / emf)
    why = "with the next three: the supply is enough for both limits"
    axis.guess("motor.gear", constant / TORQUE_CONSTANT_Nm_per_A, why)
    axis.guess("motor.torque_constant_Nm_per_A", TORQUE_CONSTANT_Nm_per_A, "see gear")
    constant = axis["motor.gear"] * TORQUE_CONSTANT_Nm_per_A
    axis.guess("motor.resistance_ohm", constant**2 / emf, "see gear")
    axis.guess("motor.supply_V", SUPPLY_V, "see gear")


def _encoder(axis: AxisGuess, servo_period_s: float) -> None:
    board, turn = axis.joint.board, 2 * math.pi
    if board is not None and axis.joint.linear:
        axis.state("counts_per_m", board.counts_per_unit)
    elif board is not None:
        axis.state("counts_per_turn", round(board.counts_per_unit * turn))
    else:
        needed = axis["servo.kd"] / servo_period_s / (COUNT_SHARE * axis["effort_limit"])
        reach = max(map(abs, axis.poses))  # a continuous axis could go further, but need not
        why = f"one count moves the servo by less than {COUNT_SHARE:.0%} of its limit"
        if axis.joint.linear:
            counts = _finest(COUNTS_PER_M, max(needed, COUNTS_PER_M_USUAL), COUNTS_MAX / reach)
            axis.guess("counts_per_m", counts, why)
        else:
            counts = _finest(COUNTS_PER_TURN, needed * turn, COUNTS_MAX / reach * turn)
            axis.guess("counts_per_turn", counts, why)


def _finest(choices: tuple[float, ...], needed: float, most: float) -> float:
    """The least that is enough, or what comes nearest to it without being too much."""
    possible = [choice for choice in choices if choice <= most] or [choices[0]]
    return next((choice for choice in possible if choice >= needed), possible[-1])
