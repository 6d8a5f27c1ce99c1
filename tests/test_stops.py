"""Coming to rest: the ramp, TAIL, FAULT and the emergency stop, on an axis that moves and falls."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rig import (
    CART,
    CONFIG,
    KNOT_US,
    PERIOD_US,
    POLL_US,
    POSITION,
    SHIFT,
    TORQUE,
    UNITS,
    Axis,
    Rig,
    State,
    cart_rig,
    cart_settings,
    device_settings,
)

from headway.firmware import _core
from headway.sim import _board

S = State
PQ = UNITS.pq_per_unit
TQ = UNITS.tq_per_effort
STOP_US = CONFIG.device.stop_us
BRAKE_US = CONFIG.device.brake_us
DECELERATION = CART.deceleration  # rad/s^2
LOAD = -1.5  # Nm, of 4

# ---- the ramp alone

speeds = st.integers(-(1 << 22), 1 << 22)


@given(speeds, st.integers(1 << 8, 1 << 30), st.integers(-(1 << 29), 1 << 29))
def test_ramp_stops_within_v_squared_over_2a(speed: int, a_q16: int, start: int) -> None:
    """At the deceleration, all the way in one direction, over v^2 / 2a and within rounding."""
    periods = abs(speed) * 65536 / a_q16
    if periods > 20_000:
        a_q16 = abs(speed) * 65536 // 20_000
        periods = abs(speed) * 65536 / a_q16
    ramp = _core.Ramp(start, speed, 0, 0)
    velocities, taken = [ramp.velocity_q16], 0
    while not ramp.resting:
        ramp.step(a_q16, 1)
        velocities.append(ramp.velocity_q16)
        taken += 1
    assert taken == max(1, math.ceil(periods))
    steps = np.diff(np.abs(velocities))
    assert (steps[:-1] == -a_q16).all() and -a_q16 <= steps[-1] <= 0
    exact = speed**2 * 65536 / (2 * a_q16) * (1 if speed > 0 else -1)
    way = ramp.position_q16 / 65536 - start
    assert abs(way - exact) <= a_q16 / 65536 / 8 + taken / 65536
    assert abs(way) >= 0 and way * speed >= 0
    still = ramp.position_q16
    ramp.step(a_q16, 1)
    assert ramp.position_q16 == still and ramp.resting


@given(st.integers(-(1 << 25), 1 << 25), st.integers(-(1 << 25), 1 << 25), st.integers(1, 1 << 24))
def test_ramp_slews_the_torque(begin: int, end: int, step: int) -> None:
    ramp, last, taken = _core.Ramp(0, 0, begin, end), begin, 0
    if abs(end - begin) // step > 5000:
        step = abs(end - begin) // 5000
    while not ramp.resting:
        ramp.step(1, step)
        assert abs(ramp.torque_tq - last) <= step
        assert abs(end - ramp.torque_tq) <= abs(end - last)
        last, taken = ramp.torque_tq, taken + 1
    assert ramp.torque_tq == end
    assert taken == max(1, -(-abs(end - begin) // step))


def test_ramp_crosses_the_wrap() -> None:
    ramp = _core.Ramp((1 << 31) - 10, 100, 0, 0)
    ramp.step(1 << 16, 1)
    assert ramp.position_pq == -(1 << 31) - 10 + 99  # 99.5, rounded down


# ---- on the axis


def moving(load: float = LOAD, seconds: float = 0.25, speed: float = 4.0) -> tuple[Rig, Axis]:
    """Running at about `speed` rad/s, with plans that reach on to a rest; the load is known."""
    rig, axis = cart_rig(load=load)
    rig.sync()
    drive(rig, axis, seconds, speed)
    assert rig.state == S.RUNNING and abs(axis.v - speed) < 0.5
    return rig, axis


def drive(rig: Rig, axis: Axis, seconds: float, speed: float) -> None:
    holding = round(-axis.load * TQ)
    rig.arm(holding)
    first = rig.knot + 12
    rig.run(2000)
    position = speed_profile(round(axis.q * PQ), speed * PQ * KNOT_US * 1e-6)
    tracks = {POSITION: position, TORQUE: [holding] * len(position)}
    assert rig.give(first, tracks) == "accepted"
    end = (first << SHIFT) + seconds * 1e6
    while rig.node.system_us(rig.now) < end:
        rig.run(4 * KNOT_US)
        gone = max(0, rig.knot - first - 5)
        part = {s: p[gone : gone + 100] for s, p in tracks.items()}
        assert rig.give(first + gone, part) == "accepted"


def speed_profile(start: int, step: float) -> list[int]:
    """Up to the speed in 10 knots, some 70 at it, and down to rest, in points."""
    steps = [0.0, 0, 0, *np.linspace(0, step, 11), *[step] * 60, *np.linspace(step, 0, 21), 0, 0, 0]
    return (start + np.rint(np.cumsum(steps))).astype(int).tolist()


def follow(rig: Rig, until: State | None, within_us: int = 1_500_000) -> list[tuple[float, ...]]:
    """(state, setpoint [rad], torque track [Nm], duty, brake, power, true position, speed) each
    period."""
    rows, axis = [], rig.encoder
    assert isinstance(axis, Axis)
    end = rig.now + within_us
    while rig.state != until and rig.now < end:
        rig.period()
        point, _, torque = rig.node.setpoint(rig.node.system_us(rig.now))
        node = rig.node
        rows.append(
            (
                node.state,
                point / PQ,
                torque / TQ,
                node.duty_q15,
                node.brake,
                node.power,
                axis.q,
                axis.v,
            )
        )
    return rows


@pytest.mark.parametrize("load", [LOAD, 0.0, 1.5])
def test_tail_stops_a_loaded_axis_without_dropping_it(load: float) -> None:
    rig, axis = moving(load)
    speed, place = axis.v, axis.q
    assert rig.ask("STOP") == "DONE"
    assert rig.state == S.TAIL and rig.reason == "HOST"
    rows = follow(rig, S.HOLD)
    assert rig.state == S.HOLD
    assert not any(row[4] for row in rows) and all(row[5] for row in rows)  # no brake, power
    way = axis.q - place
    assert way == pytest.approx(speed**2 / (2 * DECELERATION), rel=0.1)
    assert min(row[7] for row in rows) > -0.4  # it does not fall back
    taken = len(rows) * PERIOD_US * 1e-6
    assert taken == pytest.approx(speed / DECELERATION, rel=0.1)
    follow(rig, None, 500_000)
    assert axis.v == pytest.approx(0, abs=0.02)
    assert axis.q == pytest.approx(place + speed**2 / (2 * DECELERATION), abs=0.01)
    assert rig.node.status.holding_tq == pytest.approx(-load * TQ, abs=0.06 * TQ)


def test_tail_begins_where_and_as_fast_as_the_axis_is() -> None:
    """Not where the track is: no jump of the setpoint against the axis, nor of the torque track."""
    rig, axis = moving()
    axis.load -= 1.5  # it falls behind its track, by less than the monitor minds
    rig.run(80_000)
    assert rig.state == S.COAST
    before = rig.node.setpoint(rig.node.system_us(rig.now))
    assert rig.ask("STOP") == "DONE"
    rig.period()
    point, rate, torque = rig.node.setpoint(0)
    assert point / PQ == pytest.approx(axis.q, abs=axis.v * PERIOD_US * 1e-6 + 1e-3)
    assert abs(point - before[0]) / PQ > 0.02
    assert rate / PQ / (KNOT_US * 1e-6) == pytest.approx(axis.v, rel=0.25)
    assert torque / TQ == pytest.approx(before[2] / TQ, abs=0.2)


def test_coast_to_hold_without_a_bump() -> None:
    """Position, torque and duty go on; the integrator takes over what is left, slowly."""
    rig, _axis = moving()
    rig.run_until(S.COAST)
    rows = follow(rig, S.HOLD)
    rows += follow(rig, None, 300_000)
    duties = [row[3] for row in rows]
    at = next(i for i, row in enumerate(rows) if row[0] == S.HOLD)
    usual = max(
        abs(a - b) for a, b in zip(duties[at - 30 : at - 1], duties[at - 29 : at], strict=True)
    )
    assert abs(duties[at] - duties[at - 1]) <= usual + 60  # of 32768
    points = [row[1] for row in rows[at - 1 :]]
    assert max(points) - min(points) <= 1e-4
    assert len({row[2] for row in rows[at - 1 :]}) == 1


def test_hold_integrates_what_the_plan_did_not_know() -> None:
    """An unknown load: HOLD brings the axis back to its place; the status tells the torque."""
    settings = cart_settings()
    settings.servo.ki_tq = _core.Scale(3000, 10)
    rig, axis = cart_rig(settings)
    rig.sync()
    drive(rig, axis, 0.1, 1.0)
    rig.run_until(S.HOLD)
    axis.load = -1.0
    rig.run(1_500_000)
    point, _, torque = rig.node.setpoint(0)
    assert rig.state == S.HOLD and torque == 0
    assert axis.q == pytest.approx(point / PQ, abs=2e-3)
    assert rig.node.torque_tq / TQ == pytest.approx(1.0, abs=0.1)
    rig.run(2 * KNOT_US)
    held = rig.statuses[-1].holding_tq
    assert held / TQ == pytest.approx(1.0, abs=0.1)
    duty = rig.node.duty_q15
    rig.arm()  # resumes: what the integrator carried is carried on
    rig.period()
    assert rig.node.setpoint(0)[2] == pytest.approx(held, abs=0.05 * TQ)
    assert rig.node.duty_q15 == pytest.approx(duty, abs=200)
    rig.run(100_000)
    assert axis.v == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("resumes", [False, True])
def test_an_axis_that_sagged_does_not_sag_again_with_each_stop(resumes: bool) -> None:
    """Without an integrator an unknown load takes it below its setpoint. A stop makes a setpoint
    of that place: what the error pulled with there becomes holding torque."""
    rig, axis = cart_rig()
    rig.sync()
    drive(rig, axis, 0.1, 1.0)
    rig.run_until(S.HOLD)
    axis.load = -1.0
    rig.run(500_000)
    sagged = axis.q
    assert rig.node.setpoint(0)[0] / PQ - sagged > 0.01
    for _ in range(4):
        if resumes:
            rig.arm()
            rig.run(50_000)
        assert rig.ask("STOP") == "DONE"
        rig.run_until(S.HOLD)
        rig.run(500_000)
        assert axis.q == pytest.approx(sagged, abs=2e-3)
    assert rig.node.status.holding_tq == pytest.approx(1.0 * TQ, abs=0.1 * TQ)


def leaves_in_order(rows: list[tuple[float, ...]]) -> int:
    """Index of the first period with the brake on; the power goes off once it has engaged."""
    on = next(i for i, row in enumerate(rows) if row[4])
    off = next(i for i, row in enumerate(rows) if not row[5])
    assert (off - on) * PERIOD_US == BRAKE_US
    assert all(row[4] for row in rows[on:]) and not any(row[5] for row in rows[off:])
    assert all(row[3] == 0 for row in rows[off:])
    return on


def test_fault_ramps_then_brakes_then_switches_off() -> None:
    rig, axis = moving()
    speed = axis.v
    rig.node.supply_V = 20.0
    rig.run_until(S.FAULT, 10_000)
    rig.node.supply_V = 48.0
    rows = follow(rig, None, 800_000)
    on = leaves_in_order(rows)
    assert rig.state == S.FAULT and rig.reason == "UNDERVOLTAGE"
    assert on * PERIOD_US * 1e-6 == pytest.approx(speed / DECELERATION, rel=0.15)
    assert abs(rows[on][7]) < 0.1
    assert abs(rows[-1][6] - rows[on][6]) < 0.01  # it did not fall while the brake engaged


@pytest.mark.parametrize("defect", [1, 3])
def test_a_bad_encoder_brakes_at_once(defect: int) -> None:
    """Stuck, jumped: the ramp could not be trusted. Only the holding torque is left meanwhile."""
    rig, _axis = moving()
    rig.node.break_encoder(defect, rig.now)
    rig.run_until(S.FAULT, 200_000)
    assert rig.node.brake and rig.node.power
    rows = follow(rig, None, 200_000)
    leaves_in_order([(0, 0, 0, 0, 1, 1, 0, 0), *rows])
    assert rig.reason == ("STUCK" if defect == 1 else "SPIKE")
    resistance = CART.motor.resistance_ohm / CART.motor.constant
    holding = -LOAD * resistance / CART.motor.supply_V * 32768
    assert [row[3] for row in rows if row[5]] == pytest.approx([holding] * 29, abs=30)


def test_a_reversed_encoder_is_braked() -> None:
    rig, _axis = moving(load=0.0)
    rig.node.break_encoder(2, rig.now)
    rig.run_until(S.FAULT, 400_000)
    rows = follow(rig, None, 300_000)
    assert rig.reason == "REVERSED"
    assert not rows[-1][5] and rows[-1][4]


def test_estop_ramps_and_an_open_line_forbids_all() -> None:
    rig, _axis = moving()
    rig.node.stop_line = True
    rig.run_until(S.ESTOP, PERIOD_US)
    rows = follow(rig, None, 800_000)
    on = leaves_in_order(rows)
    assert abs(rows[on][7]) < 0.1
    assert rig.ask("CLEAR") == "CAUSE"
    rig.node.stop_line = False
    rig.run(100_000)
    assert rig.state == S.ESTOP  # the line alone does not
    assert rig.ask("CLEAR") == "DONE"
    assert rig.state == S.UNSYNCED
    rig.run_until(S.IDLE)
    assert rig.node.brake and not rig.node.power


@pytest.mark.parametrize("event", ["line", "supply"])
def test_the_timer_does_not_wait_for_the_ramp(event: str) -> None:
    """A ramp that would take seconds: the brake comes after stop_us, wherever the ramp is."""
    settings = cart_settings()
    settings.monitor.deceleration_q16 //= 50
    settings.monitor.bounded = False
    rig, axis = cart_rig(settings, LOAD)
    rig.sync()
    drive(rig, axis, 0.25, 4.0)
    if event == "line":
        rig.node.stop_line = True
        rig.run_until(S.ESTOP, PERIOD_US)
    else:
        rig.node.supply_V = 20.0
        rig.run_until(S.FAULT, 10_000)
        rig.node.supply_V = 48.0
    begin = rig.now
    rows = follow(rig, None, 1_000_000)
    on = leaves_in_order(rows)
    assert abs(rows[on][7]) > 1.0  # still moving
    assert abs((on + 1) * PERIOD_US - STOP_US) <= 2 * PERIOD_US
    assert rig.now > begin


def test_a_line_that_opens_in_a_fault_starts_no_new_timer() -> None:
    settings = cart_settings()
    settings.monitor.deceleration_q16 //= 50
    settings.monitor.bounded = False
    rig, axis = cart_rig(settings)
    rig.sync()
    drive(rig, axis, 0.25, 4.0)
    rig.node.supply_V = 20.0
    rig.run_until(S.FAULT, 10_000)
    begin, rig.node.supply_V = rig.now, 48.0
    rig.run(STOP_US // 2)
    rig.node.stop_line = True
    rig.run_until(S.ESTOP, PERIOD_US)
    while not rig.node.brake:
        rig.poll()
    assert abs(rig.now - begin - STOP_US) <= 2 * PERIOD_US


@pytest.mark.parametrize("stop", ["sync", "command"])
def test_a_braked_axis_that_is_stopped_stays_braked(stop: str) -> None:
    """Armed with no torque under a load that it would fall by: nobody has said it could hold it."""
    rig, axis = cart_rig(load=LOAD)
    rig.sync().arm(0)
    if stop == "sync":
        rig.syncing = False
        rig.run(CONFIG.device.sync_lost_us + 100_000)
        rig.syncing = True
    else:
        assert rig.ask("STOP") == "DONE"
    rig.run_until(S.HOLD)
    rig.run(300_000)
    assert rig.node.brake and axis.q == 0
    rig.arm()
    first = rig.knot + 16
    holding = round(-LOAD * TQ)
    assert rig.give(first, {POSITION: [0] * 60, TORQUE: [holding] * 60}) == "accepted"
    rig.run_to_knot(first + 20)
    assert not rig.node.brake and abs(axis.q) < 0.02


def test_disarm_brakes_before_the_power_goes() -> None:
    rig, axis = moving()
    rig.run_until(S.HOLD)
    rig.run(100_000)
    place = axis.q
    assert rig.ask("DISARM") == "DONE"
    assert rig.state == S.IDLE and rig.node.power
    rows = follow(rig, None, 100_000)
    leaves_in_order(rows)
    assert axis.q == pytest.approx(place, abs=0.005)


def test_rearmed_while_the_brake_engages() -> None:
    """The power has not been off yet: it stays on, with the new torque, the brake on."""
    rig, _axis = moving()
    rig.run_until(S.HOLD)
    assert rig.ask("DISARM") == "DONE"
    rig.run(10_000)
    assert rig.node.power and rig.node.brake
    rig.arm(round(-LOAD * TQ))
    rig.run(200_000)
    assert rig.state == S.ARMED and rig.node.power and rig.node.brake


def test_stops_right_after_arming_start_with_the_armed_torque() -> None:
    """Not with that of an earlier run, which the slewing would begin from."""
    rig, axis = moving()  # with a holding torque
    rig.run_until(S.HOLD)
    assert rig.ask("DISARM") == "DONE"
    rig.run(100_000)
    axis.load = 0.0
    rig.arm(0)
    rig.node.stop_line = False
    assert rig.ask("STOP") == "DONE"
    rig.poll()
    rig.period()
    assert rig.node.setpoint(0)[2] == 0
    assert rig.state in (S.TAIL, S.HOLD)
    assert rig.now % POLL_US == 0


def test_without_a_torque_track_the_armed_torque_stays() -> None:
    rig, _axis = cart_rig(load=LOAD)
    holding = round(-LOAD * TQ)
    rig.sync().arm(holding)
    first = rig.knot + 12
    points = [0] * 3 + [min(i, 20) * 2000 for i in range(30)]
    assert rig.give(first, {POSITION: points}) == "accepted"
    rig.run_to_knot(first + 10)
    assert rig.ask("STOP") == "DONE"
    rig.run_until(S.HOLD)
    assert rig.node.setpoint(0)[2] == holding


@pytest.mark.parametrize("reason", ["FOLLOWING", "TORQUE"])
def test_a_ramp_that_the_axis_does_not_follow_ends_with_the_brake(reason: str) -> None:
    settings = cart_settings()
    settings.monitor.stuck_pq = settings.monitor.stuck_periods = 1 << 30
    if reason == "TORQUE":
        settings.monitor.torque_periods = 5
    rig, axis = cart_rig(settings)
    rig.sync()
    drive(rig, axis, 0.2, 7.0)
    assert rig.ask("STOP") == "DONE"
    axis.wall = axis.q + 0.01
    rig.run_until(S.FAULT)
    assert rig.reason == reason and rig.node.status.fault.state == S.TAIL
    rig.run(STOP_US + BRAKE_US + 10_000)
    assert rig.node.brake and not rig.node.power


def test_past_its_last_limit_an_axis_is_braked_at_once() -> None:
    """A ramp that it cannot follow has carried it out: no ramp gets another try there."""
    settings = cart_settings()
    monitor = settings.monitor
    monitor.high_pq = round(0.5 * PQ)
    monitor.deceleration_q16 *= 20  # more than the motor has: told too late that there is no room
    monitor.following_periods = 60_000
    settings.monitor = monitor
    rig, axis = cart_rig(settings)
    rig.sync()
    drive(rig, axis, 0.01, 4.0)  # the plan goes on to beyond
    rig.run_until(S.TAIL)
    assert rig.reason == "ROOM" and axis.q < 0.5
    rig.run_until(S.FAULT)
    assert rig.reason == "OUTSIDE" and axis.v > 3
    assert rig.node.brake and rig.node.power  # the motor helps until the brake has engaged
    rig.run(300_000)
    assert not rig.node.power and axis.v == 0
    assert axis.q < 0.6


@pytest.mark.parametrize("off", [-40, -3, 3, 40])
def test_a_load_that_hangs_below_its_setpoint_is_not_a_stuck_encoder(off: int) -> None:
    """Held without an integrator it rests off it, by more than a stuck axis would: to begin to hold
    and to take plans again is no motion of the setpoint."""
    settings = device_settings()
    settings.monitor.stuck_pq = 2 << 10
    rig = Rig(settings=settings)
    rig.sync()
    first = rig.start(40)
    rig.run_to_knot(first + 2)
    begin, step = rig.now, off // abs(off)  # it sinks by a count in a period
    rig.encoder = lambda now: step * min(abs(off), (now - begin) // PERIOD_US)
    rig.run_until(S.HOLD)
    rig.run(200_000)
    assert rig.state == S.HOLD
    rig.epoch += 1
    assert rig.ask("RESUME", epoch=rig.epoch) == "DONE"
    rig.run(200_000)
    assert rig.state == S.ARMED, rig.reason


def pushed_by_its_torque_track(share: float, stuck: bool) -> tuple[Rig, Axis]:
    """The position track rests; the torque track does not. Half a second of it."""
    rig, axis = cart_rig()
    rig.sync()
    rig.arm(0)
    push = [0] * 6 + [round(share * CART.effort_limit * TQ)] * 80
    assert rig.give(rig.knot + 12, {POSITION: [0] * len(push), TORQUE: push}) == "accepted"
    if stuck:
        rig.node.break_encoder(1, rig.now)
    rig.run(500_000)
    return rig, axis


@pytest.mark.parametrize("share", [0.55, 0.99, -0.99])
def test_a_stuck_encoder_is_found_by_any_torque(share: float) -> None:
    """Also by one that the gains know nothing of."""
    rig, axis = pushed_by_its_torque_track(share, stuck=True)
    assert rig.state == S.FAULT and rig.reason == "STUCK"
    assert rig.node.brake and abs(axis.q) < 4.0


@pytest.mark.parametrize("torque", [-0.9, 0.9])
def test_a_load_in_the_brake_is_no_stuck_encoder(torque: float) -> None:
    """Armed with nearly all of its torque the axis stands in its brake, as it should."""
    rig, axis = cart_rig(load=-torque * CART.effort_limit)
    rig.sync()
    rig.arm(round(torque * CART.effort_limit * TQ))
    rig.run(400_000)
    assert rig.state == S.ARMED and rig.node.brake and axis.v == 0


def test_why_it_stopped_outlives_a_reset_while_it_holds() -> None:
    rig, _axis = moving()
    assert rig.ask("STOP") == "DONE"
    rig.run_until(S.HOLD)
    assert rig.node.power
    rig.node.restart()
    logs = [rig.node.memory(_board.RECORD_FAULTS_A + place) for place in (0, 1)]
    faults = [_core.faults_decode(log[4:-4]) for log in logs if log]
    reasons = {_core.REASONS[f.reason] for log in faults if log for f in log}
    assert reasons == {"HOST"}
