"""Vectors of boards among themselves: their frames, whose time they keep, and marks."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from random import Random

from line import line

from headway.firmware import _core

PEER = 4  # the label under which these frames are hashed
REQUEST, RESPONSE = 10, 11
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
