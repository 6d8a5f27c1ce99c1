"""Lets somebody who has the key do his worst to a machine in simulation; says how far he got.

hostile.py [--long] [--seed N]: 20 s of simulated time, or an hour in several sieges. Progress goes
to standard error, what was found to standard output. Exits 1 if a promise was broken.

The attacker knows the devices' clocks and the machine's motion exactly. He sends plans at and just
beyond the limits, torque against the motion and with it, gain tracks at their ends, commands of
every kind, gaps, replays, wrong epochs, stamps that lie, and nothing at all. Two things he is not
given: to set the zero elsewhere (COMMAND_ZERO moves the limits with it), and hands on the machine.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from headway.configs.load import load_config
from headway.configs.schema import Config
from headway.devices.axis import AxisUnits
from headway.devices.session import Session
from headway.devices.settings import device_settings
from headway.firmware import _core
from headway.sim.plant import Plant

ROOT = Path(__file__).resolve().parents[1]
POSITION, TORQUE, KP, KI, KD = range(5)
STEP_US, TICK_MS = 1000, 4
LENGTH = 40  # points of a plan
CAUSE = _core.COMMAND_RESULTS.index("CAUSE")
SPEED_MARGIN = 1.5  # of the velocity limit, true
OUTSIDE_MARGIN = 3.0  # following limits beyond the position limits, true
SIEGE_S, SIEGES_LONG = 20, 180
Array = NDArray[np.float64]


def _load(name: str) -> ModuleType:
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
        assert spec and spec.loader
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[name]


gate_proof = _load("gate_proof")
wave, LIVE = gate_proof.wave, gate_proof.LIVE


@dataclass
class Findings:
    """What became of one axis, or of several: the worst of all."""

    caught: int = 0  # times that the device had to be freed on site
    plans: int = 0
    accepted: int = 0
    tight: int = 0  # accepted, and refused if a limit were one quantum tighter
    outside: float = -np.inf  # true position beyond the limits, in following limits
    speed: float = 0.0  # true, in velocity limits
    torque: float = 0.0  # asked of the motor, in effort limits
    reference: int = 0  # instants at which the position track was beyond a limit
    states: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)

    def add(self, other: Findings) -> None:
        for name in ("caught", "plans", "accepted", "tight", "reference"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in ("outside", "speed", "torque"):
            setattr(self, name, max(getattr(self, name), getattr(other, name)))
        self.states.update(other.states)
        self.reasons.update(other.reasons)


class Attacker:
    """Against one device."""

    def __init__(self, config: Config, index: int, plant: Plant, rng: np.random.Generator) -> None:
        self.axis, self.rng, self.plant, self.index = config.machine.axes[index], rng, plant, index
        self.units = AxisUnits.of(self.axis, config.loop)
        self.settings = device_settings(self.axis, config.device, config.loop, config.sync)
        sync = self.settings.sync  # his frames take no time
        sync.to_device_least_us, sync.to_host_least_us, sync.limit_us = 0, 0, 5000
        self.settings.sync = sync
        self.shift = self.settings.knot_shift
        self.settings.key = rng.bytes(16)
        self.limits = {sink: self.settings.limits(sink) for sink in range(5)}
        self.node = plant.nodes[index]
        self.found = Findings()
        self.mood, self.until_us = "", 0
        self.sent: list[bytes] = []
        self.pending: tuple[int, int, dict[int, NDArray[np.int32]]] | None = None
        self.push = 1.0
        self.node.flash(self.settings, int(self.rng.integers(2**32)), 30_000)
        self.node.random = int(self.rng.integers(2**63))
        self.session = Session(self.settings.key, self.rng)
        self.tracks = {sink: _core.Track() for sink in self.limits}
        self.sent = []
        self.stamps, self.pending = (0, 0), None
        self.reason = self.number = self.command = self.epoch = 0

    def caught(self) -> bool:
        """Whether nothing over the wire gets this device going again: it is out there, braked."""
        latched = self.state == "FAULT" and self.node.status.command_result == CAUSE
        return latched and not self.node.power

    # ---- what he sees

    @property
    def state(self) -> str:
        return _core.STATES[self.node.state]

    @property
    def now_us(self) -> int:
        return self.node.system_us(self.plant.true_us)

    def look(self) -> None:
        """Every millisecond."""
        q, v = self.plant.position[self.index], self.plant.velocity[self.index]
        axis, found, node = self.axis, self.found, self.node
        beyond = max(q - axis.highest, axis.lowest - q)
        found.outside = max(found.outside, beyond / axis.following)
        found.speed = max(found.speed, abs(v) / axis.velocity_limit)
        limit = self.settings.servo.torque_limit_tq
        if node.power:
            found.torque = max(found.torque, abs(node.torque_tq) / limit)
        if self.state in ("RUNNING", "COAST"):
            p, rate, torque = node.setpoint(self.now_us)
            position = self.limits[POSITION]
            found.reference += not position.point_min - 6 <= p <= position.point_max
            found.reference += abs(rate) > position.difference_max + 3
            found.reference += abs(torque) > limit + 6
        found.states[self.state] += 1
        for _, packet in node.collect():
            if self.session.welcome(packet) == "ok":
                continue
            opened = self.session.open(packet)
            if isinstance(opened, tuple) and opened[0] == _core.FRAME_STATUS:
                status = _core.status_decode(opened[1])
                assert status is not None
                self.stamps = status.sent_count_us, self.now_us
                if status.reason != self.reason:
                    self.reason = status.reason
                    found.reasons[_core.REASONS[status.reason]] += 1

    # ---- what he does

    def act(self) -> None:
        """Every tick."""
        if not self.session.established:
            self._deliver(self.session.hello())
            if not self.session.welcomed:
                return
        self._settle()
        if self.plant.true_us >= self.until_us:
            self.mood = str(
                self.rng.choice(
                    ["rush", "rush", "shake", "pump", "random", "commands", "silence", "lie"]
                )
            )
            self.until_us = self.plant.true_us + int(self.rng.integers(50_000, 1_500_000))
            self.push = float(self.rng.choice([-1.0, 1.0]))
        rng = self.rng
        lie = int(rng.choice([0, 0, 0, 300, -300, 10**5, -(10**5), 10**9]))
        if self.state in ("UNSYNCED", "IDLE") or not self._lies():
            lie = 0
        if self.mood != "silence" or self.state in ("UNSYNCED", "IDLE"):
            stamps = *self.stamps, self.now_us + lie
            self._deliver(self.session.seal(_core.FRAME_SYNC, _core.sync_encode(stamps)))
        hold_tq = int(self.push * self.settings.servo.torque_limit_tq)
        if self.state == "IDLE":
            self._ask("ARM", hold_tq, self.epoch + 1)
        elif self.state == "HOLD" and rng.random() < 0.2:
            self._ask(str(rng.choice(["RESUME", "RESUME", "STOP", "DISARM"])), 0, self.epoch + 1)
        elif self.state in ("FAULT", "ESTOP"):
            self._ask("CLEAR")
        elif self.mood == "commands":
            kinds = ["STOP", "HOME", "JOG", "JOG", "SAVE", "FAULTS", "DISARM", "RESUME"]
            argument = int(rng.choice([hold_tq, 2**31 - 1, -(2**31), 0]))
            self._ask(str(rng.choice(kinds)), argument, self.epoch + int(rng.integers(0, 2)))
        if self.state in ("ARMED", "RUNNING", "COAST") and self.mood != "silence":
            if rng.random() < 0.05 and self.sent:
                self._deliver(self.sent[int(rng.integers(len(self.sent)))])
            elif self.mood != "commands" or rng.random() < 0.2:
                self._plan()

    def _lies(self) -> bool:
        """Now and then; always would soon be doubted, and all that follows refused."""
        return self.mood == "lie" or self.rng.random() < 0.01

    def _deliver(self, packet: bytes) -> None:
        self.node.deliver(self.plant.true_us, packet)

    def _ask(self, kind: str, argument: int = 0, epoch: int = 0) -> None:
        self.command += 1
        payload = _core.command_encode(
            self.command, _core.COMMANDS.index(kind), argument, epoch % 65536
        )
        self._deliver(self.session.seal(_core.FRAME_COMMAND, payload))

    def _settle(self) -> None:
        """Learns what became of the last plan, and of the arming."""
        status = self.node.status
        if self.pending and status.plan_accepted == self.pending[0]:
            self.found.accepted += 1
            for sink, points in self.pending[2].items():
                self.tracks[sink].write(self.pending[1], points)
        self.pending = None
        if status.epoch != self.epoch or self.state not in ("ARMED", "RUNNING", "COAST"):
            self.epoch = status.epoch
            self.tracks = {sink: _core.Track() for sink in self.limits}

    def _plan(self) -> None:
        rng, knot = self.rng, self.now_us >> self.shift
        fresh = self.state == "ARMED"
        if fresh:
            self.tracks = {sink: _core.Track() for sink in self.limits}
        elif not self.tracks[POSITION].written:
            return
        first = knot + 6 if fresh else knot
        points = {POSITION: self._positions(first, knot, fresh)}
        points[TORQUE] = self._torques(first, knot, fresh)
        if rng.random() < 0.5 if fresh else self.tracks[KP].written:
            points |= {sink: self._gain(sink, first, knot, fresh) for sink in (KP, KI, KD)}
        epoch = self.epoch if rng.random() < 0.98 else self.epoch + 1
        if rng.random() < 0.01:
            first += int(rng.integers(LENGTH, 2 * LENGTH))  # a gap
        lie = int(rng.choice([0, 0, 90_000, -90_000])) if self._lies() else 0
        stamps = 0, 0, self.now_us + lie
        self.number += 1
        self.found.plans += 1
        payload = _core.plan_encode(stamps, self.number, epoch % 65536, first, points)
        packet = self.session.seal(_core.FRAME_PLAN, payload)
        self.pending = self.number, first, points
        self.sent = [*self.sent[-20:], packet]
        self._deliver(packet)
        self.found.tight += self._is_tight(first, points[POSITION], knot)

    def _old(self, sink: int, first: int) -> Array:
        return self.tracks[sink].points(first, LENGTH).astype(np.float64)

    def _positions(self, first: int, knot: int, fresh: bool) -> NDArray[np.int32]:
        """The stored track and as much of a random way as the gate just takes, or a little more."""
        rng = self.rng
        if fresh:
            here = self.plant.position[self.index] * self.units.pq_per_unit
            old = np.full(LENGTH, np.rint(here))
        else:
            old = self._old(POSITION, first)
        way = wave(rng, 1, LENGTH, np.array([LIVE]))[0]
        if self.mood in ("rush", "pump"):
            way = self.push * np.abs(way)
        least, most = self._between(POSITION, old, way, first, knot)
        if rng.random() < 0.15:
            return self._points(old, most * way)
        return self._points(old, way * least * (1.0 if rng.random() < 0.8 else rng.random()))

    def _between(
        self, sink: int, old: Array, way: Array, first: int, knot: int
    ) -> tuple[float, float]:
        """How much of a way the gate just takes, and how much it just does not."""
        least, most = 0.0, 2.0**31 / max(float(np.abs(way).max()), 1e-9)
        for _ in range(40):
            s = (least + most) / 2
            points = self._points(old, s * way)
            result = _core.gate_check_track(
                self.limits[sink], self.tracks[sink], first, points, knot
            )
            least, most = (s, most) if result == "accepted" else (least, s)
        return least, most

    def _points(self, old: Array, change: Array) -> NDArray[np.int32]:
        return np.rint(np.clip(old + change, -(2.0**31), 2.0**31 - 1)).astype(np.int32)

    def _torques(self, first: int, knot: int, fresh: bool) -> NDArray[np.int32]:
        rng, limit = self.rng, self.limits[TORQUE].point_max
        k = first + np.arange(LENGTH)
        velocity = float(self.plant.velocity[self.index])
        if self.mood == "rush":
            torque = np.full(LENGTH, self.push)
        elif self.mood == "shake":
            torque = np.sign(np.sin(2 * np.pi * k / int(rng.integers(2, 60))) + 1e-9)
        elif self.mood == "pump":
            torque = np.full(LENGTH, np.sign(velocity) or self.push)
        else:
            torque = rng.choice([-1.0, 0.0, 1.0], LENGTH)
        points = np.rint(torque * (limit + (rng.random() < 0.02))).astype(np.int32)
        if fresh:
            points[:] = points[0]
        else:
            points[:3] = self.tracks[TORQUE].points(first, 3)
        points[-3:] = points[-3]
        return points

    def _gain(self, sink: int, first: int, knot: int, fresh: bool) -> NDArray[np.int32]:
        """From one end towards the other."""
        top = self.limits[sink].point_max
        start = float(self.rng.choice([0, top]))
        old = np.full(LENGTH, start) if fresh else self._old(sink, first)
        way = np.abs(wave(self.rng, 1, LENGTH, np.array([LIVE]))[0])
        way *= 1 if old[-1] < top / 2 else -1
        return self._points(old, way * self._between(sink, old, way, first, knot)[0])

    def _is_tight(self, first: int, points: NDArray[np.int32], knot: int) -> bool:
        at, track = self.limits[POSITION], self.tracks[POSITION]
        numbers = (
            *(at.point_min, at.point_max, at.difference_max),
            *(at.second_difference_max, at.stop_difference),
        )
        if _core.gate_check_track(at, track, first, points, knot) != "accepted":
            return False
        for i, by in enumerate((1, -1, -1, -1, -1)):
            tighter = list(numbers)
            tighter[i] += by
            limits = _core.GateLimits(*tighter)
            if _core.gate_check_track(limits, track, first, points, knot) != "accepted":
                return True
        return False


def kept(found: Findings) -> bool:
    """Whether the promises held, see tests/test_hostile.py."""
    return (
        found.reference == 0
        and found.torque <= 1
        and found.speed <= SPEED_MARGIN
        and found.outside <= OUTSIDE_MARGIN
    )


def siege(path: Path, seed: int, seconds: float) -> list[Findings]:
    """By axis, after so long. The plant has no mechanical stops: nothing but the firmware holds the
    axes. Where a device is caught for good, the machine is put back and it begins anew."""
    config = load_config(path)
    model = (path.parent / config.machine.model).resolve()
    rng, axes = np.random.default_rng(seed), config.machine.axes
    found, ms = [Findings() for _ in axes], 0
    while ms < seconds * 1000:
        start = [rng.uniform(a.lowest, a.highest) * 0.9 for a in axes]
        period_us = config.device.servo_period_us
        plant = Plant(model, config.machine, config.sim.plant, period_us, start)
        plant.model.jnt_limited[:] = 0
        attackers = [Attacker(config, i, plant, rng) for i in range(len(axes))]
        while ms < seconds * 1000 and not any(attacker.caught() for attacker in attackers):
            if ms % TICK_MS == 0:
                for attacker in attackers:
                    attacker.act()
            plant.step(STEP_US // plant.step_us)
            for attacker in attackers:
                attacker.look()
            ms += 1
        for total, attacker in zip(found, attackers, strict=True):
            attacker.found.caught += attacker.caught()
            total.add(attacker.found)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    worst: dict[str, list[Findings]] = {}
    total = Findings()
    for i in range(SIEGES_LONG if arguments.long else 1):
        for path in (ROOT / "configs" / "arm2.yaml", ROOT / "tests" / "cart" / "cart.yaml"):
            found = siege(path, arguments.seed + i, SIEGE_S)
            known = worst.setdefault(path.stem, [Findings() for _ in found])
            for a, b in zip(known, found, strict=True):
                a.add(b)
                total.add(b)
        worst_so_far = (
            f"{total.outside:.3f} following limits outside, {total.speed:.3f} of the speed"
        )
        accepted = f"{total.accepted} of {total.plans} plans accepted"
        print(f"{i + 1} sieges: {worst_so_far}, {accepted}", file=sys.stderr)
    print()
    for name, findings in worst.items():
        for i, f in enumerate(findings):
            print(f"{name} axis {i}: {f}")
    return int(not kept(total))


if __name__ == "__main__":
    raise SystemExit(main())
