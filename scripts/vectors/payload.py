"""Vectors of the payloads: plans, syncs, statuses."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import pairwise
from random import Random

from line import line

TIME_MAX = 1 << 60
POINT_MAX = (1 << 31) - 1
SINKS = ("position", "torque", "kp", "ki", "kd")
MARK = ("mark_number", "mark_width_us", "mark_least_us")
STAMPS = ("echo_us", "received_us", "sent_us", *MARK)
Stamps = tuple[int, int, int, int, int, int]
FEW: Stamps = (1, 2, 3, 4, 5, 6)
Tracks = dict[str, list[int]]


def varint(value: int) -> bytes:
    """Zigzag, seven bits a byte, the lowest first; any size, also beyond what a decoder takes."""
    zigzag = 2 * value if value >= 0 else -2 * value - 1
    out = bytearray()
    while zigzag >= 0x80:
        out.append(zigzag & 0x7F | 0x80)
        zigzag >>= 7
    return bytes([*out, zigzag])


def times(*values: int) -> bytes:
    """Signed 64-bit, little-endian."""
    return struct.pack(f"<{len(values)}q", *values)


def stamped(*stamps: int) -> bytes:
    """The head of a SYNC and of a PLAN."""
    return struct.pack("<IqqHHq", *stamps)


def _random_stamps(rng: Random) -> Stamps:
    echo_us, number, width_us = (rng.randrange(1 << bits) for bits in (32, 16, 16))
    received_us, sent_us, least_us = (rng.randrange(-TIME_MAX, TIME_MAX) for _ in range(3))
    return echo_us, received_us, sent_us, number, width_us, least_us


def varints(rng: Random) -> Iterator[str]:
    """Values around each length's end, into too little room; bytes that are none or too many."""
    ends = [0, 1, 2, *((1 << 7 * i - 1) + d for i in range(1, 10) for d in (-1, 0, 1))]
    ends += [(1 << 62) - 1, 1 << 62, (1 << 63) - 1, *(rng.randrange(1 << 63) for _ in range(8))]
    for value in [*ends, *(-end for end in ends), -(1 << 63)]:
        size = len(varint(value))
        for capacity in (size - 1, size):
            yield line("varint-encode", value=value, capacity=capacity)
        yield line("varint-decode", payload=varint(value))
        yield line("varint-decode", payload=varint(value)[:-1])
    for length in range(1, 12):
        for last in (0, 1, 2, 3, 0x7E, 0x7F, 0x80):
            for filler in (b"\x80", b"\xff"):
                yield line("varint-decode", payload=filler * (length - 1) + bytes([last]))
    yield from _runs_of_bytes()


def _runs_of_bytes() -> Iterator[str]:
    for size in (0, 1, 2, 5):
        data = bytes(range(200, 200 + size))
        for room in (size - 1, size, size + 1):
            if room >= 0:
                yield line("bytes-encode", bytes=data, capacity=room)
                yield line("bytes-decode", payload=data, count=room)


def syncs(rng: Random) -> Iterator[str]:
    """Encode into every capacity near the size; decode with stamps near their bounds."""
    rows: list[Stamps] = [
        (0, 0, 0, 0, 0, 0),
        (1, -1, 256, 1, 256, -2),
        (2**32 - 1, TIME_MAX, -TIME_MAX, 2**16 - 1, 2**16 - 2, TIME_MAX),
        (2**31, -(2**63), 2**63 - 1, 2**15, 2**16 - 1, -(2**63)),
    ]
    rows += [_random_stamps(rng) for _ in range(4)]
    for row in rows:
        for capacity in (32, 33):
            yield line("sync-encode", **dict(zip(STAMPS, row, strict=True)), capacity=capacity)
    for capacity in (0, 3, 4, 11, 12, 19, 20, 21, 22, 23, 24, 31):
        yield line("sync-encode", **dict(zip(STAMPS, rows[1], strict=True)), capacity=capacity)
    for row in rows:
        yield line("sync-decode", payload=stamped(*row))
    for size in (0, 1, 3, 4, 12, 19, 20, 21, 24, 31, 33, 40):
        yield line("sync-decode", payload=(stamped(*rows[1]) + bytes(8))[:size])
    for value in (TIME_MAX - 1, TIME_MAX, TIME_MAX + 1, 2**63 - 1, -(2**63)):
        for sign in (1, -1) if value > 0 else (1,):
            yield line("sync-decode", payload=stamped(1, sign * value, 2, 3, 4, 5))
            yield line("sync-decode", payload=stamped(1, 2, sign * value, 3, 4, 5))
            yield line("sync-decode", payload=stamped(1, 2, 3, 4, 5, sign * value))


def _track(rng: Random, count: int) -> list[int]:
    """A walk with differences of one size."""
    largest = rng.choice([0, 1, 63, 64, 8192, 1 << 20, 1 << 26])
    points = [rng.randrange(-(1 << 29), 1 << 29)]
    while len(points) < count:
        step = rng.randrange(-largest, largest + 1)
        points.append(max(-POINT_MAX, min(POINT_MAX, points[-1] + step)))
    return points


def _extremes() -> Iterator[list[int]]:
    top = POINT_MAX
    yield [top, -top, top]
    yield [-top, top, -top]
    yield [0, top, -top, -top, top, 0, 0, 0]
    yield [-top] * 3
    yield [1, -1, 1, -1]
    yield [-(1 << 31)] * 3
    yield [-(1 << 31), top, -(1 << 31), top]


def _coded(points: list[int]) -> bytes:
    """First point, first difference, second differences."""
    firsts = [b - a for a, b in zip([0, *points], points, strict=False)]
    seconds = [b - a for a, b in pairwise(firsts[1:])]
    return b"".join(varint(value) for value in [*firsts[:2], *seconds])


def _payload(
    tracks: Tracks,
    *,
    stamps: Stamps = FEW,
    number: int = 9,
    epoch: int = 3,
    first_knot: int = 77,
    mask: int | None = None,
    count: int | None = None,
) -> bytes:
    bits = sum(1 << SINKS.index(name) for name in tracks)
    most = max(map(len, tracks.values()), default=0)
    head = stamped(*stamps) + struct.pack("<IHq", number, epoch, first_knot)
    head += bytes([bits if mask is None else mask, most if count is None else count])
    ordered = [tracks[name] for name in SINKS if name in tracks]
    return head + b"".join(map(_coded, ordered))


def _encode(
    tracks: Tracks, *, capacity: int = 1000, mask: int | None = None, count: int | None = None,
    number: int = 9, epoch: int = 3, first_knot: int = 77,
    stamps: Stamps = FEW,
) -> str:  # fmt: skip
    bits = sum(1 << SINKS.index(name) for name in tracks)
    values = dict(zip(STAMPS, stamps, strict=True))
    values |= {"number": number, "epoch": epoch, "first_knot": first_knot}
    values["tracks"] = bits if mask is None else mask
    values["count"] = len(next(iter(tracks.values()), [])) if count is None else count
    return line("plan-encode", capacity=capacity, **values, **tracks)


def _plan_rows(rng: Random) -> Iterator[Tracks]:
    for sink in SINKS:
        yield {sink: _track(rng, 3)}
    for count in (3, 4, 5, 127, 128):
        yield {"position": _track(rng, count)}
    yield {name: _track(rng, 8) for name in SINKS}
    yield {"position": _track(rng, 60), "torque": _track(rng, 60)}
    for points in _extremes():
        yield {"position": points}
        yield {"torque": points, "kd": points}


def plans(rng: Random) -> Iterator[str]:
    """Encode and decode, counts and masks out of range, every cut, every hostile number."""
    for tracks in _plan_rows(rng):
        number, knot = rng.randrange(1 << 32), rng.randrange(-(1 << 63), 1 << 63)
        epoch = rng.randrange(1 << 16)
        stamps = _random_stamps(rng)
        yield _encode(tracks, number=number, epoch=epoch, first_knot=knot, stamps=stamps)
        payload = _payload(tracks, number=number, epoch=epoch, first_knot=knot, stamps=stamps)
        yield line("plan-decode", payload=payload)
    small: Tracks = {"position": [100, 90, 70, 70, 70], "torque": [5] * 5}
    good = _payload(small)
    for capacity in range(len(good) + 2):
        yield _encode(small, capacity=capacity)
        yield line("plan-decode", payload=(good + b"\0")[:capacity])
    for count in (0, 1, 2, 3, 128, 129, 255):
        yield _encode({"position": [1] * 128}, count=count)
        yield line("plan-decode", payload=_payload({"position": [1] * count}, count=count))
    for mask in (0, 1, 16, 31, 32, 33, 64, 255):
        yield _encode({name: [2, 3, 3, 3] for name in SINKS}, mask=mask)
        tracks = {name: [2, 3, 3, 3] for i, name in enumerate(SINKS) if mask >> i & 1}
        yield line("plan-decode", payload=_payload(tracks, mask=mask, count=4))
    for value in (TIME_MAX, TIME_MAX + 1):
        for sign in (-1, 1):
            for stamps in (
                (1, sign * value, 1, 1, 1, 1),
                (1, 1, sign * value, 1, 1, 1),
                (1, 1, 1, 1, 1, sign * value),
            ):
                yield line("plan-decode", payload=_payload(small, stamps=stamps))
    yield from _hostile_points(rng)


def _hostile_points(rng: Random) -> Iterator[str]:
    """Differences whose sums leave 32 bits at every place, and varints of every length."""

    def decode(*numbers: int, tail: bytes = b"") -> str:
        head = _payload({}, mask=1, count=max(3, len(numbers)))
        return line("plan-decode", payload=head + b"".join(map(varint, numbers)) + tail)

    top, wide = POINT_MAX, 4 * POINT_MAX
    low = -(1 << 31)
    for excess in (-1, 0, 1):
        yield decode(low + excess, 0, 0)
        yield decode(-1, low + 1 + excess, -low - 1)
    for sign in (1, -1):
        for excess in (-1, 0, 1, 2):
            value = sign * (top + excess)
            yield decode(value, 0, 0)
            yield decode(0, value, -value)
            yield decode(0, 0, value)
            yield decode(sign, value - sign, -value)
            yield decode(-sign * top, sign * (2 * top + excess), -sign * 2 * top)
            yield decode(sign * top, sign * excess, -sign * excess)
            wider = sign * (wide + excess)
            yield decode(wider, 0, 0)
            yield decode(0, wider, 0)
            yield decode(-sign * top, sign * 2 * top, -wider)
            huge = sign * ((1 << 63) - 1 + min(excess, 0))
            yield decode(huge, sign, sign)
            yield decode(sign, huge, sign)
            yield decode(sign, sign, huge)
            yield decode(sign, sign, sign, huge)
            # down by the widest second difference that a point allows, and up again
            yield decode(-sign * top, sign * 2 * top, -sign * 4 * top - sign * excess, 0)
    for value in (0, -1, 1, 63, 64, -64, -65, 8191, 8192, -8192, 1 << 30, -(1 << 31)):
        yield decode(value, -value, 0) if abs(value) <= top else decode(value, 0, 0)
    for length in range(1, 12):  # 1 and -1, drawn out by empty groups
        for first in (0x82, 0x81):
            drawn = bytes([first]) + b"\x80" * (length - 1) + b"\0"
            head = _payload({}, mask=1, count=3)
            yield line("plan-decode", payload=head + drawn + b"\0\0")
    for last in (0, 1, 2, 0x7F, 0x80, 0xFF):
        head = _payload({}, mask=1, count=3)
        yield line("plan-decode", payload=head + b"\xff" * 9 + bytes([last]) + b"\0\0")
        yield line("plan-decode", payload=head + b"\x80" * 9 + bytes([last]) + b"\0\0")
    for _ in range(60):
        cut = rng.randrange(20)
        yield line("plan-decode", payload=_payload({}, mask=1, count=4) + rng.randbytes(cut))


STATUS = (
    ("sent_count_us", 4), ("least_error_ns", 4), ("most_error_ns", 4), ("rate_q32", 4),
    ("heard_us", 8), ("heard_age_us", 4), ("mark_number", 2), ("mark_width_us", 2),
    ("mark_least_us", 8), ("state", 1), ("refusal", 1), ("flags", 1), ("epoch", 2),
    ("command_number", 4),
    ("command_result", 1), ("holding_tq", 4), ("fault_reason", 1), ("fault_state", 1),
    ("fault_boots", 4), ("fault_time_us", 8), ("fault_value", 4), ("fault_limit", 4),
    ("fault_position_pq", 4), ("fault_torque_tq", 4), ("plan_seen", 4), ("plan_accepted", 4),
    ("accepted_mask", 4), ("plans_accepted", 4), ("plans_late", 4), ("plans_refused", 4),
    ("frames_bad", 4), ("coasts", 4), ("stamps_excluded", 4), ("torque_peak_tq", 4),
    ("torque_clipped", 4),
)  # fmt: skip
FLAGS = ("synced", "homed", "released", "grouped")  # from the lowest bit on
SIGNED = (
    *("least_error_ns", "most_error_ns", "rate_q32", "heard_us", "mark_least_us", "holding_tq"),
    *("fault_time_us", "fault_value", "fault_limit", "fault_position_pq", "fault_torque_tq"),
    "torque_peak_tq",
)


def _status_head(sent_us: int, values: dict[str, int]) -> bytes:
    fields = b"".join(
        (values[name] % (1 << 8 * size)).to_bytes(size, "little") for name, size in STATUS
    )
    return times(sent_us) + fields


def _status_values(rng: Random) -> dict[str, int]:
    values = {name: rng.randrange(1 << 8 * size) for name, size in STATUS}
    values["flags"] &= 15
    for name, size in STATUS:
        if name in SIGNED:
            values[name] -= 1 << 8 * size - 1
    return values


def _named(values: dict[str, int]) -> dict[str, int]:
    """The flags one by one."""
    bits = {name: values["flags"] >> i & 1 for i, name in enumerate(FLAGS)}
    return {name: value for name, value in values.items() if name != "flags"} | bits


def statuses(rng: Random) -> Iterator[str]:
    """Samples from none to one too many, cuts, and sums of hostile differences."""
    for count in (0, 1, 2, 5, 31, 32, 33, 255):
        values, sent_us = _status_values(rng), rng.randrange(TIME_MAX)
        ages = sorted((rng.randrange(20_000) for _ in range(min(count, 32))), reverse=True)
        if count == 5:
            ages = [-(1 << 31), (1 << 31) - 1, 0, -5, 5]
        counts = [rng.randrange(-(1 << 31), 1 << 31) for _ in ages]
        given = _named(values) | {"sample_count": count, "ages_us": ages, "counts": counts}
        yield line("status-encode", sent_us=sent_us, **given, capacity=1000)
        body, last_us, last = b"", sent_us, 0
        for age, at in zip(ages, counts, strict=True):
            body += varint(sent_us - age - last_us) + varint(at - last)
            last_us, last = sent_us - age, at
        payload = _status_head(sent_us, values) + bytes([count]) + body
        yield line("status-decode", payload=payload)
        if count == 2:
            whole = len(payload)
            for size in (
                0,
                7,
                8,
                35,
                36,
                37,
                38,
                39,
                40,
                47,
                48,
                52,
                95,
                *range(whole - 5, whole + 2),
            ):
                yield line("status-encode", sent_us=sent_us, **given, capacity=size)
                yield line("status-decode", payload=(payload + b"\0")[:size])
    for name, size in STATUS:  # each field by itself
        values = {other: 0 for other, _ in STATUS} | {name: (1 << 8 * size) - 2}
        yield line("status-decode", payload=_status_head(0, values) + b"\0")
        if name in SIGNED:
            values[name] = 1 - (1 << 8 * size - 1)
        empty = {"sample_count": 0, "ages_us": [], "counts": [], "capacity": 1000}
        yield line("status-encode", sent_us=0, **_named(values), **empty)
    for bits in range(32):
        values = {name: 0 for name, _ in STATUS} | {"flags": bits}
        yield line("status-decode", payload=_status_head(0, values) + b"\0")
        if bits < 1 << len(FLAGS):
            yield line("status-encode", sent_us=0, **_named(values), **empty)
    head = _status_head(5, {name: 0 for name, _ in STATUS})
    for value in (2**63 - 1, -(2**63), 2**31, -(2**31) - 1, 2**32 + 7):
        body = varint(value) + varint(value)
        yield line("status-decode", payload=head + b"\x02" + body + body)
    for sent_us in (-1, -(2**63), 2**63 - 1):
        values = _status_values(rng)
        payload = _status_head(sent_us, values) + b"\x01" + varint(1) + varint(-1)
        yield line("status-decode", payload=payload)
