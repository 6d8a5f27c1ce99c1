"""What lost frames do to a plan for two axes: knots of which each axis executes another version."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path
from typing import Any

import numpy as np
from _report import arguments, finish, goal, table
from _runs import each
from numpy.typing import NDArray

from headway.cli.simulation import Simulation
from headway.configs.load import load_config
from headway.controller.record.columns import Arrays
from headway.controller.tick import DeviceError

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
LINK_M = 0.3  # both links of arm2: what an angle is worth as a path
BITS = 32

Array = NDArray[np.float64]


def plans(record: Arrays, device: int) -> dict[int, tuple[int, NDArray[np.int64]]]:
    """By number: the first knot and the position points of every plan sent to a device."""
    rows = np.flatnonzero(record["sent_plan"] & (record["sent_device"] == device))
    offsets, points = record["sent_position_pq_offsets"], record["sent_position_pq"]
    return {
        int(record["sent_number"][i]): (
            int(record["sent_first_knot"][i]),
            points[offsets[i] : offsets[i + 1]],
        )
        for i in rows
    }


def accepted(record: Arrays, device: int) -> set[int]:
    """Numbers of the plans that a device has told to have accepted."""
    numbers = set[int]()
    for i in np.flatnonzero(record["received_status"] & (record["received_device"] == device)):
        seen, mask = int(record["received_plan_seen"][i]), int(record["received_accepted_mask"][i])
        numbers |= {seen - bit for bit in range(BITS) if mask >> bit & 1}
    return numbers


def versions(record: Arrays, axes: int, margin: int) -> tuple[NDArray[np.bool_], Array]:
    """For every knot of the task and axis: whether the point that was executed is the last version
    that the host sent, and by how much it differs [pq]."""
    final: list[dict[int, int]] = []
    executed: list[dict[int, int]] = []
    knot_us = int(np.median(np.diff(record["tick_us"])))
    tick_knot = dict(zip(record["tick_sent_us"], record["tick_us"] // knot_us, strict=True))
    for device in range(axes):
        rows = np.flatnonzero(record["sent_plan"] & (record["sent_device"] == device))
        ticks = {
            int(record["sent_number"][i]): int(tick_knot.get(record["sent_us"][i], 0)) for i in rows
        }
        sent, taken = plans(record, device), accepted(record, device)
        final.append({})
        executed.append({})
        for number, (first, points) in sorted(sent.items()):
            knots = range(first, first + len(points))
            if number in taken:
                executed[-1].update(zip(knots, points.tolist(), strict=True))
            # Free at this tick: what lies beyond the margin; the rest repeats what was sent.
            free = ticks[number] + margin + 2
            final[-1].update(
                (knot, point)
                for knot, point in zip(knots, points.tolist(), strict=True)
                if knot >= free
            )
    start = int(record["task_start_us"][0])
    low, high = start // knot_us + 60, int(record["tick_us"][-1]) // knot_us
    rows = [
        k
        for k in range(low, high)
        if all(k in f and k in e for f, e in zip(final, executed, strict=True))
    ]
    excess = np.array(
        [[e[k] - f[k] for f, e in zip(final, executed, strict=True)] for k in rows], dtype=float
    )
    return excess == 0, excess


def run(job: tuple[int, float, float, int, float]) -> dict[str, Any]:
    """One run at a margin [knots], loss, mean length of a loss and seed."""
    margin, loss, length, seed, duration_s = job
    changes = [
        f"seed={seed}", f"duration_s={duration_s}", f"loop.margin_us={margin * 4096}",
        f"sim.to_device.loss={loss}", f"sim.to_device.loss_run={length}",
        f"sim.to_host.loss={loss}", f"sim.to_host.loss_run={length}",
    ]  # fmt: skip
    config = load_config(CONFIGS / "arm2.yaml", changes)
    simulation = Simulation(config, CONFIGS)
    axes, ended = config.machine.axes, False
    rms = np.full(len(axes), np.nan)
    try:
        rms = np.array(simulation.run()["tracking"]["rms"])
    except DeviceError:  # a run of losses is longer than a plan may wait: all came to rest
        ended = True
    same, excess = versions(simulation.record.arrays(), len(axes), margin)
    mixed = same.any(axis=1) & ~same.all(axis=1)
    to_mrad = np.array([1e3 / (a.counts_per_unit * 1024) for a in axes])
    return {
        "knots": len(same),
        "mixed": int(mixed.sum()),
        "path_mrad": float(np.abs(excess * to_mrad)[mixed].max(initial=0.0)),
        "rms": rms,
        "ended": ended,
    }


def tool(q: Array) -> Array:
    """Place of arm2's tool [m] at joint angles (m, 2)."""
    first, second = q[:, 0], q.sum(axis=1)
    return LINK_M * np.stack((np.cos(first) + np.cos(second), np.sin(first) + np.sin(second)), 1)


def stop(job: tuple[float, int, float]) -> float:
    """Largest distance [mm] of the tool, while it comes to rest after the host was killed, from the
    path that the host planned last."""
    loss, seed, at_s = job
    changes = [
        f"seed={seed}", f"duration_s={at_s + 0.5}", f"sim.kill_host_at_s={at_s}",
        f"sim.to_device.loss={loss}", f"sim.to_host.loss={loss}",
    ]  # fmt: skip
    config = load_config(CONFIGS / "arm2.yaml", changes)
    simulation = Simulation(config, CONFIGS)
    simulation.run()
    record, planned = simulation.record.arrays(), []
    for device, axis in enumerate(config.machine.axes):
        first, points = max(plans(record, device).items())[1]
        scale = 1 / (axis.counts_per_unit * 1024)
        value = np.convolve(points, [1 / 6, 4 / 6, 1 / 6], "valid") * scale
        planned.append(value)
    knots = (first + 1 + np.arange(len(planned[0]))) * config.loop.knot_us
    actual = np.stack(
        [
            np.interp(knots, record["truth_us"], record["truth_position"][:, axis])
            for axis in range(len(planned))
        ],
        axis=1,
    )
    return float(1e3 * np.linalg.norm(tool(actual) - tool(np.stack(planned, 1)), axis=1).max())


CASES = (  # name, loss, frames lost in a row
    ("none", 0.0, 1.0),
    ("1 % by chance", 0.01, 1.0),
    ("1 % in runs of 4", 0.01, 4.0),
    ("10 % by chance", 0.1, 1.0),
    ("10 % in runs of 4", 0.1, 4.0),
)


def main() -> int:
    """Exit code."""
    options = arguments(__doc__ or "")
    seeds, duration_s = (10, 20.0) if options.long else (2, 4.0)
    margins = (2, 3, 4) if options.long else (3,)
    grid = list(itertools.product(margins, CASES))
    jobs = [
        (margin, loss, length, seed, duration_s)
        for margin, (_, loss, length) in grid
        for seed in range(seeds)
    ]
    phases = np.linspace(1.0, 3.2, 100 if options.long else 12)
    rows = []
    results = each(run, jobs)
    for i, (margin, (name, _, _)) in enumerate(grid):
        mine = results[i * seeds : (i + 1) * seeds]
        knots = sum(r["knots"] for r in mine)
        rms = np.nanmedian([r["rms"] for r in mine], axis=0)
        rows.append({
            "margin knots": margin, "loss, each way": name, "knots": knots,
            "mixed knots": sum(r["mixed"] for r in mine),
            "mixed %": 100 * sum(r["mixed"] for r in mine) / knots,
            "error of a mixed point, mrad": max(r["path_mrad"] for r in mine),
            "rms q1 mrad": rms[0], "rms q2 mrad": rms[1],
            "runs": len(mine), "came to rest before their end": sum(r["ended"] for r in mine),
        })  # fmt: skip
    stops = {
        loss: each(stop, [(loss, seed, at_s) for seed, at_s in enumerate(phases)], "stops")
        for loss in (0.0, 0.01)
    }
    table("lost frames, arm2 as shipped", rows)
    without, with_loss = max(stops[0.0]), max(stops[0.01])
    table("the host is killed: the tool's largest distance from the planned stop", [
        {"loss": f"{loss:.0%}", "stops": len(mm), "median mm": float(np.median(mm)),
         "largest mm": max(mm)} for loss, mm in stops.items()
    ])  # fmt: skip
    one = next(r for r in rows if r["margin knots"] == 3 and r["loss, each way"] == "1 % by chance")
    goals = [
        goal("mixed knots at 1 % by chance, 3 knots of margin [%]", one["mixed %"], "<=", 0.02),
        goal("killed host at 1 %: more than without loss [mm]", with_loss - without, "<=", 0.1),
    ]
    finish(rows, goals, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
