"""Scenes of a device that stops: monitors, the emergency line, the guard; and its signals."""

from __future__ import annotations

from collections.abc import Sequence

from bench import COUNT_PQ, PERIOD_US, POSITION, TORQUE, TORQUE_MAX, Bench, Tracks, settings
from device_motion import AHEAD, at_rest, way
from device_session import ARMED, COMMAND, COOLING, HOLDING, IDLE, MOVING, STANDING, UNSYNCED

from headway.firmware import _core


def _stopped(b: Bench, state: str, reason: str) -> None:
    """FAULT and ESTOP end braked and off; TAIL under power, at rest."""
    b.until("HOLD" if state == "TAIL" else state)
    b.expect("HOLD" if state == "TAIL" else state, reason)
    b.go(60)
    assert (b.powered, b.braked) == (True, b.braked) if state == "TAIL" else (False, True)


def encoder(b: Bench) -> None:
    for slot in (IDLE, ARMED, STANDING, MOVING, HOLDING):
        b.scene("a spike: the brake at once, and the last torque until it has engaged", slot)
        b.set(position=9321)
        b.go(2)
        _stopped(b, "FAULT", "SPIKE")
        assert b.faults()[-1].reason == _core.REASONS.index("SPIKE")
        b.orders("CLEAR", "DONE", "UNSYNCED")
    b.scene("a spike of an axis with a mark: it is not homed any more", IDLE)
    made = settings()
    made.home.method = 1
    b.adjust(made)
    b.orders("ZERO", "DONE", "IDLE", 0)
    b.set(position=9321)
    b.go(9)
    b.orders("CLEAR", "DONE", "UNSYNCED")
    assert not b.status.homed
    b.scene("stuck while the plan moves", ARMED)
    b.plans("accepted", b.knot + AHEAD, {POSITION: way(8), TORQUE: [0] * len(way(8))})
    b.set(speed_q16=0)
    b.go(40)
    _stopped(b, "FAULT", "STUCK")
    b.scene("reversed", ARMED)
    b.plans("accepted", b.knot + AHEAD, {POSITION: way(8), TORQUE: [0] * len(way(8))})
    b.set(speed_q16=-13_107)
    b.go(60)
    _stopped(b, "FAULT", "REVERSED")
    b.scene("pushing without a count", STANDING)
    b.set(wall=321, speed_q16=13_107)
    b.go(8)


def motion(b: Bench) -> None:
    b.scene("a stop ramp that the axis does not follow: FAULT", MOVING)
    b.give(b.seal(COMMAND, b.command("STOP")))
    b.run(2)
    b.set(speed_q16=0, turn_q16=2 * 65536 // PERIOD_US)
    b.go(20)
    b.expect("FAULT", "FOLLOWING")
    b.scene("following: TAIL", ARMED)
    made = way(8)
    b.plans("accepted", b.knot + AHEAD, {POSITION: made, TORQUE: [0] * len(made)})
    b.go(30)
    b.set(speed_q16=2000)
    b.go(40)
    b.expect("HOLD", "FOLLOWING")
    b.go(30)
    for turn in (450, -450):
        b.scene("speed: somebody turns it", STANDING)
        b.set(turn_q16=turn * 65536 // PERIOD_US)
        b.go(20)
        assert "SPEED" in b.reasons, b.reasons
        b.go(60)
        b.set(turn_q16=0)
        b.go(60)
    b.scene("room: it could not stop before its last limit", IDLE)
    b.orders("ZERO", "DONE", "IDLE", 16_000)
    b.orders("ARM", "DONE", "ARMED")
    b.go(3)
    b.plans("accepted", b.knot + AHEAD, at_rest(20, 16_000 * COUNT_PQ))
    b.go(12)
    b.set(turn_q16=140 * 65536 // PERIOD_US, speed_q16=1000)
    b.go(30)
    assert "ROOM" in b.reasons, b.reasons
    b.go(20)
    b.scene("outside, and going on: the brake at once", IDLE)
    b.orders("ZERO", "DONE", "IDLE", 16_990)
    b.orders("ARM", "DONE", "ARMED")
    b.go(3)
    b.set(turn_q16=3 * 65536 // PERIOD_US)
    b.go(20)
    assert "OUTSIDE" in b.reasons, b.reasons
    b.set(turn_q16=0)
    b.go(80)
    b.orders("CLEAR", "CAUSE", "FAULT")
    b.set(position=321)
    b.go(80)
    b.order("CLEAR")


def heat(b: Bench) -> None:
    for supply_mV in (15_999, 30_001):
        b.scene("the supply sags or rises under power, and comes back", STANDING)
        b.set(supply_mV=16_000)
        b.go(3)
        b.set(supply_mV=supply_mV)
        b.run(4)
        b.run(8)
        b.hear()
        b.go(30)
        b.orders("CLEAR", "CAUSE", "FAULT")
        b.set(supply_mV=30_000)
        b.orders("CLEAR", "DONE", "UNSYNCED")
    b.scene("the chopper, on and off", IDLE)
    for supply_mV in (27_000, 27_001, 26_600, 26_570, 27_000):
        b.set(supply_mV=supply_mV)
        b.go(2)
    b.scene("overload: FAULT by ramp, then the brake; CLEAR once it has cooled", STANDING)
    b.orders("DISARM", "NOT_NOW", "RUNNING")
    b.set(pull_q16=-5000)
    b.go(40)
    b.go(40)
    b.scene("overload at rest", IDLE)
    b.orders("ARM", "DONE", "ARMED", TORQUE_MAX)
    b.until("FAULT", 60)
    b.expect("FAULT", "I2T")
    b.keep(COOLING)
    soon, late = 1, 120
    while late - soon > 1:
        periods = (soon + late) // 2
        b.scene(f"{periods} periods after an overload: CLEAR", COOLING)
        b.go(periods)
        if b.order("CLEAR") == "DONE":
            late = periods
        else:
            soon = periods
    b.scene("the winding: CLEAR once it has cooled to seven eighths", IDLE)
    made = settings()
    made.monitor.overload, made.monitor.heating_q16 = 1 << 20, 11_000
    b.adjust(made)
    b.orders("ARM", "DONE", "ARMED", TORQUE_MAX)
    b.go(780)
    b.expect("FAULT", "WINDING")
    results = []
    for _ in range(16):
        results.append(b.order("CLEAR"))
        b.go(50)
    assert {"CAUSE", "DONE"} <= {*results}, results
    b.scene("at the ceiling for too long: TAIL, again and again", IDLE)
    b.orders("ARM", "DONE", "ARMED", TORQUE_MAX)
    b.set(wall=320)
    b.orders("JOG", "DONE", "ARMED", 0)
    b.go(20)
    b.hear()
    assert b.reason == "TORQUE"
    b.go(30)


def line(b: Bench) -> None:
    for slot in (UNSYNCED, IDLE, ARMED, STANDING, MOVING, HOLDING):
        b.scene("the emergency line, and CLEAR", slot)
        b.set(line_open=1)
        b.go(1)
        _stopped(b, "ESTOP", "NONE")
        b.orders("CLEAR", "CAUSE", "ESTOP")
        b.orders("STOP", "NOT_NOW", "ESTOP")
        b.set(line_open=0)
        b.go(6)
        b.expect("ESTOP")
        b.orders("CLEAR", "DONE", "UNSYNCED")
    for slot in (ARMED, HOLDING):
        b.scene("the line opens after a while: its ramp is as long as at first", slot)
        b.go(40)
        b.set(line_open=1)
        b.run(9)
    b.scene("the line opens in a stop, and in a fault", MOVING)
    b.give(b.seal(COMMAND, b.command("STOP")))
    b.run(4)
    b.set(line_open=1)
    b.run(40)
    b.scene("the line opens after a spike: no ramp", MOVING)
    b.set(position=9321)
    b.run(1)
    b.set(line_open=1)
    b.run(12)
    b.set(line_open=0)
    b.go(40)
    b.orders("CLEAR", "DONE", "UNSYNCED")
    b.scene("a ramp that takes too long is braked after stop_us", MOVING)
    b.set(line_open=1, turn_q16=2500)
    b.go(30)
    assert not b.powered
    b.orders("CLEAR", "MOVING", "ESTOP")
    b.set(turn_q16=0)
    b.go(60)
    b.orders("CLEAR", "CAUSE", "ESTOP")
    b.scene("while it is braked CLEAR has to wait", STANDING)
    b.set(line_open=1)
    b.give(b.seal(COMMAND, b.command("CLEAR")))
    b.run(3)
    b.set(line_open=0)
    b.order("CLEAR")
    b.go(20)
    b.order("CLEAR")


def lost(b: Bench) -> None:
    for slot in (ARMED, STANDING):
        b.scene("no stamps for too long: TAIL, with how long it was", slot)
        b.syncing = False
        for _ in range(12):
            b.hear()
        while b.host.now_us - b.host.synced_us < 140_000:
            b.hear()
        b.go(20)
    b.scene("armed without stamps", ARMED)
    b.syncing = False
    b.sync()
    b.go(120)
    b.expect("HOLD", "SYNC_LOST")
    assert b.status.fault.value > 100_000 and b.status.fault.limit == 100_000
    assert b.order("RESUME") == "DONE"  # and ends as before
    b.scene("the clock's error outgrows its limit: CLOCK", IDLE)
    made = settings()
    made.sync.drift_ppm, made.sync.limit_us, made.sync_lost_us = 300, 100, 10_000_000
    made.sync.wander_ppb_s = 60_000
    b.adjust(made)
    for _ in range(5):
        b.sync()
        b.hear()
        b.hear()
    b.orders("ARM", "DONE", "ARMED")
    b.syncing = False
    for _ in range(30):
        b.run(20, 5000)
        if b.state != "ARMED":
            break
    b.run(8)
    b.go(20)
    b.hear()
    b.orders("RESUME", "UNSYNCED", "HOLD")
    b.order("DISARM")
    b.go(10)


def guarded(b: Bench) -> None:
    for slot in (ARMED, STANDING, MOVING, HOLDING):
        b.scene("the main loop hangs: the guard brakes; CLEAR releases it", slot)
        b.run(3, guard=1)
        b.hang(4)
        b.run(3, guard=1)
        b.hear()
        b.go(5)
        b.scene("it hangs for longer", slot)
        b.run(2, guard=1)
        b.hang(12)
        b.run(9, guard=1)
        b.expect("FAULT", "LATE")
        b.go(40)
        b.orders("CLEAR", "DONE", "UNSYNCED")
        b.go(4)
    b.scene("the guard trips by what the servo does not see: LATE, with the guard's numbers", ARMED)
    b.run(1, guard=1)
    b.hang(5, 1001)
    b.run(6, 300, guard=1)
    b.run(20, guard=1)
    b.expect("FAULT", "LATE")
    for slot in (ARMED, STANDING, MOVING, HOLDING):
        for call in range(1, 5):
            b.scene(f"the guard trips before output {call} of a period is set", slot)
            b.set(interrupt_at=call, interrupt_opens=1)
            b.run(1)
            assert b.braked and b.numbers("duty_q15") == [0]
            b.run(6)
            b.hear()
            b.go(4)
        b.scene("the guard trips by a line that the servo has not seen: LATE, by its numbers", slot)
        b.set(line_open=1)
        b.hang(1, 10)
        b.set(line_open=0)
        for _ in range(4):
            b.run(1, tell=1)
        b.expect("FAULT", "LATE")
        b.go(40)
        b.orders("CLEAR", "DONE", "UNSYNCED")
    for slot in (IDLE, MOVING):
        for calls in (5, 6, 7, 8, 9):
            b.scene(f"the guard brakes, and the main loop is back after {calls} ms", slot)
            if slot == IDLE:
                b.orders("ARM", "DONE", "ARMED")
                b.orders("JOG", "DONE", "ARMED", 0)
                b.go(8)
            b.run(2, guard=1)
            b.hang(calls)
            b.give(b.seal(COMMAND, b.command("CLEAR")))
            b.run(1, guard=1, tell=1)
            b.run(5, guard=1, tell=1)
    b.scene("late, a little and too much", ARMED)
    for step_us in (4999, 1000, 5000, 1000, 5001, 1000):
        b.run(1, step_us)
    b.run(5)
    b.hear()
    b.scene("late, without power", IDLE)
    b.run(1, 60_000)
    b.expect("IDLE")

    b.scene("CLEAR of an axis that has not been homed", IDLE)
    made = settings()
    made.home.method = 1
    b.adjust(made)
    b.set(line_open=1)
    b.go(5)
    b.set(line_open=0)
    b.orders("CLEAR", "DONE", "UNSYNCED")
    assert not b.status.homed


def several(b: Bench) -> None:
    b.scene("more faults than a log holds; it is in memory", IDLE)
    for i in range(10):
        b.set(position=321 + 600 * (i % 2 + 1) if i % 2 else 321)
        b.go(3)
        b.hear()
        b.order("CLEAR")
    b.faults()
    b.ask("device-boot", count_us=5)
    b.host.count_us = 5
    b.greet(bytes([9]) * 16)
    b.sync()
    b.run(5)
    assert len(b.faults()) == 8


def _logic(
    number: int, nodes: Sequence[tuple[int, int, int, int, int]] = (), digital: Sequence[int] = (),
    pwm: Sequence[int] = (), triggers: Sequence[tuple[int, int, int, int]] = (),
) -> bytes:  # fmt: skip
    return _core.logic_encode(number, list(nodes), list(digital), list(pwm), list(triggers))


def signals(b: Bench) -> None:
    for slot in (IDLE, ARMED, MOVING):
        b.scene("logic of all inputs and tracks, outputs, readings", slot)
        b.set(inputs=0b0101)
        every = [(0, source, 0, 3) for source in (0, 1, 2, 16)]
        b.give(b.seal(_core.FRAME_LOGIC, _logic(1, [], [21, 22, 23, 24], [16, 20], every)))
        b.run(8, tell=2)
        for number, group in enumerate(((3, 4, 17, 18), (19, 20, 21, 24), (2, 3, 4, 20)), 2):
            every = [(0, source, 0, 1) for source in group]
            logic = _logic(number, [(0, 2, 3, 0, 0)] if number == 4 else [], [24, 23], [18], every)
            b.give(b.seal(_core.FRAME_LOGIC, logic))
            b.run(6, tell=2)
            b.set(inputs=0b1010, supply_mV=25_000 + number)
        at_us = b.device_us
        b.give(b.seal(_core.FRAME_LOGIC, _logic(9, [], [5, 6], [5], [])))
        pieces = [
            (5, 0, (at_us + 3300, at_us + 3300, 0, 1)),
            (5, 1, (None, at_us + 9000, None, 90)),
        ]
        b.run(1)
        b.give(b.seal(_core.FRAME_SIGNALS, _core.batch_encode(at_us, 5, pieces)))
        b.run(14, tell=2)
        b.set(line_open=1)
        b.run(4, tell=2)
    for digital, on in (([21, 32], "3"), ([21], "1")):
        b.scene("a fault switches outputs off", IDLE)
        b.give(b.seal(_core.FRAME_LOGIC, _logic(1, [(2, 21, 0, 0, 0)], digital, [16], [])))
        b.set(inputs=1)
        b.run(6, tell=2)
        assert ("digital", on) in b.answer, b.answer
        b.keep(COOLING)
        b.set(position=5000)
        b.run(4, tell=2)
        assert "digital" not in dict(b.answer)
        b.scene("so does another host's session, in which no clock has settled", COOLING)
        b.go(20)
        assert b.greet(bytes([7]) * 16) == "ok"
        b.sync()
        b.run(8, tell=2)
        assert "digital" not in dict(b.answer)
    for source in (0, 1, 2, 3, 4, *range(16, 25)):
        b.scene(f"logic that reads source {source} alone", MOVING)
        b.set(inputs=0b1111)
        b.give(b.seal(_core.FRAME_LOGIC, _logic(1, [], [], [], [(0, source, source, 2)])))
        b.run(7, tell=1)
    for sinks in ((2, 3, 4), (4,)):
        b.scene(f"gain tracks {sinks} as values", ARMED)
        points = way(2)
        n = len(points)
        tracks: Tracks = {POSITION: points, TORQUE: [0] * n}
        tracks |= {sink: [(1 << 20) + sink] * n for sink in sinks}
        b.plans("accepted", b.knot + AHEAD, tracks)
        every = [(0, source, 0, 2) for source in (2, 3, 4, 0)]
        b.give(b.seal(_core.FRAME_LOGIC, _logic(1, [], [], [], every)))
        b.run(20, tell=1)
        for source in (2, 3, 4):
            logic = _logic(source, [], [], [], [(0, source, 0, 2)])
            b.give(b.seal(_core.FRAME_LOGIC, logic))
            b.run(6, tell=1)


SCENES = (encoder, motion, heat, line, lost, guarded, several, signals)
