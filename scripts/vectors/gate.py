"""Vectors of the gate: limits, what is stored, a plan and the knot that runs; then the verdict."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from line import line

LIVE, RING, REACH = 3, 256, 128
POINT_MAX, DIFFERENCE_MAX = (1 << 30) - 1, 1 << 25
SINKS = ("position", "torque", "kp", "ki", "kd")
EPOCH_KNOT = 415_000_000_000
WIDEST = (-POINT_MAX, POINT_MAX, DIFFERENCE_MAX, 1 << 26)
Limits = tuple[int, int, int, int]


def _named(limits: Limits, stop: int = 0, continuous: int = 0) -> dict[str, int]:
    names = ("point_min", "point_max", "difference_max", "second_max")
    return dict(zip(names, limits, strict=True)) | {"stop": stop, "continuous": continuous}


def _limits(limits: Limits, sink: str = "position", stop: int = 0, continuous: int = 0) -> str:
    return line("limits", sink=sink, **_named(limits, stop, continuous))


def _stored(first_knot: int, points: list[int], sink: str = "position") -> str:
    return line("store", sink=sink, first_knot=first_knot, points=points)


def _gate(knot: int, first_knot: int, **points: list[int]) -> str:
    return _masked(knot, first_knot, sum(1 << SINKS.index(name) for name in points), points)


def _masked(knot: int, first_knot: int, mask: int, points: dict[str, list[int]]) -> str:
    count = len(next(iter(points.values())))
    head = dict(knot=knot, first_knot=first_knot, tracks=mask, count=count)
    return line("gate", **head, **points)


def _world(
    limits: Limits, first_knot: int, points: list[int], stop: int = 0, continuous: int = 0
) -> Iterator[str]:
    yield line("blank")
    yield _limits(limits, stop=stop, continuous=continuous)
    if points:
        yield _stored(first_knot, points)


def _boundaries(knot: int) -> Iterator[str]:
    """One point of a plan at, below and above each limit, at each place of the plan."""
    rest = 50
    yield from _world((-1000, 1000, 300, 200), knot - 10, [rest] * 40)
    for place in range(3, 8):
        for sign in (1, -1):
            for delta in (199, 200, 201):  # a step: its second difference is itself
                points = [rest] * place + [rest + sign * delta] * 6
                yield _gate(knot, knot, position=points)
            for delta in (99, 100, 101):  # d, 2 d, then back to rest: 2 d is the largest
                points = [rest] * place + [rest + sign * delta] + [rest + sign * 2 * delta] * 6
                yield _gate(knot, knot, position=points)
    yield from _world((-1000, 1000, 300, 2000), knot - 10, [rest] * 40)
    for place in range(3, 8):
        for sign in (1, -1):
            for delta in (299, 300, 301):
                points = [rest] * place + [rest + sign * delta] * 6
                yield _gate(knot, knot, position=points)
    for low, high in ((-1000, 1000), (10, 90), (-90, 60), (-(1 << 29), 1 << 29)):
        start = (low + high) // 2
        yield from _world((low, high, DIFFERENCE_MAX, 1 << 26), knot - 10, [start] * 40)
        for place in range(3, 8):
            for end in (low, high):
                step = max(-DIFFERENCE_MAX, min(DIFFERENCE_MAX, end - start))
                for delta in (-1, 0, 1):
                    if start + step == end:
                        points = [start] * place + [end + delta] * 6
                        yield _gate(knot, knot, position=points)
                        peak = [start] * place + [end + delta] + [end] * 6
                        yield _gate(knot, knot, position=peak)
    yield from _world((5, 5, 1, 1), knot - 10, [5] * 40)
    for value in (4, 5, 6):
        yield _gate(knot, knot + 3, position=[value] * 5)


def _splices(knot: int) -> Iterator[str]:
    """A plan that continues motion: differences across the splice count."""
    slope = [20 * i for i in range(30)]  # ends in motion; the gate never stored such
    for limits in ((-5000, 5000, 25, 7), (-5000, 5000, 25, 4000), (-5000, 5000, 4000, 9)):
        yield from _world(limits, knot - 24, slope)
        for begin in (knot + 3, knot + 4, knot + 5, knot + 6):
            before, last = slope[begin - knot + 22], slope[begin - knot + 23]
            for splice in range(last - before - 10, last - before + 11):
                points, d = [last + splice], splice
                while d:
                    d -= max(-limits[3], min(limits[3], d))
                    points.append(points[-1] + d)
                yield _gate(knot, begin, position=[*points, points[-1], points[-1]])
    for limits in ((-5000, 5000, 40, 30), (-5000, 5000, 11, 4000), (-5000, 5000, 400, 12)):
        yield from _world(limits, knot - 8, [7] * 12)  # ends at knot + 3: its repeats are continued
        for d in (-41, -40, -31, -30, -12, -11, -1, 0, 1, 11, 12, 13, 29, 30, 31, 40, 41):
            yield _gate(knot, knot + 4, position=[7 + d, 7 + d, 7 + d])
            yield _gate(knot, knot + 2, position=[7, 7, 7 + d, 7 + d, 7 + d])


def _live(knot: int) -> Iterator[str]:
    """A point that differs, at every place around the live ones; plans that end among them."""
    stored = [100 + i for i in range(40)] + [139] * 3
    yield from _world((-9999, 9999, 2000, 4000), knot - 20, stored)
    for place in range(-8, 9):
        for delta in (-1, 1):
            first = knot - 10
            points = stored[10 : 10 + 40]
            points += [points[-1]] * 2
            points[place + 10] += delta
            yield _gate(knot, first, position=points)
            yield _gate(knot, knot + place, position=[stored[20 + place] + delta] * 3)
            yield _gate(knot, knot + place, position=[stored[20 + place]] * 3)
    yield from _world((-9999, 9999, 2000, 4000), knot - 20, [100] * 30)
    for first in range(knot - 12, knot + 12):
        for count in (3, 4, 5):
            yield _gate(knot, first, position=[100] * count)
            yield _gate(knot, first, position=[101] * count)
    for turn in range(-6, 8):  # equal now, not equal to what is stored further on
        for later in (99, 101):
            points = [100] * (20 + turn) + [later] * 5
            yield from _world((-9999, 9999, 2000, 4000), knot - 20, points)
            for first in (knot - 6, knot - 3, knot - 2, knot - 1, knot):
                for value in (100, later):
                    yield _gate(knot, first, position=[value] * 3)


def _first_plans(knot: int) -> Iterator[str]:
    yield line("blank")
    yield _limits((-1000, 1000, 30, 20))
    for ahead in range(-3, 7):
        yield _gate(knot, knot + ahead, position=[9, 9, 9, 9])
    for ahead in (REACH - 6, REACH - 5, REACH - 4, REACH - 3, REACH - 2, REACH):
        for count in (3, 4, 5):
            yield _gate(knot, knot + ahead, position=[0] * count)
    for level in (1000, 1001, -1000, -1001):
        yield _gate(knot, knot + 4, position=[level] * 3)
    for place in (1, 2, 3):
        for step in (19, 20, 21, 30, 31, 1001, -19, -20, -21, -30, -31, -1001):
            yield _gate(knot, knot + 4, position=[0] * place + [step] * 3)
    for far in (-(1 << 63), -(1 << 62), (1 << 62), (1 << 63) - 1):
        yield _gate(knot, far, position=[0, 0, 0])


def _gaps(knot: int) -> Iterator[str]:
    """The plan begins around the end of what is stored, around what is forgotten, far ahead."""
    for end in (-130, -129, -128, -127, -5, -1, 0, 1, 2, 3, 20, 120, 124, 125, 126, 127, 128):
        for count in (3, 128):
            yield from _world((-9, 9, 9, 9), knot + end - count + 1, [4] * count)
            for first in (end - 1, end, end + 1, end + 2, end + 3):
                yield _gate(knot, knot + first, position=[4] * 3)
    yield from _world((-9, 9, 9, 9), knot - 140, [4] * 128)
    yield _stored(knot - 20, [4] * 128)
    for back in range(-132, -120):
        yield _gate(knot, knot + back, position=[4] * 128)
        yield _gate(knot, knot + back, position=[4] * 3)
    for reach in range(120, 132):
        for count in (3, 10, 120, 127, 128):
            yield _gate(knot, knot + reach - count, position=[4] * count)
    for far in (-(1 << 63), -(1 << 62), (1 << 62), (1 << 63) - 1):
        yield _gate(knot, far, position=[4, 4, 4])


def _rests(knot: int) -> Iterator[str]:
    yield from _world((-99, 99, 99, 99), knot - 5, [0] * 20)
    for a in (-1, 0, 1):
        for b in (-1, 0, 1):
            for c in (-1, 0, 1):
                yield _gate(knot, knot + 3, position=[a, b, c])
                yield _gate(knot, knot + 1, position=[0, 0, a, b, c])


def _many_tracks(knot: int) -> Iterator[str]:
    """Which sinks may come, whose limits count, in which order tracks are looked at."""
    yield line("blank")
    for i, sink in enumerate(SINKS):
        yield _limits((-100 - i, 100 + i, 10 + i, 20 + i), sink)
        yield _stored(knot - 5, [i] * 30, sink)
    for mask in (*range(36), 64, 255):  # bits of no sink are not looked at
        points = {name: [i] * 12 for i, name in enumerate(SINKS)}
        yield _masked(knot, knot + 3, mask, points)
    for i, sink in enumerate(SINKS):
        for value, word in ((101 + i, 0), (i + 11 + i, 1), (i + 10 + i, 1), (i + 9 + i, 1)):
            points = {name: [j] * 6 for j, name in enumerate(SINKS)}
            points[sink] = [value] * 6 if word == 0 else [i, i, i, value, value, value]
            yield _gate(knot, knot + 3, **points)
            if sink != "position":
                pair = {"position": [0] * 6, sink: points[sink]}
                yield _gate(knot, knot + 3, **pair)
            other = SINKS[(i + 1) % 5]  # and another one wrong besides
            points[other] = [points[other][0]] * 5 + [points[other][0] + 1]
            yield _gate(knot, knot + 3, **points)
    for missing in SINKS:
        yield line("blank")
        for sink in SINKS:
            if sink != missing:
                yield _limits((-100, 100, 1, 20), sink)
        yield _gate(knot, knot + 3, **{name: [0] * 4 for name in SINKS})
        yield _gate(knot, knot + 3, position=[0] * 4)
        yield _gate(knot, knot + 3, **{"position": [0] * 4, missing: [0] * 4})
        for none in (0, -1, 1):
            yield _limits((-100, 100, none, 20), missing)
            yield _gate(knot, knot + 3, **{name: [0] * 4 for name in SINKS})


def _extremes(knot: int) -> Iterator[str]:
    """Numbers that overflow 32 bits if the tests come in another order."""
    top = (1 << 31) - 1
    for start in (-POINT_MAX, 0, POINT_MAX):
        yield from _world(WIDEST, knot - 5, [start] * 20)
        for value in (top, -top, -top - 1, POINT_MAX, -POINT_MAX, POINT_MAX + 1, -POINT_MAX - 1, 0):
            yield _gate(knot, knot + 3, position=[value] * 4)
            yield _gate(knot, knot + 3, position=[start, value, start, start, start])
        for sign in (1, -1):
            for excess in (-1, 0, 1):
                step = sign * (DIFFERENCE_MAX + excess)
                for shape in ([0, step], [0, step, 0], [step, 2 * step], [step, 0, step]):
                    points = [start + s for s in shape]
                    yield _gate(knot, knot + 3, position=[*points, points[-1], points[-1]])
    for second in ((1 << 26) - 1, 1 << 26):
        yield from _world((*WIDEST[:3], second), knot - 5, [0] * 20)
        for sign in (1, -1):
            step = sign * DIFFERENCE_MAX
            yield _gate(knot, knot + 3, position=[step, 0, step, 0, 0, 0])


def _rooms(knot: int) -> Iterator[str]:
    """Speed against the room that is left: d^2 at, below and above 2 a (limit - farthest)."""
    for stop, d in ((5, 20), (1, 9), (7, 30), (2 * DIFFERENCE_MAX, DIFFERENCE_MAX), (1, 1 << 13)):
        need = -(-d * d // (2 * stop))
        for sign in (1, -1):
            for room in (need - 1, need, need + 1):
                # up by d at each place of a span, the farthest point last, in the middle, first
                for shape in ([d, d], [d, 2 * d, 2 * d], [d, d, 0], [0, d, 2 * d], [-d, 0, -d]):
                    far = max(0, *shape)
                    ends = sorted((-sign * (1 << 29), sign * (far + room)))
                    limits = (ends[0], ends[1], DIFFERENCE_MAX, 1 << 27)
                    yield from _world(limits, knot - 9, [0] * 20, stop)
                    points = [0, 0, 0, *(sign * p for p in shape)]
                    yield _gate(knot, knot, position=[*points, points[-1], points[-1]])
                    yield _gate(knot, knot + 3, position=[*points[3:], points[-1], points[-1]])
    for stop, continuous in ((0, 0), (3, 0), (3, 1), (0, 1)):
        yield from _world((-100, 100, 1000, 1000), knot - 9, [0] * 20, stop, continuous)
        for peak in (24, 25, 90, 100, 101):
            for sign in (1, -1):
                yield _gate(knot, knot + 3, position=[sign * peak] * 4)
    # what is stored counts as well: the span that a new point completes begins three before it
    stored = [0, 0, 0, 0, 30, 60, 60, 60]
    for high in (58, 59, 60, 61, 74, 75, 76, 90):
        yield from _world((-1000, high, 1000, 1000), knot - 4, stored, 30)
        for first in (knot + 3, knot + 4):
            for value in (29, 59, 60, 61):
                yield _gate(knot, first, position=[value] * 3)


def _turns(knot: int) -> Iterator[str]:
    """An axis without ends: points go on modulo 2^32, and differences with them."""
    top = (1 << 31) - 1
    for start in (top - 2, -top - 1 + 2, 0, POINT_MAX, -POINT_MAX):
        for stop in (0, 5):
            yield from _world((0, 0, 20, 15), knot - 9, [start] * 20, stop, continuous=1)
            for sign in (1, -1):
                for d in (14, 15, 16, 20, 21):
                    points = (
                        [0, d, 2 * d, 2 * d, 2 * d] if d < 16 else [0, 15, 15 + d, 15 + d, 15 + d]
                    )
                    turned = [(start + sign * p + top + 1) % (1 << 32) - top - 1 for p in points]
                    yield _gate(knot, knot + 3, position=turned)
    for start in (top, -top - 1):
        yield from _world((*WIDEST[:3], 1 << 26), knot - 9, [start] * 20, 0, continuous=1)
        for other in (-start - 1, 0, start, DIFFERENCE_MAX, -DIFFERENCE_MAX - 1):
            yield _gate(knot, knot + 3, position=[other] * 4)
            yield _gate(knot, knot + 3, position=[start, other, other, other])


def _valid_limits() -> Iterator[str]:
    """Each limit at the ends of what the gate's arithmetic can bear."""
    good = _named((-50, 60, 7, 8), 9)
    rows = [good, *(good | {"point_min": v} for v in (60, 61, -POINT_MAX, -POINT_MAX - 1))]
    rows += [good | {"point_max": v} for v in (-50, -51, POINT_MAX, POINT_MAX + 1)]
    for value in (-1, 0, 1, DIFFERENCE_MAX - 1, DIFFERENCE_MAX, DIFFERENCE_MAX + 1):
        rows.append(good | {"difference_max": value})
    rows += [good | {"second_max": v} for v in (-1, 0, 1, (1 << 31) - 1)]
    for value in (-1, 0, 1, 2 * DIFFERENCE_MAX - 1, 2 * DIFFERENCE_MAX, 2 * DIFFERENCE_MAX + 1):
        rows.append(good | {"stop": value})
    for row in rows:
        yield line("limits-valid", sink="kd", **row)


def _walk(rng: Random, limits: Limits, last: int, difference: int, count: int) -> list[int]:
    """Points that keep the limits, often just, and end at rest."""
    low, high, d_max, d2_max = limits
    points: list[int] = []
    while len(points) < count or difference:
        step = rng.choice([-d2_max, d2_max, rng.randint(-d2_max, d2_max), 0])
        if len(points) >= count - 3:  # brake
            step = max(-d2_max, min(d2_max, -difference))
        wanted = max(-d_max, min(d_max, difference + step))
        if not low <= last + wanted <= high:
            wanted = max(difference - d2_max, min(difference + d2_max, 0))
        difference = wanted
        last += difference
        points.append(last)
    return [*points, last, last]


def _random(rng: Random) -> Iterator[str]:
    """A track stored plan by plan, as on a device, and plans that are often spoilt by one point."""
    d_max = rng.choice([1, 2, 100, 1 << 20, DIFFERENCE_MAX])
    size = min(POINT_MAX, d_max * rng.choice([1, 5, 50]))
    limits = (-size, size, d_max, rng.choice([1, d_max, 2 * d_max]))
    knot = rng.choice([0, -40, EPOCH_KNOT])
    stored = _walk(rng, limits, rng.choice([-size, 0, size]), 0, rng.randint(1, 40))[:128]
    stored[-3:] = [stored[-1]] * 3
    yield from _world(limits, knot, stored, rng.choice([0, limits[3], 4 * limits[3]]))
    for _ in range(12):
        now = knot + rng.randrange(-4, len(stored) + 8)
        first = now + LIVE - rng.choice([0, 0, 1, 2, 3, 5])
        first = min(first, knot + len(stored))
        begin = max(now + LIVE, first)
        near = [stored[max(0, min(k - knot, len(stored) - 1))] for k in range(first - 2, begin)]
        points = near[2:]
        points += _walk(rng, limits, near[-1], near[-1] - near[-2], rng.randint(1, 20))
        points = points[:100]
        if rng.random() < 0.5:
            i = rng.randrange(len(points))
            points[i] += rng.choice([-1, 1, 5, -d_max, d_max])
        yield _gate(now, first, position=points)


def gates(rng: Random) -> Iterator[str]:
    """All families, around knot numbers of both signs and beyond 32 bits."""
    families = (
        _boundaries,
        _splices,
        _live,
        _first_plans,
        _gaps,
        _rests,
        _many_tracks,
        _extremes,
        _rooms,
        _turns,
    )
    for i, family in enumerate(families):
        yield f"# {family.__name__.strip('_').replace('_', ' ')}"
        yield from family((EPOCH_KNOT, 0, -3)[i % 3])
    yield from _valid_limits()
    yield "# random"
    for _ in range(12):
        yield from _random(rng)
