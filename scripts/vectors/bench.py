"""A device on the judge's rack, and its host: each line is asked, and answered, in turn."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from line import Value, line

from headway.firmware import _core

KEY, PEER_KEY = bytes(range(100, 116)), bytes(range(50, 66))
EPOCH_US = 1_700_000_000_000_000 // 4096 * 4096
SHIFT, KNOT_US = 12, 4096
PERIOD_US = 1000
WRAP = 1 << 32
COUNT_PQ = 1 << _core.COUNT_BITS
FIRST_COUNT_US = WRAP - 700_000  # so that the counter wraps while the clock settles
POSITION, TORQUE, KP, KI, KD = range(5)
NONE, INDEX, SWITCH, STOP = range(4)  # ways to home
INTERPOLATE, RAMP, HOLD, ZERO, FAULT = range(5)  # policies
TORQUE_MAX = 1 << 20
SYNC_EVERY_US = 50_000
GUARD_LIMIT_US = 4000
SETTINGS_A, SETTINGS_B, BOOTS_A, BOOTS_B, FAULTS_A, FAULTS_B = range(6)

Tracks = dict[int, Sequence[int]]


def settings() -> _core.DeviceSettings:
    """An axis that a duty of 32768 turns by 200 counts a period, with a range of 16,000 counts each
    way; a tq is a 2^-20 of the torque limit."""
    servo = _core.ServoSettings()
    servo.kp_tq = _core.Scale(4096, 10)
    servo.ki_tq = _core.Scale(4096, 9)
    servo.kd_tq = _core.Scale(4096, 12)
    servo.velocity_tq = _core.Scale(0, 0)
    servo.resistance_mV = _core.Scale(1, 10)
    servo.emf_mV = _core.Scale(160, 16)
    servo.emf_tq = _core.Scale(0, 0)
    servo.supply_duty = _core.Scale(16, 0)
    servo.torque_limit_tq = TORQUE_MAX
    servo.ahead_us = PERIOD_US // 2
    monitor = _core.MonitorSettings()
    monitor.following_pq, monitor.following_periods = 200 * COUNT_PQ, 5
    monitor.speed_pq = 150 * COUNT_PQ
    monitor.bounded = True
    monitor.low_pq, monitor.high_pq = -17_000 * COUNT_PQ, 17_000 * COUNT_PQ
    monitor.deceleration_q16 = 2 * COUNT_PQ << 16
    monitor.torque_periods = 12
    monitor.load_q8 = _core.Scale(1, 11)
    monitor.overload, monitor.heating_q16, monitor.rise_q16 = 80, 279, 72_090
    monitor.stuck_pq, monitor.stuck_periods = 64 * COUNT_PQ, 20
    monitor.spike_counts = 500
    monitor.supply_min_mV, monitor.supply_max_mV = 16_000, 30_000
    monitor.chopper_mV, monitor.late_us = 27_000, GUARD_LIMIT_US
    home = _core.HomeSettings()
    home.speed_q16, home.acceleration_q16 = 4 * COUNT_PQ << 16, COUNT_PQ << 16
    home.torque_tq = 1 << 17
    home.way_counts, home.still_periods, home.mark_count = 400, 6, 1000
    sync = _core.SyncSettings()
    sync.drift_ppm, sync.wander_ppb_s, sync.limit_us = 200, 1000, 40_000
    sync.interval_us, sync.phase_gain, sync.skew_gain_q8 = 16_000, 4000, 10_000
    made = _core.DeviceSettings()
    made.name, made.key, made.peer_key = "axis", KEY, PEER_KEY
    made.servo, made.monitor, made.home, made.sync = servo, monitor, home, sync
    made.knot_shift, made.servo_period_us, made.sample_every = SHIFT, PERIOD_US, 4
    made.brake_periods, made.stop_us, made.sync_lost_us = 3, 20_000, 100_000
    made.torque_step_tq = 1 << 16
    made.knot_periods = _core.Scale(4194, 10)
    made.carries_gravity = True
    position = 16_000 * COUNT_PQ
    made.set_limits(
        POSITION,
        _core.GateLimits(-position, position, 400 * COUNT_PQ, 40 * COUNT_PQ, 33 * COUNT_PQ),
    )
    made.set_limits(TORQUE, _core.GateLimits(-(1 << 19), 1 << 19, 1 << 20, 1 << 21))
    for sink in (KP, KI, KD):  # points beyond a mantissa's ends, too
        made.set_limits(sink, _core.GateLimits(-(1 << 12), 1 << 25, 1 << 25, 1 << 26))
        made.set_gap_policy(sink, HOLD)
    return made


def record(generation: int, payload: bytes) -> bytes:
    """As memory has it."""
    body = generation.to_bytes(4, "little") + payload
    return body + _core.crc_of(body).to_bytes(4, "little")


def clone(session: _core.Session | None) -> _core.Session | None:
    """The same end of the same session, as far as it has come."""
    if session is None:
        return None
    copy = _core.Session(session.send_key, session.receive_key, session.number)
    copy.sent, copy.received = session.sent, session.received
    return copy


@dataclass
class Host:
    """What the host knows. `echo`: the device's count and our time of its last status."""

    now_us: int = 0  # since the device has booted
    count_us: int = FIRST_COUNT_US
    synced_us: int = 0
    echo: tuple[int, int] = (0, 0)
    nonce: bytes = bytes(16)
    session: _core.Session | None = None
    group: _core.Session | None = None
    commands: int = 0
    plans: int = 0
    epoch: int = 0
    status: _core.Status | None = None

    def copy(self) -> Host:
        return replace(self, session=clone(self.session), group=clone(self.group))


@dataclass
class Bench:
    """A judge that answers, and all lines so far."""

    judge: subprocess.Popen[str]
    host: Host = field(default_factory=Host)
    lines: list[str] = field(default_factory=list)
    kept: dict[int, Host] = field(default_factory=dict)
    syncing: bool = True
    waiting: int = 0  # packets that the device may not have taken yet
    answer: list[tuple[str, str]] = field(default_factory=list)
    opened: list[tuple[int, bytes]] = field(default_factory=list)  # of the last line
    packets: list[tuple[int, bytes]] = field(default_factory=list)  # port and bytes, of the last

    # ---- lines

    def ask(self, word: str, **values: Value) -> None:
        """Asks a line; `answer` is the judge's."""
        text = line(word, **values)
        assert self.judge.stdin and self.judge.stdout
        self.judge.stdin.write(text + "\n")
        self.judge.stdin.flush()
        said = self.judge.stdout.readline()
        if not said.startswith(text):
            raise RuntimeError(f"the judge does not answer {text[:200]}")
        self.lines.append(text)
        parts = said.rstrip("\n").partition(" ->")[2].split()
        self.answer = [(name, value) for name, _, value in (p.partition("=") for p in parts)]

    def told(self, name: str) -> str:
        """A part of the answer."""
        return dict(self.answer)[name]

    def numbers(self, name: str) -> list[int]:
        """A list of the answer."""
        found: list[int] = []
        for part in self.told(name).split(","):
            value, _, times = part.partition("*")
            found += [int(value)] * int(times or 1)
        return found

    @property
    def powered(self) -> bool:
        """The output, as the last poll has left it."""
        return self.numbers("power")[-1] == 1

    @property
    def braked(self) -> bool:
        """The brake, likewise."""
        return self.numbers("brake")[-1] == 1

    def scene(self, name: str, slot: int | None = None) -> None:
        """A new one, with the device that was kept, or with none."""
        self.lines.append(f"# {name}")
        self.syncing, self.waiting = True, 0
        if slot is None:
            self.ask("device-blank")
            self.host = Host()
        else:
            self.ask("device-recall", slot=slot)
            self.host = self.kept[slot].copy()

    def keep(self, slot: int) -> None:
        self.ask("device-keep", slot=slot)
        self.kept[slot] = self.host.copy()

    # ---- the world

    def set(self, **values: Value) -> None:
        self.ask("device-set", **values)

    def boot(
        self,
        made: _core.DeviceSettings | None = None,
        count_us: int = FIRST_COUNT_US,
        random: int = 0x0123456789ABCDEF,
    ) -> None:
        """With settings in memory, and a sensible axis."""
        made = settings() if made is None else made
        self.ask("device-record", record=SETTINGS_A, bytes=record(1, made.encode(True)))
        self.set(random=f"{random:016x}", speed_q16=200 * 65536 // PERIOD_US)
        self.ask("device-boot", count_us=count_us)
        self.host.count_us = count_us

    def _pass(self, elapsed_us: int) -> None:
        self.host.now_us += elapsed_us
        self.host.count_us = (self.host.count_us + elapsed_us) % WRAP

    def run(self, polls: int = 1, step_us: int = PERIOD_US, **more: int) -> None:
        """Polls; a SYNC before them if one is due. Takes what the line tells of packets."""
        host = self.host
        due = host.now_us - host.synced_us >= SYNC_EVERY_US
        if self.syncing and host.session is not None and due:
            self.sync()
        self._pass(polls * step_us)
        self.waiting = max(0, self.waiting - polls)
        self.ask("device-run", polls=polls, step_us=step_us, **more)
        self._take()

    def go(self, periods: int, **more: int) -> None:
        """So many servo periods, in sync."""
        while periods > 0:
            some = min(periods, 40)
            self.run(some, **more)
            periods -= some

    def report(self, step_us: int) -> None:
        self._pass(step_us)
        self.ask("device-report", step_us=step_us)
        self._take()

    def hang(self, calls: int, step_us: int = PERIOD_US) -> None:
        """The main loop does nothing, the guard runs."""
        self._pass(calls * step_us)
        self.ask("device-hang", calls=calls, step_us=step_us)

    def _take(self) -> None:
        ports = [int(value) for name, value in self.answer if name == "port"]
        told = [bytes.fromhex(value) for name, value in self.answer if name == "packet"]
        self.packets = list(zip(ports, told, strict=True))
        self.opened = []
        for port, packet in self.packets:
            session = self.host.session
            opened = session.open(packet) if session is not None and port == 0 else "none"
            if not isinstance(opened, tuple):
                continue
            self.opened.append(opened)
            if opened[0] == _core.FRAME_STATUS:
                status = _core.status_decode(opened[1])
                assert status is not None
                self.host.status = status
                age_us = (self.host.count_us - status.sent_count_us) % WRAP
                self.host.echo = (status.sent_count_us, EPOCH_US + self.host.now_us - age_us)

    # ---- the host

    def give(self, packet: bytes, port: int = 0, ago_us: int = 0) -> None:
        more: dict[str, int] = {"port": port} if port else {}
        more |= {"ago_us": ago_us} if ago_us else {}
        self.ask("device-give", packet=packet, **more)
        self.waiting += 1

    def seal(self, kind: int, payload: bytes) -> bytes:
        assert self.host.session is not None
        return self.host.session.seal(kind, payload)

    def greet(self, nonce: bytes | None = None) -> str:
        """Says hello; returns the verdict on the answer, "none" if there is none."""
        host = self.host
        host.nonce = host.nonce if nonce is None else nonce
        self.give(_core.hello(host.nonce))
        self.run(1, tell=4)
        for port, packet in self.packets:
            verdict, _, session = _core.welcome_open(KEY, host.nonce, packet)
            if session is not None and port == 0:
                host.session = session
                host.echo, host.synced_us = (0, 0), host.now_us - SYNC_EVERY_US
                host.commands = host.plans = host.epoch = 0
                host.status = None
                return verdict
        return "none"

    def stamps(self, offset_us: int = 0) -> tuple[int, int, int]:
        """With the last status echoed once; of a host whose time is so far off."""
        (count_us, received_us), self.host.echo = self.host.echo, (0, 0)
        received_us += offset_us if received_us else 0
        return count_us, received_us, EPOCH_US + self.host.now_us + offset_us

    def sync(self, offset_us: int = 0, mark: tuple[int, int, int] | None = None) -> None:
        payload = _core.sync_encode(self.stamps(offset_us), *([] if mark is None else [mark]))
        self.give(self.seal(_core.FRAME_SYNC, payload))
        self.host.synced_us = self.host.now_us

    def settle(self) -> None:
        """Until the clock has settled."""
        for _ in range(28):
            self.go(40, tell=1)
            if self.state == "IDLE":
                return
        raise AssertionError(f"did not settle: {self.state}")

    @property
    def status(self) -> _core.Status:
        assert self.host.status is not None
        return self.host.status

    @property
    def state(self) -> str:
        return _core.STATES[self.status.state]

    @property
    def reason(self) -> str:
        """Why it stopped last."""
        return _core.REASONS[self.status.fault.reason]

    @property
    def device_us(self) -> int:
        """The device's time now."""
        age_us = (self.host.count_us - self.status.sent_count_us) % WRAP
        return self.status.sent_us + age_us

    @property
    def knot(self) -> int:
        return self.device_us >> SHIFT

    def hear(self) -> None:
        """Runs to the next status, by which all that waits is taken."""
        if self.waiting > 1:
            self.run(self.waiting - 1)
        if self.host.status is None:
            self.run(6, tell=1)
            return
        before = self.status.sent_count_us
        self.run(max(1, -(-(KNOT_US - self.device_us % KNOT_US) // PERIOD_US)), tell=1)
        if self.status.sent_count_us == before:
            self.run(1, tell=1)
        assert self.status.sent_count_us != before

    def command(
        self, kind: str, argument: int = 0, epoch: int | None = None, number: int | None = None
    ) -> bytes:
        host = self.host
        if number is None:
            number = host.commands = host.commands + 1
        if epoch is None:
            host.epoch += kind in ("ARM", "RESUME")
            epoch = host.epoch
        index = _core.COMMANDS.index(kind) if kind in _core.COMMANDS else int(kind)
        return _core.command_encode(number, index, argument, epoch)

    def order(
        self, kind: str, argument: int = 0, epoch: int | None = None, number: int | None = None
    ) -> str:
        """Gives a command; returns its result as the next status tells it."""
        self.give(self.seal(_core.FRAME_COMMAND, self.command(kind, argument, epoch, number)))
        self.hear()
        return _core.COMMAND_RESULTS[self.status.command_result]

    def orders(self, kind: str, result: str, state: str, argument: int = 0, **more: int) -> None:
        """The same, with what the page says of it."""
        said = self.order(kind, argument, **more)
        assert (said, self.state) == (result, state), (kind, said, self.state, self.reason)

    def plan(
        self, first_knot: int, tracks: Tracks, number: int | None = None, epoch: int | None = None,
        ago_us: int = 0,
    ) -> bytes:  # fmt: skip
        """A packet."""
        host = self.host
        if number is None:
            number = host.plans = host.plans + 1
        points = {sink: np.array(track, dtype=np.int32) for sink, track in tracks.items()}
        stamps = self.stamps()
        stamps = (*stamps[:2], stamps[2] - ago_us)
        payload = _core.plan_encode(
            stamps, number, host.epoch if epoch is None else epoch, first_knot, points
        )
        return self.seal(_core.FRAME_PLAN, payload)

    def verdict(self, packet: bytes) -> str:
        """Gives a plan; returns the gate's result as the next status tells it."""
        before = self.status
        self.give(packet)
        self.hear()
        after = self.status
        late, refused = (getattr(after, n) - getattr(before, n)
                         for n in ("plans_late", "plans_refused"))  # fmt: skip
        if after.plans_accepted != before.plans_accepted:
            assert (after.plans_accepted - before.plans_accepted, late, refused) == (1, 0, 0)
            return "accepted"
        if late + refused == 0:
            return "none"
        said = _core.GATE_RESULTS[after.refusal]
        assert (late, refused) == ((1, 0) if said == "late" else (0, 1))
        return said

    def plans(self, result: str, first_knot: int, tracks: Tracks, **more: int) -> None:
        said = self.verdict(self.plan(first_knot, tracks, **more))
        assert said == result, (said, result, self.state)

    def told_settings(self, wanted: bytes = b"") -> _core.DeviceSettings:
        """Gives settings, or asks for them; returns the answer."""
        self.give(self.seal(_core.FRAME_SETTINGS, wanted))
        self.run(self.waiting, tell=4)
        (payload,) = [p for kind, p in self.opened if kind == _core.FRAME_SETTINGS]
        assert payload[-1] == 1  # the firmware
        made = _core.DeviceSettings.decode(payload[:-1])
        assert made is not None
        return made

    def adjust(self, made: _core.DeviceSettings) -> None:
        """Gives settings; they are told again."""
        self.give(self.seal(_core.FRAME_SETTINGS, made.encode()))
        self.run(self.waiting)
        assert self.told("sent") != "0"

    def faults(self) -> list[_core.Fault]:
        """The log, on demand."""
        self.give(self.seal(_core.FRAME_COMMAND, self.command("FAULTS")))
        self.run(self.waiting, tell=4)
        (payload,) = [p for kind, p in self.opened if kind == _core.FRAME_FAULTS]
        log = _core.faults_decode(payload)
        assert log is not None
        return log

    @property
    def reasons(self) -> list[str]:
        """The log's, on demand."""
        return [_core.REASONS[fault.reason] for fault in self.faults() if fault.reason < 21]

    def expect(self, state: str, reason: str | None = None) -> None:
        """Hears, and compares."""
        self.hear()
        self.expect_now(state, reason)

    def expect_now(self, state: str, reason: str | None = None) -> None:
        """Compares what was heard last."""
        assert self.state == state, (self.state, self.reason)
        assert reason is None or self.reason == reason, self.reason

    def until(self, state: str, periods: int = 200) -> None:
        """Until a status tells it."""
        end = self.host.now_us + periods * PERIOD_US
        while self.state != state:
            assert self.host.now_us < end, f"{self.state}, not {state}: {self.reason}"
            self.hear()


@contextmanager
def bench(judge: Path) -> Iterator[Bench]:
    """With a judge of its own."""
    command = [judge, "--answer", "/dev/stdin"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as running:
        yield Bench(running)
        assert running.stdin
        running.stdin.close()
