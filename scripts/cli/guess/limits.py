"""How strong, how fast and how hard an axis may be driven."""

from __future__ import annotations

import math

from headway.cli.guess.axes import BELIEVED, BUILT_FOR, AxisGuess
from headway.controller.equations import COULOMB_SPEED

HOLDING = 3.0  # times the static load
STALL_SHARE, SUPPLY_SHARE = 0.5, 0.85  # of a given motor's stall effort and supply
SPEED_BELIEVED = 4.0  # times what the effort reaches over the range
# Of known friction near rest, at the least inertia [1/s]: what a step of two knots can follow.
COULOMB_RATE_MAX = 150.0
STOP_SHARE = 0.7  # of the deceleration that the spare effort gives
STOP_LEAST = 0.05  # of the effort, where the load leaves nothing
STOP_RATE = 8.0  # times the velocity limit [1/s]: a harder stop gains nothing


def guess_limits(axis: AxisGuess, most: float, least: float, load: float) -> None:
    """`most`, `least`: inertia that the joint moves; `load`: static effort at most."""
    load += axis.joint.coulomb
    _effort(axis, most, load)
    _speed(axis, most, load)
    acceleration = 1.5 * axis["effort_limit"] / least
    axis.guess("acceleration_limit", acceleration, "1.5 times what the effort makes at most")
    _stop(axis, most, load)
    _coulomb(axis, least)


def _effort(axis: AxisGuess, most: float, load: float) -> None:
    stated, unit, board = axis.joint.effort, axis.unit, axis.joint.board
    believed = HOLDING * load + BELIEVED[unit] * most
    if stated is not None and stated <= believed:
        axis.state("effort_limit", stated)
    elif stated is not None:
        why = f"the model has {stated:g}, for an inertia of only {most:.2g}"
        axis.guess("effort_limit", believed, why)
    else:
        built_for = BUILT_FOR[unit]
        effort = HOLDING * load + built_for * most
        if board is not None:
            stall = board.gear * board.torque_constant_Nm_per_A * board.supply_V
            effort = min(effort, STALL_SHARE * stall / board.resistance_ohm)
        why = f"holds {HOLDING:g} times its load and gives {built_for:g} {unit}/s^2"
        axis.guess("effort_limit", effort, why)


def _speed(axis: AxisGuess, most: float, load: float) -> None:
    stated, effort, board = axis.joint.velocity, axis["effort_limit"], axis.joint.board
    spare = max(effort - load, 0.2 * effort)
    low, high = axis.poses
    reached = 0.5 * math.sqrt(spare / most * (high - low))
    where = "a turn" if axis.joint.continuous else "the range"
    why = f"half of what the effort reaches over {where}"
    if board is not None:
        constant = board.gear * board.torque_constant_Nm_per_A
        rest_V = SUPPLY_SHARE * board.supply_V - board.resistance_ohm * effort / constant
        reached = min(reached, rest_V / constant)
    if stated is None:
        axis.guess("velocity_limit", reached, why)
    elif stated > SPEED_BELIEVED * reached:
        axis.guess("velocity_limit", reached, f"{why}; the model has {stated:g}")
    else:
        axis.state("velocity_limit", stated)


def _stop(axis: AxisGuess, most: float, load: float) -> None:
    spare = max(axis["effort_limit"] - load, STOP_LEAST * axis["effort_limit"])
    possible, enough = STOP_SHARE * spare / most, STOP_RATE * axis["velocity_limit"]
    if possible < enough:
        why = f"{STOP_SHARE:.0%} of what the effort gives beyond its load"
        axis.guess("stop_deceleration", possible, why)
    else:
        why = f"stops from the velocity limit within {1 / STOP_RATE:g} s"
        axis.guess("stop_deceleration", enough, why)


def _coulomb(axis: AxisGuess, least: float) -> None:
    stated, predictable = axis.joint.coulomb, COULOMB_RATE_MAX * COULOMB_SPEED * least
    if stated > predictable:
        why = f"the model has {stated:g}: too stiff to predict, for its inertia"
        axis.guess("coulomb", predictable, why)
    elif stated:
        axis.state("coulomb", stated)
