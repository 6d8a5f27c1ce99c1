"""Throws frames that nobody with a key has sent at a machine that moves; says what became of them.

forged.py [--long] [--seed N]: 60,000 frames, or a million, to devices and controller. Whoever
throws them sees all that passes and knows sessions and counters; he has no key. Then floods: 20,000
a second to each device. Exits 1 if one was taken, if one was not counted, or if the machine
followed its reference any worse for it; in a flood of true headers it may come to rest.

All in one process and in virtual time.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from headway.configs.load import load_config
from headway.controller.live import Live
from headway.controller.loop import Loop
from headway.controller.record.recorder import Memory
from headway.controller.tick import DeviceError, Phase
from headway.devices.stop import STATES
from headway.firmware import _core
from headway.models.machine import load_machine
from headway.sim.plant_clock import PlantClock
from headway.sim.world import World

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
DURATION_S = 2.0
ROOM = 12  # frames at once that find room in a board's inbox, beside its controller's
PATIENCE = 16  # steps in which a board has looked at all of them
FLOOD_HZ = 20_000  # to a device
RUNS = 8  # with each kind of flood
REST_US = 1_000_000  # within which a machine that was let go of rests
FLOODS = "junk", "version", "forged", "longest"
HEADED = "forged", "longest"  # of these floods the header is right: they are opened
LONGEST_US = 580  # of a Cortex-M0+ at 125 MHz for one of the longest: scripts/bench firmware
OLD_US = 100_000  # by then a frame has arrived
WIRES = ["sim.to_device.loss=0", "sim.to_host.loss=0"]  # what was lost could still be let in
Seen = deque[tuple[int, bytes]]  # when, what


LONGEST = _core.cobs_encode(
    bytes((_core.FRAME_VERSION, _core.FRAME_PLAN)) + bytes(1 + n % 255 for n in range(1018))
)


class Wiretap:
    """All packets that passed, by device: to it and from it."""

    def __init__(self, devices: int) -> None:
        self.to_device: list[Seen] = [deque(maxlen=64) for _ in range(devices)]
        self.to_host: list[Seen] = [deque(maxlen=64) for _ in range(devices)]


def old(seen: Seen, now_us: int, rng: np.random.Generator) -> bytes:
    """One that has long arrived."""
    arrived = [packet for when, packet in seen if when < now_us - OLD_US]
    return arrived[int(rng.integers(len(arrived)))]


def reseal(packet: bytes, rng: np.random.Generator, session: int, counter: int) -> bytes:
    """The same frame with a fresh counter and a tag that is guessed."""
    frame = bytearray(_core.cobs_decode(packet) or b"")
    frame[2:6] = session.to_bytes(4, "little")
    frame[6:12] = counter.to_bytes(6, "little")
    frame[-8:] = rng.bytes(8)
    return _core.cobs_encode(bytes(frame))


def forge(
    kind: str, mine: Seen, back: Seen, other: Seen, now_us: int, rng: np.random.Generator
) -> bytes:
    """A frame of a kind, for whom `mine` was sent, who sends `back`; `other`: to somebody else."""
    packet = old(mine, now_us, rng)
    header = _core.frame_header(mine[-1][1])
    assert header is not None
    _, _, session, counter = header
    if kind in HEADED:
        whole = LONGEST if kind == "longest" else packet
        return reseal(whole, rng, session, counter + 1 + int(rng.integers(1000)))
    if kind == "replayed":
        return packet
    if kind == "reflected":
        return old(back, now_us, rng)
    if kind == "truncated":
        return packet[: int(rng.integers(1, len(packet)))]
    if kind == "bit-flipped":
        spoilt = bytearray(packet)
        bit = int(rng.integers(8 * len(packet)))
        spoilt[bit // 8] ^= 1 << bit % 8
        return bytes(spoilt)
    if kind == "cross-device":
        return old(other, now_us, rng)
    junk = rng.bytes(int(rng.integers(1, 200))).replace(b"\0", b"\1")
    return junk if kind == "junk" else bytes((255, _core.FRAME_VERSION)) + junk


KINDS = "forged", "replayed", "reflected", "truncated", "bit-flipped", "cross-device", "junk"


@dataclass
class Handful:
    """Frames at a device that it has not all refused yet."""

    kind: str
    device: int
    before: int  # refused
    thrown: int = 0
    steps: int = 0


class Siege:
    """A machine in closed loop, in virtual time, and whoever throws frames at it."""

    def __init__(self, frames: int, seed: int, flood: str | None = None) -> None:
        """`frames`: how many are thrown, 0: none. `flood`: what comes all the time instead."""
        changes = [f"duration_s={DURATION_S}", f"seed={seed}", *WIRES]
        config = load_config(CONFIGS / "arm2.yaml", changes)
        self.world = World(config, CONFIGS)
        self._rng = np.random.default_rng(seed)
        self.thrown: Counter[str] = Counter()
        self.counted: Counter[str] = Counter()
        self._left, self._turn, self._flood = frames, 0, flood
        n = len(self.world.remotes)
        self._busy, self._refused = [0] * n, [0] * n
        self._tap = Wiretap(n)
        self._clock = PlantClock(self.world)
        self.record = Memory()
        machine = load_machine(self.world.model, config.machine.coupling)
        loop = Loop(config, machine, self.world.remotes, self.world.reference, self.record)
        self.live = Live(config, loop, self.world.remotes, self, self.record, self)
        self._errors: list[np.ndarray] = []

    def send(self, device: int, packet: bytes, now_us: int) -> None:
        """The link, listened to."""
        self._tap.to_device[device].append((now_us, packet))
        self.world.link.send(device, packet, now_us)

    def receive(self, now_us: int) -> list[tuple[int, int, bytes]]:
        """The link, listened to."""
        packets = self.world.link.receive(now_us)
        for device, at_us, packet in packets:
            self._tap.to_host[device].append((at_us, packet))
        return packets

    def now_us(self) -> int:
        """The host's clock."""
        return self._clock.now_us()

    def wait_until(self, time_us: int) -> None:
        """Frames are thrown while time passes."""
        while self.now_us() < time_us:
            if self.live.loop.phase is Phase.RUN:
                if self._flood is not None:
                    self._pour(self._flood)
                elif self._left > 0 and self._waiting is None:
                    self._throw()
            self._clock.wait_until(min(self.now_us() + self.world.plant.step_us, time_us))
            self._settle()
            if self._flood == "longest":
                self._burden()
            if self.live.loop.phase is Phase.RUN:
                self._note_error()

    def _throw(self) -> None:
        """A handful of one kind at one device, or at the host as if from there."""
        self._turn += 1
        kind = KINDS[self._turn % len(KINDS)]
        device = self._turn // len(KINDS) % len(self.world.remotes)
        other = (device + 1) % len(self.world.remotes)
        tap, now_us = self._tap, self.now_us()
        for _ in range(ROOM):
            packet = forge(
                kind, tap.to_device[device], tap.to_host[device], tap.to_device[other], now_us,
                self._rng,
            )  # fmt: skip
            node = self.world.plant.nodes[device]
            assert node.deliver(self.world.plant.true_us, packet)
            self._expect(kind, device)
        remote = self.world.remotes[device]
        for _ in range(ROOM):
            packet = forge(
                kind, tap.to_host[device], tap.to_device[device], tap.to_host[other], now_us,
                self._rng,
            )  # fmt: skip
            before = remote.frames_bad
            assert remote.receive(packet, now_us) is None, f"the host took a {kind} frame"
            self.thrown[kind] += 1
            self.counted[kind] += remote.frames_bad - before
            self._left -= 1

    def _pour(self, kind: str) -> None:
        """What comes to each device in a step; what finds no room its board counts."""
        now_us, plant, devices = self.now_us(), self.world.plant, len(self.world.remotes)
        for device in range(devices):
            mine, other = self._tap.to_device[device], self._tap.to_device[(device + 1) % devices]
            for _ in range(FLOOD_HZ * plant.step_us // 1_000_000):
                back = self._tap.to_host[device]
                packet = forge(kind, mine, back, other, now_us, self._rng)
                plant.nodes[device].deliver(plant.true_us, packet)
                self.thrown[kind] += 1

    def _burden(self) -> None:
        """A core that has opened one of the longest frames polls no more until it is through with
        it, and then its servo is late. Of others it is before the next poll."""
        for device, node in enumerate(self.world.plant.nodes):
            refused = node.status.frames_bad
            if self._busy[device] > 0:
                self._busy[device] -= 1
            elif refused > self._refused[device]:
                self._busy[device] = LONGEST_US // self.world.plant.step_us
            self._refused[device] = refused
            node.hung = self._busy[device] > 0

    def _expect(self, kind: str, device: int) -> None:
        if self._waiting is None:
            before = self.world.plant.nodes[device].status.frames_bad
            self._waiting = Handful(kind, device, before)
        self._waiting.thrown += 1
        self.thrown[kind] += 1
        self._left -= 1

    _waiting: Handful | None = None

    def _settle(self) -> None:
        """What the device has made of the last handful, once it has had the time."""
        if self._waiting is None:
            return
        handful = self._waiting
        handful.steps += 1
        refused = self.world.plant.nodes[handful.device].status.frames_bad - handful.before
        if refused >= handful.thrown or handful.steps == PATIENCE:
            self.counted[handful.kind] += refused
            self._waiting = None

    def _note_error(self) -> None:
        time_s = (self.now_us() - self.live.loop.start_us) * 1e-6
        if 0.5 < time_s < DURATION_S:
            wanted = self.world.reference.at(np.array([time_s]))[0][0]
            self._errors.append(self.world.plant.position - wanted)

    def run(self) -> np.ndarray:
        """Tracking error of each axis, rms [mrad]; the last handful is looked at, too."""
        self.live.run()
        while self._waiting is not None:
            self.world.plant.step(1)
            self._settle()
        return self.errors()

    def errors(self) -> np.ndarray:
        """Of each axis so far, rms [mrad]."""
        return 1e3 * np.sqrt(np.mean(np.square(self._errors), axis=0))


def besiege(frames: int, seed: int, say: Callable[[str], None]) -> list[str]:
    """What broke; nothing is good. `say` gets what was found."""
    broken: list[str] = []
    thrown: Counter[str] = Counter()
    counted: Counter[str] = Counter()
    runs: list[tuple[np.ndarray, np.ndarray]] = []  # without, and under fire
    while (left := frames - sum(thrown.values())) > 0:
        siege = Siege(left, seed := seed + 1)
        runs.append((Siege(0, seed).run(), siege.run()))
        thrown.update(siege.thrown)
        counted.update(siege.counted)
        refused = [node.status.plans_refused for node in siege.world.plant.nodes]
        if any(refused) or siege.live.device_states() != ["HOLD", "HOLD"]:
            broken.append(f"plans refused: {refused}; {siege.live.device_states()} at the end")
    for kind in KINDS:
        say(f"{kind:13} {thrown[kind]:8} thrown, {counted[kind]:8} refused and counted")
        if counted[kind] != thrown[kind]:
            broken.append(f"{kind}: {thrown[kind] - counted[kind]} were not counted as bad")
    calm, under = np.sqrt(np.mean(np.square(runs), axis=0))
    say(
        f"tracking, {len(runs)} runs: {calm.round(3)} mrad rms without, {under.round(3)} under fire"
    )
    if np.any(under > 1.1 * calm):
        broken.append("the machine followed worse")
    return broken


def drown(kind: str, seed: int, runs: int, say: Callable[[str], None]) -> list[str]:
    """What broke in a flood; nothing is good. `say` gets what was found. Of one run to the next,
    without any flood, the error differs by more than a tenth: `runs` are judged together."""
    broken: list[str] = []
    pairs: list[tuple[np.ndarray, np.ndarray]] = []  # without, and in it
    thrown = refused = dropped = 0
    stops: list[str] = []
    for number in range(seed, seed + runs):
        siege = Siege(0, number, kind)
        try:
            under = siege.run()
            pairs.append((Siege(0, number).run(), under))
        except DeviceError as error:
            stops.append(str(error))
            broken += _stopped(siege, kind)
        plant = siege.world.plant
        thrown += siege.thrown[kind]
        refused += sum(node.status.frames_bad for node in plant.nodes)
        dropped += sum(node.dropped for node in plant.nodes)
    told = [f"{len(stops)} of {runs} runs stopped: {stops[0]}"] if stops else []
    if pairs:
        calm, under = np.sqrt(np.mean(np.square(pairs), axis=0))
        told.append(f"{calm.round(3)} mrad rms without, {under.round(3)} in it")
        if np.any(under > 1.1 * calm):
            broken.append(f"{kind}: the machine followed worse")
    say(
        f"{FLOOD_HZ} a second, {kind}: {thrown} thrown, {refused} refused, {dropped} without room; "
        + "; ".join(told)
    )
    return broken


def _stopped(siege: Siege, kind: str) -> list[str]:
    """What broke where the machine has been brought to rest."""
    plant = siege.world.plant
    for node in plant.nodes:
        node.hung = False
    plant.step(REST_US // plant.step_us)
    broken = [] if kind in HEADED else [f"{kind}: the task did not go on"]
    if not all(STATES[node.state] == "HOLD" for node in plant.nodes):
        broken.append(f"{kind}: no rest")
    return broken


def main() -> int:
    """Exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true", help="a million frames")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    broken = besiege(1_000_000 if options.long else 60_000, options.seed, print)
    for kind in FLOODS:
        broken += drown(kind, options.seed, RUNS, print)
    for what in broken:
        print(f"BROKEN: {what}")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
