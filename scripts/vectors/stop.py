"""Vectors of what starts and stops an axis: states, commands, faults, the ramp, gaps, homing."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from random import Random

from line import Value, line

STATES, EVENTS, REASONS = 10, 13, 21
RING = 8
INT32 = (-(1 << 31), -1, 0, 1, (1 << 31) - 1)


def states(_: Random) -> Iterator[str]:
    """The whole table."""
    for state in range(STATES):
        for event in range(EVENTS):
            yield line("next-state", state=state, event=event)


def commands(rng: Random) -> Iterator[str]:
    """Encode and decode, into every room and out of every cut."""
    rows = [(0, 0, 0, 0), (1, 2, 3, 4), ((1 << 32) - 1, 255, -(1 << 31), (1 << 16) - 1)]
    rows += [
        (rng.randrange(1 << 32), rng.randrange(10), value, rng.randrange(1 << 16))
        for value in INT32
    ]
    for number, kind, argument, epoch in rows:
        payload = struct.pack("<IBiH", number, kind, argument, epoch)
        for capacity in (*range(11), 11, 12):
            if capacity >= 11 or number == 1:
                given = {"number": number, "kind": kind, "argument": argument, "epoch": epoch}
                yield line("command-encode", **given, capacity=capacity)
        yield line("command-decode", payload=payload)
    for size in range(13):
        yield line("command-decode", payload=(struct.pack("<IBiH", 1, 2, 3, 4) + b"\0")[:size])


FAULT = (
    *("reason", "state", "boots", "time_us"),
    *("value", "limit", "position_pq", "torque_tq"),
)


def faults(rng: Random) -> Iterator[str]:
    """What each reason leads to; the log before and after it goes round."""
    for reason in range(REASONS):
        yield line("fault-response", reason=reason)
    yield line("faults-blank")
    yield line("faults-encode", capacity=1000)
    entries = []
    for i in range(2 * RING + 3):
        numbers = [rng.randrange(1 << 8), rng.randrange(1 << 8), rng.randrange(1 << 32)]
        numbers.append(rng.randrange(-(1 << 63), 1 << 63))
        numbers += [rng.randrange(-(1 << 31), 1 << 31) for _ in range(4)]
        entries.append(numbers)
        yield line("fault-add", **dict(zip(FAULT, numbers, strict=True)))
        yield line("faults-encode", capacity=1000)
        if i == RING:
            for capacity in (*range(0, 36), 243, 244, 245):
                yield line("faults-encode", capacity=capacity)
    body = b"".join(struct.pack("<BBIqiiii", *numbers) for numbers in entries[:RING])
    payload = struct.pack("<I", 9) + body
    for size in (*range(36), len(payload) - 1, len(payload), len(payload) + 1):
        yield line("faults-decode", payload=(payload + b"\0")[:size])


def ramps(rng: Random) -> Iterator[str]:
    """From both directions, over the end of the number range, ended by motion or by torque."""
    starts = [(0, 0, 0, 0), (100, 3, 5, 5), (-100, -3, -5, 9), (7, 0, 0, -1000)]
    starts += [((1 << 31) - 5, 20_000, 1 << 24, 0), (-(1 << 31) + 5, -20_000, -(1 << 24), 1 << 24)]
    starts += [
        (rng.randrange(1 << 30), rng.randrange(-(1 << 20), 1 << 20), 0, 50) for _ in range(4)
    ]
    for position, velocity, torque, end in starts:
        for rate, step in (
            (1, 1),
            (65536, 100),
            (1000, 1 << 20),
            (3 * 65536 - 1, 7),
            (3 * 65536, 5),
            (3 * 65536 + 1, 4),
        ):
            yield line(
                "ramp-start",
                position_pq=position,
                velocity_pq=velocity,
                torque_tq=torque,
                end_torque_tq=end,
            )
            for times in (1, 1, 1, 1, 2, 3, 10, 100, 2000) if velocity else (1, 1, 3, 2000):
                yield line("ramp-step", deceleration_q16=rate, torque_step_tq=step, times=times)


def gaps(rng: Random) -> Iterator[str]:
    """Which policies a sink may have; what is missing; how it is filled."""
    for sink in range(5):
        for policy in range(6):
            for carries in (0, 1):
                yield line("gap-policy", sink=sink, policy=policy, carries_gravity=carries)
    _, ramp, hold, zero, fault = range(5)
    for first in (-300, 415_000_000_000):
        yield line("gap-blank")
        yield from _gap(first + 10, [0] * 5, position=[5, 6, 7], torque=[1, 1, 1])  # nothing stored
        yield line(
            "gap-store", first_knot=first, position=[0, 0, 100], torque=[5, 5, -40], kp=[9, 9, 8]
        )
        for missing in (-2, -1, 0, 1, 2, 3, 4, 5, 20, 125, 126):
            at = first + 3 + missing
            for policies in ([0] * 5, [0, hold, hold, hold, hold], [0, zero, 0, 0, 0]):
                yield from _gap(at, policies, position=[143, 7, 7, 7], torque=[3, 2, 2, 2])
                yield from _gap(at, policies, position=[-8, 7, 7])
            for policies in (
                [ramp, 0, 0, 0, 0],
                [0, fault, 0, 0, 0],
                [ramp, fault, 0, 0, 0],
                [fault, ramp, 0, 0, 0],
                [0, 0, 0, 0, fault],
                [ramp, hold, 0, 0, 0],
            ):
                yield from _gap(at, policies, position=[143, 7, 7, 7], torque=[3, 2, 2, 2])
                yield from _gap(at, policies, position=[1, 1, 1], kd=[4, 4, 4])
        yield line(
            "gap-store", first_knot=first + 3, torque=[60, 70, 80]
        )  # further than the others
        for missing in (-1, 0, 1, 3, 4, 6):
            at = first + 3 + missing
            yield from _gap(
                at, [0] * 5, position=[-143, 7, 7], torque=[3, 2, 2], kp=[1, 1, 1], kd=[2, 3, 3]
            )
            yield from _gap(
                at, [0, hold, hold, 0, 0], position=[143, 7, 7], torque=[3, 2, 2], kp=[1, 1, 1]
            )
            yield from _gap(at, [ramp, 0, 0, 0, 0], torque=[3, 2, 2])
        for count, missing in ((124, 4), (125, 4), (126, 2), (128, 0), (128, 1), (127, 1)):
            yield from _gap(first + 6 + missing, [0] * 5, torque=[rng.randrange(99)] * count)
    for sinks in (("kd",), ("ki", "kd"), ("kp",)):
        yield line("gap-blank")
        yield line("gap-store", first_knot=0, **{sink: [7, 8, 9] for sink in sinks})
        for at in (2, 3, 4, 6):
            yield from _gap(at, [fault, 0, 0, 0, 0], **{sink: [1, 2, 2] for sink in sinks})
            yield from _gap(at, [0, 0, 0, 0, hold], **{sink: [1, 2, 2] for sink in sinks})
            yield from _gap(at, [0, 0, 0, 0, fault], **{sink: [1, 2, 2] for sink in sinks})
    top = (1 << 31) - 1  # an axis that turns for ever
    yield line("gap-blank")
    yield line("gap-store", first_knot=0, position=[top - 9] * 3)
    yield from _gap(6, [0] * 5, position=[-top] * 3)
    yield line("gap-blank")
    yield line("gap-store", first_knot=0, position=[-(1 << 29)] * 3)
    yield from _gap(7, [0] * 5, position=[1 << 29] * 3)


def _gap(first_knot: int, policies: list[int], **points: list[int]) -> Iterator[str]:
    sinks = ("position", "torque", "kp", "ki", "kd")
    mask = sum(1 << sinks.index(name) for name in points)
    count = len(next(iter(points.values())))
    for tracks in (mask, mask | 32) if "kp" in points else (mask,):  # a bit of no sink says nothing
        head = {"first_knot": first_knot, "tracks": tracks, "count": count}
        yield line("gap", policies=policies, **head, **points)


HOME: dict[str, Value] = {
    "method": 1, "backwards": 0, "mark_count": 500, "speed_q16": 200_000,
    "acceleration_q16": 60_000, "way_counts": 40, "still_periods": 3,
}  # fmt: skip
START: dict[str, Value] = {"task": 1, "position_pq": 1000, "count": 10, "jog_q16": 0}


def _marks(count: int, **other: int) -> str:
    none = {"indexed": 0, "index_count": 0, "on_switch": 0, "pushing": 0}
    return line("home-step", count=count, **(none | other))


def homing(_: Random) -> Iterator[str]:
    """Each method in both directions: the mark, the end of the way, the rest."""
    for method in (1, 2, 3):
        for backwards in (0, 1):
            sign = -1 if backwards else 1
            settings = HOME | {"method": method, "backwards": backwards}
            for seen in ({"indexed": 1, "index_count": 1 << 30}, {"on_switch": 1}, {"pushing": 1}):
                yield line("home-begin", **settings, **START)
                for i in range(5):
                    yield _marks(10 + sign * i)
                for _ in range(5):
                    yield _marks(10 + 5 * sign, **seen)
                yield _marks(10 + 6 * sign)
                yield _marks(10 + 6 * sign, pushing=1)
            for way in (39, 40, 41, -39, -40, -41):
                yield line("home-begin", **settings, **START)
                yield _marks(10)
                yield _marks(10 + way)
    for backwards in (0, 1):  # begun on the switch: off it first, then on again
        settings = HOME | {"method": 2, "backwards": backwards, "way_counts": 1000}
        for on_switch in ("1", "11110", "1111000000", "11110000001111", "0001", "00000", "10101"):
            yield line("home-begin", **settings, **START)
            for i, seen in enumerate(on_switch):
                yield _marks(10 - i, on_switch=int(seen), indexed=1, index_count=7)
            for _ in range(6):
                yield _marks(3, on_switch=1)
    for method in (0, 1, 3):  # there the switch says nothing
        yield line("home-begin", **(HOME | {"method": method}), **START)
        for i in range(6):
            yield _marks(10 + i, on_switch=int(i < 3))
    yield line("home-begin", **(HOME | {"method": 3}), **START)
    for _ in range(5):
        yield _marks(10, pushing=1)
    yield line("home-begin", **(HOME | {"method": 3}), **START)
    for count, pushing in (
        (10, 1),
        (10, 1),
        (10, 0),
        (10, 1),
        (10, 1),
        (11, 1),
        (11, 1),
        (11, 1),
        (11, 1),
        (11, 1),
    ):
        yield _marks(count, pushing=pushing)
    for speed in (
        0,
        1,
        -1,
        59_999,
        60_000,
        60_001,
        200_000,
        200_001,
        -200_001,
        1 << 30,
        -(1 << 30),
    ):
        yield line("home-begin", **HOME, **(START | {"task": 2, "jog_q16": speed}))
        for i in range(6):
            yield _marks(10 + 100 * i, indexed=1, on_switch=1, pushing=1)
    for position in ((1 << 31) - 1, -(1 << 31)):
        yield line("home-begin", **HOME, **(START | {"position_pq": position, "count": position}))
        for i in range(4):
            count = position - i if position > 0 else position + i
            yield _marks(count)
        yield _marks(position, indexed=1, index_count=-position - 1)
        yield _marks(position)
