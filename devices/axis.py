"""An axis' quanta: from SI at the joint to the device's integers, and the device's settings.

Positions are in 1/1024 of an encoder count (pq). A torque quantum (tq; of force on a linear axis)
is the smallest power of ten of Nm or N with which the limit is at most 2^25 quanta: 1 uNm for
limits from 3.4 to 33 Nm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from headway.configs.axis import Axis
from headway.configs.schema import Device, Loop
from headway.firmware import _core


@dataclass(frozen=True)
class AxisUnits:
    """Quanta of one axis; arrays in, arrays out."""

    pq_per_unit: float  # per rad or m
    tq_per_effort: float  # per Nm or N
    knot_s: float

    @classmethod
    def of(cls, axis: Axis, loop: Loop) -> AxisUnits:
        """Quanta for an axis of the config."""
        tq_per_effort = 10.0 ** math.floor(math.log10(_core.TORQUE_MAX / axis.effort_limit))
        pq_per_unit = axis.counts_per_unit * (1 << _core.COUNT_BITS)
        return cls(pq_per_unit, tq_per_effort, loop.knot_us * 1e-6)

    @property
    def unit_per_count(self) -> float:
        """One encoder count [rad or m]."""
        return (1 << _core.COUNT_BITS) / self.pq_per_unit

    def position_points(self, position: NDArray[np.float64]) -> NDArray[np.int32]:
        """Control points in pq, rounded."""
        return np.rint(position * self.pq_per_unit).astype(np.int32)

    def torque_points(self, effort: NDArray[np.float64]) -> NDArray[np.int32]:
        """Control points in tq, rounded."""
        return np.rint(effort * self.tq_per_effort).astype(np.int32)


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


def device_settings(axis: Axis, device: Device, loop: Loop) -> _core.DeviceSettings:
    """What a board is flashed with, but for its key and session.

    Raises ValueError if a limit or a gain does not fit the device's integers.
    """
    units = AxisUnits.of(axis, loop)
    period_s = device.servo_period_us * 1e-6
    tq_per_pq = units.tq_per_effort / units.pq_per_unit
    motor, gains = axis.motor, axis.servo
    servo = _core.ServoSettings()
    servo.kp_tq = scale_of(gains.kp * tq_per_pq)
    integral = gains.ki * period_s * tq_per_pq * (1 << _core.INTEGRAL_BITS)
    servo.ki_tq = scale_of(integral)
    servo.kd_tq = scale_of(gains.kd / period_s * tq_per_pq)
    servo.velocity_tq = scale_of(0.0)
    servo.resistance_mV = scale_of(
        1e3 * motor.resistance_ohm / motor.constant / units.tq_per_effort
    )
    servo.emf_mV = scale_of(1e3 * motor.constant / (units.pq_per_unit * units.knot_s))
    servo.emf_tq = scale_of(motor.damping / period_s * tq_per_pq)
    servo.supply_duty = scale_of(32768 / (1e3 * motor.supply_V))
    servo.torque_limit_tq = round(axis.effort_limit * units.tq_per_effort)
    servo.integrate_running = device.integrate_while_running

    settings = _core.DeviceSettings()
    settings.knot_shift = loop.knot_shift
    settings.servo_period_us = device.servo_period_us
    settings.sample_every = device.sample_every
    settings.servo = servo
    settings.set_limits(_core.TRACK_POSITION, position_limits(axis, units))
    settings.set_limits(_core.TRACK_TORQUE, torque_limits(axis, units))
    return settings


def position_limits(axis: Axis, units: AxisUnits) -> _core.GateLimits:
    """The gate's limits on position control points.

    Raises ValueError if one does not fit the device's integers.
    """
    position, speed = units.pq_per_unit, units.pq_per_unit * units.knot_s
    acceleration = speed * units.knot_s
    low, high = axis.position_min, axis.position_max
    v, a = axis.velocity_limit, axis.acceleration_limit
    for name, value, quanta, least, most in (
        ("position_min", low, position, -_core.POINT_MAX, _core.POINT_MAX),
        ("position_max", high, position, -_core.POINT_MAX, _core.POINT_MAX),
        ("velocity_limit", v, speed, 1, _core.DIFFERENCE_MAX),
        ("acceleration_limit", a, acceleration, 1, 2**31 - 1),
    ):
        if not least <= value * quanta <= most:
            raise ValueError(
                f"{axis.joint}: {axis.key(name)} is {value:g}; with {axis.counts_per_unit:.6g} "
                f"counts per {axis.unit} and this knot it can be {least / quanta:.3g} to "
                f"{most / quanta:.3g}"
            )
    return _core.GateLimits(
        math.ceil(low * position),
        math.floor(high * position),
        math.floor(v * speed),
        math.floor(a * acceleration),
    )


def torque_limits(axis: Axis, units: AxisUnits) -> _core.GateLimits:
    """The gate's limits on torque control points; their differences are bounded by the range."""
    limit = math.floor(axis.effort_limit * units.tq_per_effort)
    step = min(2 * limit, _core.DIFFERENCE_MAX)
    return _core.GateLimits(-limit, limit, step, 2 * step)
