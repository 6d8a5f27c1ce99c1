"""The tick's problem: two solvers against a third one, and answers that are not to be trusted."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import osqp
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray

from headway.configs.load import load_config
from headway.controller import program
from headway.controller._tick import Answer, Stranger
from headway.controller.mpc import Mpc, Solution
from headway.controller.ocp import Limits, Ocp
from headway.controller.prediction import Prediction
from headway.controller.program import Program
from headway.controller.tick import Phase
from headway.models.codegen import compile_functions
from headway.models.machine import load_machine
from headway.sim.lockstep import Lockstep

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
Array = NDArray[np.float64]


def lockstep(*overrides: str) -> Lockstep:
    return Lockstep(load_config(CONFIGS / "arm2.yaml", list(overrides)), CONFIGS)


# Two solvers and their oracle.


class Problem:
    """One tick's problem, and what its solver made of it."""

    def __init__(
        self, ocp: Ocp, pool: dict[str, Array], entries: Array, solution: Solution
    ) -> None:
        self.constraints = ocp.constraints.copy()
        self.constraints.data[:] = entries[:, 0]
        self.vectors = [pool[name][:, 0].copy() for name in ("gradient", "lower", "upper")]
        self.hessian, self.z = ocp.hessian, pool["z"][:, 0].copy()
        self.solution = solution

    def cost(self, z: Array) -> float:
        whole = self.hessian + sp.triu(self.hessian, 1).T
        return float(z @ (whole @ z) / 2 + self.vectors[0] @ z)

    def exact(self) -> Array:
        """By the osqp package, to nine digits."""
        gradient, lower, upper = self.vectors
        solver = osqp.OSQP()
        solver.setup(
            self.hessian, gradient, self.constraints, lower, upper,
            eps_abs=1e-9, eps_rel=1e-9, max_iter=100_000, polishing=True, verbose=False,
        )  # fmt: skip
        result = solver.solve(raise_error=True)
        assert result.info.status == "solved"
        z: Array = result.x
        return z


@cache
def problems(backend: str, *more: str) -> list[Problem]:
    """Of a run with a reference that asks for more torque than there is."""
    lock = lockstep(f"mpc.backend={backend}", "duration_s=1.5", "task.frequency_Hz=0.6", *more)
    seen: list[Problem] = []
    controller = lock.loop._mpc
    assert controller is not None
    ocp = Ocp(lock.config, Limits.of(lock.config))
    knots = lock.config.mpc.horizon_us // lock.config.loop.knot_us
    assemble = program.assembly(
        compile_functions("mpc", ocp.functions(knots)), ocp, dict(controller.program.pool)
    )
    solve = controller.solve

    def solve_seen(*arguments: Any) -> Solution:
        solution = solve(*arguments)
        seen.append(Problem(ocp, controller.program.pool, assemble.run()[0], solution))
        return solution

    controller.solve = solve_seen  # type: ignore[method-assign]
    lock.run()
    return seen


@pytest.mark.parametrize(
    ("backend", "tolerance"), [("osqp", 0.2), ("hpipm", 1e-3), ("riccati", 1e-3)]
)
def test_a_solver_finds_what_another_one_finds(backend: str, tolerance: float) -> None:
    """In the cost, and in the states that it weighs, in units of a millirad. What comes after them
    only has to stop, and one way is as good as another."""
    every = problems(backend, "mpc.position_weight=1e6", "mpc.velocity_weight=200")
    assert len(every) > 300
    for problem in every[::30]:
        assert problem.solution.residual <= 1
        exact = problem.exact()
        assert np.abs(problem.z - exact)[: 10 * 4].max() < tolerance
        cost = problem.cost(exact)
        assert abs(problem.cost(problem.z) - cost) < 0.05 + 1e-3 * abs(cost)


def test_limits_are_active_in_these_problems() -> None:
    """Else they would show little."""
    share = 0
    for problem in problems("hpipm")[::10]:
        _, lower, upper = problem.vectors
        value = problem.constraints @ problem.z
        share += bool(np.any((np.minimum(value - lower, upper - value) < 1e-3) & (lower < upper)))
    assert share >= 3


def test_the_residual_is_that_of_the_constraints() -> None:
    """By the matrix, where the tick goes by its blocks: with the units' tolerances undone, the two
    vanish and grow together."""
    for problem in problems("osqp")[::50]:
        _, lower, upper = problem.vectors
        value = problem.constraints @ problem.z
        excess = np.maximum(lower - value, value - upper)[: -2 * 26 * 2].max()
        assert (problem.solution.residual > 0.01) <= (excess > 1e-5)


@pytest.mark.parametrize("backend", ["osqp", "hpipm", "riccati"])
def test_the_kkt_residuals_bound_what_an_answer_costs_too_much(backend: str) -> None:
    """By convexity, with any multipliers: cost(z) - cost(z*) <= slope of the Lagrangian times
    (z - z*) + the products of multipliers and distances (Boyd, Vandenberghe, Convex Optimization,
    section 5.5.1)."""
    of_scale = Ocp(lockstep().config, Limits.of(lockstep().config)).column_scale
    for problem in problems(backend)[::30]:
        exact, solution = problem.exact(), problem.solution
        excess = problem.cost(problem.z) - problem.cost(exact)
        slope = solution.stationarity * float(np.abs((problem.z - exact) * of_scale).sum())
        # Two products for each box by stages, one for each of OSQP's rows.
        assert excess <= slope + 2 * len(problem.vectors[1]) * solution.complementarity + 1e-6


def test_the_kkt_residuals_grow_where_a_solver_stops_early() -> None:
    early = problems("osqp", "mpc.max_iterations=10")
    for name in ("stationarity", "complementarity"):
        late, soon = (
            float(np.median([getattr(p.solution, name) for p in of]))
            for of in (problems("osqp"), early)
        )
        assert soon > 3 * late


# More programs a tick.


def test_programs_in_a_row_converge_on_the_motion_itself() -> None:
    """The plan's torques, put into the machine's equations, give the plan's states: after one
    program as far as they are linear, after six to the solver's tolerance."""

    def defect(iterations: int) -> float:
        overrides = [f"mpc.sqp_iterations={iterations}", "mpc.backend=hpipm"]
        config = load_config(CONFIGS / "arm2.yaml", overrides)
        machine = load_machine(CONFIGS / config.machine.model)
        count, prediction = config.mpc.intervals, Prediction.of(config, machine)
        solver = Program(config, prediction)
        n, q = 2, np.array([0.3, 0.2])
        still = np.repeat(np.concatenate((q, np.zeros(n)))[:, None], count + 1, axis=1)
        torque = np.repeat(prediction.holding(q, np.zeros(n))[:, None], count + 1, axis=1)
        solver.prepare(still, torque, np.zeros(n))
        reference = still + np.array([[0.2], [-0.3], [0], [0]])
        done = solver.feedback(
            still[:, 0], np.array([0.3, -0.1]), reference, torque[:, 0], torque[:, 0]
        )
        assert done.accepted
        x, u = solver.answer()
        solver.prepare(x, u, np.array([0.3, -0.1]))
        return float(np.abs(solver.pool["after"] - x[:, 1:]).max())

    assert defect(1) > 100 * defect(6)
    assert defect(6) < 1e-6


# Answers that are not to be trusted.

GOOD = Answer(0, 5, True)
Twist = Callable[[Array, dict[str, Array]], tuple[Array, Answer]]


def with_entry(z: Array, value: float) -> Array:
    z[len(z) // 3] = value
    return z


def raising(z: Array, _: dict[str, Array]) -> tuple[Array, Answer]:
    raise ArithmeticError("singular")


def thrown(z: Array, pool: dict[str, Array]) -> tuple[Array, Answer]:
    """Full torque one way: as the dynamics have it, but it does not rest and knows no limits."""
    n, scale = 2, pool["parameters"].ravel()[-len(pool["lower"]) - len(z) :][: len(z)]
    nodes = pool["u"].shape[1]
    dx, du = np.zeros((nodes, 2 * n)), np.full((nodes, n), 6.0)
    dx[0] = z[: 2 * n] * scale[: 2 * n]
    for i in range(nodes - 1):
        a, b0, b1 = (
            pool[name][:, i * w : (i + 1) * w] for name, w in (("a", 4), ("b0", 2), ("b1", 2))
        )
        dx[i + 1] = (
            a @ dx[i] + b0 @ du[i] + b1 @ du[i + 1] + pool["after"][:, i] - pool["x"][:, i + 1]
        )
    z[:-n] = np.concatenate((dx.ravel(), du.ravel())) / scale[:-n]
    return z, GOOD


HOSTILE: dict[str, Twist] = {
    "not a number": lambda z, _: (with_entry(z, np.nan), GOOD),
    "infinite": lambda z, _: (with_entry(z, np.inf), GOOD),
    "OSQP's mark of failure": lambda z, _: (np.full_like(z, 2143289344.0), GOOD),
    "a bad flag": lambda z, _: (z, Answer(3, 5, False)),
    "infeasible, but solved": lambda z, _: (z + 0.5 * np.sin(np.arange(len(z))), GOOD),
    "of the wrong size": lambda z, _: (z[1:], GOOD),
    "raising": raising,
    "obeying the dynamics alone": thrown,
}


def run_with(
    twist: Twist, bad: range, monkeypatch: pytest.MonkeyPatch
) -> tuple[Lockstep, list[bool]]:
    """A run whose solver is sound but in some ticks; whether each tick's plan was taken."""
    taken: list[bool] = []
    solve = Mpc.solve

    def build(config: Any, ocp: Ocp, pool: dict[str, Array]) -> Stranger:
        real, z = program._hpipm(ocp, pool), np.zeros(ocp.size)

        def respond() -> tuple[Array, Answer]:
            real.update()
            answer = real.solve(z)
            return twist(z.copy(), pool) if len(taken) in bad else (z, answer)

        return Stranger(ocp.size, respond)

    def solve_seen(self: Mpc, *arguments: Any) -> Solution:
        solution = solve(self, *arguments)
        taken.append(solution.plan is not None)
        return solution

    with monkeypatch.context() as patch:
        patch.setattr(program, "_osqp", build)
        patch.setattr(Mpc, "solve", solve_seen)
        lock = lockstep("duration_s=2", "mpc.backend=osqp")
        lock.run()
    return lock, taken


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_bad_answer_is_refused_and_the_old_plan_runs_on(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eight ticks of nonsense, twice: all are refused, no other tick is, and the way comes back."""
    bad = [*range(100, 108), *range(200, 208)]
    lock, taken = run_with(HOSTILE[kind], bad, monkeypatch)
    assert [i for i, good in enumerate(taken) if not good] == bad
    record = lock.record.arrays()
    error = record["truth_position"] - lock.loop.task.at(record["truth_s"])[0]
    during = (record["truth_s"] > 0.6) & (record["truth_s"] < 1.95)
    assert np.abs(error[during]).max() < 0.05
    late = during & (record["truth_s"] > 1.3)
    assert np.sqrt(np.mean(error[late] ** 2)) < 1e-3


def test_if_nonsense_lasts_the_machine_rests(monkeypatch: pytest.MonkeyPatch) -> None:
    lock, taken = run_with(HOSTILE["not a number"], range(100, 10**9), monkeypatch)
    assert not any(taken[100:])
    record = lock.record.arrays()
    plan_s = (lock.config.loop.margin_us + lock.config.mpc.horizon_us) * 1e-6
    rest_s = plan_s + 0.25  # five time constants of the servos later
    late = record["truth_s"] > record["tick_s"][100] + rest_s
    assert late.sum() > 500
    assert np.abs(record["truth_velocity"][late]).max() < 0.02
    assert np.ptp(record["truth_position"][late], axis=0).max() < 1e-3


def test_a_guess_that_is_no_motion_is_noticed() -> None:
    """Not a number in the linearization: the largest violation alone would not show it."""
    lock = lockstep("duration_s=0.2")
    lock.run()
    controller = lock.loop._mpc
    assert controller is not None and lock.loop.phase is Phase.RUN
    assert controller.program.tick.feedback().accepted
    controller.program.pool["a"][1, 5] = np.nan
    assert not controller.program.tick.feedback().accepted
