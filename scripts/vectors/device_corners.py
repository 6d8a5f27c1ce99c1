"""Scenes of a device at its edges: what tells one firmware from another that is nearly like it."""

from __future__ import annotations

from bench import (
    COUNT_PQ,
    INDEX,
    KD,
    KI,
    KNOT_US,
    KP,
    PERIOD_US,
    POSITION,
    STOP,
    TORQUE,
    TORQUE_MAX,
    Bench,
    Tracks,
    settings,
)
from device_motion import AHEAD, HERE, LOAD_TQ, at_rest, way
from device_session import ARMED, COMMAND, HOLDING, IDLE, MOVING, SPARE, SYNC

from headway.firmware import _core


def _order(b: Bench, *kinds: str, argument: int = 0, step_us: int = 50) -> None:
    """Commands one after another, between two servo periods."""
    for kind in kinds:
        b.give(b.seal(COMMAND, b.command(kind, argument)))
        b.run(1, step_us)


def _align(b: Bench, used_us: int) -> None:
    """To the next servo period."""
    b.run(1, PERIOD_US - used_us)


def _let_go(b: Bench, torque_tq: int = 0) -> None:
    """Armed, the brake off, by a jog that has ended."""
    b.orders("ARM", "DONE", "ARMED", torque_tq)
    b.orders("JOG", "DONE", "ARMED", 0)
    b.go(8)


def between(b: Bench) -> None:
    b.scene("DISARM, and the line opens while the brake engages", HOLDING)
    b.set(speed_q16=0, position=321 - 40)
    b.run(1)
    _order(b, "DISARM")
    b.set(line_open=1)
    _align(b, 50)
    b.run(6)
    b.scene("a fault, and the line opens in its ramp", MOVING)
    b.set(supply_mV=31_000)
    b.run(7)
    b.set(line_open=1)
    b.run(40)
    b.hear()
    b.expect("ESTOP", "OVERVOLTAGE")
    b.scene("DISARM and ARM: the brake is engaging when the line opens", HOLDING)
    _order(b, "DISARM")
    _align(b, 50)
    _order(b, "ARM")
    _align(b, 50)
    b.set(position=321 + 7)
    b.run(1)
    b.set(position=321 + 15, line_open=1)
    b.run(8)
    b.hear()
    b.scene("another session begins, and ZERO before the next period", IDLE)
    b.go(25)
    assert b.greet(bytes([3]) * 16) == "ok"
    b.syncing = False
    b.give(b.seal(SYNC, _core.sync_encode(b.stamps())))
    b.run(1, 50)
    _order(b, "ZERO", argument=77)
    _align(b, 100)
    b.hear()
    assert b.status.command_result == 0
    b.scene("ZERO, and ARM before the next period: it holds the new place", IDLE)
    _order(b, "ZERO", argument=5000)
    _order(b, "ARM")
    _align(b, 100)
    b.run(4)
    b.orders("JOG", "DONE", "ARMED", 0)
    b.go(6)
    b.expect("ARMED", "NONE")
    b.scene("STOP twice", MOVING)
    _order(b, "STOP", "STOP")
    _align(b, 100)
    b.go(40)
    b.expect("HOLD", "HOST")


def forgotten(b: Bench) -> None:
    b.scene("an integral is forgotten by DISARM, and a track by HOLD", HOLDING)
    b.set(pull_q16=-819)
    b.go(30)
    b.orders("DISARM", "DONE", "IDLE")
    b.go(5)
    b.orders("ARM", "DONE", "ARMED", LOAD_TQ)
    assert b.status.holding_tq == LOAD_TQ
    b.go(3)
    b.plans("accepted", b.knot + AHEAD, at_rest(9))
    b.go(20)
    b.scene("all five tracks, HOLD, and all five again", IDLE)
    b.orders("ARM", "DONE", "ARMED")
    tracks = {**at_rest(9), KP: [1 << 20] * 9, KI: [1 << 20] * 9, KD: [1 << 20] * 9}
    b.plans("accepted", b.knot + AHEAD, tracks)
    b.until("HOLD")
    b.go(60)
    b.orders("RESUME", "DONE", "ARMED")
    b.plans("accepted", b.knot + AHEAD, tracks)
    b.go(9)
    b.scene("epochs may go back, but not stay", IDLE)
    b.orders("ARM", "DONE", "ARMED", epoch=9)
    b.orders("DISARM", "DONE", "IDLE")
    b.orders("ARM", "BAD", "IDLE", epoch=9)
    b.orders("ARM", "DONE", "ARMED", epoch=3)
    _order(b, "STOP")
    _align(b, 50)
    b.until("HOLD")
    b.orders("RESUME", "DONE", "ARMED", epoch=2)
    b.orders("11", "BAD", "ARMED")
    b.orders("200", "BAD", "ARMED")
    b.scene("trusted again after CLEAR", IDLE)
    made = settings()
    made.home.method = INDEX
    b.adjust(made)
    b.orders("ZERO", "DONE", "IDLE", 0)
    b.set(position=5000)
    b.go(50)
    b.orders("CLEAR", "DONE", "UNSYNCED")
    b.orders("ZERO", "DONE", "UNSYNCED", 0)
    b.set(line_open=1)
    b.go(3)
    b.set(line_open=0)
    b.orders("CLEAR", "DONE", "UNSYNCED")
    assert b.status.homed
    b.scene("the supply at its ends: CLEAR", IDLE)
    for supply_mV, result in ((15_999, "CAUSE"), (16_000, "DONE"), (30_001, "CAUSE"),
                              (30_000, "DONE")):  # fmt: skip
        b.set(line_open=1)
        b.go(2)
        b.set(line_open=0, supply_mV=supply_mV)
        b.orders("CLEAR", result, "UNSYNCED" if result == "DONE" else "ESTOP")


def torques(b: Bench) -> None:
    def stop_at(position: int, torque_tq: int) -> None:
        _let_go(b, torque_tq)
        b.set(speed_q16=0, position=position)
        b.run(1)
        _order(b, "STOP")
        _align(b, 50)
        b.run(3)
        b.hear()
        b.go(20)

    for sign in (1, -1):
        b.scene(f"beyond the torque limit by its pull, {sign}: a stop holds with no more", IDLE)
        made = settings()
        made.monitor.following_pq = 480 * COUNT_PQ
        b.adjust(made)
        stop_at(321 - sign * 300, sign * 400_000)
        b.scene(f"the same from the other side, {sign}", IDLE)
        b.adjust(made)
        stop_at(321 + sign * 300, sign * 400_000)
    b.scene("all torque downwards, and an integral on top of it", IDLE)
    b.set(pull_q16=100 * 65536 // PERIOD_US)
    _let_go(b, -TORQUE_MAX)
    b.order("STOP")
    b.until("HOLD")
    b.set(position=323)
    b.go(3)
    b.hear()
    assert b.status.holding_tq == -TORQUE_MAX
    b.order("RESUME")
    assert b.status.holding_tq == -TORQUE_MAX
    b.scene("a torque track beyond the ceiling: a stop ends at the ceiling", IDLE)
    made = settings()
    made.servo.torque_limit_tq = 1 << 18
    b.adjust(made)
    b.orders("ARM", "DONE", "ARMED")
    b.plans("accepted", b.knot + AHEAD, at_rest(9, HERE, 1 << 19))
    b.go(20)
    b.order("STOP")
    b.go(12)
    for torque in (-1, 1):
        b.scene(f"a torque of {torque} tq is told", IDLE)
        b.orders("ARM", "DONE", "ARMED", torque)
        b.hear()
        assert b.status.torque_peak_tq == 1
    b.scene("an integral to the last bit, while a plan runs", IDLE)
    made = settings()
    made.servo.integrate_running, made.servo.ki_tq = True, _core.Scale(1, 0)
    b.adjust(made)
    _let_go(b)
    b.order("STOP")
    b.until("HOLD")
    b.orders("RESUME", "DONE", "ARMED")
    b.plans("accepted", b.knot + AHEAD, at_rest(90, HERE + 1))
    b.go(300)
    b.scene("a speed below a count is told to the servo", IDLE)
    made = settings()
    made.servo.emf_mV = _core.Scale(1, 2)
    b.adjust(made)
    b.orders("ARM", "DONE", "ARMED", 0)
    b.go(3)
    b.plans("accepted", b.knot + AHEAD, {POSITION: way(2), TORQUE: [0] * len(way(2))})
    b.go(60)


def counted(b: Bench) -> None:
    """What counts periods in a row begins anew where another setpoint is followed, only there."""
    b.scene("behind while RUNNING becomes COAST: it goes on counting", ARMED)
    b.plans("accepted", b.knot + AHEAD, at_rest(30))
    b.go(20)
    b.hear()
    b.set(speed_q16=0, position=321 - 250)
    b.run(1)
    b.run(1)
    b.run(1)
    b.run(8)
    b.hear()
    b.scene("the same, and COAST becomes RUNNING", SPARE)
    first = b.knot + AHEAD
    b.set(speed_q16=0, position=321 - 250)
    b.run(2)
    b.give(b.plan(first, at_rest(20, HERE, LOAD_TQ)))
    b.run(9)
    b.hear()
    b.scene("behind in HOLD: TAIL", IDLE)
    made = settings()
    made.monitor.following_periods, made.monitor.overload = 40, 1 << 20
    made.monitor.torque_periods = made.monitor.stuck_periods = 1000
    b.adjust(made)
    _let_go(b)
    b.order("STOP")
    b.until("HOLD")
    b.set(speed_q16=0, position=321 - 215)
    b.run(30)
    b.go(14)
    b.hear()
    assert b.reason == "FOLLOWING", b.reason
    b.scene("sagged in HOLD, RESUME: it has not moved, and is not stuck", HOLDING)
    b.set(speed_q16=0, position=321 - 100)
    b.run(2)
    _order(b, "RESUME")
    _align(b, 50)
    b.go(9)
    b.expect("ARMED", "NONE")
    b.scene("sagged, and a plan that starts beyond it", IDLE)
    _let_go(b)
    b.set(speed_q16=0, position=321 - 30)
    b.run(2)
    b.plans("accepted", b.knot + AHEAD, at_rest(12, HERE - 90 * COUNT_PQ))
    b.go(12)
    b.expect("RUNNING", "NONE")
    b.scene("a stop ramp at the ceiling: FAULT", IDLE)
    made = settings()
    made.monitor.following_pq, made.servo.torque_limit_tq = 4000 * COUNT_PQ, 1 << 18
    b.adjust(made)
    b.orders("ARM", "DONE", "ARMED")
    b.plans("accepted", b.knot + AHEAD, {POSITION: way(8), TORQUE: [0] * len(way(8))})
    b.go(55)
    _order(b, "STOP")
    b.set(speed_q16=0, turn_q16=5 * 65536 // PERIOD_US)
    _align(b, 50)
    b.go(30)
    b.hear()
    b.expect("FAULT", "TORQUE")
    b.scene("outside at rest: it holds there until the brake has engaged", IDLE)
    b.orders("ZERO", "DONE", "IDLE", 16_990)
    _let_go(b)
    b.set(speed_q16=0, position=321 + 30)
    b.go(9)
    b.expect("FAULT", "OUTSIDE")


def gains(b: Bench) -> None:
    for shift, points in (
        (16, (1 << 24, (1 << 24) + 256)),
        (0, (-256, 256)),
    ):
        for sink in (KP, KI, KD):
            for point in points:
                b.scene(f"a gain of {point} on track {sink}, over 2^{shift}", IDLE)
                made = settings()
                made.servo.integrate_running = True
                made.servo.kp_tq, made.servo.ki_tq, made.servo.kd_tq = (
                    _core.Scale(3, shift), _core.Scale(5, shift), _core.Scale(7, shift),
                )  # fmt: skip
                b.adjust(made)
                b.orders("ARM", "DONE", "ARMED")
                tracks: Tracks = {POSITION: [HERE] * 9, sink: [point] * 9}
                b.plans("accepted", b.knot + AHEAD, tracks)
                b.set(speed_q16=0)
                b.go(26)
                for i in (1, 150, 2, 6, 5):
                    b.set(position=321 - i)
                    b.run(2)


def tasks(b: Bench) -> None:
    b.scene("HOME while it jogs: MOVING", IDLE)
    made = settings()
    made.home.method = INDEX
    b.adjust(made)
    b.orders("ARM", "DONE", "ARMED")
    b.orders("JOG", "DONE", "ARMED", 1 << 27)
    b.orders("HOME", "MOVING", "ARMED")
    b.go(9)
    b.orders("JOG", "DONE", "ARMED", 0)
    b.go(9)
    b.set(index_count=-70)
    b.orders("HOME", "DONE", "ARMED")  # a pulse from before it is no mark
    b.go(9)
    b.hear()
    assert not b.status.homed
    b.set(index_count=400)
    b.go(9)
    b.hear()
    assert b.status.homed
    b.scene("a jog keeps where the axis is", IDLE)
    b.orders("ZERO", "DONE", "IDLE", 5000)
    _let_go(b)
    b.orders("JOG", "DONE", "ARMED", 1 << 27)
    b.go(9)
    b.orders("JOG", "DONE", "ARMED", 0)
    b.go(9)
    b.scene("a mark 2^21 counts from here, on a continuous axis", IDLE)
    made = settings()
    made.monitor.bounded = False
    limits = made.limits(POSITION)
    made.set_limits(POSITION, _core.GateLimits(
        limits.point_min, limits.point_max, limits.difference_max,
        limits.second_difference_max, limits.stop_difference, True))  # fmt: skip
    made.home.method, made.home.mark_count = INDEX, 3 << 20
    b.adjust(made)
    b.orders("ARM", "DONE", "ARMED")
    b.orders("HOME", "DONE", "ARMED")
    b.go(6)
    b.set(index_count=330)
    b.go(30)
    b.expect("ARMED", "NONE")
    b.scene("HOME at a stop, backwards: it pushes with its torque, not more", IDLE)
    made = settings()
    made.home.method, made.home.backwards = STOP, True
    b.adjust(made)
    b.set(floor=321 - 60)
    b.orders("ARM", "DONE", "ARMED", LOAD_TQ // 4)
    b.orders("HOME", "DONE", "ARMED")
    b.go(90)
    b.hear()
    assert b.status.homed
    b.expect("ARMED", "NONE")


def brakes(b: Bench) -> None:
    for shift_us in range(-3, 4):
        b.scene(f"the brake lets go to the microsecond: {shift_us}", IDLE)
        b.hear()  # a status leaves in a servo period
        first = b.knot + 24
        b.run(1, 2 * PERIOD_US + (first * KNOT_US - 3000 - b.status.sent_us + shift_us) % PERIOD_US)
        b.orders("ARM", "DONE", "ARMED")
        b.plans("accepted", first, at_rest(9))
        b.go((first * KNOT_US - b.device_us) // PERIOD_US + 2)
    b.scene("a brake that takes 36 minutes lets go at once", IDLE)
    made = settings()
    made.brake_periods, made.servo_period_us = 65_535, 33_000
    made.monitor.late_us, made.sync_lost_us = 200_000, 3_000_000
    b.adjust(made)
    b.give(b.seal(COMMAND, b.command("ARM")))
    b.run(3, 33_000, tell=1)
    b.expect_now("ARMED")
    b.give(b.plan(b.knot + 60, at_rest(9)))
    b.run(3, 33_000, tell=1)
    b.expect_now("COAST")
    assert not b.braked


def configured(b: Bench) -> None:
    b.scene("another offset, and ARM before the next period: it holds where it is", IDLE)
    made = settings()
    made.offset_count = -700
    b.give(b.seal(_core.FRAME_SETTINGS, made.encode()))
    b.run(1, 50)
    _order(b, "ARM")
    _align(b, 100)
    b.orders("JOG", "DONE", "ARMED", 0)
    b.go(6)
    b.expect("ARMED", "NONE")
    b.scene("another time of the brake: it is engaged already", IDLE)
    made = settings()
    made.brake_periods = 9
    b.adjust(made)
    b.orders("ARM", "DONE", "ARMED", LOAD_TQ)
    b.set(line_open=1)
    b.run(1)
    assert not b.powered
    b.run(12)
    b.scene("no stamps for 2^31 us: what is told stays within 32 bits", IDLE)
    made = settings()
    made.sync.drift_ppm, made.sync.wander_ppb_s = 1, 0
    made.sync.limit_us = 900_000
    made.monitor.late_us, made.sync_lost_us = 4_000_000_000, 2_147_400_000
    b.adjust(made)
    b.sync()
    b.hear()
    b.sync()
    b.hear()
    b.orders("ARM", "DONE", "ARMED")
    b.syncing = False
    for step_us in (1_000_000_000, 1_000_000_000, 150_000_000):
        b.run(1, step_us, tell=1)
    b.run(9, tell=1)
    assert b.reason == "SYNC_LOST", b.reason
    assert (b.status.fault.value, b.status.fault.limit) == ((1 << 31) - 1, 2_147_400_000)
    for sink in (TORQUE, KP, KI, KD):
        b.scene(f"track {sink} is longer than the others: the plan rests when it ends", ARMED)
        first = b.knot + AHEAD
        b.plans("accepted", first, {POSITION: [HERE] * 30, sink: [1 << 18] * 30})
        b.go(9)
        b.plans("accepted", first, {POSITION: [HERE] * 8})
        b.go(60)
        b.expect("COAST")
        b.until("HOLD")


def watched(b: Bench) -> None:
    for sign in (1, -1):
        still, turning = 30, 110
        while turning - still > 1:
            polls = (still + turning) // 2
            b.scene(f"ARM of an axis that turns by {sign} count a period, after {polls}", IDLE)
            b.set(turn_q16=64 * sign)
            b.run(polls, 1024)
            b.give(b.seal(COMMAND, b.command("ARM")))
            b.run(1, 1024)
            b.hear()
            if b.status.command_result == 0:
                still = polls
            else:
                turning = polls
    b.scene("without power there is no load", IDLE)
    made = settings()
    made.monitor.load_q8 = _core.Scale(512, 0)
    b.adjust(made)
    b.go(60)
    b.expect("IDLE")
    b.scene("at the ceiling for too long, downwards", IDLE)
    made = settings()
    made.monitor.overload = 1 << 20
    b.adjust(made)
    b.set(floor=322, position=322)
    b.run(1)
    _let_go(b, -TORQUE_MAX)
    b.set(floor=323)
    b.go(20)
    b.hear()
    assert b.reason == "TORQUE"
    b.scene("an axis that does not know where it is has no limits", IDLE)
    made = settings()
    made.home.method, made.offset_count = INDEX, 18_000
    b.adjust(made)
    _let_go(b)
    b.orders("JOG", "DONE", "ARMED", 1 << 28)
    b.go(20)
    b.expect("ARMED", "NONE")
    b.scene("at rest in HOLD it has no limits", IDLE)
    b.orders("ZERO", "DONE", "IDLE", 16_995)
    _let_go(b)
    b.order("STOP")
    b.until("HOLD")
    b.set(speed_q16=0, turn_q16=65536 // PERIOD_US)
    b.go(12)
    b.expect("HOLD", "HOST")
    for method, kind in ((STOP, "PLAN"), (STOP, "JOG"), (INDEX, "HOME")):
        b.scene(f"against a wall, with a way to home of {method}: {kind}", IDLE)
        made = settings()
        made.home.method = method
        b.adjust(made)
        b.set(wall=321, speed_q16=0)
        if kind == "PLAN":
            b.orders("ZERO", "DONE", "IDLE", 321)
        b.orders("ARM", "DONE", "ARMED")
        if kind == "PLAN":
            points = way(4)
            b.plans("accepted", b.knot + AHEAD, {POSITION: points, TORQUE: [0] * len(points)})
        else:
            b.orders(kind, "DONE", "ARMED", 1 << 28)
        b.go(70)
        b.expect("FAULT", "STUCK")
    b.scene("the guard trips in a fault's ramp: the encoder is trusted all the same", IDLE)
    made = settings()
    made.home.method = INDEX
    b.adjust(made)
    b.orders("ZERO", "DONE", "IDLE", 321)
    _let_go(b)
    b.set(supply_mV=31_000)
    b.run(4)
    b.set(line_open=1, supply_mV=24_000)
    b.hang(1, 10)
    b.set(line_open=0)
    b.go(30)
    b.orders("CLEAR", "DONE", "UNSYNCED")
    assert b.status.homed
    b.scene("past its limit in the ramp of an emergency: the brake at once", IDLE)
    b.orders("ZERO", "DONE", "IDLE", 16_000)
    _let_go(b)
    b.set(speed_q16=0, turn_q16=60 * 65536 // PERIOD_US)
    b.run(6)
    b.set(line_open=1)
    for _ in range(6):
        b.run(4)
    assert b.braked and not b.powered


SCENES = (configured, watched, between, forgotten, torques, counted, gains, tasks, brakes)
