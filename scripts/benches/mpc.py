"""A tick of the optimal control problem, ours and acados', in the same closed loop.

The machine is 10 to 30 % heavier or lighter than its model, body by body, with friction, noise,
pulses of torque and jumps of the reference (grid/world.py). Every contender has a loop of its own
with the same seed; they take turns tick by tick, acados in a process of its own. Times are the
thread's, since the processors may be shared. Left out: our encoding to tracks, which acados has
not, and acados' setters in Python.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from _report import arguments, finish, goal, table
from grid.ours import Ours
from grid.race import SHIPPED, Lane, race
from grid.rival import Acados, Settings
from grid.world import Problem
from numpy.typing import NDArray

from headway.controller.ocp import (
    POSITION_TOLERANCE,
    TORQUE_TOLERANCE_SHARE,
    VELOCITY_TOLERANCE,
)

Array = NDArray[np.float64]

KNOTS = 48  # of 4.096 ms: the horizon is 197 ms
GRIDS = 24, 16, 12, 8
CONVERGED = "mpc.backend=hpipm", "mpc.sqp_iterations=8"
SOLVERS = "osqp", "hpipm", "riccati", "acados"
CLOCKS = "cpu", "wall"
# Within which a plan is believed, as ocp.py has it: shares of torque, speed and acceleration; soft
# limits [rad or m]; speed at rest.
BELIEVED = TORQUE_TOLERANCE_SHARE, 5e-3, 5e-3, POSITION_TOLERANCE, VELOCITY_TOLERANCE
PARTS = "linearize", "solve", "feedback", "tick"


@dataclass(frozen=True)
class Case:
    """A problem, and the settings of acados that were the fastest of those tried on it: both
    integrators, 5 to 25 intervals after condensing, HPIPM's modes, cold and warm starts."""

    problem: Problem
    acados: Settings


# The pendulum hangs, and is not to swing while the arm goes from place to place.
HANGING = (
    "task={kind: regulate, target_rad_or_m: [0.0, 3.141592653589793]}",
    "mpc.position_weight=[1.0e+4, 1.0e+3]",
    "mpc.velocity_weight=[1, 1]",
    "mpc.torque_step_weight=0.01",
)
CASES = [
    Case(Problem("arm2", "arm2.yaml"), Settings(integrator="ERK", condensed=8)),
    Case(Problem("arm6", "arm6.yaml"), Settings(integrator="IRK", condensed=12)),
    Case(Problem("furuta", "furuta.yaml", HANGING), Settings(integrator="ERK", condensed=5)),
]


def lane(case: Case, solver: str, intervals: int, seed: int = 0) -> Lane:
    """A contender in its loop."""
    problem = case.problem
    contender: Any
    if solver == "acados":
        contender = Acados(problem, intervals, KNOTS, case.acados)
    else:
        said = CONVERGED if solver == "converged" else (f"mpc.backend={solver}",)
        contender = Ours(problem.config(intervals, KNOTS, *said), problem.machine())
    return Lane(contender, problem, intervals, KNOTS, seed)


def times(of: Lane) -> dict[str, Array]:
    """By part, an array of all ticks [us]. The whole and the feedback are of the thread; acados
    measures its linearization by the wall clock, so that, and what is left, are by the wall."""

    def of_all(clock: str, part: str) -> Array:
        return np.array([getattr(reply, clock)[part] for reply in of.replies])

    whole = {clock: of_all(clock, "prepare") + of_all(clock, "feedback") for clock in CLOCKS}
    linearize = of_all("wall", "linearize")
    return {
        "linearize": linearize, "solve": whole["wall"] - linearize,
        "feedback": of_all("cpu", "feedback"), "tick": whole["cpu"],
    }  # fmt: skip


def time_rows(name: str, solver: str, of: Lane) -> list[dict[str, Any]]:
    """A row a part."""
    rows = []
    measured = times(of)
    for part in PARTS:
        row: dict[str, Any] = {"problem": name, "solver": solver, "N": of.intervals, "part": part}
        for title, percent in (("p50 us", 50), ("p99", 99), ("p99.9", 99.9), ("max", 100)):
            row[title] = float(np.percentile(measured[part], percent))
        rows.append(row)
    return rows


def quality_row(name: str, solver: str, of: Lane) -> dict[str, Any]:
    """What the loop made of it. Limits: of the plans, in percent of the limit beyond it; of speed
    and acceleration it is the machine's, of which a plan may have a share, for the same reasons."""
    torque, speed, acceleration, soft, end = np.max(of.over, axis=0)
    return {
        "problem": name, "solver": solver, "N": of.intervals,
        "p50 us": float(np.median(times(of)["tick"])),
        "cost": float(np.mean(of.costs)),
        "torque %": 100 * max(float(torque), 0.0), "speed %": 100 * max(float(speed), 0.0),
        "acceleration %": 100 * max(float(acceleration), 0.0),
        "soft [mrad]": 1e3 * max(float(soft), 0.0),
        "speed at rest": float(end),
        "iterations": float(np.median([reply.iterations for reply in of.replies])),
        "unconverged %": 100 * float(np.mean([not reply.good for reply in of.replies])),
        "limited %": 100 * of.active / len(of.replies),
    }  # fmt: skip


def goals_of(name: str, grid: str, lanes: dict[str, Lane]) -> list[dict[str, Any]]:
    """Ours over acados'."""
    goals = []
    stages = 0.8 if grid == "same grid" else 0.6
    wanted = [
        (solver, *measure)
        for solver in ("hpipm", "riccati")
        for measure in (("tick", 50, stages), ("tick", 99.9, stages), ("feedback", 50, 0.5))
    ]
    wanted.append(("osqp", "feedback", 50, 0.5))
    if grid != "same grid":
        wanted += [("osqp", "tick", 50, 1.0), ("osqp", "tick", 99.9, 1.5)]
    for solver, part, percent, limit in wanted:
        if solver in lanes:
            ours, theirs = (
                float(np.percentile(times(lanes[who])[part], percent)) for who in (solver, "acados")
            )
            title = f"{name}, {grid}: {solver} over acados, {part} p{percent:g}"
            goals.append(goal(title, ours / theirs, "<=", limit))
    return goals


def violations(of: Lane) -> Array:
    """The largest of each limit (5,), without what no plan is refused for."""
    largest: Array = np.max(of.over, axis=0)
    return np.where(largest <= BELIEVED, 0.0, largest)


def best(lanes: dict[tuple[str, int], Lane], converged: float) -> dict[str, Lane]:
    """The fastest grid of each solver whose loop costs at most 1 % more than a converged one, and
    violates no limit by more than acados' does."""
    found: dict[str, Lane] = {}
    for solver in sorted(SOLVERS, key="acados".__ne__):  # acados first
        fit = [
            of
            for (who, _), of in lanes.items()
            if who == solver
            and np.mean(of.costs) <= 1.01 * converged
            and ("acados" not in found or np.all(violations(of) <= violations(found["acados"])))
        ]
        if fit:
            found[solver] = min(fit, key=lambda of: float(np.median(times(of)["tick"])))
    return found


def main() -> int:
    """Exit code."""
    options = arguments((__doc__ or "").splitlines()[0])
    ticks = 3000 if options.long else 500  # as many as it takes to see a pulse and a jump
    grids = GRIDS if options.long else GRIDS[:2]
    timed, quality, goals = [], [], []
    for case in CASES:
        name = case.problem.name
        lanes = {
            (solver, intervals): lane(case, solver, intervals)
            for intervals in grids
            for solver in SOLVERS
        }
        reference = lane(case, "converged", SHIPPED)
        race({f"{s} {n}": of for (s, n), of in lanes.items()} | {"converged": reference}, ticks)
        same = {s: of for (s, n), of in lanes.items() if n == SHIPPED}
        chosen = best(lanes, float(np.mean(reference.costs)))
        rows = [row for s, of in same.items() for row in time_rows(name, s, of)]
        table(f"{name}: the same grid, thread time of {ticks} ticks", rows)
        more = [row for s, of in chosen.items() for row in time_rows(name, s, of)]
        if more:
            table(f"{name}: each one's best grid of {', '.join(map(str, grids))}", more)
        loops = [quality_row(name, s, of) for (s, _), of in lanes.items()]
        loops.append(quality_row(name, "converged", reference))
        table(f"{name}: the closed loops", loops)
        for grid, of_grid in (("same grid", same), ("best grids", chosen)):
            if "acados" in of_grid:
                goals += goals_of(name, grid, of_grid)
            else:
                print(
                    f"{name}, {grid}: acados' loop costs too much on each, so nothing is compared"
                )
        timed += [row | {"grid": "same"} for row in rows] + [row | {"grid": "best"} for row in more]
        quality += loops
        for of in lanes.values():
            of.contender.close()
    finish([*timed, *quality], goals, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
