"""A board's settings: the config's numbers as the device's integers.

What the monitor allows is derived from an axis' limits where the config has no key of its own.
"""

from __future__ import annotations

import math

from headway.configs.axis import Axis, DrivenAxis, StepperAxis
from headway.configs.schema import Device, Loop, Sync
from headway.devices.axis import (
    AxisUnits,
    gain_limits,
    gain_scales,
    position_limits,
    scale_of,
    torque_limits,
)
from headway.firmware import _core

NAME_MAX = 25  # bytes
TORQUE_SLEW_S = 0.05  # of the whole torque limit, while a board stops by itself
FOLLOWING_S = 0.02  # beyond the following limit
CLIPPED_S = 1.0  # at the torque limit without a break
SPEED_SHARE = 1.25  # of a plan's velocity limit, as measured
WINDING_RISE = 1.1  # of the rated rise of the winding's temperature
STUCK_COUNTS, STUCK_S = 128, 0.1  # of the setpoint, or pushing hard, without a count
JOG_SHARE, JOG_RAMP_S = 0.05, 0.2  # of the velocity limit; until that is reached
JOG_EFFORT_SHARE = 0.25  # of the effort limit, what the feedback may add to what holds the axis
SLOW_Q16 = 2**30 - 1  # the fastest that a board homes or jogs, in its own quanta
SYNC_METHODS = ["bounds", "average"]
SPIKE_MAX = 2**18 - 1  # counts: none is one
PLAN_RATE_SHARE = 1023 / 1024  # of a stepper's rate: its clock may run faster than its counter
STILL_S = 0.08  # pushing against a stop without a count


def device_settings(axis: Axis, device: Device, loop: Loop, sync: Sync) -> _core.DeviceSettings:
    """What a board is flashed with, but for its key and session.

    Raises ValueError if a limit or a gain does not fit the device's integers.
    """
    settings = _core.DeviceSettings()
    settings.name = axis.joint.encode()[:NAME_MAX].decode(errors="ignore")
    settings.knot_shift = loop.knot_shift
    settings.servo_period_us = device.servo_period_us
    settings.sample_every = device.sample_every
    settings.brake_periods = round(device.brake_us / device.servo_period_us)
    settings.stop_us, settings.sync_lost_us = device.stop_us, device.sync_lost_us
    settings.knot_periods = scale_of(loop.knot_us / device.servo_period_us)
    settings.sync, settings.dither_us = sync_settings(sync), sync.dither_us
    settings.neighbours = sum(1 << port for port in _cable_ports(axis.joint, sync))
    settings.ask_us, settings.peer_least_us = sync.ask_us, sync.cable_least_us
    if axis.passive:
        _encoder_alone(settings)
    else:
        _drive(settings, axis, device, loop)
    return settings


def _cable_ports(joint: str, sync: Sync) -> list[int]:
    """Where another board is."""
    ends = (end for c in sync.cables for end in zip(c.joints, c.ports, strict=True))
    return [port for name, port in ends if name == joint]


def _encoder_alone(settings: _core.DeviceSettings) -> None:
    """A board without a motor: no sink has limits, so that it takes no track; whatever it may be
    asked for, its duty is zero. All else is the least that settings may be."""
    servo, monitor, home = _core.ServoSettings(), _core.MonitorSettings(), _core.HomeSettings()
    servo.torque_limit_tq = settings.torque_step_tq = 1
    monitor.following_pq = monitor.speed_pq = monitor.stuck_pq = 1
    monitor.deceleration_q16 = monitor.rise_q16 = 1
    monitor.spike_counts, monitor.chopper_mV = SPIKE_MAX, 2**31 - 1
    home.method, home.acceleration_q16 = _core.HOME_METHODS.index("none"), 1
    settings.servo, settings.monitor, settings.home = servo, monitor, home


def _drive(settings: _core.DeviceSettings, axis: DrivenAxis, device: Device, loop: Loop) -> None:
    """The motor and its servo, what it may do and what it does about gaps."""
    units = AxisUnits.of(axis, loop)
    period_s = device.servo_period_us * 1e-6
    servo = _core.ServoSettings()
    servo.torque_limit_tq = round(axis.effort_limit * units.tq_per_effort)
    if not isinstance(axis, StepperAxis):
        _servo(servo, axis, device, units)
    settings.torque_step_tq = math.ceil(servo.torque_limit_tq * period_s / TORQUE_SLEW_S)
    settings.carries_gravity = axis.carries_gravity
    settings.servo = servo
    settings.set_limits(_core.TRACK_POSITION, position_limits(axis, units))
    settings.set_limits(_core.TRACK_TORQUE, torque_limits(axis, units))
    settings.monitor = monitor_settings(axis, device, loop)
    settings.home = home_settings(axis, device, units)
    policies = _core.GAP_POLICIES
    settings.set_gap_policy(_core.TRACK_POSITION, policies.index(device.position_gap))
    settings.set_gap_policy(_core.TRACK_TORQUE, policies.index(device.torque_gap))
    if isinstance(axis, StepperAxis):
        settings.step_least_q16 = step_least_q16(axis, device, loop)
        return
    for sink, limits in gain_limits(axis, device, units).items():
        settings.set_limits(sink, limits)
        settings.set_gap_policy(sink, policies.index("hold"))


def step_least_q16(axis: StepperAxis, device: Device, loop: Loop) -> int:
    """From a step to the next one at least [1/65536 us].

    Raises ValueError, with what is possible, for limits with which a board could not keep its
    promises (firmware/settings.c has them).
    """
    period_s, key = device.servo_period_us * 1e-6, axis.stepper.key("rate")
    least_q16 = math.ceil(65536e6 / axis.stepper.rate)
    _fit(least_q16, f"the time between two steps by {axis.joint}: stepper.{key}", 2**32 - 1)
    rate = 65536e6 / least_q16
    fastest = PLAN_RATE_SHARE * rate / axis.counts_per_unit
    if 2 * device.servo_period_us > loop.knot_us:
        raise ValueError(
            f"{axis.joint}: a stepper's board is a servo period ahead: device.servo_period_us is "
            f"at most half of loop.knot_us, {loop.knot_us // 2}"
        )
    for name, value, most in (
        ("velocity_limit", axis.velocity_limit, fastest),
        ("acceleration_limit", axis.acceleration_limit, 2 / period_s**2 / axis.counts_per_unit),
    ):
        if value > most:
            raise ValueError(
                f"{axis.joint}: {axis.key(name)} is {value:g}; with steps at {rate:g} a second and "
                f"this servo period it can be {most:.6g} at most"
            )
    if axis.homing.speed > fastest:
        raise ValueError(
            f"{axis.joint}: homing.{axis.homing.key('speed')} is {axis.homing.speed:g}; with steps "
            f"at {rate:g} a second it can be {fastest:.6g} at most"
        )
    return least_q16


def _servo(servo: _core.ServoSettings, axis: DrivenAxis, device: Device, units: AxisUnits) -> None:
    """Of a motor that follows its setpoint by feedback."""
    period_s = device.servo_period_us * 1e-6
    tq_per_pq = units.tq_per_effort / units.pq_per_unit
    motor, scales = axis.motor, gain_scales(axis, device, units)
    servo.kp_tq = scales[_core.TRACK_KP]
    servo.ki_tq = scales[_core.TRACK_KI]
    servo.kd_tq = scales[_core.TRACK_KD]
    servo.velocity_tq, servo.acceleration_tq = (
        _track_scale(axis, name, tq_per_pq / units.knot_s**order)
        for order, name in enumerate(("velocity", "acceleration"), 1)
    )
    ahead_us = axis.servo.ahead_us
    servo.ahead_us = device.servo_period_us // 2 if ahead_us is None else ahead_us
    servo.resistance_mV = scale_of(
        1e3 * motor.resistance_ohm / motor.constant / units.tq_per_effort
    )
    servo.emf_mV = scale_of(1e3 * motor.constant / (units.pq_per_unit * units.knot_s))
    servo.emf_tq = scale_of(motor.damping / period_s * tq_per_pq)
    servo.supply_duty = scale_of(32768 / (1e3 * motor.supply_V))
    servo.integrate_running = device.integrate_while_running


def monitor_settings(axis: DrivenAxis, device: Device, loop: Loop) -> _core.MonitorSettings:
    """What the board allows its axis to do, as measured there.

    Raises ValueError if a limit does not fit the device's integers.
    """
    units, period_s, motor = AxisUnits.of(axis, loop), device.servo_period_us * 1e-6, axis.motor
    position, speed = units.pq_per_unit, units.pq_per_unit * period_s
    count = 1 << _core.COUNT_BITS
    following = axis.following * position
    monitor = _core.MonitorSettings()
    monitor.following_pq = _fit(following, f"{axis.joint}: {axis.key('following_limit')}", 2**29)
    monitor.following_periods = math.ceil(FOLLOWING_S / period_s)
    monitor.speed_pq = math.ceil(SPEED_SHARE * axis.velocity_limit * speed) + count
    monitor.bounded = not axis.continuous
    if monitor.bounded:
        monitor.low_pq = math.floor(axis.lowest * position - following)
        monitor.high_pq = math.ceil(axis.highest * position + following)
    monitor.deceleration_q16 = _fit(
        axis.deceleration * speed * period_s * 65536,
        f"{axis.joint}: {axis.key('stop_deceleration')}",
        2**31 - 1,
    )
    monitor.torque_periods = math.ceil(CLIPPED_S / period_s)
    continuous_A = axis.effort_limit / motor.constant
    if motor.continuous_A is not None:
        continuous_A = motor.continuous_A
    monitor.load_q8 = scale_of(256 / (continuous_A * motor.constant * units.tq_per_effort))
    monitor.overload = round(3 * motor.overload_s / period_s)  # twice the current: 2^2 - 1
    monitor.heating_q16 = min(65535, math.ceil(65536 * 256 * period_s / motor.winding_s))
    monitor.rise_q16 = round(65536 * WINDING_RISE)
    monitor.stuck_pq = max(4 * count, round(min(STUCK_COUNTS * count, following / 2)))
    monitor.stuck_periods = math.ceil(STUCK_S / period_s)
    monitor.spike_counts = 16 + math.ceil(4 * axis.velocity_limit * speed / count)
    low_V, high_V = motor.supply_min_V, motor.supply_max_V
    low_V = 0.7 * motor.supply_V if low_V is None else low_V
    high_V = 1.25 * motor.supply_V if high_V is None else high_V
    monitor.supply_min_mV, monitor.supply_max_mV = round(1e3 * low_V), round(1e3 * high_V)
    monitor.chopper_mV = round(500 * (motor.supply_V + high_V))
    monitor.late_us = 4 * device.servo_period_us
    return monitor


def sync_settings(sync: Sync) -> _core.SyncSettings:
    """How the board keeps its clock."""
    settings = _core.SyncSettings()
    settings.method = SYNC_METHODS.index(sync.method)
    settings.limit_us = sync.limit_us
    settings.to_device_least_us = sync.to_device_least_us
    settings.to_host_least_us = sync.to_host_least_us
    settings.drift_ppm = math.ceil(sync.drift_ppm)
    settings.wander_ppb_s = math.ceil(sync.wander_ppm_per_s * 1000)
    settings.interval_us = sync.average_us
    per_us_q32 = 2.0**32 * 1e-6  # a rate in 2^-32, of an offset in us
    settings.phase_gain = round(sync.average_phase_per_s * per_us_q32)
    settings.skew_gain_q8 = round(sync.average_skew_per_s * per_us_q32 * 256)
    return settings


def home_settings(axis: DrivenAxis, device: Device, units: AxisUnits) -> _core.HomeSettings:
    """How the board finds out where its axis is, and how it jogs.

    Raises ValueError if the speed does not fit the device's integers.
    """
    period_s, homing = device.servo_period_us * 1e-6, axis.homing
    per_period_q16 = units.pq_per_unit * period_s * 65536
    effort, method = JOG_EFFORT_SHARE * axis.effort_limit, "none"
    home = _core.HomeSettings()
    if homing is not None:
        method = homing.method
        effort = effort if homing.effort is None else homing.effort
        home.backwards = homing.backwards
        home.mark_count = round(homing.mark * axis.counts_per_unit)
        home.way_counts = round(homing.way * axis.counts_per_unit)
        home.still_periods = math.ceil(STILL_S / period_s)
    home.method = _core.HOME_METHODS.index(method)
    home.speed_q16 = min(SLOW_Q16, round(JOG_SHARE * axis.velocity_limit * per_period_q16))
    if homing is not None:
        key = f"{axis.joint}: homing.{homing.key('speed')}"
        home.speed_q16 = _fit(homing.speed * per_period_q16, key, SLOW_Q16)
    home.acceleration_q16 = max(1, round(home.speed_q16 * period_s / JOG_RAMP_S))
    home.torque_tq = round(effort * units.tq_per_effort)
    return home


def _track_scale(axis: DrivenAxis, name: str, factor: float) -> _core.Scale:
    """A gain on what the position track does. Raises ValueError where it does not fit."""
    gain: float = getattr(axis.servo, name)
    try:
        return scale_of(gain * factor)
    except ValueError as error:
        raise ValueError(
            f"{axis.joint}: servo.{axis.servo.key(name)} is {gain:g}; with this knot and encoder "
            f"it can be 0, or {2.0**-31 / factor:.3g} to {65535 / factor:.3g}"
        ) from error


def _fit(value: float, name: str, most: int) -> int:
    if not 1 <= value <= most:
        raise ValueError(f"{name} is {value:.6g} of the board's quanta; they hold 1 to {most}")
    return round(value)
