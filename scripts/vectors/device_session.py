"""Scenes of a device: boots, sessions, the clock, what arrives and what is told of it."""

from __future__ import annotations

from bench import (
    BOOTS_A,
    BOOTS_B,
    EPOCH_US,
    FAULTS_A,
    FIRST_COUNT_US,
    KEY,
    PEER_KEY,
    PERIOD_US,
    SETTINGS_A,
    Bench,
    record,
    settings,
)
from peer import request, response

from headway.firmware import _core

UNSYNCED, IDLE, ARMED, STANDING, HOLDING, MOVING, SPARE, COOLING = range(8)  # slots
A_NONCE, B_NONCE, C_NONCE = (bytes([i]) * 16 for i in (1, 2, 3))
SYNC, PLAN, STATUS, COMMAND = (
    _core.FRAME_SYNC,
    _core.FRAME_PLAN,
    _core.FRAME_STATUS,
    _core.FRAME_COMMAND,
)


def _dead(b: Bench) -> None:
    """It answers nobody, and keeps its output off and the brake on."""
    b.set(power=1, brake=0, duty_q15=99)
    b.ask("device-boot", count_us=FIRST_COUNT_US)
    b.give(_core.hello(A_NONCE))
    b.run(3)
    assert (b.told("power"), b.told("brake"), b.told("duty_q15")) == ("0*3", "1*3", "0*3")
    assert b.told("sent") == "0"


def boots(b: Bench) -> None:
    b.scene("no settings in memory: no motion, no session")
    _dead(b)
    b.scene("settings that are not valid: the same")
    made = settings()
    made.knot_shift = 8
    b.ask("device-record", record=SETTINGS_A, bytes=record(1, made.encode(True)))
    _dead(b)
    for name, values in (("boot numbers are lost", None), ("memory takes no boot number", 3)):
        b.scene(f"good settings, but {name}: the same")
        b.ask("device-record", record=SETTINGS_A, bytes=record(1, settings().encode(True)))
        if values is None:
            b.ask("device-record", record=BOOTS_A, bytes=bytes(9))
            b.ask("device-record", record=BOOTS_B, bytes=bytes(9))
        else:
            b.set(kept=values)
        _dead(b)
    b.scene("the emergency line is open at boot: ESTOP, until it is closed and cleared")
    b.set(line_open=1)
    b.boot()
    assert b.greet(A_NONCE) == "ok"
    b.sync()
    b.go(6)
    b.expect("ESTOP")
    b.orders("CLEAR", "CAUSE", "ESTOP")
    b.set(line_open=0)
    b.orders("CLEAR", "DONE", "UNSYNCED")
    b.scene("good settings, a log of faults, leftovers of a motion: UNSYNCED, off and braked")
    log = (9).to_bytes(4, "little") + bytes(i % 256 for i in range(240))
    b.ask("device-record", record=FAULTS_A, bytes=record(4, log))
    b.set(power=1, brake=0, duty_q15=-99, position=321, supply_mV=24_000)
    b.boot()
    b.report(0)
    assert b.told("sent") == "0"
    assert b.greet(A_NONCE) == "ok"
    assert (b.told("power"), b.told("brake"), b.told("duty_q15")) == ("0", "1", "0")
    b.syncing = False
    b.run(4)
    assert b.told("sent") == "0"  # the session begins with the host's first frame
    b.syncing = True
    b.set(position=321)
    b.sync()
    b.expect("UNSYNCED", "NONE")
    assert len(b.faults()) == 8
    assert b.status.samples[-1][1] == 321, b.status.samples
    b.keep(UNSYNCED)


def hellos(b: Bench) -> None:
    b.scene("HELLO: one answer in 20 ms, the same one to the same, a new offer to another")
    b.boot()
    b.syncing = False
    nonces = []
    for nonce in (A_NONCE, A_NONCE, B_NONCE):
        assert b.greet(nonce) == "ok"
        nonces.append(b.packets[-1][1])
        for step_us in (10_000, 9998):  # then 19_999 us after it was looked at
            b.run(1, step_us)
            b.give(_core.hello(nonce))
        b.run(1, 1)
        assert b.told("sent") == "0"
        b.give(_core.hello(nonce))
        b.run(1, 1)
        assert b.told("sent") == "1"
        b.run(1, 20_000)
    assert nonces[0] == nonces[1] != nonces[2]
    b.scene("a damaged HELLO, at the host's port and at others; one that is too long")
    b.boot()
    b.syncing = False
    good = _core.hello(A_NONCE)
    bad = bytearray(good)
    bad[10] ^= 2
    for packet, port in ((bytes(bad), 0), (good, 0), (good, 1), (good + b"\1", 0), (good[:-1], 0)):
        b.give(packet, port)
        b.run(1, 25_000, tell=1)
    b.greet(A_NONCE)
    b.sync()
    b.hear()
    assert b.status.frames_bad == 4
    b.scene("the first frame in the offered session begins it; those of older offers do not")
    b.boot()
    b.syncing = False
    assert b.greet(A_NONCE) == "ok"
    old = b.host.copy()
    b.run(1, 30_000)
    assert b.greet(B_NONCE) == "ok"
    payload = _core.sync_encode((0, 0, EPOCH_US))
    assert old.session is not None
    b.give(old.session.seal(SYNC, payload))
    b.run(6)
    assert b.told("sent") == "0"
    b.give(b.seal(SYNC, payload))
    b.expect("UNSYNCED")
    b.scene("a HELLO at the very count of the boot", None)
    b.boot()
    b.give(_core.hello(A_NONCE))
    b.run(1, 0, tell=1)
    assert b.told("sent") == "1"
    for elapsed_us, begins in ((1_000_000, True), (1_000_001, False)):
        b.scene(f"an offer after {elapsed_us} us: {begins}")
        b.boot()
        b.syncing = False
        assert b.greet(A_NONCE) == "ok"
        for _ in range(9):
            b.run(1, 100_000)
        b.run(1, elapsed_us - 900_000)
        b.give(b.seal(SYNC, payload))
        b.run(1, 1)
        b.run(5)
        assert (b.told("sent") != "0") == begins
    b.scene("a session that begins without stamps: all samples since the boot are told", None)
    b.boot()
    b.syncing = False
    b.go(70)
    assert b.greet(A_NONCE) == "ok"
    b.give(b.seal(COMMAND, b.command("FAULTS")))
    b.hear()
    assert len(b.status.samples) > 16
    b.scene("offers of 2^31 us and more ago have lapsed all the same")
    b.boot()
    b.syncing = False
    assert b.greet(A_NONCE) == "ok"
    for _ in range(3):
        b.run(1, 1_500_000_000)
    b.give(b.seal(SYNC, payload))
    b.run(6)
    assert b.told("sent") == "0"


def replaced(b: Bench) -> None:
    for slot, state in ((UNSYNCED, "UNSYNCED"), (IDLE, "UNSYNCED"), (HOLDING, "HOLD")):
        b.scene(f"another host finds it at rest: {state}", slot)
        b.syncing = False
        b.go(20)
        assert b.greet(C_NONCE) == "ok"
        b.sync(-50_000)  # its time is another one
        b.run(3, tell=1)
        b.expect(state)
        s = b.status
        assert (s.epoch, s.command_number, s.command_result) == (0, 0, 0)
        assert (s.plan_seen, s.plan_accepted, s.accepted_mask, s.grouped) == (0, 0, 0, False)
        assert b.order("FAULTS") == "DONE"
        b.go(50)
    for slot in (ARMED, STANDING):
        b.scene("another host finds it under way, and is not heard", slot)
        mine = b.host.copy()
        assert b.greet(C_NONCE) == "ok"
        b.sync()
        b.host = mine
        b.host.now_us += PERIOD_US
        b.host.count_us = (b.host.count_us + PERIOD_US) % (1 << 32)
        bad = b.status.frames_bad
        b.hear()
        assert b.status.frames_bad == bad + 1


def _contradict(b: Bench) -> None:
    """Its host says for long that the time is half a second later."""
    b.syncing = False
    for i in range(70):
        b.sync(500_000)
        b.run(1)
        if i % 10 == 9:
            b.hear()


def settled(b: Bench) -> None:
    b.scene("stamps: the first ones set the clock, a second of them settles it", UNSYNCED)
    b.settle()
    assert b.status.synced and abs(b.device_us - EPOCH_US - b.host.now_us) < 2000
    b.hear()
    b.keep(IDLE)
    b.scene("no stamps for longer than sync_lost_us: UNSYNCED", IDLE)
    b.syncing = False
    b.sync()
    b.go(90)
    b.expect("IDLE")
    b.go(12)
    b.expect("UNSYNCED")
    b.sync(300)
    b.go(10)
    b.scene("the clock steps while it may, and forgets its samples", UNSYNCED)
    b.sync()
    b.run(7)
    b.sync(20_000)
    b.run(3)
    b.run(5)
    b.scene("all that its only source says contradicts it: it begins anew", IDLE)
    _contradict(b)
    b.expect("UNSYNCED")
    assert b.status.stamps_excluded == 16, b.status.stamps_excluded
    b.go(60)


def contradicted(b: Bench) -> None:
    for offset_us in (9, 14, 20):
        b.scene("out of UNSYNCED a clock is steered, and does not step", IDLE)
        b.syncing = False
        b.sync()
        b.go(85)
        b.sync(offset_us)
        b.go(9)
        b.hear()
    b.scene("contradicted before it has settled: it begins anew, from what is said then", UNSYNCED)
    b.syncing = False
    for i in range(24):
        b.sync(500_000 if i > 3 else 0)
        b.run(2, tell=1)
    b.hear()
    assert b.status.stamps_excluded == 16
    assert abs(b.device_us - EPOCH_US - b.host.now_us - 500_000) < 2000
    b.scene("stamps that contradict it while it is armed: it goes by what it knows", ARMED)
    _contradict(b)
    assert b.status.stamps_excluded >= 64
    b.until("TAIL" if b.state == "ARMED" else b.state)


def junk(b: Bench) -> None:
    b.scene("junk of all kinds, counted; a good frame behind twelve waits for the next poll", IDLE)
    before = b.status.frames_bad
    good = b.seal(SYNC, _core.sync_encode(b.stamps()))
    body = bytearray(_core.cobs_decode(good) or b"")

    def changed(at: int, value: int) -> bytes:
        frame = bytes([*body[:at], value, *body[at + 1 :]])
        return _core.cobs_encode(frame)

    kinds = [
        b"\1", b"\1" * 12, b"\2" + b"\1" * 40, b"\5\1\1" + bytes([200] * 60), good[:12], good[:13],
        good[:21], good[:22], changed(0, 2), changed(2, body[2] ^ 1), changed(5, body[5] ^ 255),
        changed(1, 6), changed(len(body) - 1, body[-1] ^ 1), changed(20, body[20] ^ 1),
        changed(1, 3), good[:-1], good + b"\1\1\1", bytes([255] * 30), b"\3\1\1\1" * 9,
    ]  # fmt: skip
    for packet in kinds:
        b.give(packet)
        b.run(1, 250)
    b.run(1)
    b.hear()
    assert b.status.frames_bad == before + len(kinds)
    b.give(good)
    b.run(1)
    b.give(good)  # again
    b.hear()
    assert b.status.frames_bad == before + len(kinds) + 1
    for _ in range(12):
        b.give(bytes([77] * 25))
    b.give(b.seal(COMMAND, b.command("JOG", 1)))
    b.give(b.seal(COMMAND, b.command("ZERO", 1)))
    b.run(1, 1)
    b.run(1, 1)
    b.hear()
    assert b.status.frames_bad == before + len(kinds) + 13
    assert b.status.command_number == b.host.commands
    b.scene("frames of every type that are authentic, and no payload of it", IDLE)
    before = b.status.frames_bad
    for kind in range(16):
        for payload in (b"", b"\0" * 5, b"\xff" * 60):
            if kind == _core.FRAME_SETTINGS and not payload:
                continue
            b.give(b.seal(kind, payload))
            b.run(1, 500)
        b.hear()
    assert b.status.frames_bad >= before + 40
    b.scene("frames in any order: those that were overtaken are taken once", IDLE)
    first, second, third = (b.seal(SYNC, _core.sync_encode(b.stamps())) for _ in range(3))
    for packet in (third, first, first, second):
        b.give(packet, ago_us=30)
        b.run(1)
    b.hear()


def groups(b: Bench) -> None:
    group = _core.Session(bytes(16), bytes(range(16)), 0x12345678)
    key = bytes(range(30, 46))
    for slot, goes in ((IDLE, "IDLE"), (STANDING, "TAIL"), (MOVING, "TAIL")):
        b.scene(f"a group: SYNC and STOP, and nothing else; {goes}", slot)
        group = _core.Session(key, key, 0x12345678)
        b.give(group.seal(SYNC, _core.sync_encode(b.stamps())))  # which it has not joined
        b.run(1)
        assert b.host.session is not None
        b.give(b.host.session.seal_group(group))
        b.hear()
        assert b.status.grouped
        bad = b.status.frames_bad
        b.give(group.seal(SYNC, _core.sync_encode(b.stamps())))
        b.run(1)
        b.give(group.seal(SYNC, b"\0"))
        b.give(group.seal(COMMAND, b"\0"))
        b.give(group.seal(COMMAND, b.command("FAULTS")))
        b.give(group.seal(PLAN, b.command("STOP")))
        b.give(group.seal(PLAN, _core.sync_encode(b.stamps())))
        b.give(group.seal(_core.FRAME_FAULTS, b.command("STOP")))
        for kind in ("ARM", "DISARM", "RESUME"):
            b.give(group.seal(COMMAND, b.command(kind)))
        for _ in range(9):
            b.run(1, 250)
        b.hear()
        assert b.status.frames_bad == bad + 9
        number = b.status.command_number
        b.give(group.seal(COMMAND, b.command("STOP", number=1)))
        b.run(1, 250)
        b.hear()
        assert (b.state, b.status.command_number) == (goes, number) or b.state == "HOLD"
        b.go(20)
    b.scene("a group with the session's own number is refused", IDLE)
    assert b.host.session is not None
    twin = _core.Session(key, key, b.host.session.number)
    b.give(b.host.session.seal_group(twin))
    b.hear()
    assert not b.status.grouped


def statuses(b: Bench) -> None:
    for dither_us in (0, 1, 2, 3000):
        b.scene(f"statuses: at each knot, one in four up to {dither_us} us later", UNSYNCED)
        made = settings()
        made.dither_us = dither_us
        b.adjust(made)
        b.sync()
        for _ in range(12):
            b.run(15, 300, tell=4)
        b.run(1, 50)
        for _ in range(24):
            b.report(170)
            b.run(1, 80)

    b.scene("a servo period begins when it is due, not before", IDLE)
    b.hear()
    for _ in range(5):
        b.run(1, 999)
        b.run(1, 1)
    b.hear()


def marks(b: Bench) -> None:
    b.scene("marks on a bus: dated by what is known, and taken from the host", UNSYNCED)
    b.set(frame_number=31, frame_age_us=100)
    b.run(2)
    b.set(frame_number=32, frame_age_us=300)
    b.run(1)
    b.hear()
    assert b.status.mark[1] == _core.MARK_OPEN
    b.settle()
    for start in (64, 65, 96):
        b.set(frame_number=start, frame_age_us=150)
        b.run(2)
        b.hear()
        number, width_us, least_us = b.status.mark
        assert width_us != _core.MARK_OPEN
        b.sync(mark=(number, width_us, least_us))
        b.run(2)
        b.sync(mark=(number, min(width_us, 40), least_us + 200))
        b.run(3)
        b.hear()
        b.sync(mark=(number + 32, 10, least_us))
        b.sync(mark=(number, _core.MARK_OPEN, least_us))
        b.run(3)
    b.sync(mark=(96, 5, least_us + 10_000_000))  # which cannot be
    excluded = b.status.stamps_excluded
    b.go(8)
    b.hear()
    assert b.status.stamps_excluded == excluded + 1


def neighbours(b: Bench) -> None:
    for random in (0x10, 0x11):
        b.scene("boards among themselves: each is known by what it has drawn, made odd", None)
        made = settings()
        made.neighbours, made.ask_us, made.sync.among_boards = 0b10, 60_000, True
        b.boot(made, random=random)
        b.run(1)
        b.give(_core.cobs_encode(request(PEER_KEY, 999)), 1)
        b.run(2, tell=2)
    for among in (False, True):
        b.scene(f"boards at two ports, {'among themselves' if among else 'beside a host'}")
        made = settings()
        made.neighbours, made.ask_us, made.peer_least_us, made.dither_us = 0b10100, 60_000, 20, 900
        made.sync.among_boards, made.sync_lost_us = among, 1_000_000
        b.boot(made, random=0xFEDCBA9876543210)
        b.syncing = False
        b.give(_core.cobs_encode(request(PEER_KEY, 999)), 2)
        for _ in range(4):
            b.run(1, tell=3)
        assert b.greet(A_NONCE) == "ok"
        b.give(_core.cobs_encode(request(PEER_KEY, 998)), 2)
        b.run(1, 50)
        b.syncing = True
        b.sync()
        b.run(1, 50)
        b.run(1, 900, tell=4)  # a step: what was asked before it has no answer
        b.run(8, 300, tell=4)
        for port in range(5):
            b.give(_core.cobs_encode(request(PEER_KEY, 1000 + port)), port, ago_us=40)
            b.give(_core.cobs_encode(request(PEER_KEY, 1000 + port)) + b"\1", port)
            b.run(3, 500, tell=4)
        b.give(_core.cobs_encode(request(bytes(16), 5)), 2)
        b.run(2, tell=2)
        for _ in range(36):
            b.run(40, tell=3)
            for port, packet in b.packets:
                frame = _core.cobs_decode(packet) or b""
                if port and frame[1] == _core.FRAME_WELCOME + 3:
                    nonce = int.from_bytes(frame[2:10], "little")
                    at_us = EPOCH_US + b.host.now_us - 200 + 77_000 * among
                    said = response(PEER_KEY, nonce, at_us - 500, at_us, -900, 800, 4321, 1)
                    b.give(_core.cobs_encode(said), port, ago_us=60)
        b.hear()
        assert among or b.state == "IDLE"
        b.give(_core.cobs_encode(request(PEER_KEY, 77)), 4)
        b.run(3, tell=3)
        assert b.status.frames_bad >= 5
        if among:
            continue
        b.syncing = False  # the host contradicts what a neighbour, too, has said
        b.hear()
        excluded = b.status.stamps_excluded
        for _ in range(63):
            b.sync(500_000)
            b.run(1)
        b.expect("IDLE")
        assert b.status.stamps_excluded == excluded + 63
        b.sync(500_000)
        b.run(2)
        b.expect("UNSYNCED")
        b.sync(500_000)
        b.run(9)


def told(b: Bench) -> None:
    b.scene("settings: told on demand, taken at rest, and no other ones", IDLE)
    made = b.told_settings()
    assert made.encode() == settings().encode() and made.key != KEY
    other = settings()
    other.name, other.offset_count, other.sample_every = "another", -700, 1
    b.adjust(other)
    b.go(9)
    b.hear()
    assert b.status.samples[-1][1] == 321 - 700
    bad = settings()
    bad.knot_shift = 16
    assert b.told_settings(bad.encode()).encode() == other.encode()
    assert b.told_settings(b"\2" + settings().encode()[1:-1]).encode() == other.encode()
    b.orders("SAVE", "DONE", "IDLE")
    b.set(kept=20)
    b.orders("SAVE", "FAILED", "IDLE")
    b.set(kept=512, flipped=9)
    b.orders("SAVE", "FAILED", "IDLE")
    b.ask("device-boot", count_us=77)
    b.host.count_us = 77
    assert b.greet(B_NONCE) == "ok"
    assert b.told_settings().encode() == other.encode()
    for slot in (ARMED, STANDING, HOLDING):
        b.scene("settings are not taken under power", slot)
        assert b.told_settings(other.encode()).encode() == settings().encode()
        b.orders("SAVE", "NOT_NOW", b.state)
    b.scene("settings are not taken in a stop", IDLE)
    b.set(line_open=1)
    b.go(9)
    assert b.told_settings(other.encode()).encode() == settings().encode()
    b.scene("settings in UNSYNCED, and just after DISARM, while the brake engages", UNSYNCED)
    b.adjust(other)
    b.scene("the same", ARMED)
    b.give(b.seal(COMMAND, b.command("DISARM")))
    b.give(b.seal(_core.FRAME_SETTINGS, other.encode()))
    b.run(1, 100)
    b.run(1, 100)
    b.go(6)
    assert b.told_settings().encode() == settings().encode()
    b.adjust(other)


SCENES = (boots, hellos, settled)
LATER = (contradicted, replaced, junk, groups, statuses, marks, neighbours, told)
