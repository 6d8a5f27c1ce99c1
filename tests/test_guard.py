"""The guard: an axis whose main loop hangs, or whose stop takes too long, is braked by a timer."""

import numpy as np
import pytest
from rig import CONFIG, PERIOD_US, POLL_US, TORQUE, Axis, Rig, State, cart_rig, cart_settings
from test_stops import LOAD, drive, moving

from headway.firmware import _core

S = State
BRAKE_US, STOP_US = CONFIG.device.brake_us, CONFIG.device.stop_us
LATE_US = 4 * PERIOD_US  # as the axes are flashed
NEVER_US = 1 << 30  # of lateness: what is left to judge is the stop


def hang(rig: Rig, us: int) -> list[tuple[bool, bool, bool, int]]:
    """The main loop stands still; (tripped, power, brake, duty) after each call of the guard."""
    rig.node.hung = True
    rows = []
    for _ in range(us // POLL_US):
        rig.poll()
        node = rig.node
        rows.append((node.tripped, node.power, node.brake, node.duty_q15))
    return rows


def recover(rig: Rig) -> None:
    """To the first servo period after a hang."""
    rig.node.hung = False
    rig.period()


def slow(load: float = 0.0, late_us: int = NEVER_US) -> tuple[Rig, Axis]:
    """Moving, with a ramp that takes seconds and a servo that may be as late as it likes."""
    settings = cart_settings()
    settings.monitor.deceleration_q16 //= 50
    settings.monitor.bounded = False
    settings.monitor.late_us = late_us
    rig, axis = cart_rig(settings, load)
    rig.sync()
    drive(rig, axis, 0.25, 4.0)
    assert rig.state == S.RUNNING
    return rig, axis


def first(rows: list[tuple[bool, bool, bool, int]], wanted: tuple[int, bool]) -> int:
    """Time of the first row with a value at a place [us after the hang began]."""
    at, value = wanted
    return (1 + next(i for i, row in enumerate(rows) if bool(row[at]) == value)) * POLL_US


@pytest.mark.parametrize("load", [LOAD, 0.0, 1.5])
def test_a_hung_axis_is_braked_in_time(load: float) -> None:
    rig, axis = moving(load)
    assert rig.node.duty_q15 != 0 and not rig.node.brake
    rows = hang(rig, 200_000)
    tripped = first(rows, (0, True))
    assert LATE_US < tripped <= LATE_US + PERIOD_US + 2 * POLL_US
    for trip, power, brake, duty in rows[: tripped // POLL_US - 1]:
        assert not trip and power and not brake and duty != 0  # till then nothing has changed
    for trip, _, brake, duty in rows[tripped // POLL_US - 1 :]:
        assert trip and brake and duty == 0
    assert first(rows, (1, False)) == tripped + BRAKE_US
    assert not any(row[1] for row in rows[(tripped + BRAKE_US) // POLL_US :])
    assert axis.v == 0


def test_the_shorted_motor_brakes_while_the_brake_engages() -> None:
    """By its back-EMF alone it loses speed; a motor whose bridge is off would not."""
    rig, axis = moving(load=0.0)
    hang(rig, LATE_US + 2 * PERIOD_US)
    before = axis.v
    assert rig.node.tripped and rig.node.power
    rig.run(5_000)
    time_constant_s = axis.inertia * axis.resistance / axis.constant**2
    expected = before * np.exp(-5e-3 / time_constant_s)
    assert 0 < axis.v < 0.98 * before
    assert axis.v == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("for_us", [7_000, 20_000, 45_000, 400_000])
def test_the_log_says_that_the_servo_was_late(for_us: int) -> None:
    """While the brake engages, and long after: it stays braked, and the host is told why."""
    rig, axis = moving()
    hang(rig, for_us)
    assert rig.state == S.RUNNING and rig.node.tripped
    recover(rig)
    fault = rig.node.status.fault
    assert rig.state == S.FAULT and rig.reason == "LATE" and fault.state == S.RUNNING
    assert fault.limit == LATE_US and abs(fault.value - for_us) <= PERIOD_US
    for _ in range(800):
        rig.poll()
        assert rig.node.brake and rig.node.duty_q15 == 0 and rig.node.tripped
    assert not rig.node.power and axis.v == 0
    assert rig.ask("FAULTS") == "DONE"
    rig.run(20_000)
    assert rig.faults is not None
    newest = max(rig.faults, key=lambda fault: fault.time_us)
    assert newest.reason == _core.REASONS.index("LATE") and newest.value == fault.value


def test_a_pause_that_is_allowed_trips_nothing() -> None:
    rig, _ = moving()
    rows = hang(rig, LATE_US - PERIOD_US)
    recover(rig)
    rig.run(20_000)
    assert not any(row[0] for row in rows) and not rig.node.tripped
    assert rig.state in (S.RUNNING, S.COAST) and not rig.node.brake


def test_what_is_off_stays_off_while_nothing_runs() -> None:
    """No latch: there is nothing to stop, and memory may be written for long."""
    rig, _ = cart_rig()
    rig.sync()
    assert not any(row[0] or row[1] or not row[2] for row in hang(rig, 300_000))
    recover(rig)
    assert not rig.node.tripped and rig.state != S.FAULT


def test_only_clear_releases_and_only_as_ever() -> None:
    rig, axis = moving()
    hang(rig, 12_000)
    recover(rig)
    assert rig.node.power and rig.ask("CLEAR") == "MOVING"
    rig.run(100_000)
    rig.node.stop_line = True
    rig.run_until(S.ESTOP, PERIOD_US)
    assert rig.ask("CLEAR") == "CAUSE" and rig.node.tripped
    rig.node.stop_line = False
    rig.run(100_000)
    assert rig.node.tripped
    assert rig.ask("CLEAR") == "DONE" and not rig.node.tripped
    rig.run_until(S.IDLE)
    drive(rig, axis, 0.25, 4.0)
    assert rig.state == S.RUNNING and not rig.node.tripped and axis.v > 3


def test_a_restart_releases() -> None:
    rig, _ = moving()
    hang(rig, 20_000)
    rig.restart()
    assert not rig.node.hung and not rig.node.tripped
    assert rig.node.brake and not rig.node.power and rig.state == S.BOOT
    rig.sync()


def test_a_held_load_does_not_fall_far() -> None:
    """Held by its torque alone, the brake off; then the shorted windings, then the brake."""
    rig, axis = moving()
    rig.run_until(S.HOLD)
    rig.run(300_000)
    place = axis.q
    hang(rig, 500_000)
    fallen = 0.5 * abs(LOAD) / axis.inertia * (BRAKE_US * 1e-6) ** 2  # if nothing held it
    assert abs(axis.q - place) < fallen and axis.v == 0
    recover(rig)
    place = axis.q
    rig.run(500_000)
    assert rig.reason == "LATE" and axis.q == place


@pytest.mark.parametrize("event", ["line", "supply", "encoder"])
def test_a_stop_that_hangs_is_ended_by_the_guard(event: str) -> None:
    """In its ramp, or while its brake engages, by its servo's time: no later than any other."""
    rig, axis = slow(late_us=LATE_US)
    if event == "line":
        rig.node.stop_line = True
    elif event == "supply":
        rig.node.supply_V = 20.0
    else:
        rig.node.break_encoder(3, rig.now)
    while rig.state < S.FAULT:
        rig.poll()
    rows = hang(rig, 100_000)
    assert first(rows, (0, True)) <= LATE_US + PERIOD_US + 2 * POLL_US
    assert rows[-1] == (True, False, True, 0) and axis.v == 0


@pytest.mark.parametrize("event", ["line", "supply"])
def test_a_stop_that_takes_too_long_is_ended_by_the_guard(event: str) -> None:
    """Whatever the servo says of itself: by the count at the stop."""
    rig, _ = slow()
    if event == "line":
        rig.node.stop_line = True
    else:
        rig.node.supply_V = 20.0
    while rig.state < S.FAULT:
        rig.poll()
    rig.node.stop_line = False
    limit_us = STOP_US + BRAKE_US + 2 * PERIOD_US
    rows = hang(rig, limit_us + 100_000)
    # `stop_count_us` is the last period's before the stop, or the one that saw the line.
    assert limit_us - 2 * PERIOD_US <= first(rows, (0, True)) <= limit_us + 2 * POLL_US
    assert rows[-1] == (True, False, True, 0)


def test_the_line_is_obeyed_by_a_device_that_does_not_look() -> None:
    """It hangs before it sees the line, and its servo's time is not judged: the line is."""
    settings = cart_settings()
    settings.monitor.late_us = NEVER_US
    rig, _ = cart_rig(settings)
    rig.sync().arm()
    rig.node.hung = True
    rig.node.stop_line = True
    limit_us = STOP_US + BRAKE_US + 3 * PERIOD_US
    rows = hang(rig, limit_us + 100_000)
    assert abs(first(rows, (0, True)) - limit_us) <= 2 * POLL_US
    assert rows[-1] == (True, False, True, 0) and rig.state == S.ARMED
    rig.node.stop_line = False
    recover(rig)  # and does not believe that it is late
    assert rig.state == S.FAULT and rig.reason == "LATE"
    fault = rig.node.status.fault
    assert fault.limit == limit_us and 0 < fault.value - limit_us <= POLL_US
    assert not rig.node.power and rig.node.brake


def test_a_line_that_closes_again_starts_the_time_anew() -> None:
    rig, _ = slow()
    rig.node.hung = True
    for _ in range(2):
        rig.node.stop_line = True
        hang(rig, STOP_US)
        rig.node.stop_line = False
        hang(rig, PERIOD_US)
    assert not rig.node.tripped


@pytest.mark.parametrize("event", ["line", "supply"])
def test_a_stop_that_keeps_its_time_does_not_trip(event: str) -> None:
    """The longest one there is: the timer ends the ramp. The guard is there for other cases."""
    rig, _ = slow(LOAD, late_us=LATE_US)
    if event == "line":
        rig.node.stop_line = True
    else:
        rig.node.supply_V = 20.0
    for _ in range((STOP_US + BRAKE_US + 100_000) // POLL_US):
        rig.poll()
        assert not rig.node.tripped
    assert rig.node.brake and not rig.node.power


def test_a_hang_at_any_phase_ends_the_same() -> None:
    """From UNSYNCED to HOLD and on: never is the output left on with a duty."""
    for after in range(0, 1200, 90):
        rig, axis = cart_rig()
        rig.sync()
        rig.arm()
        first_knot = rig.knot + 12
        points = [0] * 3 + [min(i, 60) * 4000 for i in range(90)]
        assert rig.give(first_knot, {0: points, TORQUE: [0] * len(points)}) == "accepted"
        for _ in range(after):
            rig.poll()
        rows = hang(rig, LATE_US + PERIOD_US + BRAKE_US + 4 * POLL_US)
        assert rows[-1] == (True, False, True, 0)
        assert axis.v == 0
