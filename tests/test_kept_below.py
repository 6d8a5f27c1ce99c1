"""What a task keeps below zero is rows of the program: against OSQP, IPOPT and pinocchio, and with
a tool that is kept off a wall."""

import json
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import casadi as ca
import numpy as np
import osqp
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from headway.cli.main import main
from headway.configs.load import load_config
from headway.controller import program
from headway.controller.nlp import converged
from headway.controller.objective import Costs
from headway.controller.prediction import Prediction
from headway.controller.program import Feedback, Program, riccati_source
from headway.controller.reference import own_costs, task_reference
from headway.models.machine import Machine, load_machine
from headway.sim.lockstep import Lockstep

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
BACKENDS = "riccati", "hpipm", "osqp"
WALL_M = 0.36
Array = NDArray[np.float64]

ROWS = """\
tool = s.place("tool")
s.keep_below(tool[0] - 0.36, s.parameter("wall", 1e7))
s.keep_below(ca.vertcat(s.v[1] - 1.0, s.q[1] ** 2 - 1.3), s.parameter("others", 1e3) * s.share)
return [(tool[2] - 0.35, 1e3)]"""


def written(folder: Path, body: str) -> Path:
    source = folder / "costs.py"
    lines = ["import casadi as ca", "", "def objective(s):"]
    source.write_text("\n".join([*lines, *("    " + line for line in body.splitlines())]) + "\n")
    return source


class Case:
    """A machine's program with costs of its own, on a grid that is solved exactly in a moment."""

    def __init__(self, folder: Path, body: str, *said: str, name: str = "arm2") -> None:
        n = len(load_config(CONFIGS / f"{name}.yaml").machine.axes)
        task = f"{{kind: custom, file: {written(folder, body)}, target_rad_or_m: {[0.1] * n}}}"
        grid = "mpc.horizon_us=196608", "mpc.intervals=12", "mpc.max_iterations=4000"
        config = load_config(CONFIGS / f"{name}.yaml", [f"task={task}", *grid, *said])
        self.machine = load_machine(CONFIGS / config.machine.model)
        self.prediction = Prediction.of(config, self.machine)
        self.costs = own_costs(task_reference(config, CONFIGS), self.machine)
        self.program = Program(config, self.prediction, self.costs)
        self.nodes = config.mpc.intervals + 1
        self.node_s = np.linspace(0, config.mpc.horizon_us * 1e-6, self.nodes)

    def tick(self, seed: int, size: float, begin_s: float = 0.0) -> Feedback:
        """From rest, with the tool at the wall or before it, to beyond."""
        rng = np.random.default_rng(seed)
        q = np.array([0.3, 1.2]) + rng.uniform(-0.1, 0.02, 2)
        way = size * np.abs(rng.normal(size=2)) * [1, -1]
        return self.go(q, way, rng.normal(scale=0.05, size=2), begin_s)

    def go(self, q: Array, way: Array, d: Array, begin_s: float = 0.0) -> Feedback:
        """From rest at q to so far from it, under a disturbance d."""
        none = np.zeros(len(q))
        x = np.repeat(np.concatenate((q, none))[:, None], self.nodes, axis=1)
        torque = self.prediction.holding(q, none)
        u = np.repeat(torque[:, None], self.nodes, axis=1)
        self.program.prepare(x, u, none, begin_s + self.node_s)
        reference = x + np.concatenate((way, none))[:, None]
        return self.program.feedback(x[:, 0], d, reference, torque, torque - d)

    def exact(self) -> Array:
        """The last tick's answer by the osqp package, to nine digits."""
        of = self.program
        gradient, lower, upper = (of.pool[key][:, 0] for key in ("gradient", "lower", "upper"))
        solver = osqp.OSQP()
        solver.setup(
            of.hessian(), gradient, of.constraints(), lower, upper,
            eps_abs=1e-9, eps_rel=1e-9, max_iter=400_000, polishing=True, verbose=False,
        )  # fmt: skip
        found: Array = solver.solve(raise_error=True).x
        return found

    def tool(self, x: Array) -> Array:
        """Where it is along the world's x axis, by pinocchio, at nodes (4, k) [m]."""
        return tool_m(self.machine, x[:2].T)


def tool_m(machine: Machine, q: Array) -> Array:
    """(k, 2) positions of the axes to the tool's along the world's x axis."""
    model, data = machine.model, machine.model.createData()
    frame, places = model.getFrameId("tool"), []
    for each in q:
        pin.framesForwardKinematics(model, data, each)
        places.append(data.oMf[frame].translation[0])
    return np.array(places)


SEEDS = [(seed, size) for seed in range(8) for size in (0.02, 0.1, 0.3)]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_solver_finds_what_another_one_finds(
    backend: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the cost, slacks and all, and in the states up to where the tracking ends; with rows of
    all three active, alone and together with limits of the axes."""
    monkeypatch.setattr(program, "OSQP_TOLERANCE", 1e-7)
    of = Case(tmp_path, ROWS, f"mpc.backend={backend}")
    ocp, active = of.program.ocp, np.zeros(3)
    for seed, size in SEEDS:
        done = of.tick(seed, size)
        assert done.accepted
        z, exact = of.program.pool["z"][:, 0], of.exact()
        cost = of.program.cost(exact)
        assert abs(of.program.cost(z) - cost) <= 0.05 + 1e-6 * abs(cost)
        slack = np.maximum(z[ocp.kept_slacks], 0).reshape(-1, 3)
        np.testing.assert_allclose(slack.ravel(), exact[ocp.kept_slacks], atol=0.01)
        assert np.abs(z - exact)[: 5 * 4].max() < 1e-3
        active += slack.max(axis=0) > 0.1
    assert active.min() >= 3


OTHERS = {
    "arm6": """\
s.keep_below(ca.vertcat(s.place("tool")[2] - 0.6, s.v[2] + s.v[3] - 0.2), 1e6)
s.keep_below(s.q[4] * s.q[1] - 0.05, 1e6)
return []""",
    "furuta": "s.keep_below(ca.vertcat(s.q[0] - 0.1, s.v[1]), 1e4)\nreturn [(ca.sin(s.q[1]), 1)]",
    "cartpole": "s.keep_below(ca.vertcat(s.q[0] - 0.05, s.v[0] + s.v[1] - 0.3), 1e5)\nreturn []",
}


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("backend", ["riccati", "hpipm"])
def test_so_it_is_with_many_axes_and_with_passive_ones(
    backend: str, name: str, tmp_path: Path
) -> None:
    """OSQP alone is the oracle here."""
    of = Case(tmp_path, OTHERS[name], f"mpc.backend={backend}", name=name)
    n, kept, active = of.program.ocp.n, of.program.ocp.kept_slacks, 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        done = of.go(rng.uniform(-0.1, 0.3, n), rng.normal(scale=0.1, size=n), np.zeros(n))
        assert done.accepted
        exact = of.exact()
        cost = of.program.cost(exact)
        near = 1e-6 if backend == "riccati" else 1e-4
        assert abs(of.program.cost(of.program.pool["z"][:, 0]) - cost) <= 0.05 + near * abs(cost)
        active += exact[kept].max() > 0.1
    assert active > 4


def by_hand(machine: Machine, x: Array, share: float) -> Array:
    """What ROWS says, times the roots of the weights."""
    roots = np.sqrt([1e7, 1e3 * share, 1e3 * share])
    return roots * [tool_m(machine, x[None, :2])[0] - WALL_M, x[3] - 1, x[1] ** 2 - 1.3]


def off(machine: Machine, costs: Costs, seed: int) -> float:
    """How far the slopes are from differences by hand, in parts of the largest."""
    rng = np.random.default_rng(seed)
    x, share, step = rng.uniform(-1, 1, 4), rng.uniform(), 1e-5
    value, slope = (np.array(part) for part in costs.kept(x, 0.3, share, costs.parameters))
    np.testing.assert_allclose(value[:, 0], by_hand(machine, x, share), rtol=1e-12, atol=1e-9)
    differences = [
        (by_hand(machine, x + d, share) - by_hand(machine, x - d, share)) / (2 * step)
        for d in step * np.eye(4)
    ]
    return float(np.abs(slope - np.transpose(differences)).max() / np.abs(slope).max())


def test_rows_are_the_tasks_and_a_wrong_sign_is_seen(tmp_path: Path) -> None:
    of = Case(tmp_path, ROWS)
    costs = of.costs
    assert costs is not None and costs.rows == 3
    given = [ca.SX.sym("given", *costs.kept.size_in(i)) for i in range(4)]
    value, slope = costs.kept(*given)
    wrong = replace(costs, kept=ca.Function("wrong", given, [value, -slope]))
    for seed in range(5):
        assert off(of.machine, costs, seed) < 1e-8
        assert off(of.machine, wrong, seed) > 1


def test_they_stand_at_every_node_but_the_first(tmp_path: Path) -> None:
    """Along a guess that moves: what is left to zero is the bound, and the matrix times a step is
    how the rows change, in the unit of their slacks."""
    of = Case(tmp_path, ROWS, "mpc.backend=osqp")
    rng, ocp, pool = np.random.default_rng(1), of.program.ocp, of.program.pool
    x = np.cumsum(rng.normal(scale=0.1, size=(4, of.nodes)), axis=1)
    x[:2] += [[0.3], [1.2]]
    none = np.zeros(2)
    of.program.prepare(x, np.zeros((2, of.nodes)), none, of.node_s)
    of.program.feedback(x[:, 0], none, x, none, none)
    step = 1e-6 * rng.normal(size=x.shape)
    z = np.zeros(ocp.size)
    z[ocp.states] = step.ravel(order="F") / ocp.column_scale[ocp.states]
    rows = of.program.constraints()[ocp.kept_rows]
    unit = -rows[:, ocp.kept_slacks].diagonal()
    left = pool["upper"][ocp.kept_rows, 0] / unit
    changes = rows @ z / unit
    assert np.all(pool["lower"][ocp.kept_rows] < -1e19)
    share = np.linspace(0, 1, of.nodes)
    for i in range(1, of.nodes):
        here = by_hand(of.machine, x[:, i], share[i])
        change = by_hand(of.machine, x[:, i] + step[:, i], share[i]) - here
        of_node = slice(3 * (i - 1), 3 * i)
        np.testing.assert_allclose(left[of_node], -here, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(changes[of_node], change, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("backend", BACKENDS)
def test_programs_in_a_row_and_ipopt_find_the_same(
    backend: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With rows that are curved and active, and costs that are curved as well."""
    monkeypatch.setattr(program, "OSQP_TOLERANCE", 1e-7)
    of = Case(tmp_path, ROWS, f"mpc.backend={backend}", "mpc.sqp_iterations=12")
    for seed, size in ((2, 0.1), (3, 0.1), (7, 0.3)):
        assert of.tick(seed, size).accepted
        z, said = converged(of.program, of.machine, of.prediction.law)
        assert said == "Solve_Succeeded"
        ocp = of.program.ocp
        assert z[ocp.kept_slacks].max() > 1
        away = (of.program.pool["z"][:, 0] - z)[ocp.states] * ocp.column_scale[ocp.states]
        assert np.abs(away).max() < 1e-3  # rad, rad/s


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_that_weighs_nothing_counts_for_nothing(backend: str, tmp_path: Path) -> None:
    none = "task.parameters={wall: 0, others: 0}"
    of = Case(tmp_path, ROWS, f"mpc.backend={backend}", none)
    without = Case(tmp_path, ROWS.splitlines()[-1].replace("tool", 's.place("tool")'),
                   f"mpc.backend={backend}")  # fmt: skip
    for seed, size in SEEDS[::3]:
        both = [each.tick(seed, size).accepted for each in (of, without)]
        assert both == [True, True]
        x, u = of.program.answer()
        for one, other in zip((x, u), without.program.answer(), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_weights_that_come_later(backend: str, tmp_path: Path) -> None:
    """To the same bits as if the program had begun with them."""
    later = "mpc.later=[{from_s: 1, parameters: {wall: 10}}]"
    of = Case(tmp_path, ROWS, f"mpc.backend={backend}", later)
    found = []
    for begin_s, said in ((0.0, []), (1.0, ["task.parameters.wall=10"])):
        other = Case(tmp_path, ROWS, f"mpc.backend={backend}", *said)
        assert of.tick(2, 0.3, begin_s).accepted
        assert other.tick(2, 0.3, begin_s).accepted
        found.append(of.program.answer()[0])
        np.testing.assert_array_equal(found[-1], other.program.answer()[0])
    assert of.tool(found[1]).max() > of.tool(found[0]).max() + 1e-3


# What lies so far beyond costs more than 1e8. OSQP, whose tolerance goes with the largest number of
# the problem, then stops at its limit of iterations, and the old plan runs on. So it does, now and
# then, where rows contradict each other, with multipliers as large.
TOO_FAR_FOR_OSQP = "far away", "that weighs the most", "large"
AT_TIMES_FOR_OSQP = "one against the other", "many"
CANNOT_BE_KEPT = {
    "far away": 's.keep_below(s.place("tool")[0] + 30, 1e6)',
    "one against the other": "s.keep_below(s.q[0] + 1, 1e8)\ns.keep_below(1 - s.q[0], 1e8)",
    "of no state": "s.keep_below(1.0, 1e6)",
    "that weighs the most": "s.keep_below(s.q[0] + 1, 1e12)",
    "large": "s.keep_below(1e6 + s.v[1], 1.0)",
    "many": "s.keep_below(ca.vertcat(*[s.q[0] + 1 + i for i in range(32)]), 1e4)",
}


@pytest.mark.parametrize("kind", CANNOT_BE_KEPT)
@pytest.mark.parametrize("backend", BACKENDS)
def test_what_cannot_be_kept_leaves_the_plans_accepted(
    backend: str, kind: str, tmp_path: Path
) -> None:
    of = Case(tmp_path, CANNOT_BE_KEPT[kind] + "\nreturn []", f"mpc.backend={backend}")
    for seed in range(3):
        done = of.tick(seed, 0.02)
        if backend != "osqp" or kind not in AT_TIMES_FOR_OSQP:
            assert done.accepted != (backend == "osqp" and kind in TOO_FAR_FOR_OSQP)


ANY_ROWS = """\
p = [s.parameter(f"p{i}", 0) for i in range(12)]
late = s.share ** s.parameter("late", 0)
rows = [
    s.q[0] - p[0], p[1] - s.q[1], s.place("tool")[0] - p[2], ca.fabs(s.v[1]) - p[3],
    p[4] - s.v[1] * s.q[0], s.kinetic_energy() - p[5],
]
for i, row in enumerate(rows):
    s.keep_below(row, p[6 + i] * late)
return []"""


@cache
def any_rows(backend: str) -> Case:
    with TemporaryDirectory() as folder:
        return Case(Path(folder), ANY_ROWS, f"mpc.backend={backend}")


@pytest.mark.parametrize("backend", ["riccati", "hpipm"])
@settings(max_examples=100, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), late=st.sampled_from([0.0, 1.0, 8.0]))
def test_whatever_rows_say_there_is_a_plan(backend: str, seed: int, late: float) -> None:
    """With weights up to 1e9, of rows that contradict each other."""
    of, rng = any_rows(backend), np.random.default_rng(seed)
    weights = 10 ** rng.uniform(-3, 9, 6) * (rng.random(6) < 0.5)
    values = np.concatenate((rng.normal(size=6), weights, [late]))
    of.program.pool["parameters"][-len(values) :, 0] = values
    q = np.array([0.3, 1.1]) + 0.3 * rng.normal(size=2)
    assert of.go(q, 0.1 * rng.normal(size=2), 0.1 * rng.normal(size=2)).accepted


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_row_that_is_not_a_number_leaves_the_old_plan(backend: str, tmp_path: Path) -> None:
    body = "s.keep_below(s.q[0] - 5 + ca.sqrt(20 - s.time_s), 1.0)\nreturn []"
    of = Case(tmp_path, body, f"mpc.backend={backend}")
    for begin_s, accepted in ((0.0, True), (30.0, False), (0.0, True)):
        assert of.tick(0, 0.02, begin_s).accepted == accepted


def test_it_compiles_without_a_warning(tmp_path: Path) -> None:
    file = tmp_path / "rows.c"
    file.write_text(riccati_source(Case(tmp_path, ROWS).program.ocp, True))
    command = ["cc", "-O3", "-march=native", "-Wall", "-Wextra", "-Werror", "-c", str(file)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# A tool and a wall.

WEIGHT = 1e9
BEYOND = 's.place("tool")[0] - 0.36'
AS_A_ROW = f"s.keep_below({BEYOND}, {WEIGHT})\nreturn []"
AS_A_RESIDUAL = f"return [(ca.fmax({BEYOND}, 0), {WEIGHT})]"


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_wall_is_seen_before_it_is_touched(backend: str, tmp_path: Path) -> None:
    """From a plan that stays before it, to a reference beyond: the square of what is above zero has
    no slope there."""
    for body, least_m, most_m in ((AS_A_ROW, -10e-3, 5e-3), (AS_A_RESIDUAL, 40e-3, np.inf)):
        of = Case(tmp_path, body, f"mpc.backend={backend}")
        for seed in (1, 14):
            assert of.tick(seed, 0.3).accepted
            beyond_m = of.tool(of.program.answer()[0]) - WALL_M
            assert beyond_m[0] < -30e-3
            assert least_m < beyond_m.max() < most_m  # the row is a chord of the tool's arc


def along_the_wall(folder: Path, body: str) -> tuple[Lockstep, float]:
    """A run in which the tool is to go there and back twice a second, through the wall; and how far
    it was beyond, at most [m]."""
    goal = (
        "turn = 2 * ca.pi * s.time_s / 0.5\n"
        "way = ca.if_else(s.time_s > 0, (1 - ca.cos(turn)) / 2, 0)\n"
        'goal = s.place("tool") - ca.vertcat(0.308 + 0.12 * way, 0, 0.388)\n'
    )
    source = written(folder, goal + body.replace("return [", "return [(goal, 1e5), "))
    task = f"{{kind: custom, file: {source}, target_rad_or_m: [0.3, 1.2]}}"
    weights = "mpc.position_weight=1", "mpc.velocity_weight=10"
    whole = "mpc.fade_start=0.95", "mpc.fade_end=1", "sim.plant={}", "duration_s=2.5"
    lock = Lockstep(load_config(CONFIGS / "arm2.yaml", [f"task={task}", *weights, *whole]), CONFIGS)
    lock.run()
    machine = load_machine(CONFIGS / lock.config.machine.model)
    record = lock.record.arrays()
    return lock, float(tool_m(machine, record["truth_position"]).max() - WALL_M)


def test_a_tool_is_kept_off_a_wall(tmp_path: Path) -> None:
    lock, beyond_m = along_the_wall(tmp_path, AS_A_ROW)
    assert -1e-3 < beyond_m < 1e-3  # it gets there
    record = lock.record.arrays()
    assert record["solver_usable"].all() and record["solver_residual"].max() <= 1
    _, beyond_m = along_the_wall(tmp_path, AS_A_RESIDUAL)
    assert beyond_m > 20e-3


def test_a_pendulum_swings_up_with_its_arm_kept_near(tmp_path: Path) -> None:
    """Rows together with costs that are curved, and a joint without a motor. Without them the arm
    goes twice as far."""
    text = (CONFIGS / "upright.py").read_text()
    first, rest = text.split("    angle, rate", maxsplit=1)
    for row, most_rad in (("", np.inf), ("    s.keep_below(ca.fabs(s.q[0]) - 0.4, 1e4)\n", 0.43)):
        source = tmp_path / "costs.py"
        source.write_text(f"{first}{row}    angle, rate{rest}")
        said = f"task.file={source}", "duration_s=5"
        lock = Lockstep(load_config(CONFIGS / "furuta.yaml", list(said)), CONFIGS)
        lock.run()
        record = lock.record.arrays()
        assert record["solver_usable"].all()
        arm, pendulum = record["truth_position"][record["truth_s"] < 5].T
        assert np.abs(np.cos(pendulum[-500:]) - 1).max() < 1e-3
        assert (np.abs(arm).max() > 0.7) != (most_rad < 1)
        assert np.abs(arm).max() < most_rad


def test_a_record_has_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`headway qp` solves the same program again, by whatever solver, and IPOPT the curved one."""
    source = written(tmp_path, ROWS)
    task = f"task={{kind: custom, file: {source}, target_rad_or_m: [0.3, 1.2]}}"
    run = ["run", str(CONFIGS / "arm2.yaml"), "--duration", "1", "--out", str(tmp_path / "run")]
    assert main([*run, "--set", task]) in (0, 3)
    file = tmp_path / "qp.npz"
    assert main(["qp", "dump", str(tmp_path / "run"), "100", "--out", str(file)]) == 0
    costs = []
    for backend in BACKENDS:
        capsys.readouterr()
        assert main(["qp", "solve", str(file), "--backend", backend, "--json"]) == 0
        figures = json.loads(capsys.readouterr().out)
        assert figures["accepted"] and figures["nlp"]["IPOPT says"] == "Solve_Succeeded"
        assert figures["nlp"]["position off by, at most"] < 1e-2
        costs.append(figures["cost"])
        if backend == "riccati":
            assert figures["residual"] == pytest.approx(figures["recorded"]["residual"], abs=1e-6)
    np.testing.assert_allclose(costs, costs[0], rtol=1e-2, atol=0.1)
