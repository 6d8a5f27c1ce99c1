"""The loop on the wall clock, against a plant in a process: latency, jitter, missed deadlines."""

from __future__ import annotations

import sys
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from _report import arguments, finish, goal, table

from headway.cli.failure import Failure
from headway.cli.linked import Linked
from headway.cli.measure import Measured, measure
from headway.configs.load import load_config

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
MACHINES = "arm2", "arm6"
KNOTS = 52  # of a plan, at most: longer ones do not fit a frame
HORIZON_US = 212992
MARGIN_US = 12288


def changes(knot_us: int, duration_s: float) -> list[str]:
    """Of the config, for a rate: the horizon as long as a frame allows."""
    horizon_us = min(HORIZON_US, KNOTS * knot_us)
    return [
        f"duration_s={duration_s}", f"loop.knot_us={knot_us}", f"mpc.horizon_us={horizon_us}",
        f"loop.margin_us={max(MARGIN_US, 2 * knot_us)}", "sync.limit_us=2000",
    ]  # fmt: skip


def row(machine: str, knot_us: int, mode: str, m: Measured) -> dict[str, Any]:
    def of(values: Any, percent: float) -> float:
        return float(np.percentile(values, percent))

    return {
        "machine": machine, "rate Hz": 1e6 / knot_us, "mode": mode, "ticks": len(m.ready_us),
        "wake-up p50 us": of(m.wake_us, 50), "p99": of(m.wake_us, 99),
        "p99.9": of(m.wake_us, 99.9), "max": float(m.wake_us.max()),
        "compute p50 us": of(m.compute_us, 50), "c p99": of(m.compute_us, 99),
        "c p99.9": of(m.compute_us, 99.9), "ready p99.9 us": of(m.ready_us, 99.9),
        "missed ppm": 1e6 * m.missed / m.knots, "late points": m.late_points,
        "to its end": "no" if m.failure else "yes",
    }  # fmt: skip


def main() -> int:
    """Exit code. What is missed is by the computer's other work as well: let it be idle."""
    options = arguments(__doc__ or "")
    duration_s = 120.0 if options.long else 20.0
    rows = []
    for machine, knot_us, mode in product(MACHINES, (8192, 4096, 2048, 1024), ("plain", "FIFO")):
        path, said = CONFIGS / f"{machine}.yaml", changes(knot_us, duration_s)
        linked = Linked("udp", spawn=True, punctual=mode == "FIFO")
        try:
            measured = measure(linked, path, load_config(path, said), said)
            rows.append(row(machine, knot_us, mode, measured))
        except Failure as failure:
            print(f"{machine}, {1e6 / knot_us:.0f} Hz, {mode}: {failure}", file=sys.stderr)
    table("the loop on the wall clock, over UDP", rows)
    shipped = [
        r
        for r in rows
        if r["mode"] == "FIFO" and r["machine"] == "arm2" and 240 < r["rate Hz"] < 250
    ]
    goals = [
        goal("missed per million at 244 Hz, FIFO", r["missed ppm"], "<=", 1e3) for r in shipped
    ]
    finish(rows, goals, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
