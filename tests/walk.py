"""A random walk of a device through its states, against what each state may and must not do.

    scripts/test walk [--long] [--seed N] [--steps N]

A host that mostly does what is right, and sometimes what is not; plans good and bad; losses, late
servo periods, the emergency line, the encoder, the supply, loads and power cycles, on an axis that
moves. test_walk.py walks 10^4 servo periods, --long 10^6 from each of four seeds.
"""

import argparse
import random
import sys
from collections import Counter

import numpy as np
from rig import (
    CART,
    COUNT_PQ,
    EXITS,
    PERIOD_US,
    POLL_US,
    POSITION,
    TORQUE,
    UNITS,
    Points,
    State,
    cart_rig,
    cart_settings,
)

from headway.firmware import _core

S = State
COMMANDS = _core.COMMANDS
HOST = {"ARM", "DISARM", "PLAN", "RESUME", "STOP", "CLEAR"}  # events that a frame leads to
# Pairs that one frame, or one poll without plans and commands, may lead through.
BY_HOST = {(a, b) for (a, event), b in EXITS.items() if event in HOST | {"FAULT"}}
BY_DEVICE = {(a, b) for (a, event), b in EXITS.items() if event not in HOST - {"STOP"}}
BY_DEVICE |= {(a, d) for a, b in BY_DEVICE for c, d in BY_DEVICE if b == c}
OFF = (S.BOOT, S.UNSYNCED, S.IDLE)
STOPPED = (S.FAULT, S.ESTOP)


class Broken(AssertionError):
    """A state did what it must not."""


class Walk:
    """`visited` counts the pairs of states that followed one another."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.visited: Counter[tuple[State, State]] = Counter()
        self.results: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.periods = 0
        self.begin_life()

    # ---- the world

    def begin_life(self) -> None:
        """Another board, with settings and a plant of its own."""
        rng = self.rng
        settings = cart_settings()
        settings.brake_periods = rng.choice([0, 1, 5, 30])
        settings.stop_us = rng.choice([20_000, 100_000, 500_000])
        settings.sync_lost_us = 100_000
        settings.monitor.overload = 2000
        settings.monitor.torque_periods = rng.choice([20, 1000])
        settings.set_gap_policy(POSITION, rng.choice([0, 0, 1, 4]))
        settings.set_gap_policy(TORQUE, rng.choice([0, 2, 4]))
        home = settings.home
        home.method = rng.choice([0, 0, 1, 2, 3])
        home.backwards = rng.random() < 0.5
        home.speed_q16 = round(0.5 * UNITS.pq_per_unit * 65.536)
        home.acceleration_q16 = home.speed_q16 // 50
        home.torque_tq = round(0.8 * UNITS.tq_per_effort)
        home.way_counts, home.still_periods = 3000, 50
        self.settings = settings
        self.rig, self.axis = cart_rig(
            settings, rng.choice([0.0, -0.7, 0.5]), rng.randint(-999, 999)
        )
        self.axis.wall = 2.5
        node = self.rig.node
        node.index_every, node.switch_from, node.switch_to = 2000, 1500, 2500
        self.first = self.rig.knot
        self.points: dict[int, Points] = {}
        self.begin_tracking()

    def begin_tracking(self) -> None:
        node = self.rig.node
        self.last = self.rig.state
        self.last_power, self.last_brake = False, True  # whatever the last life left
        self.brake_since = self.state_since = self.rig.now
        self.stopped_since: int | None = None
        self.held_up = False  # since then the guard may have the output
        self.task = False
        self.rest: int | None = None
        self.last_us = node.system_us(self.rig.now)

    # ---- what the host and the world do

    def act(self) -> None:
        """One thing, as likely as it should be."""
        rng = self.rng
        chance = rng.random()
        if chance < 0.10:
            self.do_right()
        elif chance < 0.103:
            self.ask_anything()
        elif chance < 0.105:
            self.plan_anything()
        elif chance < 0.107:
            self.misfortune()
        elif chance < 0.1085:
            self.repair()
        elif chance < 0.1088:
            self.restart()
        elif chance < 0.1089:
            self.begin_life()

    def do_right(self) -> None:
        rig, node, state = self.rig, self.rig.node, self.rig.state
        torque = round(-self.axis.load * UNITS.tq_per_effort)
        patience = self.rng.random()
        if state == S.IDLE and patience < 0.2:
            self.ask("ARM", torque, rig.epoch + 1)
        elif state == S.ARMED and not node.status.homed and patience < 0.3:
            self.ask("HOME")
        elif state == S.ARMED and patience < 0.5:
            here = self.place()
            self.give(rig.knot + self.rng.randint(3, 14), [here] * 12, [torque] * 12)
        elif state in (S.RUNNING, S.COAST) and patience < 0.9:
            self.go_on()
        elif state == S.HOLD and patience < 0.1:
            self.ask("RESUME", 0, rig.epoch + 1) if patience < 0.08 else self.ask("DISARM")
        elif state == S.ARMED and patience < 0.52:
            self.ask("DISARM")
        elif state in STOPPED and patience < 0.05:
            self.repair()
            self.ask("CLEAR")

    def place(self) -> int:
        """Where the device says that the axis is, in pq."""
        samples = self.rig.statuses[-1].samples if self.rig.statuses else []
        return samples[-1][1] * COUNT_PQ if samples else 0

    def go_on(self) -> None:
        """A plan that continues the last one from some free point on, to another place."""
        begin = self.rig.knot + self.rng.randint(3, 8)
        begin = min(begin, self.first + len(self.points[POSITION]))
        keep = begin - self.first
        if keep < 1:
            return
        position = self.points[POSITION][:keep]
        way = self.rng.choice([0, 0, 1, -1, 3]) * self.rng.randint(0, 300_000)
        shape = (1 - np.cos(np.linspace(0, np.pi, 25))) / 2
        position += [round(position[-1] + way * x) for x in shape]
        position += [position[-1]] * 3
        torque = round(-self.axis.load * UNITS.tq_per_effort)
        drop = max(0, len(position) - 90)
        torques = self.points[TORQUE][:keep] + [torque] * 99
        self.give(self.first + drop, position[drop:], torques[drop : len(position)])

    def give(self, first: int, position: Points, torque: Points) -> None:
        tracks = {POSITION: position, TORQUE: torque}
        result = self.rig.give(first, tracks)
        self.results["plan " + result] += 1
        if result == "accepted":
            self.first, self.points = first, tracks
        self.look(BY_HOST)

    def plan_anything(self) -> None:
        """Late, from another epoch, with a gap, too fast, out of range, old."""
        rng, rig = self.rng, self.rig
        here = self.place()
        first = rig.knot + rng.choice([-3, 0, 2, 4, 20, 25, 1 << 30])
        end = first + 12 if not self.points else self.first + len(self.points[POSITION])
        kind = rng.randrange(6)
        if kind == 0:  # a gap
            self.give(end + rng.randint(0, 6), [here] * 12, [0] * 12)
            return
        position = [here + (kind == 1) * rng.randint(-(1 << 24), 1 << 24) for _ in range(12)]
        position[-3:] = [position[-1]] * 3 if kind != 2 else [1, 2, 3]
        epoch = rig.epoch - (kind == 3)
        number = rig.number if kind == 4 else None
        tracks = {POSITION: position, TORQUE: [0] * 12} if kind != 5 else {TORQUE: [0] * 12}
        result = rig.give(first, tracks, number, epoch % 65536)
        self.results["plan " + result] += 1
        if result == "accepted":
            self.first, self.points = first, tracks | {TORQUE: [0] * 12}
        self.look(BY_HOST)

    def ask_anything(self) -> None:
        rng = self.rng
        kind = rng.choice([*COMMANDS, "JOG", "HOME", "STOP"])
        speed = self.settings.home.speed_q16
        argument = rng.choice([0, 1, speed, -speed, 1 << 20, -(1 << 31), (1 << 31) - 1])
        self.ask(kind, argument, (self.rig.epoch + rng.randint(0, 2)) % 65536)

    def ask(self, kind: str, argument: int = 0, epoch: int = 0) -> None:
        before = self.rig.state
        result = self.rig.ask(kind, argument, epoch)
        self.results[f"{kind} {result}"] += 1
        if result == "DONE":
            if kind in ("ARM", "RESUME"):
                self.rig.epoch = epoch
            if kind in ("HOME", "JOG"):
                self.task = True
            if kind == "ZERO":
                self.rest = None
        elif self.rig.state != before:
            raise Broken(f"{kind} was answered {result} and led to {self.rig.state.name}")
        self.look(BY_HOST)

    def misfortune(self) -> None:
        rng, rig, node = self.rng, self.rig, self.rig.node
        kind = rng.randrange(8)
        if kind == 0 or kind == 7:
            node.stop_line = True
        elif kind == 1:
            node.break_encoder(rng.choice([1, 2, 3]), rig.now)
        elif kind == 2:
            node.supply_V = rng.choice([20.0, 33.5, 33.7, 57.0, 60.0, 62.0])
        elif kind == 3:
            rig.syncing = False
        elif kind == 4:
            self.axis.load = rng.uniform(-2, 2)
        elif kind == 5:
            self.axis.load = rng.choice([-1, 1]) * rng.uniform(3, 6)
        else:  # the servo is held up
            pause_us = rng.choice([1000, 3000, 5000, 20_000])
            rig.now += pause_us
            self.held_up = True
            self.state_since += pause_us  # nobody can act
            if self.stopped_since is not None:
                self.stopped_since += pause_us
            self.last_us = rig.node.system_us(rig.now)
            for _ in range(100):
                self.poll()

    def repair(self) -> None:
        node = self.rig.node
        node.stop_line = False
        node.break_encoder(0, 0)
        node.supply_V = CART.motor.supply_V
        self.rig.syncing = True
        self.axis.load = self.rng.choice([0.0, -0.7, 0.5])

    def restart(self) -> None:
        rig = self.rig
        rig.restart()
        self.points = {}
        self.begin_tracking()

    # ---- what must hold

    def poll(self) -> None:
        self.rig.poll()
        self.look(BY_DEVICE)

    def look(self, pairs: set[tuple[State, State]]) -> None:
        rig, node, state = self.rig, self.rig.node, self.rig.state
        before = self.last
        if state != before:
            if (self.last, state) not in pairs:
                raise Broken(f"from {self.last.name} to {state.name}")
            self.visited[self.last, state] += 1
            if state in (S.TAIL, *STOPPED):
                self.reasons[rig.reason] += 1
            if not (self.last in STOPPED and state in STOPPED):
                self.stopped_since = rig.now if state in STOPPED else None
            self.last, self.state_since = state, rig.now
            self.task, self.rest = False, None
        self.look_at_brake(state)
        self.look_at_setpoint(state)
        system_us = node.system_us(rig.now)
        gone_us = system_us - self.last_us
        if min(state, before) >= S.ARMED and gone_us != 0 and abs(gone_us - POLL_US) > 2:
            raise Broken(f"the clock stepped by {gone_us - POLL_US} us")
        self.last_us = system_us

    def look_at_brake(self, state: State) -> None:
        rig, node = self.rig, self.rig.node
        power, brake = node.power, node.brake
        if brake != self.last_brake:
            moves = state in (S.RUNNING, S.COAST) or (state == S.ARMED and self.task)
            if not brake and not moves:
                raise Broken(f"the brake lets go in {state.name}")
            self.brake_since = rig.now
        engages_us = self.settings.brake_periods * PERIOD_US
        if self.last_power and not power:
            if not brake or rig.now - self.brake_since < engages_us - POLL_US:
                raise Broken(f"power off before the brake is on, in {state.name}")
            if S.ARMED <= state <= S.HOLD:
                raise Broken(f"no power in {state.name}")
        self.held_up &= node.tripped
        if node.tripped and not self.held_up:
            raise Broken(f"the guard brakes an axis in good time, in {state.name}")
        if node.tripped and (node.duty_q15 or not brake):
            raise Broken(f"the guard does not hold, in {state.name}")
        if not power and node.duty_q15:
            raise Broken("duty without power")
        late_us = 2 * PERIOD_US
        if state in OFF and rig.now - self.state_since > late_us:
            if not brake:
                raise Broken(f"no brake in {state.name}")
            if power and rig.now - self.state_since > engages_us + 2 * late_us:
                raise Broken(f"power in {state.name}")
        if self.stopped_since is not None:
            over_us = rig.now - self.stopped_since - self.settings.stop_us
            if over_us > late_us and not brake:
                raise Broken(f"{state.name}: no brake after the timer")
            if over_us > late_us + engages_us + PERIOD_US and power:
                raise Broken(f"{state.name}: power after the timer")
        if abs(node.torque_tq) > self.settings.servo.torque_limit_tq:
            raise Broken("more torque than the ceiling")
        self.last_power, self.last_brake = power, brake

    def look_at_setpoint(self, state: State) -> None:
        node = self.rig.node
        if state in (S.RUNNING, S.COAST) and not node.status.homed:
            raise Broken("moves without knowing where it is")
        if state not in (S.ARMED, S.HOLD) or self.rig.now - self.state_since < 2 * PERIOD_US:
            return
        point, _, _ = node.setpoint(0)
        if self.rest is not None and point != self.rest:
            slow = (self.settings.home.speed_q16 >> 16) + 1
            jumped = abs(point - self.rest) > slow and not self.was_homed(node.status.homed)
            if not self.task or jumped:
                raise Broken(f"{state.name}: the setpoint moves from {self.rest} to {point}")
        self.homed, self.rest = node.status.homed, point

    homed = False

    def was_homed(self, homed: bool) -> bool:
        """Whether the axis has just got to know where it is, or looks for it anew."""
        return (homed and not self.homed) or self.task

    def walk(self, periods: int) -> None:
        for _ in range(periods):
            self.act()
            for _ in range(PERIOD_US // POLL_US):
                self.poll()
            self.periods += 1


def unvisited(visited: Counter[tuple[State, State]]) -> set[tuple[State, State]]:
    """DESIGN's pairs that a walk has not come through, but for bad settings at boot."""
    pairs = {(a, b) for (a, _), b in EXITS.items() if a != b and not visited[a, b]}
    return pairs - {(S.BOOT, S.FAULT)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--long", action="store_true", help="10^6 servo periods from four seeds")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=10_000)
    arguments = parser.parse_args()
    seeds = range(4) if arguments.long else [arguments.seed]
    steps = 1_000_000 if arguments.long else arguments.steps
    visited: Counter[tuple[State, State]] = Counter()
    for seed in seeds:
        walk = Walk(seed)
        try:
            walk.walk(steps)
        except Broken as broken:
            print(f"seed {seed}, servo period {walk.periods}: {broken}")
            return 1
        visited += walk.visited
        print(f"seed {seed}: {walk.periods} servo periods, {walk.visited.total()} transitions")
        print("  " + ", ".join(f"{k} {n}" for k, n in walk.reasons.most_common()))
        print("  " + ", ".join(f"{k} {n}" for k, n in walk.results.most_common()))
    for (a, b), count in sorted(visited.items()):
        print(f"{a.name:>9} -> {b.name:9} {count}")
    missing = unvisited(visited)
    print("not visited:", ", ".join(f"{a.name} -> {b.name}" for a, b in sorted(missing)) or "none")
    return 1 if arguments.long and missing else 0


if __name__ == "__main__":
    sys.exit(main())
