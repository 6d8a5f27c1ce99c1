"""Steppers: pulses along a setpoint alone, then those of a device, against the track itself."""

from bisect import bisect_right
from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rig import PERIOD_US, POLL_US, POSITION, TORQUE, Rig, State, device_settings

from headway.configs.axis import StepperAxis
from headway.configs.load import ConfigError, load_config
from headway.devices.settings import device_settings as device_settings_of
from headway.firmware import _core
from headway.sim.lockstep import Lockstep

STEP = 1 << _core.COUNT_BITS  # pq
US = 1 << 16
WRAP = 1 << 32
S = State


# ---- pulses alone


class Pulses:
    """What a stepper gives, window by window: times [1/65536 us] and directions."""

    def __init__(self, least_q16: int, window_us: int, start_pq: int = 0) -> None:
        self.stepper, self.least, self.window = _core.Stepper(start_pq), least_q16, window_us
        self.times, self.signs, self.ends = list[int](), list[int](), [start_pq]

    def to(self, target_pq: int) -> None:
        begin = (len(self.ends) - 1) * self.window * US
        steps, first, spacing = self.stepper.step(self.least, target_pq, self.window)
        self.times += [begin + first + i * spacing for i in range(abs(steps))]
        self.signs += [1 if steps > 0 else -1] * abs(steps)
        assert not steps or first + (abs(steps) - 1) * spacing < self.window * US
        self.ends.append(target_pq)

    def count(self, time_q16: int) -> int:
        """Of steps, at a time."""
        return sum(self.signs[: bisect_right(self.times, time_q16)])

    def line(self, time_q16: int) -> Fraction:
        """The setpoint [pq], straight from window to window."""
        window, rest = divmod(time_q16, self.window * US)
        low, high = self.ends[window : window + 2]
        return low + Fraction(high - low) * rest / (self.window * US)


@given(
    st.integers(-(2**29), 2**29),
    st.lists(st.integers(-20 * STEP, 20 * STEP) | st.integers(-3, 3), min_size=1, max_size=12),
    st.sampled_from([125, 1000, 4000]),
)
def test_pulses_are_within_half_a_step_of_the_line(
    start: int, ways: list[int], window_us: int
) -> None:
    """The rate is no matter: a pulse may follow another one after a nanosecond."""
    pulses = Pulses(1, window_us, start)
    origin = (start + STEP // 2) // STEP
    for way in ways:
        pulses.to(pulses.ends[-1] + way)
    end = len(ways) * window_us * US
    for time in [*pulses.times, *range(0, end, end // 50 or 1)]:
        for at in (time - 1, time):
            if 0 <= at < end:
                away = pulses.line(at) - STEP * (origin + pulses.count(at))
                # A time is rounded down to 1/65536 us, and of many each by the spacing's.
                assert abs(away) <= STEP // 2 + 1
    assert pulses.stepper.count == origin + sum(pulses.signs)


@given(
    st.integers(1, 300 * US),
    st.lists(st.integers(-(2**21), 2**21) | st.integers(-600, 600), min_size=1, max_size=12),
    st.sampled_from([250, 1000]),
)
def test_whatever_is_asked_for_the_rate_is_kept_and_no_step_is_lost(
    least: int, ways: list[int], window_us: int
) -> None:
    pulses = Pulses(least, window_us)
    for way in ways:
        pulses.to(pulses.ends[-1] + way)
        assert pulses.stepper.count == sum(pulses.signs)
    wanted = (pulses.ends[-1] + STEP // 2) // STEP
    missing = abs(wanted - pulses.stepper.count)
    for _ in range(2 + missing * (least // (window_us * US) + 2)):
        if pulses.stepper.count == wanted:
            break
        pulses.to(pulses.ends[-1])
    assert pulses.stepper.count == wanted
    assert all(later - time >= least for time, later in pairwise(pulses.times))


def test_a_rate_that_is_just_enough_is_used_whole() -> None:
    """At the largest rate nothing is left over, window by window."""
    pulses = Pulses(20 * US, 1000)
    for window in range(40):
        pulses.to(50 * STEP * (window + 1))
        assert abs(pulses.ends[-1] - STEP * pulses.stepper.count) <= STEP // 2
    assert {b - a for a, b in pairwise(pulses.times)} == {20 * US}


def test_the_place_may_have_another_number() -> None:
    stepper, other = _core.Stepper(700), _core.Stepper(700 + 4000 * STEP)
    stepper.shift(4000)
    assert (stepper.count, stepper.now_pq) == (other.count, other.now_pq)
    target = 700 + 4003 * STEP + 500
    assert stepper.step(US, target, 1000) == other.step(US, target, 1000)


# ---- on a device

LEAST_US = 20  # 50 kHz
KNOT_US = 4096
SPEED = STEP * KNOT_US // LEAST_US * 1023 // 1024  # pq per knot, the largest
CURVE = 1 << 15  # pq per knot^2


def stepper_settings() -> _core.DeviceSettings:
    made = device_settings()
    made.step_least_q16 = LEAST_US * US
    made.set_limits(POSITION, _core.GateLimits(-(1 << 28), 1 << 28, SPEED, CURVE))
    made.monitor.deceleration_q16 = 1500 * US
    made.home.method = _core.HOME_METHODS.index("index")
    return made


def stepper_rig() -> Rig:
    """Told where it is, and armed."""
    rig = Rig(settings=stepper_settings())
    rig.sync()
    assert rig.ask("ZERO", 0) == "DONE"
    return rig.arm()


def moves(shares: Sequence[float]) -> list[int]:
    """Points that change their speed by these shares of the largest change, and come to rest."""
    speed, points, changes = 0.0, [0, 0, 0], [CURVE * share for share in shares]
    while changes or speed:
        change = changes.pop(0) if changes else -float(np.clip(speed, -CURVE, CURVE))
        speed = float(np.clip(speed + change, -SPEED, SPEED))
        points.append(points[-1] + int(speed))
    return [*points, *[points[-1]] * 3]


def value(first: int, points: Sequence[int], time_us: int) -> float:
    """Of the cubic B-spline [pq], by its basis (de Boor)."""
    knot, u = time_us // KNOT_US, time_us % KNOT_US / KNOT_US
    basis = [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3]
    near = (points[min(max(knot - 1 + i - first, 0), len(points) - 1)] for i in range(4))
    return sum(b * p for b, p in zip(basis, near, strict=True)) / 6


class Follower:
    """A rig, and how far its steps are from a track."""

    def __init__(self, rig: Rig, points: Sequence[int]) -> None:
        self.rig, self.points = rig, points
        self.first = rig.knot + _core.LIVE_KNOTS + 1
        self.worst, self.trains = 0.0, dict[int, tuple[int, int, int]]()
        tracks = {POSITION: points, TORQUE: [0] * len(points)}
        assert rig.give(self.first, tracks) == "accepted"

    def run(self, us: int, follows: bool = True) -> None:
        for _ in range(us // POLL_US):
            self.rig.poll()
            node, now = self.rig.node, self.rig.now
            for count_us, *train in node.trains:
                self.trains[count_us] = (train[0], train[1], train[2])
            if follows:
                for at in range(now - POLL_US, now, 7):
                    wanted = value(self.first, self.points, node.system_us(at)) / STEP
                    self.worst = max(self.worst, abs(node.steps(at) - wanted))

    @property
    def rest_us(self) -> int:
        return (self.first + len(self.points)) * KNOT_US - self.rig.node.system_us(self.rig.now)

    def least_us(self) -> float:
        """From any pulse to the next."""
        times = [
            count_us + (first + i * spacing) / US
            for count_us, (steps, first, spacing) in sorted(self.trains.items())
            for i in range(abs(steps))
        ]
        return min((b - a for a, b in pairwise(times)), default=float("inf"))


@settings(max_examples=15)
@given(st.lists(st.floats(-1, 1), min_size=3, max_size=60))
def test_steps_are_within_one_of_the_track_at_all_times(shares: list[float]) -> None:
    follower = Follower(stepper_rig(), moves(shares))
    follower.run(follower.rest_us + 50_000)
    assert follower.rig.state in (S.COAST, S.HOLD)
    assert follower.worst <= 1
    assert follower.least_us() >= LEAST_US
    assert follower.rig.node.steps(follower.rig.now) == round(follower.points[-1] / STEP)


@pytest.mark.parametrize("sign", [1, -1])
def test_also_at_the_largest_rate_and_where_it_turns(sign: int) -> None:
    shares = [sign * s for s in [1] * 10 + [0] * 10 + [-1] * 20 + [0] * 10 + [1] * 6 + [0.01] * 3]
    points = moves(shares)
    assert SPEED - np.abs(np.diff(points)).max() <= 1
    follower = Follower(stepper_rig(), points)
    follower.run(follower.rest_us + 50_000)
    assert follower.worst <= 1
    assert LEAST_US <= follower.least_us() < LEAST_US * 1.002
    assert follower.rig.state == S.HOLD


def test_no_plan_asks_for_more_than_its_rate() -> None:
    rig = stepper_rig()
    first = rig.knot + _core.LIVE_KNOTS + 1
    step = SPEED + 1
    ramp = [min(CURVE * i, step) for i in range(9)]
    points = np.cumsum([0, 0, 0, *ramp, *ramp[::-1], 0, 0, 0]).tolist()
    assert rig.give(first, {POSITION: points, TORQUE: [0] * len(points)}) == "speed"
    fewer = np.cumsum([0, 0, 0, *[min(s, SPEED) for s in [*ramp, *ramp[::-1]]], 0, 0, 0]).tolist()
    assert rig.give(first, {POSITION: fewer, TORQUE: [0] * len(fewer)}) == "accepted"


FAST = moves([1] * 8 + [0] * 40)


def test_it_stops_on_a_ramp_from_what_its_pulses_do() -> None:
    """No jump of its speed: each window has as many steps as the last one, but for the ramp's."""
    follower = Follower(stepper_rig(), FAST)
    follower.run(100_000)
    assert follower.worst <= 1
    assert follower.rig.ask("STOP") == "DONE"
    follower.run(200_000, follows=False)
    assert follower.rig.state == S.HOLD
    steps = [steps for _, (steps, *_) in sorted(follower.trains.items())]
    changes = np.abs(np.diff(steps))
    assert max(steps) >= 49 and changes.max() <= 3 and steps[-1] <= 3
    assert follower.least_us() >= LEAST_US
    rig = follower.rig
    assert rig.node.steps(rig.now) == sum(steps)
    assert rig.node.setpoint(0)[0] // STEP in (sum(steps) - 1, sum(steps))
    again = rig.node.setpoint(0)[0]
    rig.arm()
    assert rig.give(rig.knot + 16, {POSITION: [again] * 9, TORQUE: [0] * 9}) == "accepted"


def test_without_current_it_no_longer_knows_where_it_is() -> None:
    """The emergency line: the ramp, the brake, no current; then no pulse, and it is to be homed."""
    follower = Follower(stepper_rig(), FAST)
    follower.run(100_000)
    rig = follower.rig
    rig.node.stop_line = True
    follower.run(400_000, follows=False)
    assert rig.state == S.ESTOP and rig.node.brake and not rig.node.power
    steps = [steps for _, (steps, *_) in sorted(follower.trains.items())]
    assert np.abs(np.diff(steps)).max() <= 3 and steps[-1] <= 3
    assert not rig.node.status.homed
    count, told = rig.node.steps(rig.now), len(follower.trains)
    rig.node.stop_line = False
    rig.run(20_000)
    assert rig.ask("CLEAR") == "DONE"
    rig.sync().arm()
    assert rig.ask("JOG", 0) == "DONE"
    rig.run(50_000)
    assert rig.node.steps(rig.now) == count and len(follower.trains) == told
    first = rig.knot + 16
    assert rig.give(first, {POSITION: [count * STEP] * 9, TORQUE: [0] * 9}) == "state"


def test_a_first_plan_begins_where_it_stands() -> None:
    for away, verdict in ((2 * STEP, "accepted"), (2 * STEP + 1, "start"), (-3 * STEP, "start")):
        rig = stepper_rig()
        tracks = {POSITION: [away] * 9, TORQUE: [0] * 9}
        assert rig.give(rig.knot + 16, tracks) == verdict


@pytest.mark.parametrize("late_us", [0, 250, 500, 750])
def test_a_servo_that_comes_late_changes_nothing(late_us: int) -> None:
    """It is polled late, by less than a period, again and again: the board has its pulses."""
    follower = Follower(stepper_rig(), FAST)
    rig = follower.rig
    for _ in range(90):
        follower.run(PERIOD_US)
        rig.now += late_us
    assert rig.state in (S.RUNNING, S.COAST, S.HOLD)
    assert follower.worst <= 1


def faster(made: _core.DeviceSettings) -> None:
    made.set_limits(POSITION, _core.GateLimits(-(1 << 28), 1 << 28, SPEED + 1, CURVE))


def sharper(made: _core.DeviceSettings) -> None:
    curve = 2 * STEP * KNOT_US**2 // PERIOD_US**2
    made.set_limits(POSITION, _core.GateLimits(-(1 << 28), 1 << 28, SPEED, curve + 1))


def searches_fast(made: _core.DeviceSettings) -> None:
    slow = 10 * LEAST_US
    made.step_least_q16 = slow * US
    made.set_limits(POSITION, _core.GateLimits(-(1 << 28), 1 << 28, SPEED // 10, CURVE))
    made.home.speed_q16 = PERIOD_US // slow * STEP * US
    assert made.valid
    made.home.speed_q16 += 1


def never_homed(made: _core.DeviceSettings) -> None:
    made.home.method = _core.HOME_METHODS.index("none")


def feels_its_stop(made: _core.DeviceSettings) -> None:
    made.home.method = _core.HOME_METHODS.index("stop")


def long_periods(made: _core.DeviceSettings) -> None:
    made.servo_period_us = KNOT_US // 2 + 1


@pytest.mark.parametrize(
    "change", [faster, sharper, searches_fast, never_homed, feels_its_stop, long_periods]
)
def test_settings_that_would_break_a_promise_are_none(change: object) -> None:
    made = stepper_settings()
    assert made.valid
    assert callable(change)
    change(made)
    assert not made.valid
    made.step_least_q16 = 0
    assert made.valid or change is long_periods


# ---- by the config

CONFIG = Path(__file__).resolve().parent.parent / "configs" / "stepper.yaml"


def test_a_machine_of_steppers_finds_its_marks_and_follows() -> None:
    """From power-up, by homing, over wires that lose packets: what the motors' friction leaves."""
    config = load_config(CONFIG, ["duration_s=3"])
    lock = Lockstep(config, CONFIG.parent)
    lock.run()
    record = lock.record.arrays()
    under_way = (record["truth_s"] > 1) & (record["truth_s"] < 2.9)
    error = np.abs(record["truth_position"] - record["truth_reference"])[under_way].max(axis=0)
    speed = np.abs(record["truth_velocity"]).max(axis=0)
    for axis, worst, fastest in zip(config.machine.axes, error, speed, strict=True):
        assert isinstance(axis, StepperAxis)
        drag = axis.stepper.damping * fastest / axis.stiffness
        step, home = 1 / axis.counts_per_unit, axis.homing.speed * PERIOD_US * 1e-6
        assert worst <= 1.5 * drag + 2 * step + home  # a switch is read once a period
    assert lock.frames(record)["gate_refused"] == 0
    assert lock.device_states() == ["HOLD", "HOLD"]


def test_a_stepper_that_is_asked_for_too_much_loses_steps_and_nobody_knows() -> None:
    """What an open loop cannot do, in the simulator as well."""
    weak = "machine.axes.0.stepper.holding_force_N=6"
    drag = "machine.axes.0.stepper.damping_N_s_per_m=4"
    lock = Lockstep(load_config(CONFIG, ["duration_s=3", weak, drag]), CONFIG.parent)
    lock.run()
    record = lock.record.arrays()
    error = np.abs(record["truth_position"] - record["truth_reference"])[record["truth_s"] > 1, 0]
    assert error.max() > 0.01
    assert lock.device_states() == ["HOLD", "HOLD"]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("mpc.enabled=true",), r"axes.0.stepper:? takes positions alone.*mpc.enabled: false"),
        (("mpc.feedforward=model",), r"axes.0.stepper:? takes positions alone"),
        (("loop.gains=fixed",), r"axes.1.stepper:? takes positions alone.*loop.gains: off"),
        (
            ("machine.axes.0.servo={kp_N_per_m: 1, kd_N_s_per_m: 1}",),
            "an axis with a stepper has no servo: remove it, or stepper",
        ),
        (
            ("machine.axes.1.stepper.damping_Nm_s_per_rad=0.7",),
            "velocity_limit_rad_per_s:? is 6, but at 5.714 stepper.damping_Nm_s_per_rad alone",
        ),
    ],
)
def test_what_a_stepper_cannot_do_is_refused(overrides: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config(CONFIG, list(overrides))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["machine.axes.0.velocity_limit_m_per_s=0.625"],
            r"x: velocity_limit_m_per_s is 0.625; with steps at 50000 a second .* be 0.62439 at",
        ),
        (["machine.axes.0.acceleration_limit_m_per_s2=26"], r"m_per_s2 is 26; .* it can be 25 at"),
        (
            [
                "machine.axes.0.homing.speed_m_per_s=0.063",
                "machine.axes.0.stepper.steps_per_s=5000",
                "machine.axes.0.velocity_limit_m_per_s=0.06",
            ],
            r"homing.speed_m_per_s is 0.063; with steps at 5000 a second it can be 0.0624",
        ),
        (["device.servo_period_us=2500"], r"device.servo_period_us is at most half .* 2048"),
        (["machine.axes.0.stepper.steps_per_s=5"], r"stepper.steps_per_s"),
    ],
)
def test_what_its_board_cannot_hold_is_named(overrides: list[str], message: str) -> None:
    config = load_config(CONFIG, overrides)
    axis = config.machine.driven[0]
    with pytest.raises(ValueError, match=message):
        device_settings_of(axis, config.device, config.loop, config.sync)


def test_what_it_can_hold_the_board_takes() -> None:
    """At the largest speeds and accelerations that the messages tell."""
    config = load_config(CONFIG, ["machine.axes.0.velocity_limit_m_per_s=0.624389",
                                  "machine.axes.0.acceleration_limit_m_per_s2=25"])  # fmt: skip
    for axis in config.machine.axes:
        made = device_settings_of(axis, config.device, config.loop, config.sync)
        assert made.valid
