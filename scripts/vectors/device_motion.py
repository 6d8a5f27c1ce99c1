"""Scenes of a device that moves: commands, plans, their gaps and ends, homing and jogging."""

from __future__ import annotations

from bench import (
    COUNT_PQ,
    EPOCH_US,
    FAULT,
    HOLD,
    INDEX,
    INTERPOLATE,
    KD,
    KI,
    KNOT_US,
    KP,
    PERIOD_US,
    POSITION,
    RAMP,
    STOP,
    SWITCH,
    TORQUE,
    TORQUE_MAX,
    ZERO,
    Bench,
    Tracks,
    settings,
)
from device_session import ARMED, COMMAND, HOLDING, IDLE, MOVING, SPARE, STANDING, UNSYNCED

from headway.firmware import _core

HERE = 321 * COUNT_PQ  # where the axis is
AHEAD = _core.LIVE_KNOTS + 1  # knots from now to a plan's first point
LOAD_TQ = 1 << 17


def at_rest(count: int, position_pq: int = HERE, torque_tq: int = 0) -> Tracks:
    return {POSITION: [position_pq] * count, TORQUE: [torque_tq] * count}


def way(most: int, rests: int = 5, sign: int = 1) -> list[int]:
    """Points of a move, at rest at both ends, up to a speed of 32 `most` counts a knot: by
    32 most (most + 1) counts."""
    speeds = [*range(1, most + 1), *range(most, 0, -1)]
    points = [0] * rests
    for speed in speeds:
        points.append(points[-1] + sign * 32 * speed)
    return [HERE + COUNT_PQ * p for p in [*points, *[points[-1]] * 4]]


WAY = 32 * 8 * 9  # counts of a move with a speed of 8


def armed(b: Bench) -> None:
    b.scene("ARM, each time that it is refused", IDLE)
    b.orders("ARM", "BAD", "IDLE", TORQUE_MAX + 1, epoch=1)
    b.orders("ARM", "BAD", "IDLE", -TORQUE_MAX - 1, epoch=1)
    b.orders("ARM", "BAD", "IDLE", 0, epoch=0)
    b.set(line_open=1)
    b.give(b.seal(COMMAND, b.command("ARM", 0, epoch=1)))
    b.run(1, 100)  # before the servo sees the line
    b.hear()
    assert b.status.command_result == _core.COMMAND_RESULTS.index("NOT_NOW")
    b.expect("ESTOP")
    b.orders("ARM", "NOT_NOW", "ESTOP", 0, epoch=1)
    b.scene("ARM of an axis that is turned", IDLE)
    for turn, result, state in ((66_000, "MOVING", "IDLE"), (-66_000, "MOVING", "IDLE"),
                                (0, "DONE", "ARMED")):  # fmt: skip
        b.set(turn_q16=turn // PERIOD_US)
        b.go(80)
        b.orders("ARM", result, state, epoch=1)
    b.scene("ARM before the clock has settled", UNSYNCED)
    b.sync()
    b.orders("ARM", "NOT_NOW", "UNSYNCED", epoch=1)
    b.scene("ARM in the period in which the error outgrew its limit", IDLE)
    made = settings()
    made.sync.limit_us = 1
    b.adjust(made)
    b.give(b.seal(COMMAND, b.command("ARM", 0, epoch=1)))
    b.run(1)
    b.expect("UNSYNCED")
    for torque in (0, TORQUE_MAX, -TORQUE_MAX, LOAD_TQ):
        b.scene(f"ARM with {torque} tq: braked where it is; its number again does nothing", IDLE)
        number = b.host.commands + 1
        b.orders("ARM", "DONE", "ARMED", torque, epoch=7)
        b.go(5)
        assert set(b.numbers("power")) == {1} and set(b.numbers("brake")) == {1}
        assert b.status.epoch == 7 and b.status.holding_tq == torque
        b.orders("ARM", "DONE", "ARMED", epoch=9, number=number)
        b.orders("DISARM", "DONE", "IDLE")
        b.orders("ARM", "DONE", "IDLE", epoch=9, number=number)
        b.go(5)
        assert not b.powered
    b.scene("armed", IDLE)
    b.orders("ARM", "DONE", "ARMED")
    b.go(4)
    b.keep(ARMED)
    for kind in ("ARM", "RESUME", "CLEAR", "ZERO", "SAVE", "HOME"):
        result = "BAD" if kind == "HOME" else "NOT_NOW"
        b.orders(kind, result, "ARMED", epoch=99)
    b.scene("no such command", ARMED)
    b.give(b.seal(COMMAND, b"\1\0\0\0\x0b" + bytes(6)))
    b.hear()
    for kind in ("DISARM", "RESUME", "STOP", "CLEAR", "HOME", "JOG"):
        b.scene(f"{kind} at rest without power", IDLE)
        b.orders(kind, "NOT_NOW", "IDLE", epoch=99)


def zero(b: Bench) -> None:
    for slot, count, result in (
        (IDLE, 5000, "DONE"), (IDLE, (1 << 20) - 1, "DONE"), (IDLE, 1 << 20, "BAD"),
        (IDLE, 1 - (1 << 20), "DONE"), (IDLE, -(1 << 20), "BAD"), (UNSYNCED, -9, "DONE"),
    ):  # fmt: skip
        b.scene(f"ZERO at {count}", slot)
        b.order("ZERO", count)
        assert b.status.command_result == _core.COMMAND_RESULTS.index(result)
        b.go(8)
        b.hear()
        assert (b.status.samples[-1][1] == count) == (result == "DONE")
        assert b.told_settings().offset_count == (count - 321 if result == "DONE" else 0)
    for turn in (66_000, -66_000):
        b.scene("ZERO of an axis that is turned", IDLE)
        b.set(turn_q16=turn // PERIOD_US)
        b.go(80)
        b.orders("ZERO", "MOVING", "IDLE", 0)
    b.scene("ZERO while the brake engages", ARMED)
    for kind in ("DISARM", "ZERO", "SAVE"):
        b.give(b.seal(COMMAND, b.command(kind)))
        b.run(1, 100)
    b.hear()
    assert b.status.command_result == _core.COMMAND_RESULTS.index("NOT_NOW")
    b.go(4)
    b.orders("ZERO", "DONE", "IDLE", 0)
    b.scene("ZERO of a continuous axis, beyond what another one can tell", IDLE)
    made = settings()
    made.monitor.bounded = False
    limits = made.limits(POSITION)
    made.set_limits(
        POSITION,
        _core.GateLimits(limits.point_min, limits.point_max, limits.difference_max,
                         limits.second_difference_max, limits.stop_difference, True),
    )  # fmt: skip
    b.adjust(made)
    b.orders("ZERO", "DONE", "IDLE", (1 << 21) - 1)
    b.orders("ZERO", "BAD", "IDLE", 1 << 21)
    b.orders("ZERO", "DONE", "IDLE", -(1 << 21))
    b.go(8)
    b.orders("ARM", "DONE", "ARMED")
    b.go(3)
    first = b.knot + AHEAD
    low = -(1 << 31)
    b.plans("accepted", first, at_rest(20, low))
    b.go(30)
    b.plans("accepted", first, {POSITION: [low] * 14 + [(1 << 31) - COUNT_PQ * 9 * i
                                for i in range(1, 8)] + [(1 << 31) - 63 * COUNT_PQ] * 4,
                                TORQUE: [0] * 25})  # fmt: skip
    b.go(90)
    b.expect("HOLD", "NONE")


def started(b: Bench) -> None:
    b.scene("a first plan, each time that it is refused", ARMED)
    first = b.knot + AHEAD
    near = 64 * COUNT_PQ
    b.plans("epoch", first, at_rest(9), epoch=b.host.epoch - 1)
    b.plans("epoch", first, at_rest(9), epoch=b.host.epoch + 1)
    for ago_us in (100_000 + 5000, -100_000 - 5000):
        b.plans("stale", first, at_rest(9), ago_us=ago_us)
    b.run(1, 20)
    refused = b.status.plans_refused
    for sink in (POSITION, TORQUE, KP, KI, KD):
        for at in (1, 2):
            tracks = {**at_rest(9), **{gain: [1 << 20] * 9 for gain in (KP, KI, KD)}}
            for off in (1, -1):
                changed = [*tracks[sink]]
                changed[at] += off
                b.give(b.plan(first + 6, {**tracks, sink: changed}))
                b.run(1, 20)
    b.hear()
    assert b.status.plans_refused == refused + 20
    b.plans("start", first + 6, at_rest(9, HERE + near + 1))
    b.plans("start", first + 6, at_rest(9, HERE - near - 1))
    b.plans("late", b.knot + _core.LIVE_KNOTS - 2, at_rest(9))
    b.plans("sink", first + 9, {TORQUE: [0] * 9})
    b.plans("rest", b.knot + AHEAD, {POSITION: [HERE] * 6 + [HERE + 5] * 2, TORQUE: [0] * 8})
    for offset in (near, -near):
        b.scene("a first plan at the edge of where the axis is", ARMED)
        b.plans("accepted", b.knot + AHEAD, at_rest(9, HERE + offset))
        b.go(8)
        b.expect("RUNNING")
    for ago_us in (97_000, -97_000):
        b.scene("a first plan as old, or as new, as may be", ARMED)
        b.plans("accepted", b.knot + AHEAD, at_rest(9), ago_us=ago_us)
    for slot in (IDLE, HOLDING):
        b.scene("a plan where none is taken", slot)
        b.plans("state", b.knot + AHEAD, at_rest(9))
        assert b.status.plan_seen == b.host.plans
    b.scene("a first plan starts when its knot comes: the brake lets go just before", ARMED)
    first = b.knot + 9
    b.plans("accepted", first, at_rest(12))
    for _ in range(5):
        b.run(16, 500)
    b.hear()
    assert b.status.released and not b.numbers("brake")[-1]


def standing(b: Bench) -> None:
    b.scene("a plan at rest; then none: COAST after 5 knots, HOLD at its end", ARMED)
    first = b.knot + AHEAD
    b.plans("accepted", first, at_rest(40, HERE, LOAD_TQ))
    b.go(12)
    b.expect("RUNNING")
    b.keep(STANDING)
    b.go(10)
    b.hear()
    b.hear()
    b.until("COAST", 30)
    assert b.status.coasts == 1
    b.keep(SPARE)
    b.until("HOLD")
    assert b.knot >= first + 38
    b.go(5)
    b.keep(HOLDING)
    b.scene("COAST, and another plan", SPARE)
    b.plans("accepted", b.knot + AHEAD, at_rest(30, HERE, LOAD_TQ))
    b.expect("RUNNING")
    b.go(60)
    b.expect("COAST")
    assert b.status.coasts == 2
    b.scene("COAST, and STOP", SPARE)
    b.order("STOP")
    b.until("HOLD")
    b.expect("HOLD", "HOST")
    assert abs(b.status.holding_tq - LOAD_TQ) < 1 << 14
    b.scene("COAST without stamps: it ends as planned", SPARE)
    b.syncing = False
    b.until("HOLD")
    b.expect("HOLD", "NONE")


def held(b: Bench) -> None:
    b.scene("HOLD: its integrator finds the load, RESUME folds it in", HOLDING)
    b.set(pull_q16=-30_000 // PERIOD_US)
    b.go(60)
    assert b.status.holding_tq != LOAD_TQ
    b.orders("RESUME", "BAD", "HOLD", epoch=b.host.epoch)
    for kind in ("ARM", "CLEAR", "HOME", "JOG", "ZERO", "SAVE"):
        b.orders(kind, "NOT_NOW", "HOLD", epoch=77)
    before = b.status.holding_tq
    b.orders("RESUME", "DONE", "ARMED", epoch=5)
    b.host.epoch = 5
    assert b.status.epoch == 5 and abs(b.status.holding_tq - before) < 1 << 14
    b.go(5)
    b.plans("accepted", b.knot + AHEAD, at_rest(12, HERE, before))
    b.go(30)
    b.scene("HOLD, and STOP; RESUME without stamps", HOLDING)
    b.order("STOP")
    b.until("HOLD")
    b.syncing = False
    b.go(40)
    b.scene("HOLD, a clock that is not settled, RESUME", HOLDING)
    b.syncing = False
    for _ in range(3):
        b.sync()
        b.go(30)
    b.scene("HOLD, and DISARM: brake first", HOLDING)
    b.orders("DISARM", "DONE", "IDLE")
    b.go(5)
    assert not b.powered
    b.orders("STOP", "NOT_NOW", "IDLE")
    b.scene("ARMED under load, without an integrator: a stop holds it where it has sagged", ARMED)
    b.plans("accepted", b.knot + AHEAD, at_rest(9))
    b.until("HOLD")
    b.orders("RESUME", "DONE", "ARMED")
    b.set(pull_q16=-5000 // 10)
    b.go(20)
    b.order("STOP")
    b.until("HOLD")
    assert b.status.holding_tq != 0
    b.go(10)


def moving(b: Bench) -> None:
    b.scene("a move, and its rest", ARMED)
    first = b.knot + AHEAD
    points = way(8, 6)
    tracks = {POSITION: points, TORQUE: [LOAD_TQ + 500 * i for i in range(len(points) - 3)]
              + [LOAD_TQ] * 3}  # fmt: skip
    tracks[TORQUE] = [LOAD_TQ] * 4 + tracks[TORQUE][4:]
    b.plans("accepted", first, tracks)
    for _ in range(4):
        b.go(12)
        b.hear()
        at = b.knot + AHEAD - first
        b.plans("accepted", first + at, {sink: points[at:] for sink, points in tracks.items()})
    b.expect("RUNNING")
    b.keep(MOVING)
    b.until("HOLD")
    b.expect("HOLD", "NONE")
    assert abs(b.status.samples[-1][1] - 321 - WAY) < 40
    assert abs(b.status.holding_tq - LOAD_TQ) < LOAD_TQ
    b.scene("plan after plan: duplicates, overtaken, late, other tracks", ARMED)
    first = b.knot + AHEAD
    long = way(7, 8)
    zeros = [0] * len(long)
    b.plans("accepted", first, {POSITION: long[:6] + long[:1] * 3, TORQUE: [0] * 9})
    b.go(4)
    same = b.plan(first, {POSITION: long, TORQUE: zeros})
    assert b.verdict(same) == "accepted"
    assert b.verdict(same) == "none"  # replayed
    for number in (b.host.plans, b.host.plans - 1):
        b.plans("stale", b.knot + AHEAD, at_rest(9), number=number)
    for gain in (KP, KI, KD):
        b.plans("start", b.knot + AHEAD, {**at_rest(9), gain: [0] * 9})
    one, two, three = (b.plan(first + 4, {POSITION: long[4:], TORQUE: zeros[4:]}) for _ in range(3))
    assert b.verdict(three) == "accepted"
    assert b.verdict(one) == "none"
    assert b.status.plan_seen == b.host.plans and b.status.accepted_mask & 7 == 1
    assert b.verdict(two) == "none"
    late = [*long[5:]]
    late[0] += 1
    b.plans("late", b.knot, {POSITION: [*late, *late[-1:] * 9], TORQUE: [0] * (len(late) + 9)})
    b.plans(
        "accepted", first + 6, {POSITION: long[6:], TORQUE: zeros[6:]}, number=b.host.plans + 40
    )
    assert b.status.accepted_mask == 1
    b.host.plans += 40
    skipped = b.plan(first + 6, {POSITION: long[6:], TORQUE: zeros[6:]}, number=b.host.plans + 7)
    refused = b.plan(first + 6, at_rest(9), number=b.host.plans + 8, epoch=999)
    assert b.verdict(refused) == "epoch"
    assert b.verdict(skipped) == "accepted"  # the one that overtook it was not
    assert b.status.accepted_mask & 3 == 2
    b.host.plans += 9
    b.until("HOLD")
    b.go(4)


def gains(b: Bench) -> None:
    b.scene("gain tracks: beyond a mantissa's ends they stay there", ARMED)
    first = b.knot + AHEAD
    points = way(5, 6)
    n = len(points)
    low, top = -(1 << 12), 1 << 25
    b.plans("accepted", first, {
        POSITION: points, TORQUE: [0] * n,
        KP: [1 << 20] * 6 + [1 << 19] * (n - 9) + [top] * 3,
        KI: [0] * 5 + [low] * (n - 5),
        KD: [1 << 19] * 6 + [low] * 4 + [1 << 18] * (n - 10),
    })  # fmt: skip
    b.go(80)
    b.until("HOLD", 300)
    for integrates in (False, True):
        b.scene(f"the integral while a plan runs: {integrates}", IDLE)
        made = settings()
        made.servo.integrate_running = integrates
        made.servo_period_us = 1500
        b.adjust(made)
        b.orders("ARM", "DONE", "ARMED")
        b.go(4)
        b.set(pull_q16=-9)
        b.plans("accepted", b.knot + AHEAD, at_rest(20))
        b.go(60)
        b.until("HOLD", 300)


def looking_ahead(b: Bench) -> None:
    for ahead_us in (700, KNOT_US):
        b.scene(f"feed-forward by speed and acceleration, {ahead_us} us ahead", IDLE)
        made = settings()
        made.servo.velocity_tq, made.servo.acceleration_tq = _core.Scale(3, 4), _core.Scale(5, 3)
        made.servo.ahead_us = ahead_us
        b.adjust(made)
        b.orders("ARM", "DONE", "ARMED")
        b.go(4)
        points = way(8, 6)
        torque = [(i * 977) % 5000 for i in range(len(points) - 3)] + [700] * 3
        torque[:3] = [0, 0, 0]
        b.plans("accepted", b.knot + AHEAD, {POSITION: points, TORQUE: torque})
        b.go(60)
        b.orders("STOP", "DONE", "TAIL")  # the ramp's acceleration is nobody's
        b.until("HOLD", 300)


def turns(b: Bench) -> None:
    """Short periods, whose duties take turns; polls that come late change nothing of that."""
    b.scene("turns: all tracks, stamps all the time, a bad supply", IDLE)
    made = settings()
    made.servo_period_us = 125
    made.servo.acceleration_tq = _core.Scale(5, 3)
    for sink in (KP, KI, KD):
        made.set_limits(sink, _core.GateLimits(0, 1 << 25, 1 << 24, 1 << 24))
    b.adjust(made)
    b.orders("ARM", "DONE", "ARMED")
    b.go(20)
    points = way(5, 6)
    n = len(points)
    b.plans("accepted", b.knot + AHEAD, {
        POSITION: points, TORQUE: [0] * n,
        KP: [1 << 20] * 6 + [1 << 19] * (n - 6), KI: [1 << 18] * n, KD: [1 << 19] * n,
    })  # fmt: skip
    for _ in range(40):
        b.sync()
        b.run(1)
    b.go(40)
    b.set(supply_mV=12_000)
    b.until("FAULT", 100)
    for gain in (KP, KI, KD):
        b.scene(f"turns: a track of gain {gain}, which is looked at once in all turns", IDLE)
        made.servo.integrate_running = True
        b.adjust(made)
        b.orders("ARM", "DONE", "ARMED")
        changing = [1 << 17 + min(max(3, i), 25) % 4 for i in range(30)]  # seen in a turn
        b.plans("accepted", b.knot + AHEAD, {**at_rest(30), gain: changing})
        b.set(speed_q16=0)
        b.go(40)
        for away in (10, 40, 15, 60):
            b.set(position=321 - away)
            b.run(9)


def marked(b: Bench) -> None:
    b.scene("turns: stamps with a mark all the time", IDLE)
    made = settings()
    made.servo_period_us = 125
    b.adjust(made)
    b.set(frame_number=64, frame_age_us=150)
    b.run(2)
    b.hear()
    number, width_us, least_us = b.status.mark
    assert width_us != _core.MARK_OPEN
    for _ in range(52):
        b.sync(mark=(number, width_us // 2, least_us))
        b.run(1)
    b.go(40)
    b.hear()


def shaken(b: Bench) -> None:
    b.scene("turns: to and fro, at the torque limit and below it: heat has no sign", IDLE)
    made = settings()
    made.servo_period_us = 125
    made.servo.torque_limit_tq = 1 << 19
    made.monitor.load_q8, made.monitor.torque_periods = _core.Scale(1, 9), 1000
    b.adjust(made)
    b.orders("ARM", "DONE", "ARMED")
    b.set(speed_q16=0)
    for i in range(40):
        b.set(position=321 + (-150, 0, 150, 0)[i % 4])
        b.run(1)
    b.expect("FAULT", "I2T")


def switched(b: Bench) -> None:
    b.scene("turns: chopper and power on and off, at once each", IDLE)
    made = settings()
    made.servo_period_us = 125
    b.adjust(made)
    for supply_mV in (28_000, 24_000):
        for kind, state in (("ARM", "ARMED"), ("DISARM", "IDLE")):
            b.set(supply_mV=supply_mV)
            b.go(20)
            b.orders(kind, "DONE", state)
            b.set(supply_mV=52_000 - supply_mV)
            b.go(20)


def _tried(b: Bench, off_counts: int, periods: int) -> None:
    """It follows its plan's end, off by so much for so long."""
    b.go(24)
    b.set(position=321 - off_counts)
    b.run(periods)
    b.expect("COAST")


def succeeding(b: Bench) -> None:
    """A plan begins at once where something else ends: nothing of that one's stays."""
    b.scene("ARM, and a plan before the next period", IDLE)
    b.run(1)
    b.give(b.seal(_core.FRAME_COMMAND, b.command("ARM")))
    b.give(b.plan(b.knot + AHEAD, at_rest(20)))
    b.run(2, step_us=10)
    b.set(speed_q16=0)
    _tried(b, 20, 9)
    b.scene("JOG of 0, and a plan as it ends", ARMED)
    b.orders("JOG", "DONE", "ARMED", 0)
    b.go(8)
    b.give(b.seal(_core.FRAME_COMMAND, b.command("JOG", 0)))
    b.give(b.plan(b.knot + AHEAD, at_rest(20)))
    b.set(speed_q16=0)
    _tried(b, 150, 2)
    b.scene("HOLD, RESUME, and a plan before the next period: the integral rests", ARMED)
    b.plans("accepted", b.knot + AHEAD, at_rest(9))
    b.until("HOLD", 300)
    b.set(speed_q16=0)
    b.run(2)
    b.give(b.seal(_core.FRAME_COMMAND, b.command("RESUME")))
    b.give(b.plan(b.knot + AHEAD, at_rest(20)))
    b.run(2, step_us=10)
    _tried(b, 20, 9)


def steps(b: Bench) -> None:
    """Of a stepper: 50 kHz, told where it is, then homed."""
    made = settings()
    made.step_least_q16 = 20 << 16
    rate = COUNT_PQ * KNOT_US // 20 * 1023 // 1024
    limits = made.limits(POSITION)
    made.set_limits(
        POSITION,
        _core.GateLimits(limits.point_min, limits.point_max, rate, 1 << 15, limits.stop_difference),
    )
    made.home.method = INDEX

    def arm(what: str, *load_tq: int) -> None:
        b.scene(f"steps: {what}", IDLE)
        b.adjust(made)
        b.orders("ZERO", "DONE", "IDLE", 321)
        b.orders("ARM", "DONE", "ARMED", *load_tq)

    def jog() -> None:
        b.orders("JOG", "DONE", "ARMED", 2 * COUNT_PQ << 16)
        b.go(9)

    for ending in ("STOP", "line", "nothing", "torque"):
        arm(ending, LOAD_TQ)
        b.go(4)
        speeds = [*range(0, 17 << 15, 1 << 15)]
        if ending == "torque":
            speeds = [min(s, 1 << 17) for s in speeds]
        points = [HERE] * 4
        for speed in [*(min(s, rate) for s in speeds), *(min(s, rate) for s in speeds[::-1])]:
            points.append(points[-1] - speed)
        points += [points[-1]] * 3
        for away in (COUNT_PQ * 2 + 1, -COUNT_PQ * 2 - 1):
            b.plans("start", b.knot + AHEAD, at_rest(20, HERE + away))
        b.plans("accepted", b.knot + AHEAD, {POSITION: points, TORQUE: [0] * len(points)})
        b.go(60)
        if ending == "STOP":
            b.orders("STOP", "DONE", "TAIL")
        elif ending == "line":
            b.set(line_open=1)
            b.go(40)
            assert not b.powered and b.braked
            b.set(line_open=0)
            b.go(60)
            b.orders("CLEAR", "DONE", "UNSYNCED")
            b.hear()
            assert not b.status.homed
            b.settle()
            b.orders("ARM", "DONE", "ARMED")
            b.plans("state", b.knot + AHEAD, at_rest(9))
            b.orders("HOME", "DONE", "ARMED")
            b.go(20)
            b.set(index_count=-7)
            b.go(40)
            b.hear()
            assert b.status.homed
            b.orders("JOG", "DONE", "ARMED", 3 * COUNT_PQ << 16)
            b.go(20)
            b.orders("STOP", "DONE", "HOLD")  # in two periods
        b.until("HOLD", 300)
        b.go(5)
        b.orders("DISARM", "DONE", "IDLE")
        b.go(9)
        b.hear()
        assert not b.status.homed and not b.powered
    arm("the main loop hangs: the guard brakes")
    jog()
    b.run(2, guard=1)
    b.hang(12)
    b.run(9, guard=1)
    b.expect("FAULT", "LATE")
    points = [HERE] * 4
    for speed in [*range(0, 6 << 15, 1 << 15), *[6 << 15] * 12, *range(6 << 15, 0, -(1 << 15))]:
        points.append(points[-1] - speed)
    points += [points[-1]] * 3
    for call in range(1, 5):
        arm(f"the guard trips before output {call} of a period is set", LOAD_TQ)
        b.go(4)
        b.plans("accepted", b.knot + AHEAD, {POSITION: points, TORQUE: [0] * len(points)})
        b.go(60)
        b.set(interrupt_at=call, interrupt_opens=1)
        b.run(1, tell=1)
        b.run(6, tell=1)
        assert b.braked and not b.powered
    arm("a wire that jumps")
    jog()
    b.set(position=12_345)
    b.go(9)
    assert b.braked
    b.hear()
    assert b.reason == "SPIKE"


GAPS = (  # policies of position and torque, missing knots, the gate's verdict, where it leads
    (INTERPOLATE, HOLD, 1, "accepted", "RUNNING"),
    (INTERPOLATE, HOLD, 4, "accepted", "RUNNING"),
    (INTERPOLATE, HOLD, 5, "gap", "RUNNING"),
    (INTERPOLATE, ZERO, 3, "accepted", "RUNNING"),
    (INTERPOLATE, INTERPOLATE, 2, "accepted", "RUNNING"),
    (RAMP, HOLD, 1, "gap", "TAIL"),
    (RAMP, FAULT, 2, "gap", "FAULT"),
    (FAULT, HOLD, 1, "gap", "FAULT"),
    (RAMP, HOLD, 1 << 32, "gap", "TAIL"),
    (RAMP, HOLD, (1 << 31) - 1, "gap", "TAIL"),
    (RAMP, HOLD, 1 << 31, "gap", "TAIL"),
)


def gaps(b: Bench) -> None:
    for position, torque, missing, verdict, state in GAPS:
        b.scene(f"a gap of {missing} knots, by policies {position} and {torque}", IDLE)
        made = settings()
        made.carries_gravity = False
        made.set_gap_policy(POSITION, position)
        made.set_gap_policy(TORQUE, torque)
        b.adjust(made)
        b.orders("ARM", "DONE", "ARMED")
        b.go(3)
        first = b.knot + AHEAD
        b.plans("accepted", first, at_rest(9, HERE, LOAD_TQ))
        b.go(9)
        b.plans(verdict, first + 9 + missing, at_rest(7, HERE + 900, LOAD_TQ))
        if verdict == "accepted" or state == "RUNNING":
            b.expect("RUNNING")
        else:
            reason = "GAP" if state == "TAIL" else "GAP_FAULT"
            b.until("HOLD" if state == "TAIL" else "FAULT")
            assert b.reason == reason
            assert b.status.fault.value == min(missing, (1 << 31) - 1)
            assert b.status.fault.limit == 4
        b.go(40)
    b.scene("a gap before a plan that has no room for what is missing", ARMED)
    first = b.knot + AHEAD
    b.plans("accepted", first, at_rest(9))
    b.go(9)
    b.plans("gap", first + 13, at_rest(125))
    b.plans("accepted", first + 13, at_rest(90))


def homing(b: Bench) -> None:
    for method, backwards in ((INDEX, False), (INDEX, True), (SWITCH, False), (STOP, False)):
        b.scene(f"HOME by way {method}, {'backwards' if backwards else 'forwards'}", IDLE)
        made = settings()
        made.home.method, made.home.backwards = method, backwards
        b.adjust(made)
        b.hear()
        assert not b.status.homed
        b.orders("ARM", "DONE", "ARMED", LOAD_TQ // 4)
        b.go(3)
        b.plans("state", b.knot + AHEAD, at_rest(9))
        b.set(index_count=5)  # from before
        b.set(wall=321 + 60 if method == STOP else 1 << 40)
        number = b.host.commands + 1
        b.orders("HOME", "DONE", "ARMED")
        b.orders("HOME", "MOVING", "ARMED")
        b.orders("JOG", "MOVING", "ARMED", 5)
        b.orders("DISARM", "MOVING", "ARMED")
        b.plans("state", b.knot + AHEAD, at_rest(9))
        assert number < b.host.commands
        b.go(8)
        if method == INDEX:
            b.set(index_count=321 + 20)
        if method == SWITCH:
            b.set(on_switch=1)
        for _ in range(12):
            b.run(5)
        b.expect("ARMED", "NONE")
        assert b.status.homed
        b.go(4)
        at = b.status.samples[-1][1]
        b.plans("accepted", b.knot + AHEAD, at_rest(9, at * COUNT_PQ, LOAD_TQ // 4))
        b.go(9)
        b.expect("RUNNING")
        b.until("HOLD", 90)
        b.orders("DISARM", "DONE", "IDLE")
        b.go(5)
        b.orders("SAVE", "DONE", "IDLE")
    for backwards in (False, True):
        b.scene("HOME that finds nothing: TAIL with HOMING", IDLE)
        made = settings()
        made.home.method, made.home.way_counts, made.home.backwards = SWITCH, 60, backwards
        b.adjust(made)
        b.orders("ARM", "DONE", "ARMED")
        b.orders("HOME", "DONE", "ARMED")
        b.until("HOLD", 120)
        b.expect("HOLD", "HOMING")
        assert abs(b.status.fault.value) > 60 and b.status.fault.limit == 60
        assert not b.status.homed
        b.orders("RESUME", "DONE", "ARMED")
        b.plans("state", b.knot + AHEAD, at_rest(9))
    b.scene("HOME on the switch: backs off first", IDLE)
    made = settings()
    made.home.method = SWITCH
    b.adjust(made)
    b.set(on_switch=1)
    b.orders("ARM", "DONE", "ARMED")
    b.orders("HOME", "DONE", "ARMED")
    b.go(8)
    b.set(on_switch=0)
    b.go(12)
    b.set(on_switch=1)
    b.go(20)
    b.hear()
    assert b.status.homed
    b.scene("HOME, and STOP", IDLE)
    b.adjust(made)
    b.orders("ARM", "DONE", "ARMED", LOAD_TQ)
    b.orders("HOME", "DONE", "ARMED")
    b.go(6)
    b.order("STOP")
    b.until("HOLD", 90)
    b.expect("HOLD", "HOST")
    b.go(5)


def jogging(b: Bench) -> None:
    speed = 4 * COUNT_PQ << 16
    for first, second in ((speed, speed // 2), (-speed, speed), (speed * 2 - 1, -speed * 2 + 1)):
        b.scene(f"JOG at {first}, then {second}, then 0", ARMED)
        b.orders("JOG", "DONE", "ARMED", first)
        b.go(12)
        b.orders("HOME", "BAD", "ARMED")
        b.orders("JOG", "DONE", "ARMED", second)
        b.plans("state", b.knot + AHEAD, at_rest(9))
        b.go(12)
        b.orders("JOG", "DONE", "ARMED", 0)
        b.go(12)
        b.expect("ARMED", "NONE")
        at = b.status.samples[-1][1]
        b.plans("accepted", b.knot + AHEAD, at_rest(9, at * COUNT_PQ))
        b.go(9)
    b.scene("JOG of 0: it has come to rest at once", ARMED)
    b.orders("JOG", "DONE", "ARMED", 0)
    b.go(6)
    b.orders("DISARM", "DONE", "IDLE")
    b.scene("JOG against a wall: feedback within its limit, then STUCK or TORQUE", ARMED)
    b.set(wall=321 + 20)
    b.orders("JOG", "DONE", "ARMED", speed)
    b.go(60)
    b.go(60)
    b.scene("JOG, and STOP", ARMED)
    b.orders("JOG", "DONE", "ARMED", speed)
    b.go(12)
    b.order("STOP")
    b.until("HOLD", 90)
    b.expect("HOLD", "HOST")


def stopping(b: Bench) -> None:
    b.scene("ARM, and STOP before a servo period", IDLE)
    b.give(b.seal(COMMAND, b.command("ARM", 3 * LOAD_TQ)))
    b.run(1, 250)
    b.give(b.seal(COMMAND, b.command("STOP")))
    b.run(1, 250)
    b.run(1, 500)
    b.until("HOLD")
    b.expect("HOLD", "HOST")
    assert b.status.fault.state == _core.STATES.index("ARMED")
    b.go(6)
    for at, torque in ((12, True), (12, False), (26, True)):
        b.scene(f"STOP in a move, {'with' if torque else 'without'} torque of its own", IDLE)
        b.orders("ARM", "DONE", "ARMED", LOAD_TQ)
        points = way(8, 6)
        tracks: Tracks = {POSITION: points}
        if torque:
            tracks[TORQUE] = [-LOAD_TQ] * 9 + [3 * LOAD_TQ] * (len(points) - 9)
        b.plans("accepted", b.knot + AHEAD, tracks)
        b.go(4 * at)
        b.order("STOP")
        b.until("HOLD")
        b.expect("HOLD", "HOST")
        assert abs(b.status.holding_tq - (3 if torque else 1) * LOAD_TQ) < LOAD_TQ
        b.go(9)
        b.orders("RESUME", "DONE", "ARMED")
        b.go(3)
        at_pq = b.status.samples[-1][1] * COUNT_PQ
        b.plans("accepted", b.knot + AHEAD + 3, {POSITION: [at_pq] * 9})
        b.go(40)
    b.scene("ARM with all torque: what holds it stays within its limit", IDLE)
    b.orders("ARM", "DONE", "ARMED", TORQUE_MAX)
    b.set(pull_q16=-100 * 65536 // PERIOD_US)
    b.orders("JOG", "DONE", "ARMED", 0)
    b.go(9)
    b.set(position=320)
    b.go(1)
    b.order("STOP")
    b.until("HOLD")
    b.set(position=319)
    b.go(3)
    b.hear()
    assert b.status.holding_tq == TORQUE_MAX, b.status.holding_tq
    b.go(3)
    b.order("RESUME")
    b.hear()
    assert b.status.holding_tq == TORQUE_MAX
    b.order("STOP")
    b.go(9)
    b.scene("sagged while a plan ends: HOLD goes to where the plan ends", ARMED)
    b.plans("accepted", b.knot + AHEAD, at_rest(12))
    b.go(20)
    b.set(pull_q16=-2_600)
    b.until("HOLD")
    b.expect("HOLD", "NONE")
    b.go(12)


def numbers(b: Bench) -> None:
    b.scene("the first plan of all may have the number 0, the next not", ARMED)
    first = b.knot + AHEAD
    b.plans("accepted", first, at_rest(30), number=0)
    b.plans("stale", first + 9, at_rest(9), number=0)
    b.plans("accepted", first + 9, at_rest(9), number=1)
    for ahead in (31, 32, 33):
        b.scene(f"a plan {ahead} numbers ahead: what is told of the ones before", STANDING)
        accepted = b.host.plans
        b.plans("epoch", b.knot + AHEAD, at_rest(9), number=accepted + ahead, epoch=999)
        assert b.status.accepted_mask == (1 << 31 if ahead == 31 else 0)
        assert b.status.plan_seen == accepted + ahead
        b.scene(f"one that was overtaken by one {ahead} numbers ahead, which was refused", STANDING)
        late = b.plan(b.knot + AHEAD, at_rest(9, HERE, LOAD_TQ), number=accepted + 1)
        b.plans("epoch", b.knot + AHEAD, at_rest(9), number=accepted + 1 + ahead, epoch=999)
        assert b.verdict(late) == "accepted"
        assert b.status.accepted_mask == (1 << 31 if ahead == 31 else 0)
        assert b.status.plan_accepted == accepted + 1
    b.scene("one that was overtaken by one of the same number: stale", STANDING)
    late, early = (b.plan(b.knot + AHEAD, at_rest(9, HERE, LOAD_TQ), number=b.host.plans + 1)
                   for _ in range(2))  # fmt: skip
    assert b.verdict(early) == "accepted"
    assert b.verdict(late) == "stale"
    for age_us, verdict in ((100_000, "start"), (100_001, "stale"), (-100_000, "start"),
                            (-100_001, "stale")):  # fmt: skip
        b.scene(f"a plan sent {age_us} us ago: {verdict}", ARMED)
        b.hear()
        ago_us = age_us - (b.device_us + PERIOD_US - _host_us(b))
        packet = b.plan(b.knot + AHEAD, at_rest(9, HERE + (1 << 20)), ago_us=ago_us)
        b.give(packet)
        b.run(1)
        b.hear()
        assert _core.GATE_RESULTS[b.status.refusal] == verdict, b.status.refusal
    b.scene("the first plan says when the brake lets go, not the next", ARMED)
    first = b.knot + 20
    b.plans("accepted", first, at_rest(9))
    b.plans("accepted", first + 5, at_rest(9))
    b.go(60)
    b.go(40)


def _host_us(b: Bench) -> int:
    """The host's time."""
    return EPOCH_US + b.host.now_us


SCENES = (
    armed,
    zero,
    standing,
    held,
    started,
    moving,
    gains,
    looking_ahead,
    turns,
    marked,
    shaken,
    switched,
    succeeding,
    steps,
    gaps,
    homing,
    jogging,
    stopping,
    numbers,
)
