"""Vectors of signals: pieces, logic, readings, and their payloads."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from line import line

PIECES, READINGS, NODES, TRIGGERS, FEEDS = 32, 128, 16, 4, 4
LONGEST_US, TIME_MAX = 1 << 30, 1 << 60
TOP = (1 << 31) - 1
EDGES = (-TOP - 1, -TOP, -65536, -1, 0, 1, 2, 65535, 65536, TOP)
KINDS, PAST, INPUTS, NODE = 7, 6, range(16, 26), 32
MANY = 1 << 31  # pieces: then none is taken any more
PAST_KNOTS = 254  # that a track of motion reaches back
TWO = (0, 1, 4)  # kinds that read b: add, multiply, gate


def pieces(rng: Random) -> Iterator[str]:
    """Every length and slope, what is left out, every refusal at its edge, the ring."""
    for took in (0, 1, 2, 7, 1000, LONGEST_US):
        for first, last in ((0, 0), (0, 1000), (-TOP - 1, TOP), (TOP, -TOP - 1), (5, -6)):
            yield line("pieces")
            yield line("piece-at", time_us=0)
            yield line("piece-past", time_us=0)
            yield line("piece-now", time_us=0)
            yield line("piece-take", number=0, start_us=100, end_us=100 + took,
                       **{"from": first}, to=last, now_us=100)  # fmt: skip
            inside = {rng.randrange(took + 1) for _ in range(4)}
            for time_us in sorted({99, 100, 101, 99 + took, 100 + took, 101 + took}
                                  | {100 + i for i in inside}):  # fmt: skip
                yield line("piece-at", time_us=time_us)
                yield line("piece-past", time_us=time_us)
                yield line("piece-now", time_us=time_us)
    yield from _left_out()
    yield from _refused()
    yield from _ring(rng)
    yield from _many()


def _many() -> Iterator[str]:
    """Up to the last number, and beyond: a full track goes on with what it has."""
    yield line("pieces-after", count=MANY - 1)
    for number in (MANY - 1, MANY, MANY + 1, MANY + 1, MANY - 1, MANY + 2):
        at = 10 * (number - MANY + 2)
        yield line("piece-take", number=number, start_us=at, end_us=at + 5, to=number % 7, now_us=0)
        yield line("piece-at", time_us=at + 5)
        yield line("piece-now", time_us=at + 5)


def _left_out() -> Iterator[str]:
    yield line("pieces")
    yield line("piece-take", number=0, end_us=10, to=1, now_us=0)
    yield line("piece-take", number=0, start_us=0, end_us=10, to=1, now_us=0)
    yield line("piece-take", number=0, end_us=10, **{"from": 3}, to=1, now_us=0)
    yield line("piece-take", number=0, start_us=1000, end_us=2000, **{"from": 0}, to=100, now_us=9)
    yield line("piece-take", number=1, end_us=3000, to=0, now_us=9)
    yield line("piece-take", number=2, start_us=2500, end_us=2600, to=7, now_us=9)
    yield line("piece-take", number=3, end_us=2700, **{"from": 50}, to=60, now_us=9)
    yield line("piece-take", number=4, start_us=2700, end_us=2700, to=61, now_us=9)
    for time_us in (999, 1500, 2000, 2250, 2499, 2500, 2550, 2600, 2650, 2699, 2700, 1 << 40):
        yield line("piece-at", time_us=time_us)
        yield line("piece-now", time_us=time_us)


def _refused() -> Iterator[str]:
    take = {"from": 4, "to": 5}
    yield line("pieces")
    yield line("piece-take", number=1, start_us=5, end_us=9, now_us=0, **take)
    yield line("piece-take", number=0, start_us=5, end_us=9, now_us=6, **take)
    yield line("piece-take", number=0, start_us=5, end_us=4, now_us=0, **take)
    yield line("piece-take", number=0, start_us=5, end_us=6 + LONGEST_US, now_us=0, **take)
    yield line("piece-take", number=0, start_us=5, end_us=9, now_us=5, **take)
    yield line("piece-take", number=0, start_us=7, end_us=7, now_us=0, **take)
    yield line("piece-take", number=1, start_us=4, end_us=9, now_us=0, **take)
    yield line("piece-take", number=2, start_us=5, end_us=9, now_us=0, **take)
    yield line("piece-take", number=1, start_us=5, end_us=9, now_us=0, **take)
    yield line("piece-take", number=0, start_us=-9, end_us=9, now_us=0, **take)


def _ring(rng: Random) -> Iterator[str]:
    """More pieces than it holds; time stands still, goes on, or is ahead of what runs."""
    yield line("pieces")
    for number in range(PIECES):
        yield line("piece-take", number=number, start_us=10 * number, end_us=10 * number + 5,
                   **{"from": number}, to=-number, now_us=0)  # fmt: skip
    for now_us in (0, 9, 10):
        yield line("piece-take", number=PIECES, start_us=900, end_us=950, to=3, now_us=now_us)
    for time_us in (0, 4, 9, 10, 12, 25, 299, 315, 899, 925, 999):
        yield line("piece-at", time_us=time_us)
        yield line("piece-past", time_us=time_us)
        yield line("piece-now", time_us=time_us)
    at = now_us = 1000
    for number in range(PIECES + 1, PIECES + 100):
        at += rng.randrange(1, 40)
        now_us = max(now_us, at - rng.randrange(200))
        yield line(
            "piece-take", number=number, start_us=at, end_us=at + 3, to=number, now_us=now_us
        )
        if rng.random() < 0.4:
            yield line("piece-now", time_us=now_us)
            for _ in range(2):
                yield line("piece-past", time_us=now_us - rng.randrange(1000))
    yield line("piece-at", time_us=0)
    yield line("piece-now", time_us=1 << 50)


def _node(rng: Random, at: int) -> list[int]:
    a, b = (rng.choice([*range(4), *INPUTS, *range(NODE, NODE + at)]) for _ in range(2))
    low, high = sorted(rng.choice(EDGES) for _ in range(2))
    return [rng.randrange(PAST), a, b, low, high]


def graphs(rng: Random) -> Iterator[str]:
    """Every kind with every edge, hystereses on their way, and all that can be wrong."""
    for kind in range(PAST):
        for low, high in ((0, 0), (-1, 1), (-TOP - 1, TOP), (2, 65535)):
            yield line("graph", nodes=[kind, 0, 1, low, high])
            for _ in range(14):
                a, b = rng.choice(EDGES), rng.choice(EDGES)
                yield line("graph-step", values=[rng.choice((a, low, high)), b])
            for value in (
                high,
                high - 1 if high > -TOP else high,
                low,
                low + 1 if low < TOP else 0,
            ):
                for step in (TOP, value, -TOP - 1, value):
                    yield line("graph-step", values=[step, 0])
    for count in (0, 1, 5, NODES):
        for _ in range(6):
            nodes = [n for at in range(count) for n in _node(rng, at)]
            yield line("graph", nodes=nodes)
            for _ in range(6):
                yield line("graph-step", values=[rng.choice(EDGES) for _ in range(26)])
    good = [5, 0, 0, 0, 0]
    for wrong in (
        [KINDS, 0, 0, 0, 0], [255, 0, 0, 0, 0], [0, 26, 0, 0, 0], [0, 0, 31, 0, 0],
        [0, 32, 0, 0, 0], [0, 0, 33, 0, 0], [0, 34, 0, 0, 0], [0, 0, 48, 0, 0], [5, 33, 99, 0, 0],
        [3, 0, 99, 1, 0], [2, 0, 99, 1, 1], [4, 0, 33, 0, 0], [1, 0, 26, 0, 0], [5, 255, 0, 0, 0],
        [KINDS, 99, 99, 1, 0], [0, 99, 33, 1, 0],
    ):  # fmt: skip
        for nodes in (wrong, good + wrong, wrong + good, good + good + wrong):
            yield line("graph", nodes=nodes)
    yield from _past_nodes(rng)


def _past_nodes(rng: Random) -> Iterator[str]:
    """Of every source, as long ago as can be and longer, and read by others; b says nothing."""
    for shift in (9, 15):
        longest = PAST_KNOTS << shift
        for a in (0, 4, 5, 15, 16, NODE, 255):
            for ago in (0, longest, longest + 1, TOP, -1):
                yield line("graph", nodes=[PAST, a, 99, ago, -5], knot_shift=shift)
    for _ in range(4):
        at = rng.randrange(1, 5)
        others = [n for i in range(at) for n in _node(rng, i)]
        past = [PAST, rng.randrange(16), 0, rng.randrange(1000), rng.choice(EDGES)]
        nodes = [*others, *past, 0, NODE + at, 0, 0, 0, 5, NODE + at, 0, 0, 0]
        yield line("graph", nodes=nodes)
        for _ in range(4):
            before = [0] * at + [rng.choice(EDGES)]
            values = [rng.choice(EDGES) for _ in range(26)]
            yield line("graph-step", values=values, past=before)


def readings(rng: Random) -> Iterator[str]:
    """Up to the ring and beyond, and what is said of them."""
    for begun in (0, 1, (1 << 32) - 5, (1 << 32) - READINGS):
        yield line("readings", taken=begun)
        taken = begun
        for times in (1, READINGS - 1, 1, 5, READINGS, 3):
            yield line("readings-push", time_us=rng.randrange(1 << 50), value=rng.choice(EDGES[:9]),
                       trigger=rng.randrange(4), times=times)  # fmt: skip
            taken += times
            for behind in (-1, READINGS + 9, READINGS + 1, READINGS // 2, 2, 1):
                if rng.random() < 0.5:
                    yield line("readings-seen", number=(taken - behind) % (1 << 32))
        yield line("readings-seen", number=taken % (1 << 32))
    yield from _told(rng)


def _told(rng: Random) -> Iterator[str]:
    """Told once, again without an answer, past what was overwritten; answers that come or not."""
    for begun in (0, (1 << 32) - 40):
        yield line("readings", taken=begun)
        yield line("readings-tell", most=48)
        taken = seen = begun
        for step in range(120):
            times = rng.choice((0, 1, 5, 30, READINGS)) if step % 40 < 20 else 1
            if times:
                yield line(
                    "readings-push", time_us=step << 20, value=step, trigger=step % 4, times=times
                )
            taken += times
            for _ in range(rng.choice((0, 1, 1, 2))):
                yield line("readings-tell", most=rng.choice((48, 48, 3)))
            if rng.random() < (0.3, 0.9, 0.05)[step // 40]:
                seen = rng.randrange(max(seen, taken - READINGS), taken + 1)
                yield line("readings-seen", number=seen % (1 << 32))


def _zigzag(value: int) -> bytes:
    word, out = (value << 1) ^ (value >> 63), b""
    while word >= 0x80:
        out, word = out + bytes([word & 0x7F | 0x80]), word >> 7
    return out + bytes([word])


def batches(rng: Random) -> Iterator[str]:
    """Pieces of all forms, sizes at their edges, bytes that are none."""
    for count in (0, 1, 2, 9, 64):
        base = rng.choice((0, -TIME_MAX, TIME_MAX, 1_700_000_000_000_000))
        yield line("batch", base_us=base, seen=rng.choice((0, 7, (1 << 32) - 1)))
        for _ in range(count):
            form = rng.randrange(4)
            near = rng.choice((0, 1, -1, 1000, 1 << 40))
            piece: dict[str, int] = {"end_us": base + near, "to": rng.choice(EDGES)}
            if form & 1:
                piece["start_us"] = base - near
            if form & 2:
                piece["from"] = rng.choice(EDGES)
            track = rng.randrange(5, 16)
            number = rng.choice((0, 1, 300, (1 << 32) - 1))
            yield line("batch-piece", track=track, number=number, **piece)
        yield line("batch-encode", capacity=2000)
        for capacity in (0, 12, 13, 20, 30):
            yield line("batch-encode", capacity=capacity)
    yield line("batch-encode", capacity=2000, count=65)
    for base, end, track in ((TIME_MAX + 1, 0, 5), (-TIME_MAX - 1, 0, 5), (0, 0, 4), (0, 0, 16),
                             (0, TIME_MAX + 1, 5), (0, -TIME_MAX - 1, 5), (0, TIME_MAX, 15),
                             (0, -TIME_MAX, 5), (TIME_MAX, TIME_MAX, 5),
                             (-TIME_MAX, (1 << 63) - 1, 5), (TIME_MAX, -(1 << 63), 5)):  # fmt: skip
        yield line("batch", base_us=base, seen=0)
        yield line("batch-piece", track=track, number=1, end_us=end, to=0)
        yield line("batch-encode", capacity=2000)
    yield from _batch_bytes(rng)


def _batch_bytes(rng: Random) -> Iterator[str]:
    def head(base: int, count: int) -> bytes:
        return (base % (1 << 64)).to_bytes(8, "little") + (9).to_bytes(4, "little") + bytes([count])

    def piece(track: int, flags: int, *values: int) -> bytes:
        return bytes([track, 3, 0, 0, 0, flags]) + b"".join(_zigzag(v) for v in values)

    whole = head(1000, 4) + piece(5, 0, 10, -4) + piece(15, 1, -3, 10, 4)
    whole += piece(7, 2, 10, TOP, -TOP - 1) + piece(9, 3, 0, 1 << 35, 8, 9)
    yield line("batch-decode", payload=whole)
    for size in range(len(whole)):
        yield line("batch-decode", payload=whole[:size])
    yield line("batch-decode", payload=whole + b"\0")
    for base in (0, TIME_MAX, TIME_MAX + 1, -TIME_MAX, -TIME_MAX - 1):
        yield line("batch-decode", payload=head(base, 0))
    for value in (0, TOP, TOP + 1, -TOP - 1, -TOP - 2):
        yield line("batch-decode", payload=head(0, 1) + piece(5, 0, 1, value))
        yield line("batch-decode", payload=head(0, 1) + piece(5, 2, 1, value, 0))
    for time in (TIME_MAX, TIME_MAX + 1, -TIME_MAX, -TIME_MAX - 1):
        yield line("batch-decode", payload=head(0, 1) + piece(5, 0, time, 0))
        yield line("batch-decode", payload=head(0, 1) + piece(5, 1, time, 0, 0))
    for track, flags in ((4, 0), (5, 0), (15, 0), (16, 0), (5, 4), (5, 255)):
        yield line("batch-decode", payload=head(0, 1) + piece(track, flags, 1, 2))
    yield line("batch-decode", payload=head(0, 64) + piece(5, 0, 1, 2) * 64)
    yield line("batch-decode", payload=head(0, 65) + piece(5, 0, 1, 2) * 65)
    for _ in range(20):
        cut = bytearray(whole)
        cut[rng.randrange(12, len(cut))] ^= 1 << rng.randrange(8)
        yield line("batch-decode", payload=bytes(cut))


def logics(rng: Random) -> Iterator[str]:
    """Of every size, wrong in one place each, and bytes that are none."""
    usual = {"nodes": [5, 0, 0, 0, 0] * 2, "digital": [5, 33, 255, 16], "pwm": [255, 0],
             "triggers": [0, 16, 99, 1, 1, 17, 32, 0, 2, 33, 24, 7]}  # fmt: skip
    yield line("logic-check", number=1, **usual)
    for key, at, value in (
        ("nodes", 5, 7), ("nodes", 6, 33), ("digital", 0, 34), ("digital", 3, 26),
        ("digital", 3, 254), ("pwm", 0, 31), ("pwm", 1, 27), ("triggers", 0, 3),
        ("triggers", 1, 26),
        ("triggers", 3, 0), ("triggers", 5, 34), ("triggers", 6, 255), ("triggers", 8, 3),
        ("triggers", 9, 30), ("triggers", 10, 99), ("triggers", 11, 0), ("triggers", 7, 9),
    ):  # fmt: skip
        changed = {name: list(values) for name, values in usual.items()}
        changed[key][at] = value
        yield line("logic-check", number=1, **changed)
    yield from _fed(usual)
    for nodes in (0, 1, NODES):
        for triggers in (0, 1, TRIGGERS):
            sized = {
                "nodes": [n for at in range(nodes) for n in _node(rng, at)],
                "digital": [rng.randrange(256) for _ in range(4)],
                "pwm": [rng.randrange(256) for _ in range(2)],
                "triggers": [rng.randrange(3) for _ in range(4 * triggers)],
            }
            yield line("logic-check", number=2, **sized)
            size = 5 + 11 * nodes + 7 + 5 * triggers + 2
            for capacity in (1000, size, size - 1, 4, 0):
                yield line(
                    "logic-encode", number=rng.randrange(1 << 32), capacity=capacity, **sized
                )
    whole = bytes([1, 2, 3, 4, 1, 9, 8, 7, *range(8), *range(6), 2, *range(10)])
    whole += bytes([1, *range(8), 2, *range(6)])
    yield line("logic-decode", payload=whole)
    for size in range(len(whole)):
        yield line("logic-decode", payload=whole[:size])
    yield line("logic-decode", payload=whole + b"\1")
    for nodes, triggers in ((NODES, TRIGGERS), (NODES + 1, 0), (0, TRIGGERS + 1), (0, 0)):
        body = bytes(4) + bytes([nodes]) + bytes(11 * nodes + 6) + bytes([triggers])
        yield line("logic-decode", payload=body + bytes(5 * triggers + 2))


def _fed(usual: dict[str, list[int]]) -> Iterator[str]:
    """Feeds and tracks that are fed: each wrong in one place, and all good."""
    both = {"feeds": [0, 16, 7, 4, 9000, 1, 33, 65535, 1, 0], "fed": [5, 8, 15, 8]}
    yield line("logic-check", number=1, **usual, **both)
    for key, at, value in (
        ("feeds", 0, 2), ("feeds", 1, 26), ("feeds", 6, 34), ("feeds", 3, 0), ("feeds", 7, 7),
        ("feeds", 8, 0), ("fed", 0, 4), ("fed", 2, 16), ("fed", 2, 5), ("fed", 1, 7),
        ("fed", 3, 65535), ("fed", 3, 9), ("feeds", 4, 65535),
    ):  # fmt: skip
        changed = {name: list(values) for name, values in both.items()}
        changed[key][at] = value
        yield line("logic-check", number=1, **usual, **changed)
    size = 5 + 22 + 7 + 15 + 1 + 16 + 1 + 6
    for capacity in (1000, size, size - 1):
        yield line("logic-encode", number=9, capacity=capacity, **usual, **both)
    for feeds, fed in ((FEEDS, FEEDS), (FEEDS + 1, 0), (0, FEEDS + 1)):
        body = bytes(5 + 6 + 1) + bytes([feeds]) + bytes(8 * feeds) + bytes([fed])
        yield line("logic-decode", payload=body + bytes(3 * fed))


def reports(rng: Random) -> Iterator[str]:
    """Readings of all sizes and differences, bytes that are none."""
    for count in (0, 1, 2, 47, 48):
        base = rng.choice((0, -(1 << 50), 1_700_000_000_000_000))
        told = [n for _ in range(count)
                for n in (rng.randrange(256), rng.choice(EDGES), rng.choice(EDGES))]  # fmt: skip
        given = {"logic": rng.randrange(1 << 32), "result": rng.randrange(5), "wrong": 200,
                 "next": [rng.randrange(1 << 31) for _ in range(11)], "refused": 3,
                 "late": rng.randrange(1 << 32), "gaps": rng.randrange(1 << 32),
                 "kept": rng.randrange(1 << 32),
                 "first": rng.randrange(1 << 32), "readings": told, "base_us": base}  # fmt: skip
        for capacity in (1000, 79, 78, 94, 0) if count else (1000, 79, 78, 0):
            yield line("report-encode", capacity=capacity, **given) if count else line(
                "report-encode", capacity=capacity,
                **{k: v for k, v in given.items() if k != "base_us"})  # fmt: skip
    usual = {"logic": 1, "result": 0, "wrong": 0, "next": [0] * 11, "refused": 0, "late": 0,
             "gaps": 0, "kept": 0, "first": 0, "readings": [1, 2, 3], "base_us": 0}  # fmt: skip
    yield line("report-encode", capacity=2000, count=49, **usual)
    head = bytes(range(70))

    def told(*values: int) -> bytes:
        return b"".join(
            bytes([n % 3]) + _zigzag(values[n]) + _zigzag(values[n + 1])
            for n in range(0, len(values), 2)
        )

    whole = head + bytes([2]) + (77).to_bytes(8, "little") + told(1, -1, 1 << 40, 70_000)
    yield line("report-decode", payload=whole)
    for size in range(len(whole)):
        yield line("report-decode", payload=whole[:size])
    yield line("report-decode", payload=whole + b"\0")
    wild = told((1 << 63) - 1, TOP, (1 << 63) - 1, TOP, -(1 << 63), -(1 << 63))
    yield line("report-decode", payload=head + bytes([3]) + b"\xff" * 7 + b"\x7f" + wild)
    yield line("report-decode", payload=head + bytes([48]) + bytes(8) + told(*[1, 1] * 48))
    yield line("report-decode", payload=head + bytes([49]) + bytes(8) + told(*[1, 1] * 49))
