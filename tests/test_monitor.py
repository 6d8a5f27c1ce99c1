"""The monitor: at each limit nothing, one beyond a breach, after exactly the stated time."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from rig import monitor_settings
from scipy.integrate import solve_ivp

from headway.firmware import _core

COUNT_PQ = 1 << _core.COUNT_BITS
LIMIT_TQ = 1 << 24
RESPONSE = {
    "TAIL": "HOST SYNC_LOST CLOCK GAP FOLLOWING SPEED ROOM TORQUE HOMING",
    "FAULT": "GAP_FAULT OUTSIDE I2T WINDING UNDERVOLTAGE OVERVOLTAGE",
    "BRAKE": "LATE STUCK REVERSED SPIKE SETTINGS",
}

Breach = tuple[str, int, int]
NONE: Breach = ("NONE", 0, 0)


def seen(**values: int | bool) -> _core.Observation:
    """A driven axis at rest, but for `values`."""
    observation = _core.Observation()
    defaults = {
        "torque_limit_tq": LIMIT_TQ,
        "supply_mV": 24_000,
        "power": True,
        "driven": True,
        "bounded": True,
        "looks": 15,
        "heat_shift": 0,
        "stuck_periods": 1,
    }
    for name, value in (defaults | values).items():
        setattr(observation, name, value)
    return observation


class Watch:
    """A monitor with its settings, and the breaches by name."""

    def __init__(self, **changes: object) -> None:
        self.settings = monitor_settings()
        for name, value in changes.items():
            setattr(self.settings, name, value)
        self.monitor = _core.Monitor()

    def __call__(self, **values: int | bool) -> Breach:
        reason, value, limit = self.monitor.step(self.settings, seen(**values))
        return _core.REASONS[reason], value, limit

    def first(self, periods: int, **values: int | bool) -> tuple[int, Breach]:
        """The first period (from 1 on) that finds a breach, and the breach; 0 if none does."""
        for period in range(1, periods + 1):
            breach = self(**values)
            if breach != NONE:
                return period, breach
        return 0, NONE


@pytest.mark.parametrize("response", RESPONSE)
def test_what_each_reason_leads_to(response: str) -> None:
    for reason in RESPONSE[response].split():
        number = _core.fault_response(_core.REASONS.index(reason))
        assert _core.RESPONSES[number] == response, reason


def test_every_reason_has_a_response() -> None:
    assert {"NONE", *" ".join(RESPONSE.values()).split()} == set(_core.REASONS)


signs = st.sampled_from([-1, 1])


@given(st.integers(1, 1 << 29), st.integers(0, 40), signs)
def test_following(limit: int, periods: int, sign: int) -> None:
    watch = Watch(following_pq=limit, following_periods=periods)
    assert watch.first(periods + 5, error_pq=sign * limit) == (0, NONE)
    assume(limit < 1 << 29)
    beyond = sign * (limit + 1)
    found = watch.first(periods + 5, error_pq=beyond)
    assert found == (periods + 1, ("FOLLOWING", beyond, limit))


def test_following_counts_in_a_row() -> None:
    watch = Watch(following_pq=100, following_periods=3)
    for _ in range(10):
        assert watch.first(3, error_pq=101) == (0, NONE)
        assert watch(error_pq=100) == NONE
    assert watch.first(3, error_pq=101) == (0, NONE)
    watch.monitor.begin()  # another setpoint: from the beginning
    assert watch.first(9, error_pq=101)[0] == 4


@given(st.integers(0, 500))
def test_torque(periods: int) -> None:
    watch = Watch(torque_periods=periods)
    assert watch.first(periods, clipped=True) == (0, NONE)
    assert watch() == NONE
    found = watch.first(periods + 5, clipped=True)
    assert found == (periods + 1, ("TORQUE", periods + 1, periods))


@given(st.integers(-1_000_000, 1_000_000), st.integers(1, (1 << 18) - 1), signs)
def test_spike(start: int, limit: int, sign: int) -> None:
    watch = Watch(spike_counts=limit, speed_pq=1 << 30)
    assert watch(count=start) == NONE  # wherever it is at power-up
    assert watch(count=start + sign * limit) == NONE
    assert watch(count=start + 2 * sign * limit + sign) == ("SPIKE", sign * (limit + 1), limit)
    assert watch(count=start + 2 * sign * limit + sign) == NONE  # once


def test_a_spike_is_judged_without_power_too() -> None:
    watch = Watch(spike_counts=10)
    watch(power=False, driven=False)
    assert watch(count=11, power=False, driven=False)[0] == "SPIKE"


@given(st.integers(1, 3000), signs)
def test_speed_is_the_counts_slope(counts: int, sign: int) -> None:
    """At a steady speed the low-pass shows it, within the rounding of its 8 periods."""
    watch = Watch(spike_counts=1 << 17)
    for period in range(200):
        assert watch(count=sign * counts * period) == NONE
    speed = sign * watch.monitor.speed_pq
    assert counts * COUNT_PQ - 8 < speed <= counts * COUNT_PQ
    watch.settings.speed_pq = speed
    assert watch(count=sign * counts * 200) == NONE
    watch.settings.speed_pq = speed - 1
    assert watch(count=sign * counts * 201) == ("SPEED", sign * speed, speed - 1)


@given(
    st.integers(1, 2000),  # counts per period
    st.integers(1, (1 << 31) - 1),
    signs,
)
def test_room(counts: int, deceleration_q16: int, sign: int) -> None:
    """At v the room to stop is v^2 / 2a: there no breach, one quantum less is one."""
    watch = Watch(spike_counts=1 << 17)
    for period in range(200):
        watch(count=sign * counts * period)
    speed = abs(watch.monitor.speed_pq)
    deceleration_q16 = max(deceleration_q16, (speed**2 >> 14) + 1)  # room within positions
    watch.settings.deceleration_q16 = deceleration_q16
    room = -(-(speed**2 << 15) // deceleration_q16)  # v^2 / 2a, rounded up
    limits = {"low_pq": -1000, "high_pq": 500} if sign > 0 else {"low_pq": -500, "high_pq": 1000}
    for name, value in limits.items():
        setattr(watch.settings, name, value)
    watch.settings.bounded = True
    end = sign * 500
    position = end - sign * room

    def at(position_pq: int, **values: bool) -> Breach:
        nonlocal period
        period += 1
        return watch(count=sign * counts * period, position_pq=position_pq, **values)

    assert at(position) == NONE
    assert at(position + sign) == ("ROOM", position + sign, end)
    assert at(position + sign, bounded=False) == NONE
    watch.settings.bounded = False
    assert at(position + sign) == NONE


def test_beyond_the_limit_there_is_a_way_back() -> None:
    watch = Watch(bounded=True, low_pq=-100, high_pq=100)
    assert watch(position_pq=5000) == NONE  # at rest
    assert watch(count=-4, position_pq=5000) == NONE
    watch = Watch(bounded=True, low_pq=-100, high_pq=100)
    watch(position_pq=5000)
    assert watch(count=4, position_pq=5000) == ("OUTSIDE", 5000, 100)  # further out


@given(st.integers(0, 20_000))
def test_late(limit: int) -> None:
    watch = Watch(late_us=limit)
    assert watch(late_us=limit) == NONE
    assert watch(late_us=limit + 1) == ("LATE", limit + 1, limit)
    assert watch(late_us=limit + 1, power=False, driven=False) == NONE


@pytest.mark.parametrize(
    ("reason", "limit", "step"), [("UNDERVOLTAGE", 16_000, -1), ("OVERVOLTAGE", 30_000, 1)]
)
def test_supply(reason: str, limit: int, step: int) -> None:
    watch = Watch()
    assert watch.first(50, supply_mV=limit) == (0, NONE)
    assert watch.first(9, supply_mV=limit + step) == (4, (reason, limit + step, limit))
    assert watch.first(3, supply_mV=limit + step) == (0, NONE)
    assert watch(supply_mV=limit) == NONE  # not in a row
    assert watch.first(3, supply_mV=limit + step) == (0, NONE)
    assert (
        watch(supply_mV=limit + step, power=False, driven=False) == NONE
    )  # nor with the power off
    assert watch.first(9, supply_mV=limit + step)[0] == 4


@pytest.mark.parametrize("power", [False, True])
@given(st.lists(st.integers(26_000, 28_000), min_size=1, max_size=60))
def test_chopper(power: bool, supplies: list[int]) -> None:
    """On above 27 V, off at 1/64 below; between, as it was."""
    watch, on = Watch(), False
    for supply_mV in [*supplies, 27_000, 27_001, 26_579, 26_580, 26_579]:
        watch(supply_mV=supply_mV, power=power, driven=power)
        on = supply_mV > 27_000 or (on and supply_mV > 27_000 - 27_000 // 64)
        assert watch.monitor.chopper == on


# ---- stuck


@pytest.mark.parametrize("sign", [-1, 1])
def test_stuck_while_the_setpoint_moves(sign: int) -> None:
    watch = Watch(stuck_pq=4096)
    for way in range(0, 4097, 512):
        assert watch(setpoint_pq=1000 + sign * way) == NONE
    assert watch(setpoint_pq=1000 + sign * 4097) == ("STUCK", sign * 4097, 4096)


@given(st.lists(st.integers(-300, 300), min_size=1, max_size=100))
def test_a_moving_encoder_is_not_stuck(steps: list[int]) -> None:
    watch, count = Watch(stuck_pq=300), 0
    for step in steps:
        count += 1 if step > 0 else -1
        assert watch(count=count, setpoint_pq=step, torque_tq=LIMIT_TQ) == NONE


@given(st.integers(0, 300), signs, st.integers(0, LIMIT_TQ // 2))
def test_stuck_under_a_growing_push(periods: int, sign: int, carried: int) -> None:
    watch = Watch(stuck_periods=periods)
    half = LIMIT_TQ // 2
    watch(torque_tq=sign * carried)
    watch(torque_tq=sign * carried)
    assert watch.first(periods + 3, torque_tq=sign * (carried + half - 1)) == (0, NONE)
    found = watch.first(periods + 3, torque_tq=sign * (carried + half))
    assert found == (periods + 1, ("STUCK", periods + 1, periods))


@given(st.integers(-LIMIT_TQ, LIMIT_TQ))
def test_a_heavy_load_at_rest_is_not_a_stuck_encoder(load: int) -> None:
    """Feed-forward, P or integrator carry it; the encoder stands still, as it should."""
    watch = Watch(stuck_periods=10)
    for period in range(200):  # the integrator takes it over, count by count
        share = min(period, 50)
        assert watch(count=share, torque_tq=load) == NONE


def test_a_stop_that_is_looked_for_is_not_a_stuck_encoder() -> None:
    watch = Watch(stuck_pq=100, stuck_periods=5)
    for period in range(100):
        push = min(LIMIT_TQ, period << 20)
        assert watch(setpoint_pq=50 * period, torque_tq=push, may_stand=True) == NONE
    assert watch(setpoint_pq=50 * 99, torque_tq=LIMIT_TQ) == NONE


# ---- reversed, and honestly behind


def behind(watch: Watch, speed_counts: int, **values: int | bool) -> Breach:
    for period in range(100):
        breach = watch(count=speed_counts * period, **values)
        if breach != NONE:
            return breach
    return NONE


@given(st.integers(2, 200), signs)
def test_reversed_is_told_from_behind(speed: int, sign: int) -> None:
    """The error is positive when the axis is too low; feedback pushes it up."""
    far = {"error_pq": sign * 10_001, "feedback_tq": sign * 500, "torque_tq": sign * 500}

    def watch() -> Watch:
        return Watch(following_pq=10_000, following_periods=30)

    assert behind(watch(), -sign * speed, **far) == ("REVERSED", sign * 10_001, 10_000)  # runs away
    assert behind(watch(), sign * speed, **far)[0] == "FOLLOWING"  # catches up, too slowly
    assert behind(watch(), 0, **far)[0] == "FOLLOWING"  # blocked
    helpless = far | {"feedback_tq": -sign * 500}  # the track itself runs away from a free axis
    assert behind(watch(), -sign * speed, **helpless)[0] == "FOLLOWING"


# ---- heat, against an integration in floating point


def loads(rng: np.random.Generator, periods: int) -> "np.ndarray[tuple[int], np.dtype[np.int64]]":
    """Torques that change every so often, in tq of a continuous torque of 2^24."""
    values = rng.uniform(-2.5, 2.5, periods // 500 + 1)
    return np.rint(np.repeat(values, 500)[:periods] * (1 << 24)).astype(np.int64)


@pytest.mark.parametrize("seed", range(6))
def test_i2t(seed: int) -> None:
    """The allowance of (load^2 - 1) is used up when an exact integral of it says so."""
    rng = np.random.default_rng(seed)
    torques = loads(rng, 60_000)
    excess, used = (torques / (1 << 24)) ** 2 - 1, np.empty(len(torques))
    total = 0.0
    for i, step in enumerate(excess):
        total = max(0.0, total + step)
        used[i] = total
    allowance = round(0.6 * used.max())
    watch = Watch(overload=allowance, rise_q16=1 << 30)
    exact = int(np.argmax(used > allowance))
    for i, torque in enumerate(torques):
        reason, value, limit = watch(torque_tq=int(torque), count=i % 2)
        if i % 5000 == 0:
            assert abs(watch.monitor.overload - used[i]) <= 0.02 * used.max() + 2
        if reason != "NONE":
            assert (reason, limit) == ("I2T", allowance) and value > allowance
            assert abs(used[i] - allowance) <= 0.02 * allowance + 5
            assert i >= 0.9 * exact
            return
    raise AssertionError("never")


def test_i2t_allows_the_continuous_torque_for_ever() -> None:
    watch = Watch(overload=100, rise_q16=1 << 30)
    assert watch.first(20_000, torque_tq=1 << 24) == (0, NONE)
    period, breach = watch.first(20_000, torque_tq=1 << 25)  # twice that: 3 a period
    assert breach == ("I2T", 102, 100) and period == 34


@pytest.mark.parametrize("winding_s", [5.0, 60.0, 3600.0])
@pytest.mark.parametrize("load", [0.7, 1.2, 1.9])
def test_winding(winding_s: float, load: float) -> None:
    """rise' = (load^2 - rise) / T, by scipy; the breach comes when that passes the limit."""
    period_s = 1e-3
    heating = round(65536 * 256 * period_s / winding_s)
    exact_T = 65536 * 256 * period_s / heating  # as the integer has it
    limit = 1.1
    end_s = min(3 * winding_s, 60.0)
    solution = solve_ivp(
        lambda t, rise: [(load**2 - rise[0]) / exact_T], (0, end_s), [0.0], dense_output=True
    )
    watch = Watch(overload=1 << 31, heating_q16=heating, rise_q16=round(65536 * limit))
    torque = round(load * (1 << 24))
    steps = round(end_s / period_s)
    for i in range(1, steps + 1):
        breach = watch(torque_tq=torque)
        if breach == NONE and i % 1024:
            continue
        rise = float(solution.sol(i // 256 * 256 * period_s)[0])  # it is stepped each 256 periods
        if breach != NONE:
            assert breach[0] == "WINDING"
            assert rise == pytest.approx(limit, rel=0.02)
            return
        assert watch.monitor.rise_q16 / 65536 == pytest.approx(rise, rel=0.03, abs=0.003)
    assert rise < 1.01 * limit


def test_a_slow_winding_gets_as_hot_as_it_should() -> None:
    """No rounding keeps it cold: an hour's time constant, at 1.2 times the continuous torque."""
    watch = Watch(overload=1 << 31, heating_q16=5, rise_q16=1 << 30)
    hot, steps = seen(torque_tq=round(1.2 * (1 << 24))), 4000
    for _ in range(256 * steps):
        watch.monitor.step(watch.settings, hot)
    exact = 1.44 * (1 - (1 - 5 / 65536) ** steps)
    assert watch.monitor.rise_q16 / 65536 == pytest.approx(exact, rel=0.02)


def test_the_sternest_breach_is_told() -> None:
    watch = Watch(following_pq=10, following_periods=0, late_us=10, overload=0, spike_counts=5)
    both = {"error_pq": 11, "supply_mV": 0, "torque_tq": 1 << 25}
    assert watch(**both)[0] == "I2T"  # before FOLLOWING
    assert watch(**both, late_us=11)[0] == "LATE"
    assert watch(**both, count=6)[0] == "SPIKE"
    assert watch(**both, late_us=11, count=12)[0] == "LATE"  # which explains the jump
    watch = Watch(following_pq=10, following_periods=50, overload=1 << 30, rise_q16=1 << 30)
    runaway = {"error_pq": 11, "feedback_tq": 1, "torque_tq": 1 << 25}
    for period in range(50):
        assert watch(count=-2 * period, **runaway) == NONE
    watch.settings.overload = 0
    assert watch(count=-100, **runaway) == ("REVERSED", 11, 10)  # found last, and the sternest


def test_nothing_is_judged_of_an_axis_that_is_not_driven() -> None:
    watch = Watch(following_pq=10, following_periods=0, torque_periods=0, speed_pq=1, stuck_pq=1)
    bad = {"error_pq": 99, "clipped": True, "setpoint_pq": 5000, "driven": False}
    assert watch.first(50, **bad) == (0, NONE)
    assert watch.first(1, **(bad | {"driven": True}))[0] == 1
