"""A tick's program rebuilt from a record, solved again, and beside a converged solution."""

import json
from pathlib import Path

import numpy as np
import pytest

from headway.cli.main import main
from headway.controller.nlp import converged
from headway.controller.prediction import ServoLaw
from headway.controller.program import Program
from headway.controller.record.reader import Run, read_run
from headway.controller.replay import Given, Replay, ReplayError
from headway.models.machine import load_machine

ROOT = Path(__file__).resolve().parent.parent


def run_of(folder: Path, config: str, *more: str) -> Run:
    arguments = ["run", str(ROOT / "configs" / config), "--duration", "1.2", "--out", str(folder)]
    assert main([*arguments, *(f"--set={each}" for each in more)]) in (0, 3)
    return read_run(folder)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that loses frames, asks for more torque than there is and repeats old plans."""
    folder = tmp_path_factory.mktemp("qp") / "run"
    losses = "sim.to_device.loss=0.1", "sim.to_host.loss=0.1", "task.frequency_Hz=0.6"
    run_of(folder, "arm2.yaml", *losses)
    return folder


def solved(replay: Replay, given: Given, *, sqp_iterations: int = 1) -> tuple[Program, list[float]]:
    mpc = replay.config.mpc.model_copy(update={"sqp_iterations": sqp_iterations})
    config = replay.config.model_copy(update={"mpc": mpc})
    program = Program(config, replay.prediction, replay.costs)
    program.prepare(given.x, given.u, given.assumed, given.node_s)
    done = program.feedback(given.start, given.d, given.reference, given.committed, given.holding)
    return program, [done.residual, done.stationarity, done.complementarity]


@pytest.mark.parametrize("backend", ["hpipm", "riccati"])
@pytest.mark.parametrize("config", ["arm2.yaml", "furuta.yaml", "cartpole.yaml"])
def test_who_has_no_memory_says_of_every_tick_what_was_said_then(
    config: str, backend: str, tmp_path: Path
) -> None:
    """With axes that have no motor and costs of a task's own, too."""
    run = run_of(tmp_path / "run", config, f"mpc.backend={backend}", "sim.to_device.loss=0.1")
    replay, names = Replay(run), ("residual", "stationarity", "complementarity")
    assert replay.ticks > 250
    for tick in range(0, replay.ticks, 7):
        _, said = solved(replay, replay.given(tick))
        then = [float(run.arrays[f"solver_{name}"][replay.row(tick)]) for name in names]
        np.testing.assert_allclose(said, then, rtol=1e-4, atol=1e-6)


def test_weights_that_came_later_are_those_of_its_tick(tmp_path: Path) -> None:
    """A dump of a tick before and behind the change has the program that was solved then."""
    later = "mpc.later=[{from_s: 0.6, position_weight: 1.0e5, torque_step_weight: 2}]"
    replay = Replay(run := run_of(tmp_path / "run", "arm2.yaml", "mpc.backend=riccati", later))
    names = "residual", "stationarity", "complementarity"
    begins_s = np.array([replay.given(tick).node_s[0] for tick in range(replay.ticks)])
    change = int(np.searchsorted(begins_s, 0.6))
    diagonals = []
    for tick in (change - 40, change - 1, change, change + 40):
        program, said = solved(replay, replay.given(tick))
        then = [float(run.arrays[f"solver_{name}"][replay.row(tick)]) for name in names]
        np.testing.assert_allclose(said, then, rtol=1e-4, atol=1e-6)
        unscaled = program.ocp.hessian.diagonal() / program.ocp.column_scale**2
        diagonals.append(unscaled[0])
    np.testing.assert_allclose(diagonals, [1.2e7, 1.2e7, 2e5, 2e5], rtol=1e-3)


def test_programs_in_a_row_and_ipopt_find_the_same(folder: Path) -> None:
    replay = Replay(read_run(folder))
    mpc = replay.config.mpc.model_copy(update={"backend": "hpipm"})
    replay.config = replay.config.model_copy(update={"mpc": mpc})
    program, _ = solved(replay, replay.given(150), sqp_iterations=8)
    axes = replay.config.machine.axes
    machine = load_machine(Path(replay.config.machine.model))
    z, said = converged(program, machine, ServoLaw.of(axes))
    assert said == "Solve_Succeeded"
    states = program.ocp.states
    assert np.abs(program.pool["z"][states, 0] - z[states])[: 10 * 4].max() < 0.02  # of a mrad


def test_dump_and_solve(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "qp.npz"
    assert main(["qp", "dump", str(folder), "100", "--out", str(file)]) == 0
    for backend in ("osqp", "hpipm", "riccati"):
        capsys.readouterr()
        assert main(["qp", "solve", str(file), "--backend", backend, "--json"]) == 0
        figures = json.loads(capsys.readouterr().out)
        assert figures["backend"] == backend and figures["accepted"]
        assert figures["nlp"]["IPOPT says"] == "Solve_Succeeded"
        assert figures["nlp"]["position off by, at most"] < 1e-2
    with np.load(file) as dumped:
        assert len(dumped["A_indptr"]) == len(dumped["q"]) + 1
        assert len(dumped["l"]) == len(dumped["u"]) == dumped["A_indices"].max() + 1


def test_costs_of_a_tasks_own_are_part_of_both_problems(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On its way up the pendulum's energy is what counts: without it the plan would be another."""
    run_of(tmp_path / "run", "furuta.yaml")
    replay = Replay(read_run(tmp_path / "run"))
    assert replay.costs is not None
    program, _ = solved(replay, replay.given(60), sqp_iterations=12)
    machine = load_machine(Path(replay.config.machine.model))
    law = ServoLaw.of(replay.config.machine.axes)
    z, said = converged(program, machine, law)
    assert said == "Solve_Succeeded"
    states = program.ocp.states
    away = (program.pool["z"][states, 0] - z[states]) * program.ocp.column_scale[states]
    assert np.abs(away).max() < 1e-3  # rad, rad/s
    file = tmp_path / "qp.npz"
    assert main(["qp", "dump", str(tmp_path / "run"), "60", "--out", str(file)]) == 0
    capsys.readouterr()
    assert main(["qp", "solve", str(file), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["accepted"] and figures["nlp"]["IPOPT says"] == "Solve_Succeeded"
    with np.load(file) as dumped:  # P has their curvature
        assert dumped["P_data"].sum() != pytest.approx(program.ocp.hessian.data.sum(), rel=1e-3)


def test_what_cannot_be_done_is_said(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["qp", "dump", str(folder), "100000", "--out", str(tmp_path / "a.npz")]) == 2
    assert "there is no tick 100000: the run has" in capsys.readouterr().err
    (tmp_path / "b.npz").write_text("nothing")
    assert main(["qp", "solve", str(tmp_path / "b.npz")]) == 2
    assert "is not of `headway qp dump`" in capsys.readouterr().err
    run = run_of(tmp_path / "gains", "arm2.yaml", "loop.gains=fixed")
    with pytest.raises(ReplayError, match=r"loop\.gains is fixed"):
        Replay(run)
