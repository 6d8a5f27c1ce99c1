"""Kills controllers of a moving machine, and sees by the plant's own record that it comes to rest.

kills.py [--long] [--seed N]: 10 kills, or 200, over ptys and UDP at once, at peak speed and at any
phase of the task. Real processes at real ports; a row for each kill, as soon as its plant's record
has been judged. Exits 1 if a setpoint did not rest within the plan or an axis not soon after, or if
a limit was violated.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from processes import AFTER_US, KILL, Controller, Machine, coast, within_limits

PEAKS_S = [0.5556, 1.1111, 1.6667]  # where q2 is fastest, and at 1.1111 q1 as well
TRIES = 10  # at real time a busy computer may not even start a task
BATCH = 10  # kills of one plant


def moving(machine: Machine, task_s: float, ports: Path | None = None) -> Controller:
    """A controller that has its machine in motion, at a time of the task."""
    for _ in range(TRIES):
        controller = machine.controller(ports)
        if controller.await_task(task_s):
            return controller
        controller.wait()
    raise AssertionError(machine.said)


def _kill(folder: Path, kind: str, phases: list[float], say: Callable[[str], None]) -> list[str]:
    """Kills a controller at each of these times of its task; the next one takes over."""
    killed_us = []
    folder.mkdir()
    with Machine(folder, kind, 1.0) as machine:
        for phase in phases:
            controller = moving(machine, phase)
            controller.send(KILL)
            killed_us.append(machine.now_us())
            assert controller.wait() == -KILL
            machine.pause(machine.plan_us + 2 * AFTER_US)
    truth, broken, before = machine.truth(), [], []
    if not within_limits(machine, truth):
        broken.append(f"{kind}: a limit was violated")
    for at_us, phase in zip(killed_us, phases, strict=True):
        rest = coast(machine, truth, at_us, at_us + machine.plan_us + 2 * AFTER_US)
        before.append(rest.speed)
        say(f"{kind}, killed at {phase:.3f} s: {rest}")
        broken += [f"{kind}, killed at {phase:.3f} s: {what}" for what in rest.broken]
    if np.median(before) < 1.0:
        broken.append(f"{kind}: it did not move when it was killed: {before}")
    return broken


def kills(folder: Path, count: int, seed: int, say: Callable[[str], None]) -> list[str]:
    """What broke; nothing is good. `say` gets a row for each kill."""
    rng = np.random.default_rng(seed)
    phases = [PEAKS_S[n // 2 % 3] if n % 4 > 1 else rng.uniform(0.1, 1.7) for n in range(count)]

    def over(half: int, kind: str) -> list[str]:
        mine = phases[half::2]
        parts = [mine[at : at + BATCH] for at in range(0, len(mine), BATCH)]
        return [
            what
            for number, part in enumerate(parts)
            for what in _kill(folder / f"{kind}{number}", kind, part, say)
        ]

    with ThreadPoolExecutor(2) as pool:
        jobs = [pool.submit(over, half, kind) for half, kind in enumerate(("serial", "udp"))]
        return [what for job in jobs for what in job.result()]


def main() -> int:
    """Exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true", help="200 kills")
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    count = 200 if options.long else 10
    with tempfile.TemporaryDirectory(prefix="headway-") as folder:
        broken = kills(Path(folder), count, options.seed, lambda row: print(row, flush=True))
    for what in broken:
        print(f"BROKEN: {what}")
    print(f"{count} controllers killed at speed: {len(broken)} promises broken")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
