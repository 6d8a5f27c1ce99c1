"""riccati.c against OSQP at full precision, on programs at random: with and without active limits,
passive joints and costs of a task's own."""

import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import osqp
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from trees import chain_mjcf

from headway.cli.guess.first import first_config
from headway.configs.load import load_config
from headway.controller._tick import Riccati
from headway.controller.prediction import Prediction
from headway.controller.program import (
    STAGES_TOLERANCE,
    Feedback,
    Program,
    _stages,
    riccati_source,
    squaring,
)
from headway.controller.reference import own_costs, task_reference
from headway.models.codegen import compile_source
from headway.models.machine import load_machine

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
MACHINES = "arm2", "arm6", "furuta", "cartpole"
SIZES = 0.001, 0.1, 0.3, 1.0
Array = NDArray[np.float64]


class Machine:
    """A program, and what it takes to have ticks of it at random."""

    def __init__(self, name: str, backend: str = "riccati") -> None:
        # On a grid as coarse as to be solved exactly in a moment.
        said = [f"mpc.backend={backend}", "mpc.horizon_us=196608", "mpc.intervals=12"]
        said += ["machine.axes.0.acceleration_limit_rad_per_s2=60"] if name == "arm2" else []
        config = load_config(CONFIGS / f"{name}.yaml", said)
        machine = load_machine(CONFIGS / config.machine.model)
        self.prediction = Prediction.of(config, machine)
        costs = own_costs(task_reference(config, CONFIGS), machine)
        self.program = Program(config, self.prediction, costs)
        self.n, self.nodes = self.prediction.n, config.mpc.intervals + 1

    def tick(self, seed: int, size: float) -> Feedback:
        """From a posture at rest, somewhat off, to somewhere; the larger the more limits count."""
        rng, n, nodes = np.random.default_rng(seed), self.n, self.nodes
        limits = self.program.ocp.limits
        low, high = np.maximum(limits.soft_min, -3), np.minimum(limits.soft_max, 3)
        q = np.where(rng.random(n) < 0.3, rng.choice([low, high]), rng.uniform(low, high))
        x = np.repeat(np.concatenate((q, np.zeros(n)))[:, None], nodes, axis=1)
        torque = self.prediction.holding(q, np.zeros(n))
        u = np.repeat(torque[:, None], nodes, axis=1)
        off = np.concatenate((rng.normal(scale=2e-3, size=n), rng.normal(scale=0.1, size=n)))
        d = size * 0.1 * limits.torque[0].min() * rng.normal(size=n)
        reference = x + size * np.concatenate((rng.normal(size=n), np.zeros(n)))[:, None]
        self.program.prepare(x, u, np.zeros(n))
        return self.program.feedback(x[:, 0] + size * off, d, reference, torque, torque - d)

    def costs(self) -> tuple[Array, Array]:
        """The last tick's: Hessian (z, z), and the weights of soft rows, each of its own slack."""
        ocp, pool = self.program.ocp, self.program.pool
        half = ocp.hessian.copy()
        if "curvature" in pool:
            half.data[:] = squaring(self.program._library, ocp, dict(pool)).run()[0][:, 0]
        soft = 2 * ocp.stages()[2][1][ocp.bounded]
        return half + sp.triu(half, 1).T, np.tile(soft, 2 * (self.nodes - 1))

    def least(self) -> float:
        """The last tick's cost, by OSQP to nine digits."""
        pool, (hessian, soft) = self.program.pool, self.costs()
        gradient, lower, upper = (pool[name][:, 0] for name in ("gradient", "lower", "upper"))
        count, rows = len(gradient) - self.n, self.program.constraints()
        slack = sp.diags_array(
            -self.program.ocp.row_scale, offsets=0, shape=(rows.shape[0], rows.shape[0])
        )
        solver = osqp.OSQP()
        solver.setup(
            sp.block_diag([sp.triu(hessian[:count, :count]), sp.diags_array(soft)], format="csc"),
            np.append(gradient[:count], np.zeros(len(soft))),
            sp.hstack([rows[:, :count], slack.tocsc()[:, -len(soft) :]], format="csc"),
            lower, upper, eps_abs=1e-9, eps_rel=1e-9, max_iter=200_000, polishing=True,
            verbose=False,
        )  # fmt: skip
        return float(solver.solve(raise_error=True).info.obj_val)

    def cost(self) -> float:
        """Of the last tick's answer, with what soft limits cost."""
        pool, (hessian, soft) = self.program.pool, self.costs()
        z = pool["z"][:, 0]
        beyond = np.maximum(self.program.constraints() @ z - pool["upper"][:, 0], 0)
        beyond = (beyond / self.program.ocp.row_scale)[len(beyond) - len(soft) :]
        return float(z @ (hessian @ z) / 2 + pool["gradient"][:, 0] @ z + beyond**2 @ soft / 2)


machine = cache(Machine)


@pytest.mark.parametrize("name", MACHINES)
@settings(max_examples=15, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), size=st.sampled_from(SIZES))
def test_the_answer_costs_the_least(name: str, seed: int, size: float) -> None:
    of = machine(name)
    done = of.tick(seed, size)
    assert done.accepted
    least, near = of.least(), 1e-6 if done.status == 0 else 1e-3  # at its limit of iterations
    assert abs(of.cost() - least) <= 1e-3 + near * abs(least)


@pytest.mark.parametrize("name", MACHINES)
def test_one_step_where_no_limit_is_active_and_few_where_some_are(name: str) -> None:
    """So both are tested above."""
    counts = [machine(name).tick(seed, size).iterations for seed in range(20) for size in SIZES]
    assert counts.count(0) > 5
    assert max(counts) > 3 and np.mean(counts) < 15


@pytest.mark.parametrize("name", MACHINES)
def test_it_is_the_same_for_every_processor(name: str) -> None:
    """With vectors of another length, as far as it converges: the padding counts for nothing."""
    of = machine(name)
    pool, ocp = of.program.pool, of.program.ocp
    source = riccati_source(ocp, "curvature" in pool)
    for width in (16, 32, 64):
        library = compile_source("riccati", f"#define WIDTH {width}\n{source}")
        other = Riccati(str(library), _stages(ocp, pool), 30, STAGES_TOLERANCE)
        for seed in range(5):
            for size in SIZES:
                z = np.zeros(ocp.size)
                assert of.tick(seed, size).accepted
                assert other.update()
                other.solve(z)
                np.testing.assert_allclose(z, pool["z"][:, 0], atol=1e-3)


def test_from_a_guess_that_is_far_beyond_the_limits(tmp_path: Path) -> None:
    """A chain that runs at more than half of its speed limits, where it was taken to rest: to stop
    costs many rows their bounds on the way. It can, and within the cap."""
    model, file = tmp_path / "chain.xml", tmp_path / "chain.yaml"
    model.write_text(chain_mjcf(0, 5))
    file.write_text(first_config(model, file)[0])
    config = load_config(file)
    prediction = Prediction.of(config, load_machine(model))
    program, n = Program(config, prediction), prediction.n
    limits, fastest = program.ocp.limits, [axis.velocity_limit for axis in config.machine.axes]
    low, high = np.maximum(limits.soft_min, -3), np.minimum(limits.soft_max, 3)
    accepted = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        q = low + (high - low) * rng.uniform(0.2, 0.8, n)
        rest = np.repeat(np.append(q, np.zeros(n))[:, None], config.mpc.intervals + 1, axis=1)
        torque = prediction.holding(q, np.zeros(n))
        program.prepare(rest, np.repeat(torque[:, None], rest.shape[1], axis=1), np.zeros(n))
        start = np.append(q, 0.6 * rng.choice([-1, 1], n) * fastest)
        accepted.append(program.feedback(start, np.zeros(n), rest, torque, torque).accepted)
    assert np.mean(accepted) > 0.9  # with distances of START_DISTANCE: 0.63


def test_what_cannot_be_kept_is_refused() -> None:
    """Too fast to be below the speed limit at the first node, and what is not a number."""
    of = machine("arm2")
    of.tick(0, 0.1)
    pool, fast = of.program.pool, of.program.pool["x"][:, 0].copy()
    fast[2:] = 3 * of.program.ocp.limits.velocity
    rest = [np.zeros(2), pool["reference"].copy(), np.zeros(2), np.zeros(2)]
    assert not of.program.feedback(fast, *rest).accepted
    assert not of.program.feedback(np.full(4, np.nan), *rest).accepted
    x, u = pool["x"].copy(), pool["u"].copy()
    of.program.prepare(np.full_like(x, np.nan), u, np.zeros(2))
    assert not of.program.feedback(x[:, 0], *rest).accepted
    assert of.tick(0, 0.1).accepted


def test_it_compiles_without_a_warning(tmp_path: Path) -> None:
    for name in ("arm2", "furuta"):
        of = machine(name)
        file = tmp_path / f"{name}.c"
        file.write_text(riccati_source(of.program.ocp, "curvature" in of.program.pool))
        command = ["cc", "-O3", "-march=native", "-Wall", "-Wextra", "-Werror", "-c", str(file)]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


def test_another_library_is_refused() -> None:
    of = machine("arm2")
    library = compile_source("nothing", "int nothing;\n")
    with pytest.raises(RuntimeError, match="lacks a function"):
        Riccati(str(library), _stages(of.program.ocp, of.program.pool), 30, STAGES_TOLERANCE)
