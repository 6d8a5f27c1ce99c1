"""Fixed-point products and the servo, against exact integers and exact sampled-data solutions."""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from headway.firmware import _core

INT32_MAX = (1 << 31) - 1
COUNT_PQ = 1 << _core.COUNT_BITS
COUNT_MAX = (1 << (30 - _core.COUNT_BITS)) - 1
PERIOD_S = 1e-3
SERVO_ERROR_MAX = (1 << 29) - 1
FILTER_PERIODS = 8

Floats = NDArray[np.float64]


def clamp(value: int, limit: int) -> int:
    return max(-limit, min(limit, value))


# ---- Scale

int32s = st.integers(-INT32_MAX - 1, INT32_MAX) | st.sampled_from(
    [s * (1 << b) + d for b in (0, 15, 16, 17, 30) for d in (-1, 0, 1) for s in (-1, 1)]
    + [INT32_MAX, -INT32_MAX, -INT32_MAX - 1]
)
mantissas = st.integers(0, 65535) | st.sampled_from([0, 1, 2, 32768, 65534, 65535])
scales = st.builds(_core.Scale, mantissas, st.integers(0, 31))


@given(mantissas, st.integers(0, 31), int32s)
@example(65535, 16, -INT32_MAX - 1)
@example(65535, 16, INT32_MAX)
def test_scale_is_the_exact_product_rounded_down(mantissa: int, shift: int, a: int) -> None:
    scale = _core.Scale(mantissa, shift)
    exact = (a * mantissa) >> shift
    edge = (1 << 31) - (1 << max(0, 16 - shift))
    if -edge <= exact < edge:
        assert scale * a == exact
    else:
        assert scale * a == (INT32_MAX if exact > 0 else -INT32_MAX)


@pytest.mark.parametrize("shift", range(32))
@pytest.mark.parametrize("mantissa", [1, 3, 255, 32768, 65535])
def test_scale_around_its_saturation(mantissa: int, shift: int) -> None:
    scale = _core.Scale(mantissa, shift)
    edge = (1 << 31) - (1 << max(0, 16 - shift))
    for sign in (-1, 1):
        centre = sign * ((edge << shift) // mantissa)
        for a in range(centre - 3, centre + 4):
            if not -INT32_MAX - 1 <= a <= INT32_MAX:
                continue
            exact = (a * mantissa) >> shift
            inside = -edge <= exact < edge
            assert scale * a == (exact if inside else sign * INT32_MAX)


@given(scales, int32s, int32s)
def test_scale_is_monotone(scale: _core.Scale, a: int, b: int) -> None:
    assert scale * min(a, b) <= scale * max(a, b)


def test_a_scale_shifts_by_31_at_the_most() -> None:
    with pytest.raises(ValueError, match="shift"):
        _core.Scale(1, 32)


# ---- Servo: the same arithmetic in unbounded integers


def servo_settings(**changes: object) -> _core.ServoSettings:
    settings = _core.ServoSettings()
    settings.torque_limit_tq = 1 << 24
    for name, value in changes.items():
        setattr(settings, name, value)
    return settings


@dataclass
class ExactServo:
    """servo.h in unbounded integers: products rounded down, sums clamped where servo.c says so."""

    settings: _core.ServoSettings
    error: int | None = None
    integral: int = 0
    differences: int = 0
    unclipped: int = 0
    torque: int = 0
    saturated: bool = False

    def step(self, position: int, velocity: int, torque: int, count: int, integrate: bool) -> int:
        def product(a: int, scale: _core.Scale) -> int:
            return (a * scale.mantissa) >> scale.shift

        s = self.settings
        error = clamp(position - clamp(count, COUNT_MAX) * COUNT_PQ, SERVO_ERROR_MAX)
        difference = 0 if self.error is None else error - self.error
        self.error = error
        pushes = (error > 0) == (self.unclipped > 0)
        if integrate and not (self.saturated and pushes):
            limit = min(s.torque_limit_tq << _core.INTEGRAL_BITS, INT32_MAX)
            increment = clamp(product(error, s.ki_tq), 1 << 28)
            self.integral = clamp(self.integral + increment, limit)
        self.differences += difference - int(Fraction(self.differences, FILTER_PERIODS))
        average = int(Fraction(self.differences, FILTER_PERIODS))  # towards zero, as in C
        emf = clamp(product(average, s.emf_tq), 1 << 27)
        terms = (
            emf,
            product(error, s.kp_tq),
            product(difference, s.kd_tq),
            product(velocity, s.velocity_tq),
            torque,
        )
        self.unclipped = sum(clamp(t, 1 << 27) for t in terms)
        self.unclipped += self.integral >> _core.INTEGRAL_BITS
        self.torque = clamp(self.unclipped, s.torque_limit_tq)
        voltage = clamp(product(self.torque - emf, s.resistance_mV), 1 << 20)
        voltage += clamp(product(velocity, s.emf_mV), 1 << 20)
        duty = product(voltage, s.supply_duty)
        clipped = clamp(duty, _core.DUTY_MAX)
        self.saturated = self.torque != self.unclipped or duty != clipped
        return clipped


positions = st.integers(-_core.POINT_MAX, _core.POINT_MAX) | st.sampled_from(
    [-_core.POINT_MAX, -1, 0, 1, _core.POINT_MAX]
)
counts = st.integers(-COUNT_MAX - 5, COUNT_MAX + 5) | int32s
steps = st.lists(st.tuples(positions, int32s, int32s, counts, st.booleans()), max_size=20)


@given(
    st.tuples(*[scales] * 8),
    st.integers(1, 1 << 25) | st.sampled_from([1, (1 << 25) - 1, 1 << 25]),
    steps,
)
def test_servo_is_exact_at_any_input(
    factors: tuple[_core.Scale, ...],
    limit: int,
    inputs: list[tuple[int, int, int, int, bool]],
) -> None:
    names = ("kp_tq", "ki_tq", "kd_tq", "velocity_tq", "resistance_mV", "emf_mV", "emf_tq")
    names = (*names, "supply_duty")
    settings = servo_settings(**dict(zip(names, factors, strict=True)), torque_limit_tq=limit)
    servo, exact = _core.Servo(), ExactServo(settings)
    for position, velocity, torque, count, integrate in inputs:
        duty = servo.step(settings, position, velocity, torque, count, integrate)
        assert duty == exact.step(position, velocity, torque, count, integrate)
        assert servo.unclipped_tq == exact.unclipped
        assert servo.torque_tq == exact.torque
        assert servo.integral == exact.integral
        assert servo.saturated == exact.saturated
        assert abs(servo.torque_tq) <= limit
        assert abs(duty) <= _core.DUTY_MAX


def test_encoder_jump_from_end_to_end() -> None:
    """The following error's difference is as large as it can be."""
    settings = servo_settings(kd_tq=_core.Scale(1, 10), torque_limit_tq=1 << 25)
    for sign in (-1, 1):
        servo = _core.Servo()
        servo.step(settings, sign * _core.POINT_MAX, 0, 0, -sign * INT32_MAX)
        servo.step(settings, -sign * _core.POINT_MAX, 0, 0, sign * INT32_MAX)
        # from one largest error to the other: 1 / 2^10 of their difference, rounded down
        assert servo.unclipped_tq == (-sign * 2 * SERVO_ERROR_MAX) >> 10


def test_encoder_that_jumps_to_and_fro_for_ever() -> None:
    """The sum of differences is the largest: each jump adds to what is left of the last ones."""
    settings = servo_settings(emf_tq=_core.Scale(1, 10), torque_limit_tq=1 << 25)
    servo, exact = _core.Servo(), ExactServo(settings)
    for period in range(200):
        end = 1 if period // (1 + period // 20) % 2 else -1
        inputs = (end * _core.POINT_MAX, 0, 0, -end * INT32_MAX)
        servo.step(settings, *inputs)
        exact.step(*inputs, integrate=True)
        assert servo.unclipped_tq == exact.unclipped
    assert abs(exact.differences) < 1 << 31


@given(st.lists(st.integers(-2000, 2000), min_size=1, max_size=40))
def test_back_emf_of_the_speed_error_is_compensated(counts: list[int]) -> None:
    """It counts as torque, but the voltage that it makes by itself is left out."""
    settings = servo_settings(
        emf_tq=_core.Scale(3, 4), resistance_mV=_core.Scale(1, 8), supply_duty=_core.Scale(1, 6)
    )
    servo, low_pass = _core.Servo(), Fraction(0)
    for last, count in zip([counts[0], *counts], counts, strict=False):
        low_pass += (last - count) * COUNT_PQ - low_pass / FILTER_PERIODS
        duty = servo.step(settings, 0, 0, 5000, count)
        emf = low_pass / FILTER_PERIODS * Fraction(3, 16)
        assert abs(servo.unclipped_tq - (5000 + emf)) < 3
        if not servo.saturated:
            assert abs(duty - Fraction(5000, 1 << 14)) < 2


# ---- the ceiling and the voltage


@given(
    st.integers(-(1 << 20), 1 << 20),
    st.integers(-(1 << 20), 1 << 20),
    st.integers(4096, 65535),
    st.integers(4096, 65535),
    st.integers(20000, 65535),
)
def test_duty_is_the_rational_formula_within_its_rounding(
    torque: int, velocity: int, resistance: int, emf: int, supply: int
) -> None:
    """duty = (torque R + velocity E) / supply: each product is rounded down once."""
    settings = servo_settings(
        resistance_mV=_core.Scale(resistance, 22),
        emf_mV=_core.Scale(emf, 22),
        supply_duty=_core.Scale(supply, 16),
    )
    servo = _core.Servo()
    duty = servo.step(settings, 0, velocity, torque, 0)
    voltage = torque * Fraction(resistance, 1 << 22) + velocity * Fraction(emf, 1 << 22)
    exact = voltage * Fraction(supply, 1 << 16)
    assert servo.torque_tq == torque
    if -_core.DUTY_MAX <= exact <= _core.DUTY_MAX - 1:
        assert 0 <= exact - duty < 2 * Fraction(supply, 1 << 16) + 1
        assert not servo.saturated
    if exact > _core.DUTY_MAX + 3 or exact < -_core.DUTY_MAX - 3:
        assert duty == (_core.DUTY_MAX if exact > 0 else -_core.DUTY_MAX)
        assert servo.saturated


@pytest.mark.parametrize("limit", [1, 1000, (1 << 25) - 1, 1 << 25])
@pytest.mark.parametrize("sign", [-1, 1])
def test_output_ceiling(limit: int, sign: int) -> None:
    settings = servo_settings(torque_limit_tq=limit)
    for torque in (limit - 1, limit, limit + 1, INT32_MAX):
        servo = _core.Servo()
        servo.step(settings, 0, 0, sign * torque, 0)
        assert servo.torque_tq == sign * min(torque, limit)
        assert servo.unclipped_tq == sign * min(torque, 1 << 27)
        assert servo.saturated == (torque > limit)


@pytest.mark.parametrize("sign", [-1, 1])
def test_duty_ends(sign: int) -> None:
    settings = servo_settings(resistance_mV=_core.Scale(1, 0), supply_duty=_core.Scale(1, 0))
    for torque, saturated in ((32766, False), (32767, False), (32768, True), (1 << 21, True)):
        servo = _core.Servo()
        duty = servo.step(settings, 0, 0, sign * torque, 0)
        assert duty == sign * min(torque, _core.DUTY_MAX)
        assert servo.saturated == saturated


# ---- closed loop: a pure inertia, torque held over each period


class Inertia:
    """x'' = gain * torque [pq/s^2 per tq], integrated exactly while the torque is held."""

    def __init__(self, gain: float, position_pq: float) -> None:
        self.gain, self.x, self.v = gain, position_pq, 0.0

    @property
    def count(self) -> int:
        return int(np.floor(self.x / COUNT_PQ + 0.5))

    def hold(self, torque_tq: float) -> None:
        a = self.gain * torque_tq
        self.x += self.v * PERIOD_S + a * PERIOD_S**2 / 2
        self.v += a * PERIOD_S


def sampled_loop(gain: float, kp: float, kd: float) -> tuple[Floats, Floats, Floats]:
    """z = [x, v, last error]: z+ = A z + b_r r + b_w w, where w is a torque.

    The plant's part is the matrix exponential of the double integrator with a held input.
    """
    block = expm(np.array([[0, 1, 0], [0, 0, gain], [0, 0, 0]]) * PERIOD_S)
    plant, held = block[:2, :2], block[:2, 2]
    feedback = np.array([-(kp + kd), 0, -kd])  # torque of z; the error is r - x
    a = np.zeros((3, 3))
    a[:2, :2] = plant
    a[:2] += np.outer(held, feedback)
    a[2] = [-1, 0, 0]
    return a, np.array([*(held * (kp + kd)), 1.0]), np.array([*held, 0.0])


def worst_gain(a: Floats, b: Floats, steps: int) -> float:
    """Largest |x| that inputs within +-1 can cause: the sum of the impulse response's sizes."""
    total, z = 0.0, b
    for _ in range(steps):
        total += abs(z[0])
        z = a @ z
    return float(total)


LOOPS = [  # natural frequency [rad/s], damping
    (20.0, 1.0),
    (50.0, 0.7),
    (120.0, 0.5),
]


def tuned(omega: float, damping: float) -> tuple[float, _core.ServoSettings, float, float]:
    gain = omega**2 / 0.25  # so that kp is 1/4 tq/pq
    kd = round(2 * damping * omega / (gain * PERIOD_S) * 1024)
    settings = servo_settings(
        kp_tq=_core.Scale(1 << 14, 16), kd_tq=_core.Scale(kd, 10), velocity_tq=_core.Scale(3, 4)
    )
    return gain, settings, 0.25, kd / 1024


@pytest.mark.parametrize(("omega", "damping"), LOOPS)
@pytest.mark.parametrize("start_counts", [-3000, 12345])
def test_step_response_is_the_sampled_systems(
    omega: float, damping: float, start_counts: int
) -> None:
    gain, settings, kp, kd = tuned(omega, damping)
    a, b_r, b_w = sampled_loop(gain, kp, kd)
    steps, start = 400, float(start_counts * COUNT_PQ)
    plant, servo = Inertia(gain, start), _core.Servo()
    # The encoder is off by half a count at most, the torque by one rounding of each product.
    bound = worst_gain(a, b_r, steps) * COUNT_PQ / 2 + worst_gain(a, b_w, steps) * 2
    assert bound < abs(start) / 50
    z0 = np.array([start, 0.0, -start])
    for n in range(steps):
        exact = np.linalg.matrix_power(a, n) @ z0
        assert abs(plant.x - exact[0]) <= bound
        servo.step(settings, 0, 0, 0, plant.count)
        plant.hold(servo.torque_tq)
    assert abs(plant.x) < abs(start) / 10  # it has moved, to where it should


@pytest.mark.parametrize(("omega", "damping"), LOOPS)
@given(seed=st.integers(0, 2**32))
def test_any_setpoint_and_feed_forward(omega: float, damping: float, seed: int) -> None:
    gain, settings, kp, kd = tuned(omega, damping)
    a, b_r, b_w = sampled_loop(gain, kp, kd)
    rng, steps = np.random.default_rng(seed), 60
    references = np.cumsum(rng.integers(-20_000, 20_001, steps))
    torques = rng.integers(-50_000, 50_001, steps)
    velocities = rng.integers(-80_000, 80_001, steps)
    plant, servo = Inertia(gain, 0.0), _core.Servo()
    bound = worst_gain(a, b_r, steps) * COUNT_PQ / 2 + worst_gain(a, b_w, steps) * 3
    z = np.array([0.0, 0.0, float(references[0])])  # the first difference is none
    for r, torque, velocity in zip(references, torques, velocities, strict=True):
        servo.step(settings, int(r), int(velocity), int(torque), plant.count)
        plant.hold(servo.torque_tq)
        z = a @ z + b_r * r + b_w * (torque + 3 / 16 * velocity)
        assert abs(plant.x - z[0]) <= bound


# ---- the integrator


def run_integrating(limit: int, steps: int, anti_windup: bool) -> tuple[Floats, list[int]]:
    """Positions and integrals of a step of 2000 counts with an integrator and a low ceiling."""
    omega = 50.0
    gain, settings, kp, kd = tuned(omega, 0.9)
    settings.ki_tq = _core.Scale(20, 6)  # 0.3 of kp, per 64 periods: slower than the loop
    settings.torque_limit_tq = limit
    plant, servo = Inertia(gain, -2000.0 * COUNT_PQ), _core.Servo()
    positions, integrals, integral, last = [], [], 0.0, None
    for _ in range(steps):
        if anti_windup:
            servo.step(settings, 0, 0, 0, plant.count)
            torque = float(servo.torque_tq)
            integrals.append(servo.integral)
        else:  # the same law with an integral that always grows
            error = -plant.count * COUNT_PQ
            integral += error * 20 / 64 / (1 << _core.INTEGRAL_BITS)
            rate = 0 if last is None else error - last
            last = error
            torque = float(np.clip(kp * error + kd * rate + integral, -limit, limit))
        plant.hold(torque)
        positions.append(plant.x)
    return np.array(positions), integrals


def test_recovers_from_saturation() -> None:
    limit, steps = 60_000, 2500
    guarded, integrals = run_integrating(limit, steps, anti_windup=True)
    naive, _ = run_integrating(limit, steps, anti_windup=False)
    assert max(map(abs, integrals)) <= limit << _core.INTEGRAL_BITS
    step = 2000 * COUNT_PQ
    assert naive.max() > 0.5 * step  # without a guard it overshoots by most of the step
    assert guarded.max() < 0.15 * step
    assert np.abs(guarded[-500:]).max() < 5 * COUNT_PQ

    def settled(positions: Floats) -> int:
        return int(np.flatnonzero(np.abs(positions) > 0.05 * step)[-1])

    assert settled(guarded) < 0.6 * settled(naive)


@pytest.mark.parametrize("sign", [-1, 1])
def test_integral_is_bounded_and_returns_at_once(sign: int) -> None:
    limit = 1000
    settings = servo_settings(ki_tq=_core.Scale(1, 0), torque_limit_tq=limit)
    servo, bound = _core.Servo(), limit << _core.INTEGRAL_BITS
    error_counts = -10 * sign
    for n in range(1, 21):
        servo.step(settings, 0, 0, 0, error_counts)
        assert servo.integral == sign * min(10 * COUNT_PQ * n, bound)
    # more torque than the ceiling: the integral rests while the error pushes on ...
    servo.step(settings, 0, 0, sign * 10, error_counts)
    assert servo.saturated
    servo.integral = held = sign * (bound - 640)
    servo.step(settings, 0, 0, sign * 11, error_counts)
    assert servo.integral == held
    # ... and falls with the first error of the other sign
    servo.step(settings, 0, 0, sign * 11, -error_counts)
    assert servo.integral == held - sign * 10 * COUNT_PQ


def test_integral_stops_at_the_voltage_too() -> None:
    settings = servo_settings(
        ki_tq=_core.Scale(1, 0), resistance_mV=_core.Scale(1, 0), supply_duty=_core.Scale(1, 0)
    )
    servo = _core.Servo()
    servo.step(settings, 0, 0, 40_000, -1)
    assert servo.saturated and servo.torque_tq == servo.unclipped_tq
    held = servo.integral
    servo.step(settings, 0, 0, 40_000, -1)
    assert servo.integral == held == COUNT_PQ


@given(steps)
def test_integrator_rests(inputs: list[tuple[int, int, int, int, bool]]) -> None:
    settings = servo_settings(ki_tq=_core.Scale(65535, 10), kp_tq=_core.Scale(1, 3))
    servo = _core.Servo()
    servo.integral = 12345
    for position, velocity, torque, count, _ in inputs:
        servo.step(settings, position, velocity, torque, count, integrate=False)
        assert servo.integral == 12345


def test_integral_holds_a_constant_load() -> None:
    """It takes over a load without a following error, at the rate that ki_tq says."""
    settings = servo_settings(ki_tq=_core.Scale(1, 4))
    servo = _core.Servo()
    for n in range(1, 200):
        servo.step(settings, 0, 0, 0, -3)
        assert servo.integral == n * (3 * COUNT_PQ >> 4)
        assert servo.torque_tq == servo.integral >> _core.INTEGRAL_BITS
