"""The handshake's frames, the keys that both ends derive, and the host's end of it."""

import zlib

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from headway.devices.session import Session, draw_group
from headway.firmware import _core

KEY = bytes(range(100, 116))
SIZE, CRC = 46, 4
PROOF, NUMBER, TO_DEVICE, TO_HOST = 1, 2, 3, 5  # labels; a key's second half has the next one
keys = nonces = st.binary(min_size=16, max_size=16)


def device_nonce(boot: int = 7, number: int = 1, random: int = 0xABCDEF) -> bytes:
    return boot.to_bytes(4, "little") + number.to_bytes(4, "little") + random.to_bytes(8, "little")


def derived(key: bytes, label: int, host: bytes, device: bytes) -> bytes:
    return _core.siphash24(key, label, host + device).to_bytes(8, "little")


def at_device(key: bytes, host: bytes, device: bytes) -> _core.Session:
    """The device's end, made by hand from what handshake.h says."""
    to_device = b"".join(derived(key, TO_DEVICE + i, host, device) for i in range(2))
    to_host = b"".join(derived(key, TO_HOST + i, host, device) for i in range(2))
    number = int.from_bytes(derived(key, NUMBER, host, device)[:4], "little")
    return _core.Session(to_host, to_device, number, at_device=True)


def crc_framed(body: bytes) -> bytes:
    return cobs.encode(body + zlib.crc32(body).to_bytes(CRC, "little"))


def host(seed: int = 1, key: bytes = KEY) -> Session:
    return Session(key, np.random.default_rng(seed))


def nonce_in(packet: bytes) -> bytes:
    return cobs.decode(packet)[2:18]


def answer(session: Session, key: bytes = KEY, **nonce: int) -> bytes:
    return _core.welcome(key, nonce_in(session.hello()), device_nonce(**nonce))


def status_under(session: _core.Session) -> bytes:
    return session.seal(_core.FRAME_STATUS, b"anything")


@given(st.binary(max_size=600))
def test_crc_is_that_of_zlib(data: bytes) -> None:
    assert _core.crc_of(data) == zlib.crc32(data)


@given(nonces)
def test_hello_layout(nonce: bytes) -> None:
    frame = cobs.decode(_core.hello(nonce))
    body = bytes([1, _core.FRAME_HELLO]) + nonce
    body += bytes(SIZE - CRC - len(body))
    assert frame == body + zlib.crc32(body).to_bytes(CRC, "little")


@given(keys, nonces, nonces)
def test_welcome_layout_is_as_long_as_a_hello(key: bytes, ours: bytes, theirs: bytes) -> None:
    frame = cobs.decode(_core.welcome(key, ours, theirs))
    body = bytes([1, _core.FRAME_WELCOME]) + ours + theirs + derived(key, PROOF, ours, theirs)
    assert frame == body + zlib.crc32(body).to_bytes(CRC, "little")
    assert len(frame) == len(cobs.decode(_core.hello(ours))) == SIZE


@given(keys, nonces, nonces)
def test_both_ends_derive_the_same(key: bytes, ours: bytes, theirs: bytes) -> None:
    verdict, nonce, session = _core.welcome_open(key, ours, _core.welcome(key, ours, theirs))
    assert (verdict, nonce) == ("ok", theirs)
    device = at_device(key, ours, theirs)
    assert session is not None
    assert session.number == device.number
    assert (session.send_key, session.receive_key) == (device.receive_key, device.send_key)
    assert device.open(session.seal(_core.FRAME_SYNC, b"there")) == (_core.FRAME_SYNC, b"there")
    assert session.open(device.seal(_core.FRAME_STATUS, b"back")) == (_core.FRAME_STATUS, b"back")


@given(keys, nonces, nonces, st.integers(0, 383))
def test_every_bit_of_key_and_nonces_makes_other_keys(
    key: bytes, ours: bytes, theirs: bytes, bit: int
) -> None:
    """All keys that any two handshakes derive are distinct, in both directions."""
    changed = bytearray(key + ours + theirs)
    changed[bit // 8] ^= 1 << bit % 8
    seen: list[bytes] = []
    for material in (key + ours + theirs, bytes(changed)):
        k, h, d = material[:16], material[16:32], material[32:]
        session = _core.welcome_open(k, h, _core.welcome(k, h, d))[2]
        assert session is not None
        seen += [session.send_key, session.receive_key]
        halves = {key[:8] for key in seen[-2:]} | {key[8:] for key in seen[-2:]}
        proof = derived(k, PROOF, h, d)  # goes over the wire, so it may be no part of a key
        assert len(halves | {proof}) == 5
    assert len(set(seen)) == 4


@pytest.mark.parametrize("bit", range(8 * SIZE))
def test_a_flipped_bit_of_a_welcome_is_line_noise(bit: int) -> None:
    session = host()
    frame = bytearray(cobs.decode(answer(session)))
    frame[bit // 8] ^= 1 << bit % 8
    assert session.welcome(cobs.encode(bytes(frame))) == "line noise"
    assert not session.welcomed
    assert session.welcome(answer(session)) == "ok"


def test_a_flipped_bit_on_the_wire_begins_nothing() -> None:
    session = host()
    packet = answer(session)
    for bit in range(8 * len(packet)):
        flipped = bytearray(packet)
        flipped[bit // 8] ^= 1 << bit % 8
        assert session.welcome(bytes(flipped)) in ("line noise", "another frame")
        assert not session.welcomed


@given(st.integers(0, SIZE * 8 - 1), st.integers(1, 1 << 32))
def test_a_burst_of_noise_is_found(at: int, burst: int) -> None:
    """A CRC-32 finds every burst of up to 32 bits (Peterson and Brown, 1961)."""
    session = host()
    frame = int.from_bytes(cobs.decode(answer(session)), "little")
    damaged = (frame ^ (burst % (1 << 32) or 1) << at) % (1 << 8 * SIZE)
    if damaged != frame:
        packet = cobs.encode(damaged.to_bytes(SIZE, "little"))
        assert session.welcome(packet) == "line noise"


@pytest.mark.parametrize("size", [0, 1, 2, 19, 20, 45, 47, 1020])
def test_other_sizes(size: int) -> None:
    session = host()
    whole = cobs.decode(answer(session))
    cut = (whole + bytes(1020))[:size]
    assert session.welcome(cobs.encode(cut)) == "line noise"
    status = bytes([1, _core.FRAME_STATUS]) + bytes(size)
    assert session.welcome(cobs.encode(status)) == (
        "line noise" if len(status) == SIZE else "another frame"
    )


@given(keys)
def test_wrong_key(key: bytes) -> None:
    session = host()
    expected = "ok" if key == KEY else "wrong key"
    assert session.welcome(answer(session, key)) == expected
    assert session.welcomed == (key == KEY)


@pytest.mark.parametrize("bit", range(128))
def test_a_key_wrong_by_a_bit(bit: int) -> None:
    key = bytearray(KEY)
    key[bit // 8] ^= 1 << bit % 8
    session = host()
    assert session.welcome(answer(session, bytes(key))) == "wrong key"
    assert not session.welcomed


@pytest.mark.parametrize("at", range(2, SIZE - CRC))
def test_a_forged_welcome_is_not_taken(at: int) -> None:
    """Who has no key can mend the CRC, and gains nothing by it."""
    session = host()
    body = bytearray(cobs.decode(answer(session))[:-CRC])
    body[at] ^= 0x10
    assert session.welcome(crc_framed(bytes(body))) == ("stale" if at < 18 else "wrong key")
    assert not session.welcomed


def test_another_version_and_another_frame() -> None:
    session = host()
    body = cobs.decode(answer(session))[1:-CRC]
    assert session.welcome(crc_framed(b"\x02" + body)) == "other version"
    assert session.welcome(session.hello()) == "another frame"
    assert session.welcome(b"\0\0") == "line noise"
    assert not session.welcomed


def test_a_replayed_welcome_is_stale() -> None:
    """One that answered an earlier HELLO, of this host or of another one."""
    session = host()
    old = answer(session)
    assert session.welcome(old) == "ok"
    session.renew()
    assert session.welcome(old) == "stale"
    assert not session.welcomed
    assert host(2).welcome(old) == "stale"


def test_hello_is_the_same_until_renewed() -> None:
    session = host()
    first = session.hello()
    assert session.hello() == first
    session.welcome(answer(session))
    assert session.hello() == first
    session.renew()
    assert session.hello() != first


def test_the_same_welcome_again_does_not_count_from_the_start() -> None:
    """To use a counter twice would sign two frames as the same one."""
    session = host()
    packet = answer(session)
    assert session.welcome(packet) == "ok"
    first = session.seal(_core.FRAME_SYNC, b"one")
    assert session.welcome(packet) == "ok"
    assert session.seal(_core.FRAME_SYNC, b"one") != first


def test_a_newer_welcome_replaces_an_older_one_until_the_device_has_answered() -> None:
    session = host()
    nonce = nonce_in(session.hello())
    assert session.welcome(answer(session, number=4)) == "ok"
    assert session.welcome(answer(session, number=3)) == "stale"
    assert session.welcome(answer(session, number=5)) == "ok"
    assert session.welcome(answer(session, number=4)) == "stale"
    assert session.open(status_under(at_device(KEY, nonce, device_nonce(number=4)))) == (
        "bad session"
    )
    assert not session.established
    assert isinstance(
        session.open(status_under(at_device(KEY, nonce, device_nonce(number=5)))), tuple
    )
    assert session.established
    assert session.welcome(answer(session, number=6)) == "stale"
    assert session.welcome(answer(session, boot=8)) == "stale"
    session.renew()
    assert session.welcome(answer(session, number=5)) == "stale"  # the device went back in time
    assert session.welcome(answer(session, boot=8)) == "ok"


def test_before_a_welcome_nothing_is_signed_or_opened() -> None:
    session = host()
    for seal in (
        lambda: session.seal(_core.FRAME_SYNC, b""),
        lambda: session.seal_group(draw_group(np.random.default_rng(1))),
    ):
        with pytest.raises(ValueError, match="first hello"):
            seal()
    nonce = nonce_in(session.hello())
    assert session.open(status_under(at_device(KEY, nonce, device_nonce()))) == "no session"


def test_overtaken_frames_are_told() -> None:
    session = host()
    assert session.welcome(answer(session)) == "ok"
    device = at_device(KEY, nonce_in(session.hello()), device_nonce())
    packets = [status_under(device) for _ in range(3)]
    told = []
    for i in (0, 2, 1):
        assert isinstance(session.open(packets[i]), tuple)
        told.append(session.overtaken)
    assert told == [False, False, True]


@given(st.integers(0, (1 << 48) - 2), st.integers(0, (1 << 48) - 1))
def test_the_groups_key_travels_under_a_pad_of_its_own(counter: int, group_counter: int) -> None:
    session, group = host(), draw_group(np.random.default_rng(3))
    assert session.welcome(answer(session)) == "ok"
    device = at_device(KEY, nonce_in(session.hello()), device_nonce())
    sealing = _core.Session(device.receive_key, device.send_key, device.number)
    sealing.sent, group.sent = counter, group_counter
    opened = device.open(sealing.seal_group(group))
    assert isinstance(opened, tuple) and opened[0] == _core.FRAME_GROUP
    masked, rest = opened[1][:16], opened[1][16:]
    assert rest == group.number.to_bytes(4, "little") + group_counter.to_bytes(6, "little")
    own = (counter + 1).to_bytes(8, "little")
    pad = b"".join(
        _core.siphash24(device.receive_key, prefix, own).to_bytes(8, "little") for prefix in (2, 3)
    )
    assert bytes(a ^ b for a, b in zip(masked, pad, strict=True)) == group.send_key
    if counter < (1 << 48) - 2:
        again = device.open(sealing.seal_group(group))
        assert isinstance(again, tuple) and again[1][:16] != masked
