"""Scenes of what arrives at a device: what is refused at a glance, and what has to be opened.

A packet that is refused at a glance costs little: the next one is looked at in the same poll. So
behind each comes a command that is answered at once; whether the poll answers it tells which of
both it was.
"""

from __future__ import annotations

import struct

from bench import PEER_KEY, Bench, settings
from device_session import A_NONCE, COMMAND, IDLE, MOVING, SYNC, UNSYNCED
from peer import request, response

from headway.firmware import _core

DRAW_STEP = 0x9E3779B97F4A7C15
KEY = bytes(range(30, 46))


def _glance(b: Bench, packet: bytes, port: int = 0) -> bool:
    """Whether it is refused at a glance."""
    b.give(packet, port)
    b.give(b.seal(COMMAND, b.command("FAULTS")))
    b.run(1, 10)
    sent = int(b.told("sent"))
    assert sent in (0, 1)
    if not sent:
        b.run(1, 10)
        assert b.told("sent") == "1"
    return sent == 1


def _joined(b: Bench, number: int, sent: int = 0) -> _core.Session:
    """A group that the device is in."""
    group = _core.Session(KEY, KEY, number)
    group.sent = sent
    assert b.host.session is not None
    b.give(b.host.session.seal_group(group))
    b.run(1, 10)
    return group


def glances(b: Bench) -> None:
    b.scene("what is no frame of ours is refused at a glance", IDLE)
    b.syncing = False
    assert b.host.session is not None
    good = b.seal(SYNC, _core.sync_encode(b.stamps()))
    body = _core.cobs_decode(good)
    assert body is not None

    def changed(at: int, value: int) -> bytes:
        return _core.cobs_encode(bytes([*body[:at], value % 256, *body[at + 1 :]]))

    for size in (1, 2, 11, 12, 13, 14, 19, 20):
        assert _glance(b, good[:size]), size
    assert not _glance(b, good[:21])
    for packet in (b.seal(0, b""), b.seal(0, bytes(40)), b.seal(6, b""), b.seal(6, b"\1" * 30)):
        assert _glance(b, packet)
    for at in range(2, 6):
        assert _glance(b, changed(at, body[at] + 1)) and _glance(b, changed(at, body[at] - 1))
    for version in (2, 255, 0):
        assert _glance(b, changed(0, version))
    assert not _glance(b, changed(len(body) - 1, body[-1] + 1))  # a wrong tag
    assert not _glance(b, good)
    assert _glance(b, good)  # again
    assert _glance(b, b"\5\0" + good[2:]) and _glance(b, bytes([1] * 40))
    assert _glance(b, bytes([2, 9] * 20)) and _glance(b, bytes([255] * 60))
    for kind in (5, 7, 4, 1, 14):
        assert not _glance(b, b.seal(kind, b"\1"))
    asked = b.seal(_core.FRAME_SETTINGS, b"\1" * 40)
    b.give(asked[:-2])  # a block that goes on behind the end
    b.run(1, 10)
    assert b.told("sent") == "0"
    b.hear()
    b.scene("all of a counter counts", IDLE)
    b.syncing = False
    for number, sent in ((0x12345600, 0), (0x12340078, 1 << 24), (0x00560078, 0x55 << 40),
                         (0x12003400, 0x1234560000), (0, 0xFF)):  # fmt: skip
        group = _joined(b, number, sent)
        packets = [group.seal(SYNC, _core.sync_encode(b.stamps())) for _ in range(3)]
        assert not _glance(b, packets[1]) and not _glance(b, packets[0])
        assert _glance(b, packets[1]) and _glance(b, packets[0])
        assert not _glance(b, packets[2])
        assert _glance(b, group.seal(0, b"")) and _glance(b, group.seal(0, bytes(30)))
        b.hear()
    b.scene("twelve at a glance in a poll, and no thirteenth", IDLE)
    b.syncing = False
    for junk in (11, 12):
        for _ in range(junk):
            b.give(bytes([77] * 25))
        b.give(b.seal(COMMAND, b.command("FAULTS")))
        b.run(1, 10)
        assert (b.told("sent") == "1") == (junk == 11)
        b.run(1, 10)
    b.hear()


def ports(b: Bench) -> None:
    b.scene("neighbours: by port and size", IDLE)
    b.syncing = False
    made = settings()
    made.neighbours, made.ask_us = 0b01010, 10_000_000
    b.adjust(made)
    b.run(1)
    good = b.seal(SYNC, _core.sync_encode(b.stamps()))
    for port in range(1, 5):
        on = port in (1, 3)
        for size in (18, 19, 20, 47, 48, 49, 30):
            packet = bytes([7, 1, *[9] * 5, size - 7, *[8] * (size - 8)])
            assert _glance(b, packet, port) == (not on or size not in (19, 48)), (port, size)
            other = bytes([packet[0], 2, *packet[2:]])
            assert _glance(b, other, port) and _glance(b, b"\7\0" + packet[2:], port)
        assert _glance(b, good, port)
        assert _glance(b, _core.hello(A_NONCE), port)
        b.give(_core.cobs_encode(request(PEER_KEY, 7)), port)
        b.give(_core.cobs_encode(response(PEER_KEY, 7, 1, 2, -3, 4, 5, 1)), port)
        b.run(1, 10)
        b.run(1, 10, tell=1)
        b.run(1, 10, tell=1)
    b.hear()


def offers(b: Bench) -> None:
    b.scene("HELLOs in a session: what is like one, what is ignored, what is answered", IDLE)
    b.syncing = False
    b.go(30)
    bad = b.status.frames_bad
    b.give(_core.hello(bytes([5]) * 16))
    b.run(1, 10)
    for kind in (1, 4, 5, 7, 12):  # as long as a HELLO, within its pause
        assert not _glance(b, b.seal(kind, b"\1" * 26)), kind
    assert _glance(b, _core.hello(bytes([5]) * 16))
    assert _glance(b, _core.hello(bytes([5]) * 16) + b"\1")
    b.hear()
    assert b.status.frames_bad - bad == 6  # what is ignored is not bad
    mine = b.host.copy()
    nonces = [bytes([5]) * 16, bytes([5]) * 15 + b"\6", bytes([5]) * 15 + b"\4", bytes([4]) * 16]
    for nonce in (*nonces, mine.nonce):
        b.run(1, 25_000)
        b.give(_core.hello(nonce))
        b.run(1, 10, tell=4)
        b.give(_core.hello(nonce))
        b.run(1, 25_000)
    b.scene("a frame with the offer's number alone does not begin it", IDLE)
    b.syncing = False
    b.go(30)
    mine = b.host.copy()
    nonce = bytes([6]) * 16
    b.give(_core.hello(nonce))
    b.run(1, 10, tell=4)
    (packet,) = [p for _, p in b.packets]
    _, _, offered = _core.welcome_open(settings().key, nonce, packet)
    assert offered is not None
    forged = _core.Session(KEY, KEY, offered.number)
    assert not _glance(b, forged.seal(SYNC, _core.sync_encode((0, 0, 1))))
    b.hear()
    b.expect("IDLE")
    for slot, state in ((IDLE, "IDLE"), (MOVING, "ESTOP")):
        b.scene(f"a group ends with its session; a stop, first, {state}", slot)
        b.syncing = False
        b.go(0 if slot == MOVING else 30)
        _joined(b, 77)
        b.order("ARM" if slot == IDLE else "ZERO", 1 << 30)
        assert b.status.grouped and b.status.command_result != 0
        b.syncing = False
        if slot == MOVING:
            b.set(line_open=1)
            b.go(40)
            b.hear()
            assert b.status.synced
        assert b.greet(bytes([8]) * 16) == "ok"
        b.sync()
        b.hear()
        assert not b.status.grouped and b.status.command_result == 0 and not b.status.synced
        b.go(30)
        assert b.greet(bytes([8]) * 16) == "ok"  # the same HELLO: another offer
        b.sync()
        b.hear()
    b.scene("another session while it brakes: not yet", MOVING)
    b.syncing = False
    b.syncing = False
    mine = b.host.copy()
    b.give(_core.hello(nonce))
    b.run(1, 10, tell=4)
    (packet,) = [p for _, p in b.packets]
    _, _, offered = _core.welcome_open(settings().key, nonce, packet)
    assert offered is not None
    b.set(line_open=1)
    b.run(2)
    b.give(offered.seal(SYNC, _core.sync_encode((0, 0, 1))))
    b.run(1, 10)
    b.hear()
    b.go(60)
    b.give(offered.seal(SYNC, _core.sync_encode((0, 0, 1))))
    b.run(6)


def collisions(b: Bench) -> None:
    """The number of an offer, of 32 bits, that the group has already."""
    b.scene("an offer whose number is the group's is none", UNSYNCED)
    b.syncing = False
    b.go(30)
    nonce, draw = bytes([11]) * 16, 0x1111222233334444
    device = struct.pack("<IIQ", 1, 2, draw)  # of the first boot, its second offer
    welcome = _core.welcome(settings().key, nonce, device)
    _, _, session = _core.welcome_open(settings().key, nonce, welcome)
    assert session is not None
    taken = session.number
    for number, answers in ((taken, False), (0, True), (0xFFFFFFFF, True)):
        _joined(b, number)
        b.set(random=f"{draw:016x}")
        b.give(_core.hello(nonce if number == taken else nonce[:15] + bytes([number % 251 + 1])))
        b.run(1, 10, tell=4)
        assert (b.told("sent") == "1") == answers, (number, b.answer)
        b.set(random=f"{draw:016x}")
        b.run(1, 21_000)
    b.hear()


SCENES = (glances, ports, offers, collisions)
