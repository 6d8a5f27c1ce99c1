"""Sessions of a whole device: who is let in, when, and what a group may do."""

import zlib
from collections.abc import Callable

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st
from rig import sync_settings

from headway.devices.session import Session, draw_group
from headway.firmware import _core
from headway.sim import _board

KEY = bytes(range(100, 116))
EPOCH_US = 1_700_000_000_000_123
POLL_US, SYNC_US, SHIFT = 250, 4000, 12
STATE = {name: number for number, name in enumerate(_core.STATES)}
COMMAND = {name: number for number, name in enumerate(_core.COMMANDS)}


def device_settings(key: bytes = KEY) -> _core.DeviceSettings:
    servo = _core.ServoSettings()
    servo.kp_tq = _core.Scale(1, 2)
    servo.resistance_mV = _core.Scale(1, 10)
    servo.supply_duty = _core.Scale(1, 0)
    servo.torque_limit_tq = 1 << 24
    made = _core.DeviceSettings()
    made.name, made.key, made.servo = "shoulder", key, servo
    made.knot_shift, made.servo_period_us, made.sample_every = SHIFT, 1000, 1
    made.brake_periods, made.stop_us, made.sync_lost_us = 15, 300_000, 1_000_000
    made.torque_step_tq, made.knot_periods = 1000, _core.Scale(4, 0)
    made.set_limits(0, _core.GateLimits(-(1 << 28), 1 << 28, 1 << 20, 1 << 18))
    made.set_limits(1, _core.GateLimits(-(1 << 20), 1 << 20, 1 << 21, 1 << 22))
    made.set_gap_policy(1, _core.GAP_POLICIES.index("hold"))
    monitor = made.monitor
    monitor.following_pq = monitor.speed_pq = monitor.stuck_pq = 1 << 20
    monitor.following_periods, monitor.deceleration_q16 = 100, 1 << 16
    monitor.torque_periods = monitor.stuck_periods = 1000
    monitor.load_q8, monitor.overload, monitor.rise_q16 = _core.Scale(1, 16), 1 << 30, 1 << 18
    monitor.spike_counts, monitor.supply_max_mV, monitor.chopper_mV = 1000, 60_000, 50_000
    monitor.late_us = 10_000
    made.sync = sync_settings()
    home = made.home
    home.speed_q16, home.acceleration_q16, home.way_counts = 1 << 16, 1 << 10, 1000
    assert made.valid
    return made


class Rig:
    """A node and a host; packets arrive at once, true time runs in polls of 250 us."""

    def __init__(self, seed: int = 1) -> None:
        self.rng = np.random.default_rng(seed)
        self.node = _board.Node(np.zeros(_board.NODE_NUMBERS))
        self.node.random = int(self.rng.integers(2**63))
        self.node.supply_V = 24.0
        self.node.flash(device_settings(), 12_345)
        self.host = Session(KEY, self.rng)
        self.now = self.numbers = 0
        self.stamps = (0, 0)
        self.heard: list[bytes] = []  # of the last poll
        self.frames: list[tuple[int, bytes]] = []  # of the host's session
        self.status: _core.Status | None = None

    @property
    def host_us(self) -> int:
        return EPOCH_US + self.now

    @property
    def state(self) -> str:
        return _core.STATES[self.node.state]

    def poll(self) -> None:
        self.now += POLL_US
        self.node.poll(self.now, 0)
        self.heard = [packet for _, packet in self.node.collect()]
        for packet in self.heard:
            opened = self.host.open(packet)
            if not isinstance(opened, tuple):
                continue
            self.frames.append(opened)
            if opened[0] == _core.FRAME_STATUS:
                self.status = _core.status_decode(opened[1])
                assert self.status
                self.stamps = (self.status.sent_count_us, self.host_us)

    def give(self, packet: bytes) -> list[bytes]:
        """Delivers a packet; what the device sent in the next poll."""
        assert self.node.deliver(self.now, packet)
        self.poll()
        return self.heard

    def sync_packet(self, host: Session | _core.Session | None = None) -> bytes:
        payload = _core.sync_encode((*self.stamps, self.host_us))
        return (host or self.host).seal(_core.FRAME_SYNC, payload)

    def run(self, us: int, host: Session | None = None) -> None:
        """Stamps all the while."""
        for _ in range(us // POLL_US):
            if self.now % SYNC_US == 0:
                self.node.deliver(self.now, self.sync_packet(host))
            self.poll()

    def rest(self, us: int) -> None:
        """Nothing is said."""
        for _ in range(us // POLL_US):
            self.poll()

    def greet(self, host: Session) -> str:
        """HELLO and the answer to it, once the device's pause is over; the host's verdict."""
        self.rest(_core.OFFER_PAUSE_US)
        return max(map(host.welcome, self.give(host.hello())), default="no answer")

    def begin(self) -> "Rig":
        """Into IDLE, in a session."""
        assert self.greet(self.host) == "ok"
        while self.state != "IDLE":
            assert self.now < 4_000_000
            self.run(SYNC_US)
        return self

    def ask(self, command: str, argument: int = 0, epoch: int = 1) -> str:
        self.numbers += 1
        payload = _core.command_encode(self.numbers, COMMAND[command], argument, epoch)
        self.give(self.host.seal(_core.FRAME_COMMAND, payload))
        status = self.node.status
        assert status.command_number == self.numbers
        return _core.COMMAND_RESULTS[status.command_result]

    def plan_packet(self, number: int, position_pq: int = 0) -> bytes:
        """One that stands still."""
        knot = self.node.system_us(self.now) >> SHIFT
        if self.state == "ARMED":
            knot += _core.LIVE_KNOTS + 1
        points = np.zeros(60, dtype=np.int32)
        stamps = (0, 0, self.host_us)
        payload = _core.plan_encode(stamps, number, 1, knot, {0: points + position_pq, 1: points})
        return self.host.seal(_core.FRAME_PLAN, payload)

    def plan(self, number: int) -> None:
        before = self.node.status.plans_accepted
        self.give(self.plan_packet(number))
        refusal = _core.GATE_RESULTS[self.node.status.refusal]
        assert self.node.status.plans_accepted == before + 1, (self.state, refusal)

    def into(self, state: str) -> "Rig":
        """Into a state, in a session."""
        self.begin()
        if state in ("ARMED", "RUNNING", "COAST", "HOLD", "TAIL"):
            assert self.ask("ARM") == "DONE"
        if state in ("RUNNING", "COAST", "HOLD"):
            self.plan(1)
        if state in ("COAST", "HOLD"):
            while self.state != state:
                self.run(POLL_US)
        if state == "TAIL":
            assert self.ask("STOP") == "DONE"
        assert self.state == state
        return self


def another(seed: int = 99) -> Session:
    return Session(KEY, np.random.default_rng(seed))


def hello_of(nonce: int) -> bytes:
    return _core.hello(nonce.to_bytes(16, "little"))


# ---- beginning


def test_a_booted_device_answers_nothing_but_hello() -> None:
    rig = Rig()
    stranger = _core.Session(KEY, KEY, 0)
    nothing = _core.Session(bytes(16), bytes(16), 0)
    for session in (stranger, nothing):
        for kind in range(256):
            assert rig.give(session.seal(kind, bytes(30))) == []
    rig.rest(100_000)
    assert rig.heard == []
    assert rig.node.session is None
    assert rig.greet(rig.host) == "ok"
    assert rig.node.session is None  # the host has not proved itself
    assert rig.host.welcomed and not rig.host.established
    rig.run(20_000)
    assert rig.node.session is not None
    assert rig.host.established


def test_from_hello_to_idle() -> None:
    rig = Rig().begin()
    assert abs(rig.node.system_us(rig.now) - rig.host_us) < 100
    assert rig.status and rig.status.frames_bad == 0


def test_wrong_key_and_line_noise_are_told_apart() -> None:
    rig = Rig()
    assert rig.greet(Session(bytes(16), np.random.default_rng(2))) == "wrong key"
    rig.rest(_core.OFFER_PAUSE_US)
    (packet,) = rig.give(rig.host.hello())
    frame = bytearray(cobs.decode(packet))
    frame[20] ^= 4
    assert rig.host.welcome(cobs.encode(bytes(frame))) == "line noise"
    assert rig.greet(rig.host) == "ok"


def test_a_hello_of_another_version_is_answered_in_ours() -> None:
    """So that a host of that version can say what is wrong."""
    rig = Rig()
    body = bytearray(cobs.decode(rig.host.hello())[:-4])
    body[0] = 2
    (packet,) = rig.give(cobs.encode(bytes(body) + zlib.crc32(body).to_bytes(4, "little")))
    assert cobs.decode(packet)[:2] == bytes([1, _core.FRAME_WELCOME])


@pytest.mark.parametrize("bit", range(0, 8 * 46))
def test_a_damaged_hello_is_not_answered(bit: int) -> None:
    rig = Rig()
    frame = bytearray(cobs.decode(rig.host.hello()))
    frame[bit // 8] ^= 1 << bit % 8
    assert rig.give(cobs.encode(bytes(frame))) == []
    assert rig.node.status.frames_bad == 1


@settings(max_examples=300)
@given(st.data())
def test_no_damage_leads_to_a_session_of_other_keys(data: st.DataObject) -> None:
    """Any bits of the three packets; if there is a session in the end, both ends have its keys."""
    rig = Rig()

    def carry(packet: bytes, name: str) -> bytes:
        damaged = bytearray(packet)
        for bit in data.draw(st.lists(st.integers(0, 8 * len(packet) - 1), max_size=4), name):
            damaged[bit // 8] ^= 1 << bit % 8
        return bytes(damaged)

    for packet in rig.give(carry(rig.host.hello(), "HELLO")):
        rig.host.welcome(carry(packet, "WELCOME"))
    if rig.host.welcomed:
        rig.give(carry(rig.sync_packet(), "SYNC"))
    if rig.node.session is not None:
        rig.run(10_000)
        assert rig.host.established
        assert rig.node.status.plan_seen == 0


def test_sessions_in_a_row_have_other_keys_and_numbers() -> None:
    """Even for a host that says the same nonce for ever."""
    rig = Rig()
    seen: set[bytes | int] = set()
    for boot in range(1, 6):
        assert rig.node.boots == boot
        for number in range(1, 6):
            rig.rest(_core.OFFER_PAUSE_US)
            (packet,) = rig.give(hello_of(5))
            frame = cobs.decode(packet)
            assert frame[18:26] == boot.to_bytes(4, "little") + number.to_bytes(4, "little")
            _, _, session = _core.welcome_open(KEY, (5).to_bytes(16, "little"), packet)
            assert session is not None
            seen |= {session.number, session.send_key, session.receive_key}
            rig.give(session.seal(_core.FRAME_SYNC, _core.sync_encode((0, 0, rig.host_us))))
            assert rig.node.session == session.number
        rig.node.restart()
        assert rig.node.session is None
    assert len(seen) == 5 * 5 * 3


def test_the_same_boot_with_a_broken_oscillator() -> None:
    """The ring oscillator may say the same for ever: the nonces still differ."""
    rig = Rig()
    seen = set()
    for nonce in range(20):
        rig.node.random = 0
        rig.rest(_core.OFFER_PAUSE_US)
        (packet,) = rig.give(hello_of(nonce))
        seen.add(cobs.decode(packet)[18:26])
    assert len(seen) == 20


def test_a_repeated_hello_gets_the_same_welcome() -> None:
    """So a host can say it until it is heard, while answers are under way."""
    rig = Rig()
    assert rig.greet(rig.host) == "ok"
    (first,) = rig.give(hello_of(1)) or [b""]  # too early: the pause
    assert first == b""
    rig.rest(_core.OFFER_PAUSE_US)
    (second,) = rig.give(rig.host.hello())
    assert rig.host.welcome(second) == "ok"
    rig.run(10_000)
    assert rig.host.established


def test_an_offer_lapses() -> None:
    rig = Rig()
    assert rig.greet(rig.host) == "ok"
    rig.rest(_core.OFFER_VALID_US + 2000)
    rig.give(rig.sync_packet())
    assert rig.node.session is None
    assert rig.greet(rig.host) == "ok"  # the same HELLO, a new offer
    rig.give(rig.sync_packet())
    assert rig.node.session is not None


# ---- floods and forgeries


def test_a_flood_of_hellos_while_running() -> None:
    """Neither the plan nor the statuses suffer, and few session numbers are used."""
    rig = Rig().into("RUNNING")
    session, plans = rig.node.session, 1
    statuses = len(rig.frames)
    welcomes = 0
    start_us = rig.now
    flood = 0
    while rig.now < start_us + 400_000:
        for _ in range(8):
            flood += 1
            rig.node.deliver(rig.now, hello_of(flood))
        if rig.now % SYNC_US == 0:
            plans += 1
            rig.plan(plans)
        else:
            rig.poll()
        welcomes += sum(cobs.decode(p)[1] == _core.FRAME_WELCOME for p in rig.heard)
        assert rig.state == "RUNNING"
        assert rig.node.session == session
    assert flood > 10_000
    assert welcomes <= 400_000 // _core.OFFER_PAUSE_US + 1
    assert len(rig.frames) - statuses >= 400_000 // 4096 - 1
    assert rig.node.dropped == 0
    assert rig.node.status.frames_bad == 0


def test_hellos_of_one_boot_do_not_run_out() -> None:
    assert 2**32 * _core.OFFER_PAUSE_US * 1e-6 > 2 * 365 * 24 * 3600


def test_a_reflected_packet_is_nothing() -> None:
    rig = Rig()
    rig.rest(_core.OFFER_PAUSE_US)
    (packet,) = rig.give(rig.host.hello())
    assert rig.give(packet) == []
    assert rig.host.welcome(rig.host.hello()) == "another frame"
    assert rig.host.welcome(packet) == "ok"
    rig.run(50_000)
    sealed = rig.sync_packet()
    assert rig.host.open(sealed) != (_core.FRAME_SYNC, b"")
    assert isinstance(rig.host.open(sealed), str)
    bad = rig.node.status.frames_bad
    while not rig.heard:
        rig.poll()
    rig.give(rig.heard[0])
    assert rig.node.status.frames_bad == bad + 1


def test_a_replayed_hello_of_an_earlier_session() -> None:
    rig = Rig()
    old = rig.host.hello()
    rig.begin()
    session = rig.node.session
    rig.rest(_core.OFFER_PAUSE_US)
    assert rig.give(old) != []  # a WELCOME that nobody asked for
    assert rig.host.welcome(rig.heard[0]) == "stale"
    rig.run(50_000)
    assert rig.node.session == session
    assert rig.state == "IDLE"


def test_recorded_frames_of_an_earlier_session() -> None:
    """They open nothing in the next one, of the same boot or of another one."""
    rig = Rig().begin()
    recorded = [rig.sync_packet() for _ in range(5)]
    for restart in (False, True):
        if restart:
            rig.node.restart()
        rig.host.renew()
        assert rig.greet(rig.host) == "ok"
        rig.run(20_000)
        bad = rig.node.status.frames_bad
        for packet in recorded:
            rig.give(packet)
        assert rig.node.status.frames_bad == bad + 5


# ---- taking over


@pytest.mark.parametrize("state", ["IDLE", "HOLD"])
def test_a_restarted_host_takes_over_at_rest(state: str) -> None:
    rig = Rig().into(state)
    old, rig.host = rig.host, another()
    before = rig.node.session
    assert rig.greet(rig.host) == "ok"
    assert rig.node.session == before
    rig.run(20_000)
    assert rig.node.session not in (before, None)
    assert rig.host.established
    assert rig.state == ("HOLD" if state == "HOLD" else "UNSYNCED")
    bad = rig.node.status.frames_bad
    rig.give(rig.sync_packet(old))
    assert rig.node.status.frames_bad == bad + 1
    rig.numbers = 0  # it counts from the start
    if state == "HOLD":
        assert rig.node.power
        assert rig.ask("RESUME") == "DONE"
        rig.plan(1)
        assert rig.state == "RUNNING"
    else:
        while rig.state != "IDLE":
            rig.run(SYNC_US)
        assert rig.ask("ARM") == "DONE"


@pytest.mark.parametrize("state", ["ARMED", "RUNNING", "COAST", "TAIL"])
def test_nobody_takes_over_what_may_move(state: str) -> None:
    rig = Rig().into(state)
    session, newcomer = rig.node.session, another()
    rig.node.deliver(rig.now, newcomer.hello())
    rig.poll()
    for packet in rig.heard:
        newcomer.welcome(packet)
    if not newcomer.welcomed:  # the answer to the first host was not long ago
        for packet in rig.give(newcomer.hello()):
            newcomer.welcome(packet)
    assert newcomer.welcomed
    bad = rig.node.status.frames_bad
    before = rig.state
    rig.give(rig.sync_packet(newcomer))
    stop = _core.command_encode(1, COMMAND["STOP"])
    rig.give(newcomer.seal(_core.FRAME_COMMAND, stop))
    assert rig.node.session == session
    assert rig.node.status.frames_bad == bad + 2
    assert before == state


def test_takes_over_once_it_rests() -> None:
    """The newcomer goes on asking, from RUNNING through COAST to HOLD."""
    rig = Rig().into("RUNNING")
    session, newcomer, rested_us = rig.node.session, another(), None
    while not newcomer.established:
        assert rig.now < 5_000_000
        if rig.now % SYNC_US == 0:
            rig.node.deliver(rig.now, newcomer.hello())
            if newcomer.welcomed:
                rig.node.deliver(rig.now, rig.sync_packet(newcomer))
        moving = rig.state in ("RUNNING", "COAST")
        rig.poll()
        if moving:
            assert rig.node.session == session
        elif rested_us is None:
            rested_us = rig.now
        for packet in rig.heard:
            newcomer.welcome(packet)
            newcomer.open(packet)
    assert rig.state == "HOLD"
    assert rested_us is not None and rig.now - rested_us < 50_000


# ---- frames out of turn


def test_a_plan_that_was_overtaken_is_no_refusal() -> None:
    rig = Rig().into("RUNNING")
    packets = [rig.plan_packet(number) for number in range(2, 6)]
    for i in (1, 0, 3, 2):
        rig.give(packets[i])
    status = rig.node.status
    assert (status.plans_accepted, status.plan_accepted, status.plan_seen) == (3, 5, 5)
    assert status.plans_refused == status.plans_late == status.frames_bad == 0
    for packet in packets:
        rig.give(packet)
    assert rig.node.status.frames_bad == 4
    assert rig.node.status.plans_accepted == 3
    rig.give(rig.plan_packet(4))  # in turn, but with an old number: a host that errs
    assert rig.node.status.plans_refused == 1


def test_a_plan_is_taken_when_the_one_that_overtook_it_was_refused() -> None:
    rig = Rig().into("RUNNING")
    good, bad = rig.plan_packet(2), rig.plan_packet(3, position_pq=5)  # live points would change
    rig.give(bad)
    rig.give(good)
    status = rig.node.status
    assert (status.plan_seen, status.plan_accepted) == (3, 2)
    assert status.plans_late == 1
    assert status.accepted_mask & 0b11 == 0b10


@pytest.mark.parametrize("grouped", [False, True])
def test_stamps_that_were_overtaken_prove_as_much_as_others(grouped: bool) -> None:
    """Whatever their delay is, it is not negative. Two devices, one of which gets them."""
    widths, excluded = [], []
    for taken in (False, True):
        rig = Rig().begin()
        group = draw_group(np.random.default_rng(5))
        rig.give(rig.host.seal_group(group))
        rig.rest(900_000)  # what is known becomes less
        sender = group if grouped else rig.host
        early = sender.seal(_core.FRAME_SYNC, _core.sync_encode((*rig.stamps, rig.host_us)))
        rig.give(sender.seal(_core.FRAME_SYNC, _core.sync_encode((0, 0, rig.host_us))))
        if taken:
            rig.give(early)
        else:
            rig.poll()
        rig.rest(10_000)
        status = rig.node.status
        assert status.frames_bad == 0
        error_ns = (rig.node.system_us(rig.now) - rig.host_us) * 1000
        assert status.least_error_ns - 1000 <= error_ns <= status.most_error_ns
        widths.append(status.most_error_ns - status.least_error_ns)
        excluded.append(status.stamps_excluded)
    assert widths[1] < widths[0] - 1000  # ns
    assert excluded == [0, 0]


def test_a_command_that_was_overtaken_is_not_obeyed() -> None:
    rig = Rig().begin()
    arm, disarm = (
        rig.host.seal(_core.FRAME_COMMAND, _core.command_encode(number, COMMAND[kind], 0, 1))
        for number, kind in ((1, "ARM"), (2, "DISARM"))
    )
    rig.give(disarm)
    rig.give(arm)
    assert rig.state == "IDLE"
    assert not rig.node.power


# ---- the group


def grouped(rig: Rig, group: _core.Session) -> None:
    rig.give(rig.host.seal_group(group))
    rig.run(10_000)
    assert rig.status and rig.status.grouped


def test_one_packet_stops_all() -> None:
    rigs = [Rig(seed).into("RUNNING") for seed in range(3)]
    group = draw_group(np.random.default_rng(5))
    for number, rig in enumerate(rigs):
        assert rig.status and not rig.status.grouped
        rig.give(rig.host.seal_group(group))
        assert rig.node.status.frames_bad == 0, number
    packet = group.seal(_core.FRAME_COMMAND, _core.command_encode(0, COMMAND["STOP"]))
    for rig in rigs:
        assert rig.state == "RUNNING"
        rig.give(packet)
        assert rig.state == "TAIL"
        assert _core.REASONS[rig.node.status.fault.reason] == "HOST"
        assert rig.node.status.command_number == rig.numbers  # its own count goes on


def every_payload(rig: Rig) -> list[tuple[int, bytes]]:
    """One good payload of each kind of frame, and of each command."""
    points = np.zeros(30, dtype=np.int32)
    knot = rig.node.system_us(rig.now) >> SHIFT
    plan = _core.plan_encode((0, 0, rig.host_us), 50, 1, knot, {0: points, 1: points})
    commands = [
        (_core.FRAME_COMMAND, _core.command_encode(1000, kind, 0, 1))
        for kind in range(len(_core.COMMANDS))
    ]
    return [
        *commands,
        (_core.FRAME_SYNC, _core.sync_encode((0, 0, rig.host_us))),
        (_core.FRAME_PLAN, plan),
        (_core.FRAME_SETTINGS, device_settings().encode()),
        (_core.FRAME_SETTINGS, b""),
        (_core.FRAME_GROUP, bytes(26)),
        (_core.FRAME_STATUS, b""),
        (_core.FRAME_HELLO, b""),
        (_core.FRAME_WELCOME, b""),
    ]


@pytest.mark.parametrize("state", ["IDLE", "ARMED", "RUNNING", "HOLD"])
def test_a_group_may_sync_and_stop_and_nothing_else(state: str) -> None:
    rig = Rig().into(state)
    group = draw_group(np.random.default_rng(5))
    rig.give(rig.host.seal_group(group))
    taken = []
    for kind, payload in every_payload(rig):
        stops = kind == _core.FRAME_COMMAND and payload[4] == COMMAND["STOP"]
        if stops:
            continue
        before, bad = rig.node.status, rig.node.status.frames_bad
        packets = rig.give(group.seal(kind, payload))
        assert all(cobs.decode(p)[1] == _core.FRAME_STATUS for p in packets)
        assert rig.state == state
        after = rig.node.status
        assert after.command_number == before.command_number
        assert after.plans_accepted == before.plans_accepted
        assert after.plan_seen == before.plan_seen
        if after.frames_bad == bad:
            taken.append(kind)
    assert taken == [_core.FRAME_SYNC]


def test_a_group_has_a_window_of_its_own() -> None:
    rig = Rig().begin()
    group = draw_group(np.random.default_rng(5))
    early = [rig.sync_packet(group) for _ in range(100)]
    grouped(rig, group)
    late = [rig.sync_packet(group) for _ in range(100)]
    bad = rig.node.status.frames_bad
    for packet in (early[99], early[50]):  # from before the device had the group's key
        rig.give(packet)
    assert rig.node.status.frames_bad == bad + 2
    for packet in (late[99], late[40], late[99], late[40], late[35]):
        rig.give(packet)
    assert rig.node.status.frames_bad == bad + 5  # two replayed, one behind the window
    rig.give(rig.sync_packet())
    assert rig.node.status.frames_bad == bad + 5


def test_the_group_ends_with_the_session() -> None:
    rig = Rig().begin()
    group = draw_group(np.random.default_rng(5))
    grouped(rig, group)
    rig.host.renew()
    assert rig.greet(rig.host) == "ok"
    rig.run(20_000)
    assert rig.status and not rig.status.grouped
    bad = rig.node.status.frames_bad
    rig.give(rig.sync_packet(group))
    assert rig.node.status.frames_bad == bad + 1


def test_a_group_that_has_the_sessions_number_is_not_joined() -> None:
    rig = Rig().begin()
    assert rig.node.session is not None
    rig.give(rig.host.seal_group(_core.Session(KEY, KEY, rig.node.session)))
    rig.run(10_000)
    assert rig.status and not rig.status.grouped
    grouped(rig, draw_group(np.random.default_rng(5)))


def test_a_reflected_group_frame_is_nothing() -> None:
    """Each device has the group's one key: it may not pass for the host by sending back."""
    group = draw_group(np.random.default_rng(5))
    device = _core.Session(group.send_key, group.send_key, group.number, at_device=True)
    rig = Rig().begin()
    grouped(rig, group)
    bad = rig.node.status.frames_bad
    rig.give(rig.sync_packet(device))
    assert rig.node.status.frames_bad == bad + 1


# ---- settings over the wire


def settings_told(rig: Rig, payload: bytes) -> _core.DeviceSettings:
    """What the device answers to a SETTINGS frame."""
    rig.frames.clear()
    rig.give(rig.host.seal(_core.FRAME_SETTINGS, payload))
    (answer,) = [body for kind, body in rig.frames if kind == _core.FRAME_SETTINGS]
    told = _core.DeviceSettings.decode(answer[:-1])
    assert told is not None and answer[-1] == 1  # and the version of its firmware
    assert KEY not in answer
    return told


def other_settings() -> _core.DeviceSettings:
    other = device_settings(bytes(16))
    other.name, other.offset_count, other.servo_period_us = "elbow", 7, 500
    return other


@pytest.mark.parametrize("state", ["BOOT", "IDLE", "ARMED", "RUNNING", "TAIL", "HOLD"])
def test_settings_are_taken_where_nothing_is_powered(state: str) -> None:
    rig = Rig()
    if state == "BOOT":  # it is UNSYNCED by the time that it has a session
        assert rig.greet(rig.host) == "ok"
    else:
        rig.into(state)
    assert settings_told(rig, b"").encode() == device_settings().encode()
    told = settings_told(rig, other_settings().encode())
    taken = state in ("BOOT", "IDLE")
    assert told.encode() == (other_settings() if taken else device_settings()).encode()
    assert rig.node.settings.key == KEY
    if taken:
        while rig.state != "IDLE":
            rig.run(SYNC_US)
        assert rig.ask("ARM") == "DONE"
        rig.plan(1)
        rig.run(20_000)
        assert rig.node.status.released


@pytest.mark.parametrize("how", ["SETTINGS", "ZERO"])
def test_armed_in_the_same_instant_as_another_offset(how: str) -> None:
    """The position that it holds is already in the new counts: no kick."""
    rig = Rig().begin()
    if how == "SETTINGS":
        other = device_settings()
        other.offset_count = 50
        packets = [rig.host.seal(_core.FRAME_SETTINGS, other.encode())]
    else:
        zero = _core.command_encode(1, COMMAND["ZERO"], 50, 1)
        packets = [rig.host.seal(_core.FRAME_COMMAND, zero)]
    arm = _core.command_encode(2, COMMAND["ARM"], 0, 1)
    packets.append(rig.host.seal(_core.FRAME_COMMAND, arm))
    for packet in packets:
        rig.node.deliver(rig.now, packet)
    for _ in range(20):
        rig.poll()
        assert rig.node.torque_tq == 0
    assert rig.state == "ARMED"
    assert rig.node.setpoint(0)[0] == 50 << _core.COUNT_BITS


def invalid(change: Callable[[_core.DeviceSettings], None]) -> bytes:
    made = other_settings()
    change(made)
    assert not made.valid
    return made.encode()


def no_period(made: _core.DeviceSettings) -> None:
    made.servo_period_us = 0


def no_deceleration(made: _core.DeviceSettings) -> None:
    made.monitor.deceleration_q16 = 0


@pytest.mark.parametrize(
    "payload",
    [
        invalid(no_period),
        invalid(no_deceleration),
        other_settings().encode()[:-1],
        other_settings().encode() + b"\0",
        other_settings().encode(with_key=True),
        b"\x01" + other_settings().encode()[1:],
        b"\0",
    ],
)
def test_bad_settings_change_nothing(payload: bytes) -> None:
    rig = Rig().begin()
    assert settings_told(rig, payload).encode() == device_settings().encode()
    assert rig.state == "IDLE"


def test_settings_are_kept_only_when_saved() -> None:
    rig = Rig().begin()
    for saved in (False, True):
        settings_told(rig, other_settings().encode())
        if saved:
            assert rig.ask("SAVE") == "DONE"
        rig.node.restart()
        expected = other_settings() if saved else device_settings()
        assert rig.node.settings.encode() == expected.encode()
        assert rig.node.settings.key == KEY
        rig.numbers = 0
        rig.host.renew()
        rig.now += 10_000_000
        rig.greet(rig.host)
        rig.run(10_000)


@pytest.mark.parametrize("state", ["ARMED", "RUNNING", "COAST", "TAIL", "HOLD"])
def test_nothing_is_saved_under_power(state: str) -> None:
    rig = Rig().into(state)
    before = [rig.node.memory(_board.RECORD_SETTINGS_A + i) for i in range(2)]
    assert rig.ask("SAVE") == "NOT_NOW"
    assert [rig.node.memory(_board.RECORD_SETTINGS_A + i) for i in range(2)] == before
