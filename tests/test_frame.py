"""The authenticated frame: what is opened, and the named error of everything else."""

import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from headway.firmware import _core

KEY, BACK_KEY = bytes(range(16)), bytes(range(50, 66))  # to the device, to the host
HEADER, TAG, PAYLOAD_MAX = 12, 8, 1000
NUMBER = 0xA1B2C3D4
WINDOW = 64
VERSION_AT, TYPE_AT, SESSION_AT, COUNTER_AT = 0, 1, 2, 6

payloads = st.binary(max_size=80)


def pair() -> tuple[_core.Session, _core.Session]:
    host = _core.Session(KEY, BACK_KEY, NUMBER)
    return host, _core.Session(BACK_KEY, KEY, NUMBER, at_device=True)


def reopen(receiver: _core.Session, frame: bytes) -> tuple[int, bytes] | str:
    """Opens a frame that was tampered with below the byte stuffing."""
    return receiver.open(cobs.encode(frame))


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 255), payloads), min_size=1, max_size=8))
def test_round_trip_in_both_directions(frames: list[tuple[bool, int, bytes]]) -> None:
    host, device = pair()
    sent = {True: 0, False: 0}
    for to_device, kind, payload in frames:
        sender, receiver = (host, device) if to_device else (device, host)
        packet = sender.seal(kind, payload)
        assert 0 not in packet
        assert receiver.open(packet) == (kind, payload)
        sent[to_device] += 1
        assert sender.sent == sent[to_device]
        assert receiver.received == sent[to_device]


def test_layout() -> None:
    host, _ = pair()
    host.sent = 0x0102030405
    frame = cobs.decode(host.seal(_core.FRAME_PLAN, b"payload"))
    head = bytes([1, _core.FRAME_PLAN]) + NUMBER.to_bytes(4, "little")
    assert frame[:HEADER] == head + (0x0102030406).to_bytes(6, "little")
    assert frame[HEADER:-TAG] == b"payload"
    to_device = 0
    tag = _core.siphash24(KEY, to_device, frame[:-TAG])
    assert frame[-TAG:] == tag.to_bytes(TAG, "little")


def test_every_single_bit_flip_is_refused() -> None:
    host, device = pair()
    host.sent = 0x010203  # nonzero bytes, so that flips go both ways
    frame = cobs.decode(host.seal(_core.FRAME_PLAN, bytes(range(1, 24))))
    device.received = 0x010203
    for bit in range(8 * len(frame)):
        flipped = bytearray(frame)
        flipped[bit // 8] ^= 1 << bit % 8
        error = reopen(device, bytes(flipped))
        at = bit // 8
        if at == VERSION_AT:
            assert error == "bad version"
        elif SESSION_AT <= at < COUNTER_AT:
            assert error == "bad session"
        elif COUNTER_AT <= at < HEADER:
            higher = flipped[at] > frame[at]
            assert error == ("bad tag" if higher else "replayed")
        else:
            assert error == "bad tag"
        assert device.received == 0x010203
    assert device.open(cobs.encode(frame)) == (_core.FRAME_PLAN, bytes(range(1, 24)))


def test_every_single_bit_flip_on_the_wire_is_refused() -> None:
    host, device = pair()
    packet = host.seal(_core.FRAME_SYNC, bytes(24))
    for bit in range(8 * len(packet)):
        flipped = bytearray(packet)
        flipped[bit // 8] ^= 1 << bit % 8
        assert isinstance(device.open(bytes(flipped)), str)
        assert device.received == 0
    assert device.open(packet) == (_core.FRAME_SYNC, bytes(24))


@given(payloads)
def test_every_truncation_and_extension_is_refused(payload: bytes) -> None:
    host, device = pair()
    frame = cobs.decode(host.seal(_core.FRAME_PLAN, payload))
    for size in range(len(frame)):
        short = size < HEADER + TAG
        assert reopen(device, frame[:size]) == ("bad length" if short else "bad tag")
    assert reopen(device, frame + b"\0") == "bad tag"
    assert device.received == 0


def test_length_limits() -> None:
    host, device = pair()
    longest = bytes(PAYLOAD_MAX)
    assert device.open(host.seal(_core.FRAME_PLAN, longest)) == (_core.FRAME_PLAN, longest)
    with pytest.raises(ValueError, match="too long"):
        host.seal(_core.FRAME_PLAN, longest + b"\0")
    frame = cobs.decode(host.seal(_core.FRAME_PLAN, longest))
    assert reopen(device, frame + b"\0") == "bad length"
    assert device.open(host.seal(_core.FRAME_PLAN, b"")) == (_core.FRAME_PLAN, b"")
    for junk in (b"", b"\0", b"\x05\x01"):  # no COBS packet at all
        assert device.open(junk) == "bad length"


@given(payloads)
def test_reflected_to_its_sender(payload: bytes) -> None:
    one_key = [_core.Session(KEY, KEY, NUMBER, at_device) for at_device in (False, True)]
    for session in (*pair(), *one_key):
        assert session.open(session.seal(_core.FRAME_PLAN, payload)) == "bad tag"
        assert session.received == 0


@given(st.lists(st.integers(0, 299), min_size=1, max_size=120), st.integers(1, 1 << 40))
def test_any_order_duplication_and_loss(order: list[int], start: int) -> None:
    """Against a set of all counters: accepted once, if not overtaken by a whole window."""
    host, device = pair()
    host.sent = device.received = start
    packets = [host.seal(_core.FRAME_PLAN, i.to_bytes(2, "little")) for i in range(300)]
    accepted: set[int] = set()
    for i in order:
        fresh = i not in accepted and all(i > other - WINDOW for other in accepted)
        expected = (_core.FRAME_PLAN, i.to_bytes(2, "little")) if fresh else "replayed"
        assert device.open(packets[i]) == expected
        if fresh:
            accepted.add(i)
        newest = start + max(accepted) + 1 if accepted else start
        assert device.received == newest


@pytest.mark.parametrize("ahead", [1, 2, 62, 63, 64, 65, 127, 128, 129, 1000])
def test_window_boundaries(ahead: int) -> None:
    """All of a window's frames after one that was so far ahead of them."""
    host, device = pair()
    packets = [host.seal(_core.FRAME_PLAN, b"") for _ in range(ahead + 1)]
    opened = (_core.FRAME_PLAN, b"")
    assert device.open(packets[0]) == opened
    assert device.open(packets[ahead]) == opened
    for i in range(ahead - 1, -1, -1):
        in_window = i > ahead - WINDOW and i != 0
        assert device.open(packets[i]) == (opened if in_window else "replayed"), i
        assert device.open(packets[i]) == "replayed"
        assert device.received == ahead + 1


def test_a_forgery_does_not_move_the_window() -> None:
    host, device = pair()
    packets = [host.seal(_core.FRAME_PLAN, b"x") for _ in range(200)]
    for packet in (packets[199], packets[3]):
        frame = bytearray(cobs.decode(packet))
        frame[-1] ^= 1
        assert reopen(device, bytes(frame)) == "bad tag"
    for packet in packets[:100]:
        assert device.open(packet) == (_core.FRAME_PLAN, b"x")


def test_counter_zero_is_never_sent_and_never_taken() -> None:
    host, device = pair()
    host.sent = (1 << 64) - 1  # the next one is 0
    with pytest.raises(OverflowError):
        host.seal(_core.FRAME_SYNC, b"")
    frame = bytearray(cobs.decode(pair()[0].seal(_core.FRAME_SYNC, b"")))[:-TAG]
    frame[COUNTER_AT:HEADER] = bytes(6)
    tag = _core.siphash24(KEY, 0, bytes(frame)).to_bytes(TAG, "little")
    assert reopen(device, bytes(frame) + tag) == "replayed"


@given(st.integers(0, 31))
def test_other_session_number(bit: int) -> None:
    host, _ = pair()
    other = _core.Session(BACK_KEY, KEY, NUMBER ^ 1 << bit, at_device=True)
    assert other.open(host.seal(_core.FRAME_PLAN, b"x")) == "bad session"
    assert other.received == 0


@pytest.mark.parametrize("bit", range(128))
def test_other_key(bit: int) -> None:
    host, _ = pair()
    key = bytearray(KEY)
    key[bit // 8] ^= 1 << bit % 8
    other = _core.Session(BACK_KEY, bytes(key), NUMBER, at_device=True)
    assert other.open(host.seal(_core.FRAME_PLAN, b"x")) == "bad tag"
    assert other.received == 0


@pytest.mark.parametrize("size", [0, 15, 17])
def test_a_key_has_sixteen_bytes(size: int) -> None:
    with pytest.raises(ValueError, match="16 bytes"):
        _core.Session(bytes(size), KEY, 1)
    with pytest.raises(ValueError, match="16 bytes"):
        _core.Session(KEY, bytes(size), 1)


def test_counter_uses_all_its_48_bits() -> None:
    host, device = pair()
    host.sent = (1 << 48) - 3
    device.received = (1 << 48) - 3
    for _ in range(2):
        packet = host.seal(_core.FRAME_SYNC, b"")
        assert device.open(packet) == (_core.FRAME_SYNC, b"")
        assert device.open(packet) == "replayed"
    assert device.received == (1 << 48) - 1
    for _ in range(2):  # and never wraps
        with pytest.raises(OverflowError, match="no counters left"):
            host.seal(_core.FRAME_SYNC, b"")
        assert host.sent == (1 << 48) - 1
