"""What a host may ask of a device besides plans: in every state, once, and with what result."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rig import (
    BRAKE_PERIODS,
    COUNT_PQ,
    MAKE,
    PERIOD_US,
    POSITION,
    SYNC_LOST_US,
    TORQUE,
    Rig,
    State,
    device_settings,
    emergency,
    faulty,
    holding,
    home_settings,
    synced_rig,
)

from headway.firmware import _core

S = State

# What each command answers in each state; a state that is not named answers NOT_NOW.
ANSWERS: dict[str, dict[State, str]] = {
    "ARM": {S.IDLE: "DONE"},
    "DISARM": {S.ARMED: "DONE", S.HOLD: "DONE"},
    "RESUME": {S.HOLD: "DONE"},
    "STOP": {s: "DONE" for s in (S.ARMED, S.RUNNING, S.COAST, S.HOLD)},
    "CLEAR": {S.FAULT: "DONE", S.ESTOP: "DONE"},
    "HOME": {S.ARMED: "BAD"},  # these settings have no homing
    "JOG": {S.ARMED: "DONE"},
    "ZERO": {S.UNSYNCED: "DONE", S.IDLE: "DONE"},
}
LEADS = {"ARM": S.ARMED, "RESUME": S.ARMED, "STOP": S.TAIL, "CLEAR": S.UNSYNCED}


@pytest.mark.parametrize("state", [s for s in S if s != S.BOOT])
@pytest.mark.parametrize("command", ANSWERS)
def test_every_command_in_every_state(state: State, command: str) -> None:
    rig = MAKE[state]()
    answer = rig.ask(command, epoch=9)
    assert answer == ANSWERS[command].get(state, "NOT_NOW")
    if command == "DISARM" and answer == "DONE":
        assert rig.state == S.IDLE
    else:
        assert rig.state == (LEADS.get(command, state) if answer == "DONE" else state)


@pytest.mark.parametrize("kind", [len(_core.COMMANDS), 100, 255])
def test_no_such_command(kind: int) -> None:
    rig = synced_rig()
    rig.node.deliver(rig.now, rig.host.seal(_core.FRAME_COMMAND, _core.command_encode(1, kind)))
    rig.node.poll(rig.now, 0)
    assert _core.COMMAND_RESULTS[rig.node.status.command_result] == "BAD"
    assert rig.node.status.frames_bad == 0


u32 = st.integers(0, 2**32 - 1)


@given(u32, st.integers(0, 255), st.integers(-(1 << 31), (1 << 31) - 1), st.integers(0, 65535))
def test_payload(number: int, kind: int, argument: int, epoch: int) -> None:
    """number u32, command u8, argument i32, epoch u16."""
    payload = _core.command_encode(number, kind, argument, epoch)
    laid_out = number.to_bytes(4, "little") + bytes([kind])
    laid_out += argument.to_bytes(4, "little", signed=True) + epoch.to_bytes(2, "little")
    assert payload == laid_out
    assert _core.command_decode(payload) == (number, kind, argument, epoch)
    for bad in (payload[:-1], payload + b"\0", b""):
        assert _core.command_decode(bad) is None


def test_malformed_commands_are_bad_frames() -> None:
    rig = synced_rig()
    for payload in (b"", bytes(10), bytes(12)):
        bad = rig.node.status.frames_bad
        rig.node.deliver(rig.now, rig.host.seal(_core.FRAME_COMMAND, payload))
        rig.node.poll(rig.now, 0)
        assert rig.node.status.frames_bad == bad + 1
    assert rig.node.status.command_number == 0


def test_a_number_is_carried_out_once() -> None:
    rig = synced_rig()
    assert rig.ask("ARM", epoch=1, number=5) == "DONE"
    for number in (5, 4, 0):
        assert rig.ask("DISARM", number=number) == "DONE"  # the answer to number 5, again
        assert rig.state == S.ARMED and rig.node.status.command_number == 5
    assert rig.ask("HOME", number=6) == "BAD"
    assert rig.ask("DISARM", number=2**32 - 1) == "DONE"
    assert rig.state == S.IDLE
    assert rig.ask("ARM", epoch=2, number=7) == "DONE"  # no number comes after the largest
    assert rig.state == S.IDLE
    rig.node.restart()
    assert rig.node.status.command_number == 0


def test_the_status_tells_number_and_result() -> None:
    rig = synced_rig()
    rig.ask("RESUME", epoch=4, number=12)
    rig.run(10_000)
    status = rig.statuses[-1]
    assert (status.command_number, _core.COMMAND_RESULTS[status.command_result]) == (12, "NOT_NOW")
    assert status.epoch == 0


# ---- arm


@pytest.mark.parametrize("sign", [-1, 1])
def test_armed_with_the_torque_that_it_is_told(sign: int) -> None:
    limit = device_settings().servo.torque_limit_tq
    assert synced_rig().ask("ARM", sign * (limit + 1), epoch=1) == "BAD"
    rig = synced_rig()
    assert rig.ask("ARM", sign * limit, epoch=1) == "DONE"
    assert rig.node.brake
    rig.period()
    assert rig.node.power and rig.node.brake
    assert rig.node.torque_tq == sign * limit
    assert rig.node.duty_q15 == (sign * limit) >> 10
    rig.run(8000)
    assert rig.statuses[-1].holding_tq == sign * limit


@pytest.mark.parametrize("least", [-(1 << 31), (1 << 31) - 1])
def test_arguments_from_another_world(least: int) -> None:
    rig = synced_rig()
    assert rig.ask("ARM", least, epoch=1) == "BAD"
    assert rig.ask("ZERO", least) == "BAD"
    rig.arm()
    assert rig.ask("JOG", least) == "DONE"


def test_not_armed_while_it_moves() -> None:
    """A count per servo period is motion; the low-pass on the speed has to settle."""
    rig = synced_rig()
    begin = rig.now
    rig.encoder = lambda now: (now - begin) // 500
    rig.run(100_000)
    assert rig.ask("ARM", epoch=1) == "MOVING"
    end = rig.encoder(rig.now)
    rig.encoder = lambda now: end
    rig.run(100_000)
    assert rig.ask("ARM", epoch=1) == "DONE"


def test_not_armed_with_the_line_open() -> None:
    rig = synced_rig()
    rig.node.stop_line = True  # the servo has not seen it yet
    assert rig.ask("ARM", epoch=1) == "NOT_NOW"
    assert rig.state == S.IDLE
    rig.period()
    assert rig.state == S.ESTOP


# ---- epochs


def test_plans_of_another_epoch_are_refused() -> None:
    rig = synced_rig().arm()
    tracks = {POSITION: [0] * 30, TORQUE: [0] * 30}
    for epoch in (0, 2, 65535):
        assert rig.give(rig.knot + 4, tracks, epoch=epoch) == "epoch"
        assert rig.state == S.ARMED
    first = rig.knot + 4
    assert rig.give(first, tracks, epoch=1) == "accepted"
    assert rig.give(first, tracks, epoch=0) == "epoch"
    rig.run_until(S.COAST)
    assert rig.give(first, tracks, epoch=0) == "epoch"
    rig.run_until(S.HOLD)
    assert rig.ask("RESUME", epoch=1) == "BAD"  # plans from before may still be on their way
    assert rig.state == S.HOLD
    assert rig.ask("RESUME", epoch=2) == "DONE"
    assert rig.give(rig.knot + 4, tracks, epoch=1) == "epoch"
    assert rig.give(rig.knot + 4, tracks, epoch=2) == "accepted"


def test_an_epoch_begins_with_a_clean_slate() -> None:
    rig = synced_rig().arm()
    rig.ask("STOP")
    rig.run_until(S.HOLD)
    assert rig.reason == "HOST"
    assert rig.ask("DISARM") == "DONE"
    rig.run(50_000)
    assert rig.reason == "HOST"  # till it is armed again
    assert rig.ask("ARM", epoch=1) == "BAD"
    rig.arm()
    assert rig.reason == "NONE" and rig.node.status.epoch == 2


# ---- resume


def test_resume_waits_for_a_plan_from_where_the_axis_is() -> None:
    rig = holding()
    rig.encoder = lambda now: 300  # pushed aside, while holding
    rig.run(10_000)
    rig.arm()
    assert not rig.node.brake and rig.node.power
    tracks = {POSITION: [0] * 30, TORQUE: [0] * 30}
    assert rig.give(rig.knot + 4, tracks) == "start"
    tracks[POSITION] = [300 * COUNT_PQ] * 30
    first = rig.knot + 4
    assert rig.give(first, tracks) == "accepted"
    rig.run_to_knot(first + 1)
    assert rig.state == S.RUNNING and not rig.node.brake


# ---- disarm


@pytest.mark.parametrize("state", [S.ARMED, S.HOLD])
def test_disarm_brakes_first(state: State) -> None:
    rig = MAKE[state]()
    braked = rig.node.brake
    assert rig.ask("DISARM") == "DONE"
    rig.period()
    assert rig.node.brake
    for _ in range(0 if braked else BRAKE_PERIODS):  # it may be on already
        assert rig.node.power
        rig.period()
    assert not rig.node.power and rig.node.duty_q15 == 0


def test_a_task_has_to_end_before_the_disarming() -> None:
    rig = synced_rig().arm()
    assert rig.ask("JOG", 1 << 16) == "DONE"
    assert rig.ask("DISARM") == "MOVING"
    assert rig.ask("JOG", 0) == "DONE"
    rig.run(200_000)
    assert rig.ask("DISARM") == "DONE"


# ---- clear


def test_clear_waits_for_the_brake_and_for_rest() -> None:
    rig = holding()
    rig.node.stop_line = True
    rig.period()
    rig.node.stop_line = False
    while rig.node.power:
        assert rig.ask("CLEAR") == "MOVING"
        rig.period()
    begin = rig.now
    rig.encoder = lambda now: (now - begin) // 500
    rig.run(50_000)
    assert rig.ask("CLEAR") == "MOVING"
    rig.encoder = lambda now: 100
    rig.run(100_000)
    assert rig.ask("CLEAR") == "DONE"


@pytest.mark.parametrize("volts", [15.9, 30.1])
def test_clear_waits_for_the_supply(volts: float) -> None:
    rig = faulty()
    rig.node.supply_V = volts
    assert rig.ask("CLEAR") == "CAUSE"
    rig.node.supply_V = 24.0
    assert rig.ask("CLEAR") == "DONE"


def test_clear_waits_for_the_line() -> None:
    rig = faulty()
    rig.node.stop_line = True
    assert rig.ask("CLEAR") == "CAUSE"
    rig.period()
    assert rig.state == S.ESTOP
    assert rig.ask("CLEAR") == "CAUSE"
    rig.node.stop_line = False
    rig.period()
    assert rig.state == S.ESTOP
    assert rig.ask("CLEAR") == "DONE"


@pytest.mark.parametrize("kind", ["overload", "winding"])
def test_clear_waits_for_the_motor_to_cool(kind: str) -> None:
    settings = device_settings()
    settings.monitor.load_q8 = _core.Scale(1, 10)  # 2^18 tq for ever
    settings.monitor.overload = 3000 if kind == "overload" else 1 << 31
    settings.monitor.heating_q16 = 2000
    settings.monitor.rise_q16 = 1 << 30 if kind == "overload" else 72_090
    rig = Rig(settings=settings).sync().arm(1 << 19)  # twice that
    rig.run_until(S.FAULT, 5_000_000)
    assert rig.reason == {"overload": "I2T", "winding": "WINDING"}[kind]
    while rig.node.power:
        rig.period()
    rig.run(10_000)
    begin = rig.now
    assert rig.ask("CLEAR") == "CAUSE"
    while rig.ask("CLEAR") != "DONE":
        rig.period()
        assert rig.now - begin < 5_000_000
    if kind == "overload":  # half the allowance, at one a period
        assert rig.now - begin == pytest.approx(1_500_000, rel=0.05)
    else:
        assert rig.now - begin > 500_000


def test_after_a_clear_the_clock_settles_anew() -> None:
    """It ran alone during the fault: what has piled up is stepped away, not slewed from IDLE on."""
    rig = Rig()
    rig.node.flash(rig.settings, 0, 50_000)  # 50 ppm fast
    rig.sync()
    rig.node.stop_line = True
    rig.period()
    rig.syncing = False
    rig.run(60_000_000 // 4)  # 750 us by now
    rig.node.stop_line = False
    rig.syncing = True
    assert abs(rig.node.system_us(rig.now) - rig.host_us) > 400
    assert rig.ask("CLEAR") == "DONE"
    rig.run(50_000)
    assert rig.state == S.UNSYNCED
    rig.run_until(S.IDLE)
    assert abs(rig.node.system_us(rig.now) - rig.host_us) <= 200


# ---- zero


@given(st.integers(-(1 << 20) + 1, (1 << 20) - 1), st.integers(-5000, 5000))
def test_zero_says_where_the_axis_is(position: int, count: int) -> None:
    rig = synced_rig()
    rig.encoder = lambda now: count
    rig.run(100_000)
    assert rig.ask("ZERO", position) == "DONE"
    rig.run(10_000)
    assert rig.statuses[-1].samples[-1][1] == position
    assert rig.statuses[-1].homed
    rig.arm()
    assert rig.give(rig.knot + 4, {POSITION: [position * COUNT_PQ] * 4}) == (
        "accepted" if abs(position) <= 1 << 18 else "range"
    )


@pytest.mark.parametrize("sign", [-1, 1])
def test_zero_within_the_range_of_positions(sign: int) -> None:
    assert synced_rig().ask("ZERO", sign * (1 << 20)) == "BAD"
    settings = device_settings()
    settings.set_limits(POSITION, _core.GateLimits(0, 0, 1 << 20, 1 << 18, 0, True))
    rig = Rig(settings=settings).sync()
    assert rig.ask("ZERO", sign * (1 << 21) + (sign > 0) * -1) == "DONE"  # one turn of the numbers
    assert rig.ask("ZERO", sign * (1 << 21) + sign) == "BAD"


def test_zero_at_rest_and_off_only() -> None:
    rig = synced_rig()
    begin = rig.now
    rig.encoder = lambda now: (now - begin) // 500
    rig.run(100_000)
    assert rig.ask("ZERO", 5) == "MOVING"
    rig = MAKE[S.HOLD]()
    assert rig.ask("DISARM") == "DONE"
    assert rig.ask("ZERO", 5) == "MOVING"  # the brake is engaging, the servo still holds
    rig.run((BRAKE_PERIODS + 2) * PERIOD_US)
    assert rig.ask("ZERO", 5) == "DONE"


# ---- jog


def jogging(speed_q16: int, acceleration_q16: int = 1 << 16) -> Rig:
    settings = device_settings()
    settings.home.acceleration_q16 = acceleration_q16
    rig = Rig(settings=settings)
    rig.sync().arm(1000)
    assert rig.ask("JOG", speed_q16) == "DONE"
    return rig


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(("asked", "given"), [(10, 10), (40, 40), (41, 40), (30_000, 40)])
def test_jog_moves_no_faster_than_allowed(sign: int, asked: int, given: int) -> None:
    """The setpoint starts once the brake is off, speeds up by 1 pq a period, stops like that."""
    rig = jogging(sign * asked << 16)
    assert rig.node.setpoint(0)[0] == 0
    points, braked = [], []
    for _ in range(200):
        rig.period()
        points.append(rig.node.setpoint(0)[0])
        braked.append(not rig.node.status.released)
        assert rig.state == S.ARMED
    begin = braked.index(False)
    assert begin == BRAKE_PERIODS and set(points[:begin]) == {0}
    steps = [abs(b - a) for a, b in itertools.pairwise(points)]
    assert max(steps) == given and steps[-1] == given
    assert max(abs(b - a) for a, b in itertools.pairwise(steps)) <= 1
    assert points[-1] * sign > 0
    assert rig.ask("JOG", 0) == "DONE"
    rig.run(60 * PERIOD_US)
    rest = rig.node.setpoint(0)
    rig.run(60 * PERIOD_US)
    assert rig.node.setpoint(0) == rest and rest[1] == 0
    assert rig.ask("DISARM") == "DONE"  # the task is over


def test_jog_may_turn_round() -> None:
    rig = jogging(40 << 16)
    rig.run(100 * PERIOD_US)
    high = rig.node.setpoint(0)[0]
    assert rig.ask("JOG", -40 << 16) == "DONE"
    rig.run(300 * PERIOD_US)
    assert rig.node.setpoint(0)[0] < high - 40 * 150
    assert rig.ask("HOME") == "BAD"


def test_jog_pushes_no_harder_than_allowed() -> None:
    """Blocked: beyond the holding torque there is the task's torque and no more."""
    rig = jogging(40 << 16)
    limit = home_settings().torque_tq
    rig.encoder = lambda now: -10_000
    rig.run(10 * PERIOD_US)
    assert rig.node.torque_tq == 1000 + limit


def test_no_plan_during_a_task() -> None:
    rig = jogging(1 << 16)
    tracks = {POSITION: [0] * 30, TORQUE: [0] * 30}
    assert rig.give(rig.knot + 4, tracks) == "state"
    assert rig.ask("JOG", 0) == "DONE"
    rig.run(10 * PERIOD_US)
    assert rig.give(rig.knot + 4, tracks) == "accepted"


def test_a_jog_without_a_host_stops() -> None:
    rig = jogging(40 << 16)
    rig.run(100_000)
    rig.syncing = False
    rig.run_until(S.TAIL, SYNC_LOST_US + 10_000)
    assert rig.reason == "SYNC_LOST"
    rig.run_until(S.HOLD)
    rest = rig.node.setpoint(0)
    rig.run(20_000)
    assert rig.node.setpoint(0) == rest


# ---- faults


def test_the_fault_log_tells_the_last_eight() -> None:
    """Oldest first, with frozen numbers; asked again, it answers again."""
    rig = synced_rig()
    begin = rig.now
    for i in range(10):
        rig.arm(100 * i)
        rig.period()
        assert rig.ask("STOP") == "DONE"
        rig.run_until(S.HOLD)
        assert rig.ask("DISARM") == "DONE"
        rig.run(20_000)
    for _ in range(2):
        rig.faults = None
        assert rig.ask("FAULTS", number=1000) == "DONE"
        rig.run(10_000)
        assert rig.faults is not None and len(rig.faults) == 8
        assert [f.torque_tq for f in rig.faults] == [100 * i for i in range(2, 10)]
    assert {_core.REASONS[f.reason] for f in rig.faults} == {"HOST"}
    assert {f.state for f in rig.faults} == {S.ARMED}
    times = [f.time_us for f in rig.faults]
    assert times == sorted(times) and times[0] > rig.epoch_us + begin
    assert len({f.boots for f in rig.faults}) == 1
    rig.restart()
    rig.sync().arm(-77)
    assert rig.ask("STOP") == "DONE"
    rig.run(20_000)
    assert rig.ask("FAULTS") == "DONE"
    rig.run(10_000)
    assert [f.torque_tq for f in rig.faults] == [*(100 * i for i in range(3, 10)), 0]
    boots = [f.boots for f in rig.faults]
    assert boots[-1] == boots[0] + 1 and len(set(boots)) == 2
    emergency()


def test_the_log_is_empty_at_first() -> None:
    rig = synced_rig()
    rig.ask("FAULTS")
    rig.run(10_000)
    assert rig.faults == []
    assert _core.faults_decode(b"") is None
    assert _core.faults_decode(bytes(4 + 8 * 30 + 1)) is None
    assert _core.faults_decode(bytes(4 + 8 * 30)) == []
