"""A device on a bench: node, host, wire and encoder, in polls of 250 us; for tests and the walk."""

from collections.abc import Callable
from enum import IntEnum
from pathlib import Path

import numpy as np

from headway.configs.load import load_config
from headway.configs.schema import Config
from headway.devices.axis import AxisUnits
from headway.devices.settings import device_settings as axis_settings
from headway.firmware import _core
from headway.sim import _board

KEY = bytes(range(100, 116))
SHIFT, KNOT_US = 12, 4096
POLL_US, PERIOD_US = 250, 1000
COUNT_PQ = 1 << _core.COUNT_BITS
BRAKE_PERIODS = 5
STOP_US = 300_000
SYNC_LOST_US = 400_000
SUPPLY_V = 24.0
POSITION, TORQUE, KP, KI, KD = range(5)

Points = list[int]
Plan = dict[int, Points]


class State(IntEnum):
    """The device's states by name; the firmware's own list is held against it in test_states."""

    BOOT = 0
    UNSYNCED = 1
    IDLE = 2
    ARMED = 3
    RUNNING = 4
    COAST = 5
    TAIL = 6
    HOLD = 7
    FAULT = 8
    ESTOP = 9


# DESIGN, section 4, line by line: who may leave a state, why, and where to.
POWERED = {State.ARMED, State.RUNNING, State.COAST, State.TAIL, State.HOLD}
EXITS = {
    (State.BOOT, "BOOTED"): State.UNSYNCED,  # the device
    (State.UNSYNCED, "SYNCED"): State.IDLE,  # the device, once the clock has settled
    (
        State.IDLE,
        "SYNC_LOST",
    ): State.UNSYNCED,  # above IDLE a clock never steps, so it goes back from here
    (State.IDLE, "ARM"): State.ARMED,  # host `arm`
    (State.ARMED, "PLAN"): State.RUNNING,  # host `go` with a plan
    (State.ARMED, "DISARM"): State.IDLE,
    (State.RUNNING, "OVERDUE"): State.COAST,  # no plan accepted for 5 knots
    (State.COAST, "PLAN"): State.RUNNING,  # a fresh plan
    (State.COAST, "RESTED"): State.HOLD,  # its rest
    (State.TAIL, "RESTED"): State.HOLD,
    (State.HOLD, "RESUME"): State.ARMED,  # replanned from actual: the plan comes after
    (State.HOLD, "DISARM"): State.IDLE,
    (State.FAULT, "CLEAR"): State.UNSYNCED,  # operator `clear`
    (State.ESTOP, "CLEAR"): State.UNSYNCED,
}
EXITS |= {(s, "STOP"): State.TAIL for s in POWERED - {State.TAIL}}  # a gap, a breach, the host
EXITS |= {(s, "SYNC_LOST"): State.TAIL for s in (State.ARMED, State.RUNNING)}
EXITS |= {
    (s, "FAULT"): State.FAULT for s in State if s not in (State.FAULT, State.ESTOP)
}  # any -> FAULT, latched
EXITS |= {(s, "ESTOP"): State.ESTOP for s in State if s != State.ESTOP}  # any -> ESTOP


def monitor_settings() -> _core.MonitorSettings:
    """Limits far from anything that an axis at rest does."""
    monitor = _core.MonitorSettings()
    monitor.following_pq, monitor.following_periods = 1 << 28, 20
    monitor.speed_pq = 1 << 26
    monitor.deceleration_q16 = 1 << 22  # 64 pq per period squared
    monitor.torque_periods = 1000
    monitor.load_q8 = _core.Scale(1, 16)  # the torque limit is the continuous torque
    monitor.overload, monitor.heating_q16, monitor.rise_q16 = 9000, 279, 72090
    monitor.stuck_pq, monitor.stuck_periods = 1 << 30, 1000
    monitor.spike_counts = 100_000
    monitor.supply_min_mV, monitor.supply_max_mV = 16_000, 30_000
    monitor.chopper_mV, monitor.late_us = 27_000, 4 * PERIOD_US
    return monitor


def home_settings() -> _core.HomeSettings:
    """No homing; a jog of at most 40 counts a second."""
    home = _core.HomeSettings()
    home.speed_q16, home.acceleration_q16 = 40 << 16, 1 << 16
    home.torque_tq = 1 << 20
    home.way_counts, home.still_periods = 400, 50
    return home


def sync_settings() -> _core.SyncSettings:
    """Oscillators as good as a crystal; a wire that is not known."""
    sync = _core.SyncSettings()
    sync.drift_ppm, sync.wander_ppb_s, sync.limit_us = 200, 1000, 40_000
    sync.interval_us, sync.phase_gain, sync.skew_gain_q8 = 16_000, 4000, 10_000
    return sync


def device_settings(sample_every: int = 1) -> _core.DeviceSettings:
    """A quarter of a torque quantum per pq, 1 mV per 1024 tq, a duty of one per mV."""
    servo = _core.ServoSettings()
    servo.kp_tq = _core.Scale(1, 2)
    servo.ki_tq = _core.Scale(1, 0)
    servo.resistance_mV = _core.Scale(1, 10)
    servo.supply_duty = _core.Scale(1, 0)
    servo.torque_limit_tq = 1 << 24
    servo.ahead_us = PERIOD_US // 2
    settings = _core.DeviceSettings()
    settings.key, settings.servo = KEY, servo
    settings.knot_shift, settings.servo_period_us = SHIFT, PERIOD_US
    settings.sample_every = sample_every
    settings.brake_periods, settings.stop_us = BRAKE_PERIODS, STOP_US
    settings.sync_lost_us, settings.torque_step_tq = SYNC_LOST_US, 1 << 18
    settings.knot_periods = _core.Scale(4194, 10)
    settings.carries_gravity = True
    settings.monitor, settings.home = monitor_settings(), home_settings()
    settings.sync = sync_settings()
    settings.set_limits(POSITION, _core.GateLimits(-(1 << 28), 1 << 28, 1 << 20, 1 << 18))
    settings.set_limits(TORQUE, _core.GateLimits(-(1 << 20), 1 << 20, 1 << 21, 1 << 22))
    settings.set_limits(KP, _core.GateLimits(0, 1 << 24, 1 << 24, 1 << 25))
    return settings


class Rig:
    """A node, a host and a wire of constant delay; true time runs in polls."""

    def __init__(
        self,
        epoch_us: int = 1_700_000_000_000_123,
        count_offset: int = 12_345,
        delay_us: int = 1000,
        settings: _core.DeviceSettings | None = None,
        supply_V: float = SUPPLY_V,
        poll_us: int = POLL_US,
    ) -> None:
        self.poll_us = poll_us
        self.memory = np.zeros(_board.NODE_NUMBERS)
        self.node = _board.Node(self.memory)
        self.node.supply_V = supply_V
        self.settings = settings or device_settings()
        self.node.flash(self.settings, count_offset)
        self.host = _core.Session(bytes(16), bytes(16), 0)  # until it is welcome
        self.welcomed = False
        self.epoch_us, self.delay_us = epoch_us, delay_us
        self.now = 0  # true time
        self.syncing = True
        self.stamps = (0, 0)
        self.number = self.epoch = self.asked = 0
        self.flying: list[tuple[int, bytes]] = []
        self.statuses: list[_core.Status] = []
        self.payload = b""  # of the last status
        self.reports: list[_core.Report] = []
        self.faults: list[_core.Fault] | None = None  # as last asked for
        self.encoder: Callable[[int], int] = lambda true_us: 0

    @property
    def host_us(self) -> int:
        return self.epoch_us + self.now

    @property
    def knot(self) -> int:
        """The knot whose interval runs on the device."""
        return self.node.system_us(self.now) >> SHIFT

    @property
    def state(self) -> State:
        return State(self.node.state)

    @property
    def reason(self) -> str:
        """Why the device stopped last."""
        return _core.REASONS[self.node.status.fault.reason]

    def greet(self) -> None:
        """Says hello, at once; the session begins with the host's next frame."""
        nonce = self.node.boots.to_bytes(16, "little")
        self.node.deliver(self.now, _core.hello(nonce))
        self.node.poll(self.now, self.encoder(self.now))
        for _, packet in self.node.collect():
            verdict, _, session = _core.welcome_open(KEY, nonce, packet)
            if session is not None:
                assert verdict == "ok"
                self.host, self.welcomed = session, True

    def restart(self) -> None:
        """A power cycle; the host begins anew as well."""
        self.node.restart()
        self.flying.clear()
        self.stamps, self.welcomed = (0, 0), False
        self.number = self.epoch = self.asked = 0

    def poll(self) -> None:
        self.now += self.poll_us
        self.node.poll(self.now, self.encoder(self.now))
        if not self.welcomed:
            self.greet()
        self.flying += [(t + self.delay_us, packet) for t, packet in self.node.collect()]
        for arrival, packet in [f for f in self.flying if f[0] <= self.now]:
            opened = self.host.open(packet)
            assert isinstance(opened, tuple)
            kind, payload = opened
            if kind == _core.FRAME_FAULTS:
                self.faults = _core.faults_decode(payload)
                continue
            if kind == _core.FRAME_READINGS:
                report = _core.report_decode(payload)
                assert report is not None
                self.reports.append(report)
                continue
            assert kind == _core.FRAME_STATUS
            status = _core.status_decode(payload)
            assert status is not None
            self.statuses.append(status)
            self.payload = payload
            self.stamps = (status.sent_count_us, self.epoch_us + arrival)
        self.flying = [f for f in self.flying if f[0] > self.now]
        if self.syncing and self.welcomed and self.now % 4000 == 0:
            payload = _core.sync_encode((*self.stamps, self.host_us))
            self.node.deliver(self.now + self.delay_us, self.host.seal(_core.FRAME_SYNC, payload))

    def run(self, us: int) -> None:
        for _ in range(us // self.poll_us):
            self.poll()

    def period(self) -> None:
        """To the poll after the next servo period."""
        self.run(PERIOD_US)

    def run_to_knot(self, knot: int) -> None:
        """To the first poll in or after the knot's interval."""
        assert self.knot <= knot
        while self.knot < knot:
            self.poll()

    def run_until(self, state: State, within_us: int = 2_000_000) -> None:
        """To the first poll in the state."""
        end = self.now + within_us
        while self.state != state:
            assert self.now < end, f"{self.state.name}, not {state.name}: {self.reason}"
            self.poll()

    def sync(self) -> "Rig":
        self.run_until(State.IDLE)
        self.run(100_000)
        return self

    def ask(self, kind: str, argument: int = 0, epoch: int = 0, number: int | None = None) -> str:
        """Delivers a command at once; returns its result."""
        if number is None:
            number = self.asked = self.asked + 1
        payload = _core.command_encode(number, _core.COMMANDS.index(kind), argument, epoch)
        bad = self.node.status.frames_bad
        self.node.deliver(self.now, self.host.seal(_core.FRAME_COMMAND, payload))
        self.node.poll(self.now, self.encoder(self.now))
        status = self.node.status
        assert status.frames_bad == bad
        return _core.COMMAND_RESULTS[status.command_result]

    def arm(self, torque: int = 0) -> "Rig":
        """Arms, or resumes, with the next epoch."""
        self.epoch += 1
        command = "RESUME" if self.state == State.HOLD else "ARM"
        result = self.ask(command, torque if command == "ARM" else 0, self.epoch)
        assert result == "DONE", f"{result}: {self.state.name}, {self.reason}"
        assert self.state == State.ARMED
        return self

    def plan(
        self, first_knot: int, tracks: Plan, number: int | None = None, epoch: int | None = None
    ) -> bytes:
        self.number = self.number + 1 if number is None else number
        arrays = {s: np.array(p, dtype=np.int32) for s, p in tracks.items()}
        epoch = self.epoch if epoch is None else epoch
        stamps = (0, 0, self.host_us)
        payload = _core.plan_encode(stamps, self.number, epoch, first_knot, arrays)
        return self.host.seal(_core.FRAME_PLAN, payload)

    def give(
        self, first_knot: int, tracks: Plan, number: int | None = None, epoch: int | None = None
    ) -> str:
        """Delivers a plan at once; returns the gate's result."""
        return self.hand_over(self.plan(first_knot, tracks, number, epoch))

    def hand_over(self, packet: bytes) -> str:
        """Delivers a plan's packet at once; returns the gate's result."""
        before = self.node.status
        # Between servo periods: nothing but the packet happens.
        self.node.deliver(self.now, packet)
        self.node.poll(self.now, self.encoder(self.now))
        after = self.node.status
        assert after.frames_bad == before.frames_bad
        if after.plans_accepted > before.plans_accepted:
            return "accepted"
        refused = (before.plans_late + before.plans_refused) + 1
        assert after.plans_late + after.plans_refused == refused
        reason = _core.GATE_RESULTS[after.refusal]
        assert (after.plans_late > before.plans_late) == (reason == "late")
        return reason

    def start(self, count: int = 30, position: int = 0) -> int:
        """Arms; takes up a first plan at rest; returns its first knot."""
        if self.state != State.ARMED:
            self.arm()
        first = self.knot + _core.LIVE_KNOTS
        assert self.give(first, {POSITION: [position] * count, TORQUE: [0] * count}) == "accepted"
        return first

    def setpoints(self, low_knot: int, high_knot: int) -> list[tuple[int, int, int]]:
        """Position, rate and torque of the device's tracks, eight to a knot."""
        times = range(low_knot << SHIFT, high_knot << SHIFT, KNOT_US // 8)
        return [self.node.setpoint(t) for t in times]


def ramp(first: int, start: int, count: int = 12) -> Points:
    """At rest, a move of 2^17, at rest."""
    step = 1 << 14
    points = [start] * first + [start + step * i for i in range(1, 9)]
    return points + [points[-1]] * max(3, count - len(points))


BRAKE_US = 15_000  # until the plant's brake has engaged, or let go


class Axis:
    """A motor that turns an inertia under a constant load, with a brake: SI at the joint."""

    def __init__(self, node: _board.Node, inertia: float, load: float = 0.0) -> None:
        motor = CART.motor
        self.node, self.inertia, self.load = node, inertia, load
        self.constant, self.resistance = motor.constant, motor.resistance_ohm
        self.q = self.v = 0.0
        self.wall = float("inf")  # a stop that it cannot pass
        self._now = 0
        self._brake, self._brake_us = True, -BRAKE_US

    @property
    def braked(self) -> bool:
        """Held by the brake: it takes its time, both ways."""
        settled = self._now - self._brake_us >= BRAKE_US
        return self._brake if settled else not self._brake

    @property
    def count(self) -> int:
        return round(self.q * CART.counts_per_unit)

    def __call__(self, true_us: int) -> int:
        """The encoder's count at a true time, not before the last one."""
        node, dt = self.node, (true_us - self._now) * 1e-6
        self._now = true_us
        if node.brake != self._brake:
            self._brake, self._brake_us = node.brake, true_us
        torque = self.load
        if node.power:
            volts = node.duty_q15 / 32768 * node.supply_V
            torque += self.constant * (volts - self.constant * self.v) / self.resistance
        self.v = 0.0 if self.braked else self.v + torque / self.inertia * dt
        self.q += self.v * dt
        if self.q > self.wall:
            self.q, self.v = self.wall, 0.0
        return self.count


def _cart() -> Config:
    return load_config(Path(__file__).parent / "cart" / "cart.yaml", [])


CONFIG = _cart()
CART = CONFIG.machine.axes[1]  # a hinge: 40000 counts a turn, 4 Nm, 12 rad/s
INERTIA = 0.02  # kg m^2
UNITS = AxisUnits.of(CART, CONFIG.loop)


def cart_settings() -> _core.DeviceSettings:
    """As a board of the cart's hinge is flashed."""
    settings = axis_settings(CART, CONFIG.device, CONFIG.loop, CONFIG.sync)
    settings.key = KEY
    return settings


def cart_rig(
    settings: _core.DeviceSettings | None = None, load: float = 0.0, encoder_offset: int = 0
) -> tuple[Rig, Axis]:
    """A rig with the cart's hinge on it."""
    rig = Rig(settings=settings or cart_settings(), supply_V=CART.motor.supply_V)
    rig.node.encoder_offset = encoder_offset
    rig.node.poll(0, 0)  # the brake is on
    axis = Axis(rig.node, INERTIA, load)
    rig.encoder = axis
    return rig, axis


_SYNCED: list[tuple[np.ndarray, Rig]] = []


def clone(session: _core.Session) -> _core.Session:
    """The same end of the same session, as far as it has come."""
    copy = _core.Session(session.send_key, session.receive_key, session.number)
    copy.sent, copy.received = session.sent, session.received
    return copy


def synced_rig() -> Rig:
    """A copy of one synced rig: the node's whole state is the array."""
    if not _SYNCED:
        rig = Rig().sync()
        _SYNCED.append((rig.memory.copy(), rig))
    memory, origin = _SYNCED[0]
    rig = Rig()
    rig.memory[:] = memory
    rig.now, rig.stamps = origin.now, origin.stamps
    rig.host = clone(origin.host)
    rig.welcomed = True
    return rig


# ---- a device in each state


def booting() -> Rig:
    return Rig()


def unsynced() -> Rig:
    rig = Rig()
    rig.syncing = False
    rig.run(20_000)
    return rig


def idle() -> Rig:
    return synced_rig()


def armed() -> Rig:
    rig = synced_rig().arm()
    rig.period()
    return rig


def running() -> Rig:
    rig = synced_rig()
    first = rig.start(60)
    rig.run_to_knot(first)
    assert rig.give(first, {POSITION: [0] * 60, TORQUE: [0] * 60}) == "accepted"
    return rig


def coasting() -> Rig:
    rig = running()
    rig.run_until(State.COAST)
    return rig


def tailing() -> Rig:
    """Moving by 40 counts a period: the ramp takes a while."""
    rig = running()
    begin = rig.now
    rig.encoder = lambda now: (now - begin) // 25
    rig.run(20_000)
    assert rig.ask("STOP") == "DONE"
    end = rig.encoder(rig.now)
    rig.encoder = lambda now: end
    return rig


def holding() -> Rig:
    rig = coasting()
    rig.run_until(State.HOLD)
    return rig


def faulty() -> Rig:
    rig = idle()
    rig.encoder = lambda now: 200_000  # jumps
    rig.period()
    rig.run(20_000)
    return rig


def emergency() -> Rig:
    rig = idle()
    rig.node.stop_line = True
    rig.period()
    rig.node.stop_line = False
    rig.run(20_000)
    return rig


MAKE: dict[State, Callable[[], Rig]] = {
    State.BOOT: booting,
    State.UNSYNCED: unsynced,
    State.IDLE: idle,
    State.ARMED: armed,
    State.RUNNING: running,
    State.COAST: coasting,
    State.TAIL: tailing,
    State.HOLD: holding,
    State.FAULT: faulty,
    State.ESTOP: emergency,
}
