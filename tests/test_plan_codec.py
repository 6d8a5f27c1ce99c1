"""The payloads of PLAN, SYNC and STATUS, against the layouts that plan.h and status.c describe."""

import struct
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rig import Rig

from headway.firmware import _core

TIME_MAX = 1 << 60
PAYLOAD_MAX = 1000
INT32_MAX = (1 << 31) - 1
SINKS = range(5)

Stamps = tuple[int, int, int]
NO_MARK = struct.pack("<HHq", 0, 0xFFFF, 0)  # number, width, least time: a width of none
Tracks = dict[int, list[int]]


def zigzag(value: int) -> bytes:
    """Sign in the lowest bit; seven bits a byte, the last without the high bit."""
    number = 2 * value if value >= 0 else -2 * value - 1
    out = []
    while number >= 128:
        out.append(number % 128 + 128)
        number //= 128
    return bytes([*out, number])


def deltas(points: list[int]) -> Iterator[int]:
    """The first point, the first difference, then second differences."""
    yield points[0]
    yield points[1] - points[0]
    for a, b, c in zip(points, points[1:], points[2:], strict=False):
        yield c - 2 * b + a


def head_of(stamps: Stamps, number: int, epoch: int, first: int, mask: int, count: int) -> bytes:
    head = struct.pack("<Iqq", *stamps) + NO_MARK
    return head + struct.pack("<IHqBB", number, epoch, first, mask, count)


def layout(stamps: Stamps, number: int, epoch: int, first_knot: int, tracks: Tracks) -> bytes:
    count = len(next(iter(tracks.values())))
    mask = sum(1 << sink for sink in tracks)
    head = head_of(stamps, number, epoch, first_knot, mask, count)
    return head + b"".join(zigzag(d) for s in sorted(tracks) for d in deltas(tracks[s]))


def encode(stamps: Stamps, number: int, epoch: int, first_knot: int, tracks: Tracks) -> bytes:
    arrays = {s: np.array(p, dtype=np.int32) for s, p in tracks.items()}
    return _core.plan_encode(stamps, number, epoch, first_knot, arrays)


times = st.integers(-TIME_MAX, TIME_MAX)
numbers = st.integers(0, 2**32 - 1)
stamps_us = st.tuples(numbers, times, times)
epochs = st.integers(0, 2**16 - 1)
knots = st.integers(-(1 << 63), (1 << 63) - 1)
values = (
    st.integers(-100, 100)
    | st.integers(-INT32_MAX - 1, INT32_MAX)
    | st.sampled_from([-INT32_MAX - 1, -INT32_MAX, INT32_MAX])
)


@st.composite
def plans(draw: st.DrawFn) -> Tracks:
    sinks = draw(st.sets(st.sampled_from(SINKS), min_size=1))
    count = draw(st.integers(3, 12))
    points = st.lists(values, min_size=count, max_size=count)
    return {sink: draw(points) for sink in sinks}


ALTERNATING = [INT32_MAX, -INT32_MAX - 1] * 6  # the largest second differences


@given(stamps_us, numbers, epochs, knots, plans())
@example(
    (2**32 - 1, -TIME_MAX, TIME_MAX),
    2**32 - 1,
    2**16 - 1,
    -(1 << 63),
    dict.fromkeys(SINKS, ALTERNATING),
)
def test_plan_round_trip(
    stamps: Stamps, number: int, epoch: int, first_knot: int, tracks: Tracks
) -> None:
    payload = encode(stamps, number, epoch, first_knot, tracks)
    assert payload == layout(stamps, number, epoch, first_knot, tracks)
    decoded = _core.plan_decode(payload)
    assert decoded is not None
    assert decoded[:4] == (stamps, number, epoch, first_knot)
    assert {s: list(p) for s, p in decoded[4].items()} == tracks
    assert all(p.dtype == np.int32 for p in decoded[4].values())


@given(stamps_us, plans())
def test_truncated_or_extended_plan_is_refused(stamps: Stamps, tracks: Tracks) -> None:
    payload = encode(stamps, 1, 7, 2, tracks)
    for size in range(len(payload)):
        assert _core.plan_decode(payload[:size]) is None
    assert _core.plan_decode(payload + b"\0") is None


@given(st.binary(max_size=120))
def test_random_bytes_decode_to_something_legal_or_nothing(noise: bytes) -> None:
    head = head_of((0, 0, 0), 1, 7, 5, 3, 4)
    for payload in (noise, head + noise):
        decoded = _core.plan_decode(payload)
        if decoded is not None:
            stamps, number, epoch, first_knot, tracks = decoded
            points = {s: [int(p) for p in a] for s, a in tracks.items()}
            assert set(points) <= set(SINKS)
            canonical = layout(stamps, number, epoch, first_knot, points)
            assert len(canonical) <= len(payload)  # varints may be longer than they need
            assert all(-INT32_MAX - 1 <= p <= INT32_MAX for a in points.values() for p in a)
        _core.status_decode(payload)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 128, 129, 255])
def test_counts(count: int) -> None:
    head = head_of((0, 0, 0), 1, 7, 5, 1, count)
    decoded = _core.plan_decode(head + bytes(count))
    assert (decoded is not None) == (3 <= count <= _core.PLAN_POINTS_MAX)
    if count <= 128:
        return
    with pytest.raises(ValueError, match=r"3 \.\. 128"):
        encode((0, 0, 0), 1, 7, 0, {0: [0] * count})


@pytest.mark.parametrize("mask", [*range(34), 0x40, 0x80, 0xFF])
def test_masks(mask: int) -> None:
    head = head_of((0, 0, 0), 1, 7, 5, mask, 3)
    decoded = _core.plan_decode(head + bytes(3 * mask.bit_count()))
    assert (decoded is not None) == (0 < mask < 32)
    if decoded is not None:
        assert set(decoded[4]) == {s for s in SINKS if mask >> s & 1}


@pytest.mark.parametrize(
    "varint",
    [
        zigzag(INT32_MAX + 1),
        zigzag(-INT32_MAX - 2),
        zigzag(1 << 62),
        zigzag((1 << 63) - 1),
        zigzag(-(1 << 63)),
        b"\xff" * 9 + b"\x7f",  # ten bytes, bits beyond the 64th
        b"\xff" * 10,  # never ends
        b"\x80" * 10 + b"\0",  # eleven bytes
        b"\xff" * 60,
    ],
)
def test_huge_varints_are_refused(varint: bytes) -> None:
    head = head_of((0, 0, 0), 1, 7, 5, 1, 3)
    assert _core.plan_decode(head + b"\0\0\0") is not None
    for lead in (b"", b"\0", b"\0\0"):
        payload = head + lead + varint
        assert _core.plan_decode(payload + bytes(2 - len(lead))) is None
        assert _core.plan_decode(payload) is None


def test_sums_beyond_32_bits_are_refused() -> None:
    head = head_of((0, 0, 0), 1, 7, 5, 1, 4)

    def decode(*differences: int) -> object:
        return _core.plan_decode(head + b"".join(map(zigzag, differences)))

    assert decode(INT32_MAX, 0, 0, 0) is not None
    assert decode(INT32_MAX, 1, 0, 0) is None
    assert decode(INT32_MAX, -2 * INT32_MAX, 4 * INT32_MAX, -4 * INT32_MAX) is not None
    assert decode(INT32_MAX, -2 * INT32_MAX - 1, 2 * INT32_MAX + 1, 0) is not None
    assert decode(INT32_MAX, -2 * INT32_MAX - 2, 2 * INT32_MAX + 2, 0) is None
    assert decode(INT32_MAX, -2 * INT32_MAX, -2, 0) is None
    assert decode(0, 1, 1 << 30, 1 << 30) is None  # differences add up
    assert decode(0, 1 << 30, 0, 0) is None
    assert decode(INT32_MAX, 1 << 33, 0, 0) is None


@pytest.mark.parametrize("at", [1, 2])
def test_stamps_from_another_age_are_refused(at: int) -> None:
    for time_us, ok in ((TIME_MAX, True), (TIME_MAX + 1, False), ((1 << 63) - 1, False)):
        for sign in (-1, 1):
            stamps = [0, 0, 0]
            stamps[at] = sign * time_us
            payload = encode((stamps[0], stamps[1], stamps[2]), 1, 7, 0, {0: [0, 0, 0]})
            assert (_core.plan_decode(payload) is not None) == ok


def test_plans_out_of_shape() -> None:
    for bad in ({}, {0: [1, 2]}, {5: [0] * 3}, {-1: [0] * 3}, {0: [0] * 3, 1: [0] * 4}):
        with pytest.raises(ValueError, match="plan"):
            encode((0, 0, 0), 1, 7, 0, bad)


def test_the_largest_plan_fits_and_one_byte_more_does_not() -> None:
    full = {s: [100] * 128 for s in SINKS}
    assert len(encode((0, 0, 0), 1, 7, 0, full)) == 48 + 5 * 129  # the first point takes two bytes
    wide, still = [1 << 29, -(1 << 29)] * 64, [0] * 128
    spare = PAYLOAD_MAX - len(layout((0, 0, 0), 1, 7, 0, {0: wide, 1: still, 2: still}))
    assert 0 < spare < 120
    for two_bytes, fits in ((spare, True), (spare + 1, False)):
        seconds = [0, *(100 * (-1) ** i for i in range(two_bytes)), *[0] * (127 - two_bytes)]
        points = np.cumsum(np.cumsum(seconds)).tolist()
        tracks = {0: wide, 1: still, 2: points}
        assert len(layout((0, 0, 0), 1, 7, 0, tracks)) == PAYLOAD_MAX + (not fits)
        if fits:
            assert len(encode((0, 0, 0), 1, 7, 0, tracks)) == PAYLOAD_MAX
        else:
            with pytest.raises(ValueError, match="does not fit"):
                encode((0, 0, 0), 1, 7, 0, tracks)


@given(stamps_us)
def test_sync_layout(stamps: Stamps) -> None:
    assert _core.sync_encode(stamps) == struct.pack("<Iqq", *stamps) + NO_MARK
    mark = (7, 12, -5)
    assert _core.sync_encode(stamps, mark)[20:] == struct.pack("<HHq", *mark)


# ---- status

HEAD = "<qIiiiqIHHqBBBHIBiBBIqiiiiIIIIIIIIIiIB"
FLAGS = ("synced", "homed", "released")
FAULT = (*("reason", "state", "boots", "time_us", "value", "limit", "position_pq", "torque_tq"),)
CLOCK = ("sent_count_us", "least_error_ns", "most_error_ns", "rate_q32", "heard_us", "heard_age_us")
BEFORE = ("epoch", "command_number", "command_result", "holding_tq")
AFTER = (
    *("plan_seen", "plan_accepted", "accepted_mask"),
    *("plans_accepted", "plans_late", "plans_refused", "frames_bad", "coasts", "stamps_excluded"),
    *("torque_peak_tq", "torque_clipped"),
)
u8 = st.integers(0, 255)
u32 = st.integers(0, 2**32 - 1)
int64s = st.integers(-(1 << 62), (1 << 62) - 1)  # of which each difference is one
int32s = st.integers(-INT32_MAX - 1, INT32_MAX)
heads = st.tuples(
    *(int64s, u32, int32s, int32s, int32s, int64s, u32),
    *(epochs, epochs, int64s),
    *(u8, u8, st.integers(0, 7)),
    *(epochs, u32, u8, int32s),
    *(u8, u8, u32, int64s, int32s, int32s, int32s, int32s),
    *[u32] * 9,
    *(int32s, u32),
)
samples_of = st.lists(st.tuples(int64s, int32s), max_size=32)


def status_layout(head: tuple[int, ...], samples: list[tuple[int, int]]) -> bytes:
    payload = struct.pack(HEAD, *head, len(samples))
    time_us, count = head[0], 0
    for sample in samples:
        payload += zigzag(sample[0] - time_us) + zigzag(sample[1] - count)
        time_us, count = sample
    return payload


def fields_of(status: _core.Status) -> tuple[int, ...]:
    flags = sum(getattr(status, name) << bit for bit, name in enumerate(FLAGS))
    before = [getattr(status, name) for name in BEFORE]
    fault = [getattr(status.fault, name) for name in FAULT]
    after = [getattr(status, name) for name in AFTER]
    clock = [getattr(status, name) for name in CLOCK]
    states = (status.state, status.refusal, flags)
    return (status.sent_us, *clock, *status.mark, *states, *before, *fault, *after)


@given(heads, samples_of)
def test_status_is_read_as_laid_out(head: tuple[int, ...], samples: list[tuple[int, int]]) -> None:
    payload = status_layout(head, samples)
    status = _core.status_decode(payload)
    assert status is not None
    assert fields_of(status) == head
    assert status.samples == samples
    for size in range(len(payload)):
        assert _core.status_decode(payload[:size]) is None
    assert _core.status_decode(payload + b"\0") is None


@pytest.mark.parametrize("count", [32, 33, 255])
def test_status_holds_32_samples(count: int) -> None:
    payload = struct.pack(HEAD, *[0] * 36, count) + bytes(2 * count)
    assert (_core.status_decode(payload) is not None) == (count <= 32)


def test_a_device_writes_status_as_laid_out() -> None:
    rig = Rig()
    rig.encoder = lambda true_us: true_us * true_us % 10_007 - 5_000
    rig.run(20_000)
    assert rig.payload and not rig.statuses[-1].frames_bad
    rig.node.deliver(rig.now, b"\x05junk")
    for _ in range(10):
        rig.run(4096)
        status = rig.statuses[-1]
        assert status_layout(fields_of(status), status.samples) == rig.payload
        assert len(status.samples) >= 8
    assert status.frames_bad == 1
