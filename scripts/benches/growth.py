"""How a tick's time grows with the horizon and with the axes of a machine.

Machines are chains at random (tests/trees.py) with the first config that `headway init` writes for
them, in the closed loop of `scripts/bench mpc`: masses off, friction, noise, pulses, jumps. What is
timed is the compiled tick, prepare and feedback, without encoding, in the thread's time.
All problems of a row of the table take turns tick by tick. An exponent is the slope of a line
through the logarithms.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from _report import arguments, finish, goal, table
from grid.ours import Ours
from grid.race import Lane, race
from grid.reply import Watch
from grid.world import Problem
from matplotlib.figure import Figure
from numpy.typing import NDArray

from headway.cli.guess.first import first_config

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))
from trees import chain_mjcf  # noqa: E402

Array = NDArray[np.float64]

STRIDE = 2  # knots of an interval, which stays 8.2 ms long: more of them look further ahead
INTERVALS, AXES = (5, 10, 20, 40, 80), (2, 3, 4, 6, 8, 10, 12)
USUAL_INTERVALS, USUAL_AXES = 20, 6  # while the other varies
SOLVERS = "riccati", "hpipm", "osqp"
PERCENTS = {"p50": 50, "p99": 99}
SETTLED = 20  # ticks that are not counted: the first ones load code and caches
# The exponents that there should be at most.
LINEAR, QUADRATIC = 1.0, 2.0


class Compiled:
    """The two calls of a program, timed."""

    def __init__(self, tick: Any) -> None:
        self._tick, self.took_us = tick, 0.0

    def prepare(self) -> None:
        """Of the tick to come."""
        with Watch() as watch:
            self._tick.prepare()
        self.took_us = watch.cpu

    def feedback(self) -> Any:
        """From here on `took_us` is that of both."""
        with Watch() as watch:
            done = self._tick.feedback()
        self.took_us += watch.cpu
        return done


class Timed(Ours):
    """A backend whose compiled calls are timed alone."""

    def __init__(self, problem: Problem, solver: str, intervals: int) -> None:
        config = problem.config(intervals, STRIDE * intervals, f"mpc.backend={solver}")
        super().__init__(config, problem.machine())
        program, self._compiled = self.program, Compiled(self.program.tick)
        of: Any = replace(program._now, tick=self._compiled)  # type: ignore[arg-type]
        program._now, program._weighings = of, [of]
        self.took_us: list[float] = []

    def feedback(self, start: Array) -> Any:
        """As of any contender."""
        reply = super().feedback(start)
        self.took_us.append(self._compiled.took_us)
        return reply


def chain(folder: Path, axes: int) -> Problem:
    """A chain of so many axes, with its config in the folder."""
    model, config = (folder / f"chain{axes}.{end}" for end in ("xml", "yaml"))
    model.write_text(chain_mjcf(0, axes))
    config.write_text(first_config(model, config)[0])
    return Problem(config.stem, str(config))


def raced(problems: list[tuple[Problem, int]], solver: str, ticks: int) -> list[Lane]:
    """Each problem on so many intervals in a loop of its own."""
    lanes = {}
    for problem, intervals in problems:
        contender = Timed(problem, solver, intervals)
        knots = STRIDE * intervals
        lanes[f"{problem.name} {intervals}"] = Lane(
            contender, problem, intervals, knots, seed=0, measured=intervals
        )
    race(lanes, SETTLED + ticks)
    return list(lanes.values())


def exponent(counts: tuple[int, ...], times: list[float]) -> float:
    """Slope of the line through the logarithms."""
    return float(np.polyfit(np.log(counts), np.log(times), 1)[0])


def rows_of(varied: str, solver: str, counts: tuple[int, ...], lanes: list[Lane]) -> list[Any]:
    """A row a count."""
    rows = []
    for count, lane in zip(counts, lanes, strict=True):
        took = lane.contender.took_us[SETTLED:]
        iterations = [reply.iterations for reply in lane.replies[SETTLED:]]
        row: dict[str, Any] = {"varied": varied, "solver": solver, "count": count}
        row |= {f"{name} us": float(np.percentile(took, at)) for name, at in PERCENTS.items()}
        row |= {
            f"iterations {n}": float(np.percentile(iterations, at)) for n, at in PERCENTS.items()
        }
        row["limited %"] = 100 * lane.active / len(lane.replies)
        row["unconverged %"] = 100 * float(np.mean([not r.good for r in lane.replies[SETTLED:]]))
        rows.append(row)
    return rows


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Time over intervals and over axes, both in logarithms."""
    style = {"svg.hashsalt": "headway", "svg.fonttype": "path", "font.size": 9}
    matplotlib.rcParams.update(style | {"axes.spines.top": False, "axes.spines.right": False})
    figure = Figure(figsize=(8.6, 3.6), facecolor="white", layout="constrained")
    colours = dict(zip(SOLVERS, ("#1f5fa8", "#d97a0f", "#3a8f4d"), strict=True))
    panels = figure.subplots(1, 2, sharey=True)
    for panel, varied, power in zip(panels, ("intervals", "axes"), (1, 2), strict=True):
        for solver in SOLVERS:
            mine = [r for r in rows if (r["varied"], r["solver"]) == (varied, solver)]
            x = [r["count"] for r in mine]
            for name, line in (("p50 us", "-"), ("p99 us", ":")):
                panel.plot(x, [r[name] for r in mine], line, color=colours[solver], marker="o",
                           markersize=3, label=f"{solver}, {name.removesuffix(' us')}")  # fmt: skip
        first = min(r["p50 us"] for r in rows if r["varied"] == varied)
        ends = np.array([x[0], x[-1]], dtype=float)
        panel.plot(ends, first / 2 * (ends / ends[0]) ** power, color="#999999", linewidth=0.8,
                   dashes=(6, 3), label=("linear", "quadratic")[power - 1])  # fmt: skip
        panel.set(xscale="log", yscale="log", xlabel=varied, xticks=x, xticklabels=x)
        panel.minorticks_off()
        panel.grid(color="#e4e4e4", linewidth=0.6)
        panel.set_axisbelow(True)
        panel.legend(frameon=False, fontsize=7)
    panels[0].set_ylabel("a tick, prepare and feedback [us]")
    figure.savefig(path, metadata={"Date": None, "Creator": "scripts/bench growth"})


def add(parser: argparse.ArgumentParser) -> None:
    """Options of its own."""
    parser.add_argument("--svg", type=Path, metavar="FILE", help="the picture")


def main() -> int:
    options = arguments((__doc__ or "").splitlines()[0], add)
    ticks = 1000 if options.long else 300
    rows: list[dict[str, Any]] = []
    slopes, goals = [], []
    with tempfile.TemporaryDirectory(prefix="headway-growth-") as folder:
        problems = {axes: chain(Path(folder), axes) for axes in AXES}
        sweeps = {
            "intervals": (INTERVALS, [(problems[USUAL_AXES], count) for count in INTERVALS]),
            "axes": (AXES, [(problems[count], USUAL_INTERVALS) for count in AXES]),
        }
        for solver in SOLVERS:
            for varied, (counts, cases) in sweeps.items():
                mine = rows_of(varied, solver, counts, raced(cases, solver, ticks))
                rows += mine
                slope: dict[str, Any] = {"solver": solver, "varied": varied}
                for name in PERCENTS:
                    slope[name] = exponent(counts, [row[f"{name} us"] for row in mine])
                    limit = LINEAR if varied == "intervals" else QUADRATIC
                    title = f"{solver}: exponent in {varied}, {name}"
                    goals.append(goal(title, slope[name], "<=", limit))
                slopes.append(slope)
                table(f"{solver}, thread time of {ticks} ticks", mine)
    table("exponents", slopes)
    if options.svg:
        draw(rows, options.svg)
    finish([*rows, *slopes], goals, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
