"""Vectors of the servo: each term alone, each ceiling, the integral and its stop; then all."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from line import Value, line

INT_MAX, INT_MIN = (1 << 31) - 1, -(1 << 31)
FREE = 1 << 30  # a feedback limit that never acts
NONE: list[int] = [0, 0]
SCALES = (
    *("kp_tq", "ki_tq", "kd_tq", "velocity_tq", "resistance_mV", "emf_mV", "emf_tq"),
    *("supply_duty", "kp", "ki", "kd"),
)
USUAL: dict[str, Value] = {
    **dict.fromkeys(SCALES, NONE), "torque_limit_tq": 1 << 24, "position_pq": 0, "velocity_pq": 0,
    "torque_tq": 0, "feedback_limit_tq": FREE, "integrate": 0,
}  # fmt: skip
REAL: dict[str, Value] = {  # arm2's first axis, about
    "velocity_tq": [48_000, 16], "resistance_mV": [54_613, 26], "emf_mV": [40_000, 24],
    "emf_tq": [47_000, 6], "supply_duty": [44_739, 16], "kp": [38_603, 11], "ki": [9000, 15],
    "kd": [60_000, 3], "torque_limit_tq": 12_000_000,
}  # fmt: skip


def _step(**values: Value) -> str:
    return line("servo-step", **values)


def servos(rng: Random) -> Iterator[str]:
    """Positions, steps at the ends of each range, and a walk."""
    for continuous in (0, 1):
        for count in (0, 1, -1, (1 << 20) - 1, 1 << 20, -(1 << 20), 1 - (1 << 20), 1 << 21, 1 << 22,
                      INT_MAX, INT_MIN):  # fmt: skip
            yield line("servo-position", count=count, continuous=continuous)
    yield line("servo-usual", **USUAL)
    yield from _errors()
    yield from _terms()
    yield from _ceilings()
    yield from _integral()
    yield from _emf()
    yield from _walk(rng)


def _errors() -> Iterator[str]:
    most = (1 << 29) - 1
    for sign in (1, -1):
        yield line("servo", kp=[1, 0], kd=[1, 2])
        for position, measured in (
            (5, 5), (5, 4), (most, 0), (most + 1, 0), (most + 2, 0), (most, -1), (INT_MAX, 0),
            (INT_MAX, -1), (1 << 30, -(1 << 30)), (0, most), (0, -most),
        ):  # fmt: skip
            yield _step(position_pq=sign * position, measured_pq=sign * measured)


def _terms() -> Iterator[str]:
    """Each scale alone, its clamp at 2^27 and at 2^20 mV."""
    for name, driven in (
        ("kp", "position_pq"),
        ("kd", "position_pq"),
        ("velocity_tq", "velocity_pq"),
    ):
        for mantissa, shift in ((3, 1), (1, 0), (4, 0), (65535, 0)):
            yield line("servo", **{name: [mantissa, shift], "torque_limit_tq": 1 << 25})
            for value in (0, 1, -1, 1000, (1 << 27) - 1, 1 << 27, (1 << 27) + 1, -(1 << 27) - 1):
                yield _step(**{driven: value})
    yield line("servo")
    for torque in (1, -1, (1 << 24) - 1, 1 << 24, (1 << 24) + 1, -(1 << 24) - 1, (1 << 27) - 1,
                   1 << 27, (1 << 27) + 1, -(1 << 27) - 1, INT_MAX, INT_MIN):  # fmt: skip
        yield _step(torque_tq=torque)
    for name, driven in (("resistance_mV", "torque_tq"), ("emf_mV", "velocity_pq")):
        yield line("servo", **{name: [1, 0], "supply_duty": [1, 6], "torque_limit_tq": 1 << 25})
        for value in (63, 64, -64, 1000, (1 << 20) - 64, (1 << 20) - 1, 1 << 20, (1 << 20) + 64,
                      -(1 << 20) - 64, 32767 * 64, 32768 * 64, -32768 * 64, 1 << 24):  # fmt: skip
            yield _step(**{driven: value})
        yield line("servo", **{name: [1, 0], "supply_duty": [1, 0]})
        for value in (32766, 32767, 32768, -32767, -32768, -32769):
            yield _step(**{driven: value})


def _ceilings() -> Iterator[str]:
    for limit in (1, 1000, (1 << 25) - 1, 1 << 25):
        yield line("servo", torque_limit_tq=limit, resistance_mV=[1, 4], supply_duty=[1, 2])
        for torque in (limit - 1, limit, limit + 1, -limit, -limit - 1):
            yield _step(torque_tq=torque)
    for limit in (0, 500, FREE):
        yield line("servo", kp=[1, 0], kd=[1, 1], emf_tq=[1, 3], feedback_limit_tq=limit)
        for position in (0, 499, 500, 501, 900, -499, -900, 3000, 3000, 3000, 100):
            yield _step(position_pq=position, torque_tq=7)


def _integral() -> Iterator[str]:
    yield line("servo", ki=[1, 0])
    for position, integrate in ((100, 0), (100, 1), (-40, 1), (64, 1), (0, 1), (7, 0)):
        yield _step(position_pq=position, integrate=integrate)
    for limit in (10, 1 << 24, (1 << 25) - 1, 1 << 25):  # its own ceiling, either way
        for sign in (1, -1):
            yield line("servo", ki=[1, 0], torque_limit_tq=limit, integrate=1, torque_tq=0)
            yield _step(position_pq=sign * 64 * limit if limit == 10 else sign * ((1 << 28) - 1))
            yield _step(times=1)
            yield _step(times=2)
            yield _step(times=20)
            yield _step(position_pq=-sign * 50)
            yield _step(position_pq=-sign * (1 << 28), times=30)
    for mantissa in (1, 2, 3):  # a step of at most 2^28
        yield line("servo", ki=[mantissa, 0], torque_limit_tq=1 << 25, integrate=1)
        for position in ((1 << 28) - 1, 1 << 28, (1 << 28) + 1, -(1 << 28) - 1, -(1 << 29)):
            yield _step(position_pq=position)
    # saturated: not on in the same direction, but back
    for torque in (900, 1000, 1001, -1001, 5000, -5000):
        for position in (300, 1, 0, -1, -300):
            yield line("servo", ki=[1, 0], torque_limit_tq=1000, integrate=1)
            yield _step(torque_tq=torque)
            yield _step(position_pq=position)
            yield _step(torque_tq=0)
            yield _step()
    for torque in (1, 0, -1):  # by the speed's voltage, whatever the torque is
        for position in (300, -300):
            yield line("servo", ki=[1, 0], emf_mV=[1, 0], supply_duty=[1, 0], integrate=1)
            yield _step(torque_tq=torque, velocity_pq=40_000)
            yield _step(position_pq=position)
    # by the voltage alone
    for torque in (32766, 32767, 32768, -32767, -32768, 40_000, -40_000):
        yield line("servo", ki=[1, 0], resistance_mV=[1, 0], supply_duty=[1, 0], integrate=1)
        yield _step(torque_tq=torque)
        yield _step(position_pq=300 if torque > 0 else -300)
        yield _step()


def _emf() -> Iterator[str]:
    """The low-pass of the error's difference over 8 periods; rounding towards zero."""
    for emf in ([1, 0], [3, 1], [65535, 0]):
        yield line("servo", emf_tq=emf, resistance_mV=[1, 2], supply_duty=[1, 1])
        for position in (0, 7, 15, 8, 8, 8, -9, -30, -30, -31, 100_000, -100_000, 1 << 28, 0):
            yield _step(position_pq=position)
        yield _step(times=40)


def _walk(rng: Random) -> Iterator[str]:
    for _ in range(6):
        yield line("servo", **REAL, integrate=rng.randrange(2))
        position, measured = rng.randrange(-(1 << 29), 1 << 29), 0
        measured = position
        for _ in range(25):
            velocity = rng.randrange(-400_000, 400_000)
            position += velocity // 4
            measured = position + rng.randrange(-30_000, 30_000)
            yield _step(
                position_pq=position, velocity_pq=velocity, measured_pq=measured,
                torque_tq=rng.randrange(-9_000_000, 9_000_000),
                feedback_limit_tq=rng.choice([FREE, FREE, 100_000]),
            )  # fmt: skip
    for _ in range(60):
        scales = {name: [rng.randrange(1 << 16), rng.randrange(32)] for name in SCALES}
        limit = rng.choice([1 << 20, 1 << 25, rng.randrange(1, 1 << 25)])
        yield line("servo", **scales, torque_limit_tq=limit, integrate=1)
        for _ in range(3):
            values = {
                name: rng.choice([INT_MIN, INT_MAX, rng.randrange(INT_MIN, INT_MAX)])
                for name in ("position_pq", "velocity_pq", "torque_tq", "measured_pq")
            }
            values["position_pq"] = max(-(1 << 30), min(1 << 30, values["position_pq"]))
            yield _step(**values)
