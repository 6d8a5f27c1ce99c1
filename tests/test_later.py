"""Weights that change while a task runs: the program is the one that begins with them."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from headway.cli.main import main
from headway.configs.load import ConfigError, load_config
from headway.configs.schema import Config
from headway.controller.prediction import Prediction
from headway.controller.program import Program
from headway.controller.record.reader import read_run
from headway.controller.reference import own_costs, task_reference
from headway.models.machine import load_machine

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
Array = NDArray[np.float64]

WEIGHTS = {
    "position_weight": "[2.0e4, 7.0e3]", "velocity_weight": "30", "torque_step_weight": "[3, 0.1]",
    "torque_start_weight": "1", "soft_weight": "1.0e5",
}  # fmt: skip
# By machine: what comes first, what it changes to, as keys of mpc and of task.parameters.
CHANGES = {
    "arm2": [WEIGHTS, {"velocity_weight": "[3, 900]"}],
    "furuta": [{"parameters": "{energy: 9}"}, {"position_weight": "50", "parameters": "{rate: 4}"}],
}


def said(change: dict[str, str]) -> list[str]:
    """As `--set` has it."""
    words = [f"mpc.{key}={value}" for key, value in change.items() if key != "parameters"]
    if "parameters" in change:
        name, value = change["parameters"].strip("{}").split(": ")
        words.append(f"task.parameters.{name}={value}")
    return words


def program(machine: str, words: list[str]) -> tuple[Program, Config]:
    config = load_config(CONFIGS / f"{machine}.yaml", words)
    model = load_machine(CONFIGS / config.machine.model)
    costs = own_costs(task_reference(config, CONFIGS), model)
    return Program(config, Prediction.of(config, model), costs), config


def answer(of: Program, config: Config, begin_s: float) -> Array:
    """From a place at rest to one beside it, both of no meaning."""
    n, nodes = len(config.machine.axes), config.mpc.intervals + 1
    x = np.repeat(np.concatenate((np.full(n, 0.1), np.zeros(n)))[:, None], nodes, axis=1)
    none = np.zeros(n)
    node_s = begin_s + np.linspace(0, config.mpc.horizon_us * 1e-6, nodes)
    of.prepare(x, np.zeros((n, nodes)), none, node_s)
    done = of.feedback(x[:, 0], none, x + 0.02, none, none)
    assert done.accepted
    return np.concatenate([part.ravel() for part in of.answer()])


@pytest.mark.parametrize("backend", ["osqp", "hpipm", "riccati"])
@pytest.mark.parametrize("machine", CHANGES)
def test_as_if_it_had_begun_with_them(machine: str, backend: str) -> None:
    """By the time at which a plan begins: to the same bits, of solvers that begin anew."""
    changes, base = CHANGES[machine], [f"mpc.backend={backend}", "mpc.max_iterations=4000"]
    times = 1.0, 2.5
    entries = [
        "{" + ", ".join([f"from_s: {time}", *(f"{k}: {v}" for k, v in change.items())]) + "}"
        for time, change in zip(times, changes, strict=True)
    ]
    of, config = program(machine, [*base, f"mpc.later=[{', '.join(entries)}]"])
    found = [answer(of, config, begin_s) for begin_s in (0.99999, 1.0, 2.5)]
    words = list(base)
    for i, got in enumerate(found):
        np.testing.assert_array_equal(got, answer(*program(machine, words), 0.0))
        words += said(changes[i]) if i < len(changes) else []
    for one, other in ((0, 1), (1, 2), (0, 2)):
        assert np.abs(found[one] - found[other]).max() > 1e-6


def test_a_run_obeys_them(tmp_path: Path) -> None:
    """Nothing differs until then, and behind it something does."""
    words = ["run", str(CONFIGS / "arm2.yaml"), "--duration", "1"]
    later = "mpc.later=[{from_s: 0.5, position_weight: 1.0e4}]"
    runs = []
    for name, more in (("plain", []), ("later", ["--set", later])):
        assert main([*words, "--out", str(tmp_path / name), *more]) == 0
        runs.append(read_run(tmp_path / name).arrays)
    commit_s = (runs[0]["commit_us"] - runs[0]["tick_us"][0]) * 1e-6
    estimates = [run["commit_estimate"] for run in runs]
    same = np.all(estimates[0] == estimates[1], axis=1)
    assert same[commit_s < 0.5].all() and not same[commit_s > 0.6].any()


@pytest.mark.parametrize(
    ("later", "wrong"),
    [
        ("[{from_s: 1}]", "changes nothing: give a weight or parameters beside from_s"),
        ("[{position_weight: 1}]", "from_s"),
        ("[{from_s: 0, position_weight: 1}]", "from_s"),
        ("[{from_s: 1, position_weight: -1}]", "position_weight"),
        ("[{from_s: 1, position_weight: [1, 2, 3]}]", "mpc.later.0.position_weight: has 3 entries"),
        ("[{from_s: 1, horizon_us: 40960}]", "horizon_us"),
        ("[{from_s: 1, parameters: {swing: 1}}]", "mpc.later.0.parameters: is for custom tasks"),
        ("[{from_s: 2, soft_weight: 1}, {from_s: 2, soft_weight: 2}]", "the order of time"),
    ],
)
def test_what_cannot_be_is_said(later: str, wrong: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_config(CONFIGS / "arm2.yaml", [f"mpc.later={later}"])
    assert wrong in str(error.value)


def test_parameters_that_the_file_does_not_ask_for(capsys: pytest.CaptureFixture[str]) -> None:
    later = "mpc.later=[{from_s: 1, parameters: {swig: 1}}]"
    assert main(["check", str(CONFIGS / "furuta.yaml"), "--set", later]) == 2
    told = capsys.readouterr()
    assert "mpc.later has swig, which" in told.out + told.err
