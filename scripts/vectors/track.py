"""Vectors of track evaluation: points by knot, value, rate and curve by time."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import accumulate
from random import Random

from line import line

POINT_MAX, DIFFERENCE_MAX, RING = (1 << 30) - 1, 1 << 25, 256
SHIFTS = range(9, 16)
EPOCH_US = 1_700_000_000_000_123


def _walk(rng: Random, largest: int, count: int) -> list[int]:
    """Steps of up to `largest`, often just that; inside the gate's range."""
    steps = [rng.choice([-largest, largest, rng.randint(-largest, largest)]) for _ in range(count)]
    start = rng.randint(-POINT_MAX, POINT_MAX)
    clipped = lambda a, b: max(-POINT_MAX, min(POINT_MAX, a + b))  # noqa: E731
    return list(accumulate(steps, clipped, initial=start))


def _phases(rng: Random, shift: int) -> list[int]:
    whole = 1 << shift
    return [0, 1, whole // 2, whole - 1, rng.randrange(whole)]


def _evaluated(rng: Random, first_knot: int, knots: list[int], shift: int) -> Iterator[str]:
    for knot in knots:
        for phase in _phases(rng, shift):
            time_us = ((first_knot + knot) << shift) + phase
            yield line("track-at", sink="position", time_us=time_us, knot_shift=shift)


def fixed(rng: Random) -> Iterator[str]:
    """Clamping, and products with a scale at each shift, up to and beyond saturation."""
    top = (1 << 31) - 1
    for limit in (0, 1, 5, top):
        for value in (
            -top - 1,
            -top,
            max(-top, -limit - 1),
            -limit,
            1 - limit,
            -1,
            0,
            limit - 1,
            limit,
            top,
        ):
            yield line("fixed-clamp", value=value, limit=limit)
        yield line("fixed-clamp", value=min(top, limit + 1), limit=limit)
    ends64 = (-(1 << 63), -(1 << 32), (1 << 32) - 1, (1 << 63) - 1)
    for limit in (0, 5, top):
        near = {sign * limit + d for sign in (1, -1) for d in (-1, 0, 1)}
        for value in sorted({*ends64, 0, *near}):
            yield line("fixed-clamp64", value=value, limit=limit)
    for a in (-top - 1, -top, -1, 0, 1, 77, top):
        for b in (-top - 1, -1, 0, 1, 5, top):
            yield line("fixed-sum", a=a, b=b)
    for shift in range(32):
        for mantissa in (1, 65535, rng.randrange(1 << 16)):
            edge = (top << shift) // max(1, mantissa)  # of what 32 bits hold
            ends = [sign * min(top, max(0, edge + d)) for sign in (1, -1) for d in (-1, 0, 1)]
            random = [rng.randrange(-top - 1, top + 1) for _ in range(2)]
            for value in dict.fromkeys([0, 1, -1, 65535, -65536, top, -top - 1, *ends, *random]):
                yield line("fixed-scale", value=value, mantissa=mantissa, shift=shift)
    signed = (-top - 1, -top, -65537, -65536, -1, 0, 1, 65535, 65536, top)
    for a in (*signed, rng.randrange(-top - 1, top + 1)):
        for b in (0, 1, 255, 65535, rng.randrange(1 << 16)):
            yield line("fixed-mul-u16", a=a, b=b)
    whole = (0, 1, 65535, 65536, 65537, 1 << 31, 2 * top + 1, rng.randrange(1 << 32))
    for a in whole:
        for b in whole:
            yield line("fixed-mul-u32", a=a, b=b)


def tracks(rng: Random) -> Iterator[str]:
    """Splines of every size of difference and knot shift, the ends, the ring."""
    yield line("blank")
    yield line("track-point", sink="kd", knot=5)
    yield line("track-at", sink="kd", time_us=EPOCH_US, knot_shift=12)
    for shift in SHIFTS:
        for largest in (0, 1, 3, 100, 1 << 18, DIFFERENCE_MAX):
            first = rng.choice([0, -7, 12345, EPOCH_US >> shift, -EPOCH_US >> shift, 1 << 44])
            points = _walk(rng, largest, 9)
            yield line("blank")
            yield line("store", sink="position", first_knot=first, points=points)
            outside = rng.choice([-300, -2, -1, 0, 8, 9, 10, 11, 500])
            knots = [*rng.sample(range(1, 8), 3), outside]
            yield from _evaluated(rng, first, knots, shift)
    yield from _alternating()
    yield from _ring(rng)
    yield from _turned()
    yield from _past(rng)


def _alternating() -> Iterator[str]:
    """The sharpest curve that the gate lets through, and the highest points."""
    shapes = [
        [0, DIFFERENCE_MAX] * 4,
        [0, -DIFFERENCE_MAX] * 4,
        [POINT_MAX, POINT_MAX - DIFFERENCE_MAX] * 4,
        [-POINT_MAX, -POINT_MAX + DIFFERENCE_MAX] * 4,
        [POINT_MAX] * 8,
        [-POINT_MAX] * 8,
        [0, 1, 0, -1, 0, 1, 2, 3],
        [5, 4, 3, 2, 1, 0, 0, 0],
    ]
    for points in shapes:
        yield line("blank")
        yield line("store", sink="position", first_knot=100, points=points)
        for shift in (9, 12, 15):
            for knot in (102, 103, 104):
                for phase in (0, 1, 1 << (shift - 1), (1 << shift) - 1):
                    time_us = (knot << shift) + phase
                    yield line("track-at", sink="position", time_us=time_us, knot_shift=shift)


def _turned() -> Iterator[str]:
    """An axis without ends passes from the largest number to the smallest."""
    top = (1 << 31) - 1
    for step in (1, 100, DIFFERENCE_MAX):
        for sign in (1, -1):
            points = [(sign * (top - 4 * step + i * step) + top + 1) % (1 << 32) - top - 1
                      for i in range(9)]  # fmt: skip
            yield line("blank")
            yield line("store", sink="position", first_knot=100, points=points)
            for knot in range(101, 107):
                for phase in (0, 1, 2048, 4095):
                    time_us = (knot << 12) + phase
                    yield line("track-at", sink="position", time_us=time_us, knot_shift=12)


def _ring(rng: Random) -> Iterator[str]:
    """Writes that overlap, leave gaps of nothing and go round the ring, on all sinks."""
    for start in (0, -3, (1 << 32) - 40, (1 << 31) - 5, 415_000_000_000):
        yield line("blank")
        end, serial = start - 1, 1
        for _ in range(7):
            count = rng.choice([3, 4, 40, 128]) if serial > 1 else 3
            first = end + 1 - (rng.randrange(min(count, 6)) if serial > 1 else 0)
            for sink, sign in (("position", 1), ("torque", -1)):
                points = [sign * (serial + i) for i in range(count)]
                yield line("store", sink=sink, first_knot=first, points=points)
            if serial == 1:  # before its first point a track is at that point
                for knot in (start - 1, start - 100, (start - 1) // RING * RING):
                    if first + count - 1 - knot < RING:
                        yield line("track-point", sink="position", knot=knot)
            serial, end = serial + count, first + count - 1
            written = end - start + 1
            backs = {0, 1, 2, 3, min(written, RING) - 1, *(rng.randrange(RING) for _ in range(2))}
            for back in (-1000, -3, -2, -1, *sorted(backs)):
                for sink in ("position", "torque"):
                    yield line("track-point", sink=sink, knot=end - back)
            time_us = (end << 12) - 4096 * rng.randrange(1, 3)
            yield line("track-at", sink="torque", time_us=time_us + 77, knot_shift=12)


def _past(rng: Random) -> Iterator[str]:
    """Back to the ring's oldest and the first point, from before and beyond the end; also where a
    plan ends before what was stored."""
    for start, shift in (((1 << 32) - 40, 12),):
        yield line("blank")
        yield line("track-past", sink="position", time_us=start << shift, knot_shift=shift)
        end, highest = start - 1, start - 1
        for count, back in ((3, 0), (40, 2), (128, 1), (100, 90), (128, 3), (128, 0), (5, 5)):
            first = end + 1 - back
            points = [rng.randrange(-1000, 1000) for _ in range(count)]
            yield line("store", sink="position", first_knot=first, points=points)
            end = first + count - 1
            highest = max(highest, end)
            oldest = max(start, highest - RING + 1)
            for knot in sorted(
                {
                    start - 1,
                    start,
                    start + 1,
                    oldest - 1,
                    oldest,
                    oldest + 1,
                    end - 200,
                    end - 2,
                    end - 1,
                    end,
                    end + 1,
                    end + 2,
                    end + 300,
                }
            ):
                for phase in (0, rng.randrange(1 << shift)):
                    time_us = (knot << shift) + phase
                    yield line("track-past", sink="position", time_us=time_us, knot_shift=shift)
