"""Vectors of boards among themselves: their frames, whose time they keep, and marks."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from random import Random

from line import line

from headway.firmware import _core

PEER = 4  # the label under which these frames are hashed
REQUEST, RESPONSE, FEED = 10, 11, 15
POINTS = 6  # of a feed, in a frame
TIME_MAX = 1 << 60
LAYOUT = "<QqqiiIB"
WRAP = 1 << 32


def sealed(key: bytes, body: bytes) -> bytes:
    return body + _core.siphash24(key, PEER, body).to_bytes(8, "little")


def request(key: bytes, nonce: int) -> bytes:
    return sealed(key, bytes([1, REQUEST]) + nonce.to_bytes(8, "little"))


def response(key: bytes, *values: int) -> bytes:
    return sealed(key, bytes([1, RESPONSE]) + struct.pack(LAYOUT, *values))


def _broken(frame: bytes, key: bytes) -> Iterator[bytes]:
    """Each bit's opposite, each cut, a byte more; other versions and types under a right tag."""
    for i in range(8 * len(frame)):
        if i % 8 in (0, 7) or i < 16:
            yield (int.from_bytes(frame, "little") ^ 1 << i).to_bytes(len(frame), "little")
    yield from (frame[:size] for size in range(len(frame)))
    yield frame + b"\0"
    body = frame[:-8]
    for version, kind in ((0, body[1]), (2, body[1]), (1, REQUEST + RESPONSE - body[1]), (1, 1)):
        yield sealed(key, bytes([version, kind]) + body[2:])
    yield sealed(key, body[:-1])
    yield sealed(key, body + b"\0")
    for prefix in (0, 1, 2, 3, 5):  # what is hashed for another purpose
        yield body + _core.siphash24(key, prefix, body).to_bytes(8, "little")


def peers(rng: Random) -> Iterator[str]:
    """Frames with every number at its ends; broken, cut, under another key, of another kind."""
    key, other = rng.randbytes(16), rng.randbytes(16)
    for nonce in (0, 1, WRAP, (1 << 64) - 1, rng.getrandbits(64)):
        for of in (key, bytes(16)):
            yield line("peer-request-encode", key=of, nonce=f"{nonce:016x}")
            yield line("peer-request-decode", key=of, frame=request(of, nonce))
    yield line("peer-request-decode", key=other, frame=request(key, 7))
    for frame in _broken(request(key, nonce), key):
        yield line("peer-request-decode", key=key, frame=frame)
    names = ("received_us", "sent_us", "least_error_ns", "most_error_ns", "lineage", "settled")
    rows = [(0, 0, 0, 0, 0, 0), (1, 2, 3, 4, 5, 1), (-1, -2, -3, -4, 6, 0)]
    top = (1 << 31) - 1
    rows += [(TIME_MAX, -TIME_MAX, -top, top, WRAP - 1, 1), (5, 6, -top - 1, -1, 1 << 31, 0)]
    for _ in range(8):
        times = (rng.randrange(-TIME_MAX, TIME_MAX) for _ in range(2))
        errors = (rng.randrange(-top, top) for _ in range(2))
        rows.append((*times, *errors, rng.randrange(WRAP), rng.randrange(2)))
    for row in rows:
        nonce = rng.getrandbits(64)
        given = dict(zip(names, row, strict=True))
        yield line("peer-response-encode", key=key, nonce=f"{nonce:016x}", **given)
        yield line("peer-response-decode", key=key, frame=response(key, nonce, *row))
        yield line("peer-response-decode", key=other, frame=response(key, nonce, *row))
    for flags in (2, 3, 254, 255):  # only the lowest bit says something
        yield line("peer-response-decode", key=key, frame=response(key, 9, 1, 2, 3, 4, 5, flags))
    for time_us in (TIME_MAX, TIME_MAX + 1, -TIME_MAX, -TIME_MAX - 1, 2**63 - 1, -(2**63)):
        for row in ((time_us, 0, 0, 0, 0, 0), (0, time_us, 0, 0, 0, 0)):
            yield line("peer-response-decode", key=key, frame=response(key, 9, *row))
    for frame in _broken(response(key, nonce, *rows[1]), key):
        yield line("peer-response-decode", key=key, frame=frame)
    yield from _feeds(rng, key, other)


def feed(key: bytes, number: int, flags: int, lineage: int, time_us: int,
         points: list[tuple[int, int]], count: int | None = None) -> bytes:  # fmt: skip
    """Points: how long before `time_us`, and the value."""
    count = len(points) if count is None else count
    body = bytes([1, FEED]) + struct.pack("<HBBIq", number, flags, count, lineage, time_us)
    filled = points + [(0, 0)] * (POINTS - len(points))
    return sealed(key, body + b"".join(struct.pack("<Ii", *point) for point in filled))


def _feeds(rng: Random, key: bytes, other: bytes) -> Iterator[str]:
    top = (1 << 31) - 1
    for count in range(1, POINTS + 1):
        number, lineage = rng.choice((0, 1, 65535)), rng.choice((0, 5, WRAP - 1))
        time_us, steps = rng.choice((0, TIME_MAX, -TIME_MAX, 1_700_000_000_000_000)), count % 2
        ages = sorted({rng.randrange(top) for _ in range(count)}, reverse=True)
        points = [(age, rng.choice((0, 1, -1, top, -top - 1))) for age in ages]
        yield line("peer-feed-encode", key=key, number=number, steps=steps, lineage=lineage,
                   time_us=time_us, points=[n for point in points for n in point])  # fmt: skip
        frame = feed(key, number, steps, lineage, time_us, points)
        yield line("peer-feed-decode", key=key, frame=frame)
        yield line("peer-feed-decode", key=other, frame=frame)
    usual = [(9, 1), (8, -2), (0, 3)]
    for ages in ([0], [WRAP - 1], [WRAP - 1, 0], [5, 5], [4, 5], [5, 4], [9, 8, 8], [9, 8, 9]):
        whole = feed(key, 7, 0, 0, 77, [(age, age % 7) for age in ages])
        yield line("peer-feed-decode", key=key, frame=whole)
    for count in (0, 1, 3, POINTS, POINTS + 1, 255):
        frame = feed(key, 7, 0, 0, 77, [(60 - 9 * i, i) for i in range(POINTS)], count)
        yield line("peer-feed-decode", key=key, frame=frame)
    for flags in (2, 3, 255):  # only the lowest bit says something
        yield line("peer-feed-decode", key=key, frame=feed(key, 7, flags, 0, 77, usual))
    for time_us in (TIME_MAX, TIME_MAX + 1, -TIME_MAX, -TIME_MAX - 1, 2**63 - 1, -(2**63)):
        yield line("peer-feed-decode", key=key, frame=feed(key, 7, 1, 0, time_us, usual))
    broken = list(_broken(feed(key, 7, 1, 3, 77, usual), key))
    for frame in (*broken[::24], *broken[-11:]):
        yield line("peer-feed-decode", key=key, frame=frame)


def lineages(rng: Random) -> Iterator[str]:
    """Every order of numbers, both settled or not, and ages on each side of being known."""
    top = WRAP - 1
    for own, other in ((1, 2), (2, 1), (5, 5), (0, 3), (3, 0), (0, 0), (1, top), (top, 1)):
        for settled in range(4):
            for least_us, most_us in (
                (1, 1), (1, 9), (0, 1), (0, 0), (-1, 1), (-1, 0), (-9, -1), (-1, -1),
                (86_400_000_000, 86_400_000_400), (-86_400_000_000, -86_399_999_000),
            ):  # fmt: skip
                yield line(
                    "lineage", own=own, own_settled=settled & 1, other=other,
                    other_settled=settled >> 1, ahead_least_us=least_us, ahead_most_us=most_us,
                )  # fmt: skip


def marks(rng: Random) -> Iterator[str]:
    """Starts of frames, each seen more than once, across the wraps of both numbers."""
    for first in (0, 33, 65_400):
        yield line("marks")
        yield line("marks-find", mark_number=first // 32 * 32)
        count = rng.randrange(WRAP)
        for i in range(400):
            number = (first + i) % (1 << 16)
            count = (count + 1000) % WRAP
            if number % 32 in (0, 1, 31) or i < 40:
                for _ in range(1 + (i % 5 == 0)):
                    yield line("marks-note", mark_number=number, count_us=count)
            if number % 32 == 0:
                for back in (0, 1, 32, 6 * 32, 7 * 32, 8 * 32, 9 * 32):
                    yield line("marks-find", mark_number=(number - back) % (1 << 16))
