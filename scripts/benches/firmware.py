"""Cycles of the firmware on a Cortex-M0+: each kernel, the whole servo tick, a plan; and rivals.

The firmware, cross-compiled with -O2, runs in an emulator that counts (scripts/cortex/emulator.py
says by which table, and what a chip adds). It is the device of arm2's shoulder at work, at 10 kHz,
with all tracks and an integral, and lives through the same polls as the same device on this
computer: their states stay the same to the last byte. --profile: where a tick's cycles go, by
part, by function and by line.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "cortex"))
from _report import arguments, finish, goal, table
from emulator import RAM, SIZE, Emulator, Tally
from image import WHOLE, compile_firmware, soft_float
from profile_lines import profile
from scene import POLL_US, Scene, State, is_tick
from tools import HERE, PREFIX, need

from headway.firmware import _core

BUDGET = 1700  # of a servo tick, as it was meant to be
HELD = 1590  # and what a change may not exceed
SHORT_US, LONG_US = 100_000, 1_000_000  # of its life
PLANNED_US, SILENT_US = 8000, 400_000  # of one whose host falls silent
TICK_LEAST = 1000  # cycles: a poll without a tick has a quarter of it
PROFILED = 60  # rows
KERNELS = {  # what a tick calls
    "track_load": "spline, a knot's polynomial",
    "clock_advance": "clock map",
    "sync_carry": "clock, bounds",
    "sync_compare": "clock, comparison",
    "sync_lead": "clock, steering",
    "sync_tell": "clock, error",
    "servo_step": "PID, feed-forward, duty",
    "monitor_step": "monitors",
    "drive": "setpoint, servo, outputs",
    "signals_step": "two nodes, two digital outputs",
    "device_guard": "guard (a timer's interrupt)",
}
PARTS = {  # of a plan's frame
    "frame_open": "of it, SipHash and counter",
    "plan_decode": "of it, decoding",
    "gate_check": "of it, the gate",
}
REPORTS = ("outbox_status", "outbox_readings")
DIVISIONS = ("__udivmoddi4", "__divdi3", "__udivdi3", "__aeabi_ldivmod", "__aeabi_uldivmod")
JUNK_HZ, CLOCK_HZ = 20_000, 125_000_000  # frames to a device, and what its core runs at
POLLS_HZ = 4000  # the fewest: device.h
JUNK_SHARE = 0.10  # of all cycles, at most, for them
JUNK = {"noise": (46, 200), "version right": (47, 200), "header right": (46, 200, 1020)}  # bytes
JUNKS = 16  # of each are thrown
SEEDS = 64  # inputs of the rivals
AGREE = {"float": 0.002, "decimal": 0.02}  # of the result, by which rivals may differ
SCRATCH = RAM + SIZE - 0x8000


def reports(tally: Tally) -> int:
    """Cycles for what is sent in a poll."""
    return sum(sum(tally.calls.get(name, [])) for name in REPORTS)


def cost(tally: Tally) -> int:
    """Of a poll, but for what is sent and the guard's timer."""
    return sum(tally.calls["device_poll"]) - reports(tally)


def row(name: str, cycles: list[int]) -> dict[str, Any]:
    return {"what": name, "mean": float(np.mean(cycles)), "max": float(max(cycles))}


def life(core: Emulator, us: int, **of_scene: Any) -> list[Tally]:
    """The polls of a device at work; `of_scene` goes to its Scene."""
    scene = Scene(**of_scene)
    twin = scene.emulate(core)
    scene.run(us)
    return twin.tallies


def as_a_whole(file: Path) -> Emulator:
    """A core with the firmware built as one unit."""
    return Emulator(file, ("device_poll", *REPORTS))


def left_alone(core: Emulator) -> dict[State, list[Tally]]:
    """Ticks by state, of a device whose plan ends without another: it coasts to rest, and holds."""
    scene = Scene()
    twin, found = scene.emulate(core), dict[State, list[Tally]]()
    scene.run(PLANNED_US)
    for _ in range(SILENT_US // POLL_US):
        before = twin.state
        scene.rig.poll()
        if twin.state == before:
            found.setdefault(State(before), []).append(twin.tallies[-1])
    return {state: ticks_of(tallies) for state, tallies in found.items()}


def called(tallies: list[Tally], name: str) -> list[int]:
    return [cycles for tally in tallies for cycles in tally.calls.get(name, [])]


def junk(kind: str, size: int, scene: Scene, rng: np.random.Generator) -> bytes:
    """A packet that nobody with a key has sent."""
    noise = rng.bytes(size).replace(b"\0", b"\1")
    if kind == "noise":
        return noise
    if kind == "version right":
        return bytes((size, _core.FRAME_VERSION)) + noise[2:]
    frame = bytearray(scene.rig.host.seal(_core.FRAME_SYNC, noise[20:]))
    frame[-1] = frame[-1] % 255 + 1  # of its tag
    return bytes(frame)


def thrown(core: Emulator) -> list[dict[str, Any]]:
    """What junk costs: cycles for a packet, and the share of all cycles that a flood of it has. Of
    packets that are opened a poll takes one, the rest waits, and no more than the queue holds."""
    scene, rng, rows = Scene(), np.random.default_rng(0), []
    twin = scene.emulate(core)
    for kind, sizes in JUNK.items():
        for size in sizes:
            cycles = []
            while len(cycles) < JUNKS:
                scene.run(POLL_US)
                if twin.tallies[-1].packets > 0:
                    continue
                before = twin.status.frames_bad
                nothing = poll(scene)
                twin.deliver(scene.rig.now, junk(kind, size, scene, rng))
                cycles.append(poll(scene) - nothing)
                if twin.status.frames_bad != before + 1:
                    raise ValueError(f"{kind} of {size} bytes was not counted")
            taken_hz = JUNK_HZ
            if kind == "header right":  # or as many as a core can that does nothing else
                taken_hz = min(POLLS_HZ, CLOCK_HZ / max(cycles))
            label = f"junk of {size} bytes, {kind}"
            rows.append(row(label, cycles) | {"share": taken_hz * max(cycles) / CLOCK_HZ})
    return rows


def poll(scene: Scene) -> int:
    """Cycles of the inbox in another poll at the same instant, when no servo is due."""
    rig = scene.rig
    rig.node.poll(rig.now, rig.encoder(rig.now))
    tallies: list[Tally] = rig.node.tallies  # type: ignore[attr-defined]
    return sum(tallies[-1].calls["inbox_take"])


def siphash(core: Emulator, size: int) -> int:
    core.take()
    core.write(SCRATCH, bytes(range(256)) * 5)
    core.call("siphash24", SCRATCH, 0, SCRATCH + 16, size)
    return core.take().cycles


def rivals(file: Path, device: bytes) -> list[dict[str, Any]]:
    """The servo's two kernels in three kinds of numbers; raises ValueError if they disagree."""
    core = Emulator(file)
    core.write(core.address("the_device"), device)
    rows = []
    for work in ("spline", "pid"):
        cycles: dict[str, list[int]] = {kind: [] for kind in ("fixed", *AGREE)}
        for seed in range(SEEDS):
            results = {}
            for kind in cycles:
                core.call("rivals_prepare", seed)
                core.take()
                results[kind] = np.int32(np.uint32(core.call(f"{work}_{kind}")))
                cycles[kind].append(core.take().cycles)
            for kind, share in AGREE.items():
                apart = abs(int(results[kind]) - int(results["fixed"]))
                if apart > max(30, share * abs(int(results["fixed"]))):
                    raise ValueError(f"{work}, seed {seed}: {results}")
        fixed = np.mean(cycles["fixed"])
        rows.append(
            {
                "what": "spline, value and rate" if work == "spline" else "PID, feed-forward, duty",
                "fixed": float(fixed),
                "soft-float": float(np.mean(cycles["float"])),
                "ratio": float(np.mean(cycles["float"]) / fixed),
                "4 decimal digits": float(np.mean(cycles["decimal"])),
                "ratio of it": float(np.mean(cycles["decimal"]) / fixed),
            }
        )
    return rows


Rows = list[dict[str, Any]]


def ticks_of(tallies: list[Tally]) -> list[Tally]:
    """Polls with a servo tick and nothing else: as one unit no function of it has a name."""
    busy = [t for t in tallies if t.packets == 0 and not reports(t)]
    return [t for t in busy if cost(t) > TICK_LEAST]


def whole(folder: Path, us: int) -> tuple[Emulator, Path, list[Tally]]:
    """The firmware built as one unit, and the ticks of its life."""
    image = compile_firmware(folder / "whole.elf", options=WHOLE)
    core = as_a_whole(image)
    return core, image, ticks_of(life(core, us))


def measure(us: int) -> tuple[Rows, Rows, Rows, Rows]:
    """Cycles, floods of junk, rivals and goals, of so long a life."""
    with tempfile.TemporaryDirectory() as folder:
        _, file, ticks_seen = whole(Path(folder), us)
        ticks = [cost(t) for t in ticks_seen]
        other_nodes = ticks_of(life(as_a_whole(file), us, kinds=("edge", "add")))
        alone = left_alone(as_a_whole(file))
        image = compile_firmware(Path(folder) / "firmware.elf")
        core = Emulator(image, ("device_poll", "inbox_take", *REPORTS, *KERNELS, *PARTS))
        tallies = life(core, us)
        apart = [t for t in tallies if is_tick(t)]
        idle = [t for t in tallies if "servo_step" not in t.calls and t.packets == 0]
        plans = [t for t in tallies if "gate_check" in t.calls and "servo_step" not in t.calls]
        cycles = [
            row("servo tick, whole", ticks),
            row("the same with nodes edge and add", [cost(t) for t in other_nodes]),
            row("the same, coasting to rest", [cost(t) for t in alone[State.COAST]]),
            row("the same, at rest in HOLD", [cost(t) for t in alone[State.HOLD]]),
            row("the first, compiled file by file", [cost(t) for t in apart]),
            *(
                row(f"  {label}", called(apart, name))
                for name, label in KERNELS.items()
                if called(apart, name)
            ),
            row("poll between ticks", [cost(t) for t in idle]),
            row("PLAN frame, 55 points on 5 tracks", [cost(t) for t in plans]),
            *(row(f"  {label}", called(plans, name)) for name, label in PARTS.items()),
            row("STATUS and READINGS frames", [reports(t) for t in tallies if reports(t)]),
            row("SipHash of 64 bytes", [siphash(core, 64)]),
            row("SipHash of 12 bytes, of the shortest frame", [siphash(core, 12)]),
        ]
        device = core.read(core.address("the_device"), core.read_u32("the_sizes"))
        floods = thrown(core)
        others = compile_firmware(Path(folder) / "rivals.elf", [HERE / "rivals.c"])
        compared = rivals(others, device)
        worst = cycles[0]["max"]
        divided = sum(t.own.get(name, 0) for t in apart for name in DIVISIONS)
        goals = [
            goal("servo tick, maximum [cycles]", worst, "<=", BUDGET),
            goal("servo tick, maximum, no more than before [cycles]", worst, "<=", HELD),
            goal(
                "routines of soft-float in the image", len(soft_float(core.image.symbols)), "<=", 0
            ),
            goal("cycles of 64-bit divisions in all ticks", divided, "<=", 0),
            *(
                goal(f"{flood['what']}, {JUNK_HZ}/s [share]", flood["share"], "<=", JUNK_SHARE)
                for flood in floods
            ),
        ]
    return cycles, floods, compared, goals


def print_profile(us: int) -> None:
    """Mean and worst tick, by part, by function and by line."""
    with tempfile.TemporaryDirectory() as folder:
        core, image, ticks = whole(Path(folder), us)
        for what, chosen in (("mean", ticks), ("worst", [max(ticks, key=cost)])):
            for by in ("part", "function", "line"):
                rows = profile(core, image, chosen, by)
                table(f"Servo tick, {what}, cycles by {by}", rows[:PROFILED])


def add_profile(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--profile", action="store_true", help="where a tick's cycles go")


def main() -> None:
    need(f"{PREFIX}gcc")
    options = arguments(__doc__ or "", add_profile)
    us = LONG_US if options.long else SHORT_US
    if options.profile:
        print_profile(us)
        return
    cycles, floods, compared, goals = measure(us)
    table("Cortex-M0+, cycles", cycles)
    table(f"Junk, cycles a packet; {JUNK_HZ} a second: share of {CLOCK_HZ / 1e6:.0f} MHz", floods)
    table("The same work in other numbers, cycles", compared)
    finish([*cycles, *floods, *compared], goals, options.json)


if __name__ == "__main__":
    main()
