"""Machines that nobody has tuned: a first config, five seconds to a position, and rest."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from sysconfig import get_path
from typing import Any

import numpy as np
from _report import arguments, finish, goal, table
from _runs import each

from headway.cli.guess.first import first_config
from headway.cli.simulation import Simulation
from headway.configs.load import load_config
from headway.controller.tick import DeviceError

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))
from trees import random_mjcf  # noqa: E402

DURATION_S = 5.0
SIZES = 7  # of random trees: 2 to 8 joints
# Of PyPI's example-robot-data, as they are.
ROBOTS = ["TwoDofs", "double_pendulum", "ur3_robot", "ur5_robot", "ur10_robot", "so101"]


def run(job: tuple[str, str]) -> dict[str, Any]:
    """A model's file: from half of the gentle motion's amplitudes beside its middle to there."""
    name, model = job
    with tempfile.TemporaryDirectory(prefix="headway-machines-") as folder:
        path = Path(folder) / "machine.yaml"
        try:
            text, _ = first_config(Path(model), path)
            path.write_text(text)
            task = load_config(path).task.axes
            target = [axis.offset for axis in task]
            start = [axis.offset + axis.amplitude / 2 for axis in task]
            config = load_config(
                path,
                [
                    f"task={{kind: regulate, target_rad_or_m: {target}}}",
                    f"sim.start_rad_or_m={start}", f"duration_s={DURATION_S}",
                ],
            )  # fmt: skip
            summary = Simulation(config, Path(folder)).run()
        except (ValueError, DeviceError) as error:
            return {"name": name, "axes": 0, "said": " ".join(str(error).split())[:200]}
    return {
        "name": name, "axes": len(target), "said": "; ".join(summary["limits_violated"]),
        "rests": bool(summary["at_rest_after_end"]),
        "rms": float(max(summary["tracking"]["rms"])),
        "refused": float(summary["solver"]["rejected"]),
        "us": float(summary["compute_us"]["p50"]),
    }  # fmt: skip


def robots() -> list[tuple[str, str]]:
    """Where the robots are, if the package is installed."""
    share = Path(get_path("purelib")) / "cmeel.prefix" / "share" / "example-robot-data"
    files = {path.stem: str(path) for path in share.glob("robots/**/*.urdf")}
    if set(ROBOTS) <= set(files):
        return [(name, files[name]) for name in ROBOTS]
    print("no robots: .venv/bin/pip install --no-deps example-robot-data", file=sys.stderr)
    return []


def main() -> int:
    options = arguments(__doc__ or "")
    trees = 20 if options.long else 2
    with tempfile.TemporaryDirectory(prefix="headway-trees-") as folder:
        jobs = []
        for seed in range(trees):
            path = Path(folder) / f"tree{seed}.xml"
            path.write_text(random_mjcf(seed, SIZES))
            jobs.append((f"random tree {seed}", str(path)))
        jobs += robots() if options.long else []
        rows = each(run, jobs, "machines")
    table("to a position in five seconds", [
        {
            "machine": row["name"], "axes": row["axes"], "rests": str(row.get("rests", False)),
            "error, rms mrad or mm": row.get("rms", np.nan),
            "plans refused": row.get("refused", np.nan), "tick, median us": row.get("us", np.nan),
            "": row["said"],
        }
        for row in rows
    ])  # fmt: skip
    rest = sum(bool(row.get("rests")) and not row["said"] for row in rows)
    goals = [goal(f"at rest, within limits, of {len(rows)}", rest, ">=", len(rows))]
    finish(rows, goals, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
