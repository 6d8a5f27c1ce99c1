"""An axis' quanta: from SI at the joint to the device's integers, and its limits in them.

Positions are in 1/1024 of an encoder count (pq). A torque quantum (tq; of force on a linear axis)
is the smallest power of ten of Nm or N with which the limit is at most 2^25 quanta: 1 uNm for
limits from 3.4 to 33 Nm.

A continuous axis has its points and its tracks modulo 2^32 pq, 2^22 counts; here, and only here,
they are brought back to an angle without bounds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from headway.configs.axis import Axis, DrivenAxis
from headway.configs.schema import Device, Loop
from headway.devices._tracks import unwrap
from headway.firmware import _core

GAIN_BITS = 8  # of a gain's control point after the point of the mantissa
# Knots in which a gain may go from zero to the configured one: its second differences then take
# three bytes in a frame, at worst.
GAIN_KNOTS = 16
TURN = 2 * math.pi  # of a continuous axis: after it every pose comes again


@dataclass(frozen=True)
class AxisUnits:
    """Quanta of one axis; arrays in, arrays out."""

    pq_per_unit: float  # per rad or m
    tq_per_effort: float  # per Nm or N
    knot_s: float
    continuous: bool

    @classmethod
    def of(cls, axis: Axis, loop: Loop) -> AxisUnits:
        """Quanta for an axis of the config."""
        tq_per_effort = 1.0  # of a passive axis, which has no effort
        if not axis.passive:
            tq_per_effort = 10.0 ** math.floor(math.log10(_core.TORQUE_MAX / axis.effort_limit))
        pq_per_unit = axis.counts_per_unit * (1 << _core.COUNT_BITS)
        return cls(pq_per_unit, tq_per_effort, loop.knot_us * 1e-6, axis.continuous)

    @property
    def unit_per_count(self) -> float:
        """One encoder count [rad or m]."""
        return (1 << _core.COUNT_BITS) / self.pq_per_unit

    def position_points(self, position: NDArray[np.float64]) -> NDArray[np.int32]:
        """Control points in pq, rounded; modulo 2^32 on a continuous axis."""
        points = np.rint(position * self.pq_per_unit)
        return (points.astype(np.int64) if self.continuous else points).astype(np.int32)

    def unwrapped(self, points: NDArray[np.int32], near: float) -> NDArray[np.float64]:
        """Control points, or a track at several times, in pq without bounds.

        On a continuous axis each follows the one before it by less than half of the 2^32, and of
        all that the first may stand for it is the one next to the position `near` [rad].
        """
        if not self.continuous:
            return points.astype(np.float64)
        return unwrap(points, near * self.pq_per_unit)

    def torque_points(self, effort: NDArray[np.float64]) -> NDArray[np.int32]:
        """Control points in tq, rounded."""
        return np.rint(effort * self.tq_per_effort).astype(np.int32)


def whole_turns(axes: Sequence[Axis], way: NDArray[np.float64]) -> NDArray[np.float64]:
    """The part of ways (..., n) on the axes that makes no difference: on a continuous one all whole
    turns in it, on others nothing [rad or m]."""
    turn = np.array([TURN if axis.continuous else 0.0 for axis in axes])
    turns: NDArray[np.float64] = turn * np.rint(way / TURN)
    return turns


def scale_of(factor: float) -> _core.Scale:
    """The nearest mantissa / 2^shift with 16 bits of mantissa.

    Raises ValueError for a factor that no scale can hold.
    """
    if factor == 0:
        return _core.Scale(0, 0)
    shift = min(31, 15 - math.floor(math.log2(factor)))
    mantissa = round(factor * 2.0**shift)
    if mantissa > 65535:
        mantissa, shift = round(factor * 2.0 ** (shift - 1)), shift - 1
    if factor < 0 or shift < 0 or mantissa == 0:
        raise ValueError(f"the factor {factor:g} is outside a fixed-point scale's range")
    return _core.Scale(mantissa, shift)


def gain_factors(device: Device, units: AxisUnits) -> dict[int, float]:
    """By sink, what a gain in SI is multiplied by to be the device's, see firmware/servo.h."""
    period_s = device.servo_period_us * 1e-6
    tq_per_pq = units.tq_per_effort / units.pq_per_unit
    return {
        _core.TRACK_KP: tq_per_pq,
        _core.TRACK_KI: period_s * tq_per_pq * (1 << _core.INTEGRAL_BITS),
        _core.TRACK_KD: 1 / period_s * tq_per_pq,
    }


def gain_scales(axis: DrivenAxis, device: Device, units: AxisUnits) -> dict[int, _core.Scale]:
    """By sink, the configured gain as the device has it. A gain track's control points are such a
    scale's mantissa, Q8.

    Raises ValueError if one does not fit the device's integers.
    """
    factors, servo = gain_factors(device, units), axis.servo
    gains = {_core.TRACK_KP: servo.kp, _core.TRACK_KI: servo.ki, _core.TRACK_KD: servo.kd}
    return {sink: scale_of(gain * factors[sink]) for sink, gain in gains.items()}


def gain_limits(axis: DrivenAxis, device: Device, units: AxisUnits) -> dict[int, _core.GateLimits]:
    """By sink, the gate's limits on a gain's control points: from zero to the configured gain, all
    the way in GAIN_KNOTS at the fastest. As both differences have the same limit, a gain track may
    stop anywhere."""
    limits = {}
    for sink, scale in gain_scales(axis, device, units).items():
        top = scale.mantissa << GAIN_BITS
        step = max(1, top // GAIN_KNOTS)
        limits[sink] = _core.GateLimits(0, top, step, step)
    return limits


def position_limits(axis: DrivenAxis, units: AxisUnits) -> _core.GateLimits:
    """The gate's limits on position control points.

    Raises ValueError if one does not fit the device's integers.
    """
    position, speed = units.pq_per_unit, units.pq_per_unit * units.knot_s
    acceleration = speed * units.knot_s
    v, a = axis.velocity_limit, axis.acceleration_limit
    ends = (
        ("position_min", axis.lowest, position, -_core.POINT_MAX, _core.POINT_MAX),
        ("position_max", axis.highest, position, -_core.POINT_MAX, _core.POINT_MAX),
    )
    for name, value, quanta, least, most in (
        *(() if axis.continuous else ends),
        ("velocity_limit", v, speed, 1, _core.DIFFERENCE_MAX),
        ("acceleration_limit", a, acceleration, 1, 2**31 - 1),
        ("stop_deceleration", axis.deceleration, acceleration, 1, 2 * _core.DIFFERENCE_MAX),
    ):
        if not least <= value * quanta <= most:
            raise ValueError(
                f"{axis.joint}: {axis.key(name)} is {value:g}; with {axis.counts_per_unit:.6g} "
                f"counts per {axis.unit} and this knot it can be {least / quanta:.3g} to "
                f"{most / quanta:.3g}"
            )
    low, high = -_core.POINT_MAX, _core.POINT_MAX  # which a continuous axis does not look at
    if not axis.continuous:
        low, high = math.ceil(axis.lowest * position), math.floor(axis.highest * position)
    return _core.GateLimits(
        low,
        high,
        math.floor(v * speed),
        math.floor(a * acceleration),
        math.floor(axis.deceleration * acceleration),
        axis.continuous,
    )


def torque_limits(axis: DrivenAxis, units: AxisUnits) -> _core.GateLimits:
    """The gate's limits on torque control points; their differences are bounded by the range."""
    limit = math.floor(axis.effort_limit * units.tq_per_effort)
    step = min(2 * limit, _core.DIFFERENCE_MAX)
    return _core.GateLimits(-limit, limit, step, 2 * step)
