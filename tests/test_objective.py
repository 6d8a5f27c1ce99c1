"""A task's own costs: against finite differences and pinocchio, and told where they are wrong."""

from pathlib import Path
from textwrap import dedent

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from headway.cli.main import main
from headway.controller.objective import Costs, Symbols, read_costs
from headway.models.machine import Machine, load_machine

ROOT = Path(__file__).resolve().parent.parent
Array = NDArray[np.float64]


def machine_of(name: str) -> Machine:
    return load_machine(ROOT / "models" / name / f"{name}.xml")


def costs_of(tmp_path: Path, body: str, **parameters: float) -> Costs:
    """Of furuta, with the function's body as given."""
    source = tmp_path / "costs.py"
    head = "import casadi as ca\n\n"
    source.write_text(head + "def objective(s):\n" + "    " + dedent(body).replace("\n", "\n    "))
    return read_costs(source, machine_of("furuta"), np.array([0.3, 0.1]), parameters)


BODY = """\
weight = s.parameter("weight", 2.0)
tip = s.place("tip") - ca.vertcat(0.1, 0.2, s.time_s)
s.keep_below(s.q[0] - 0.2, 5.0)
return [
    (tip, weight * s.share),
    (ca.sin(s.q[1]) * s.v - s.target, 3.0),
]"""


def by_hand(x: Array, time_s: float, share: float, weight: float) -> float:
    """What BODY says, with pinocchio's kinematics. What it keeps below is a row, and no part of
    it."""
    model = machine_of("furuta").model
    data = model.createData()
    pin.framesForwardKinematics(model, data, x[:2])
    tip = data.oMf[model.getFrameId("tip")].translation - [0.1, 0.2, time_s]
    swing = np.sin(x[1]) * x[2:] - [0.3, 0.1]
    return float(weight * share * tip @ tip + 3 * swing @ swing)


@pytest.mark.parametrize("seed", range(8))
def test_the_slope_is_that_of_the_sum_of_squares(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, time_s, share = rng.uniform(-1, 1, 4), rng.uniform(0, 2), rng.uniform()
    costs = costs_of(tmp_path, BODY, weight=4.0)
    np.testing.assert_array_equal(costs.parameters, [4.0])
    curvature, slope = costs.function(x, time_s, share, costs.parameters)
    step = 1e-6
    differences = [
        (by_hand(x + d, time_s, share, 4.0) - by_hand(x - d, time_s, share, 4.0)) / (2 * step)
        for d in step * np.eye(4)
    ]
    np.testing.assert_allclose(np.array(slope)[:, 0], differences, rtol=1e-6, atol=1e-7)
    assert np.linalg.eigvalsh(np.array(curvature)).min() > -1e-12


def test_the_curvature_of_linear_residuals_is_theirs(tmp_path: Path) -> None:
    costs = costs_of(tmp_path, "return [(s.q + 2 * s.v, 3.0)]")
    curvature, _ = costs.function(np.ones(4), 0, 0, [])
    row = np.array([[1.0, 0, 2, 0], [0, 1, 0, 2]])
    np.testing.assert_allclose(np.array(curvature), 6 * row.T @ row)


@pytest.mark.parametrize("name", ["arm2", "arm6", "furuta", "cartpole"])
def test_energies_and_places_are_pinocchios(name: str) -> None:
    machine = machine_of(name)
    s = Symbols(machine, np.zeros(machine.tree.count), {})
    energies = [s.kinetic_energy(), s.potential_energy()]
    kinds = pin.FrameType.BODY, pin.FrameType.OP_FRAME  # bodies and sites
    frames = {f.name: f for f in machine.model.frames if f.type in kinds and f.name != "universe"}
    places = ca.horzcat(*(s.place(frame) for frame in frames))
    function = ca.Function("all", [s.q, s.v], [*energies, places])
    model, data = machine.model, machine.model.createData()
    rng = np.random.default_rng(1)
    for _ in range(5):
        q, v = rng.uniform(-2, 2, (2, machine.tree.count))
        kinetic, potential, at = function(q, v)
        mass = np.triu(pin.crba(model, data, q))
        expected = v @ (mass + np.triu(mass, 1).T) @ v / 2
        assert float(kinetic) == pytest.approx(expected, rel=1e-12)
        assert float(potential) == pytest.approx(
            pin.computePotentialEnergy(model, data, q), rel=1e-12, abs=1e-12
        )
        pin.framesForwardKinematics(model, data, q)
        expected_at = [
            data.oMi[f.parentJoint].act(f.placement.translation) for f in frames.values()
        ]
        np.testing.assert_allclose(np.array(at).T, expected_at, atol=1e-12)


@pytest.mark.parametrize(
    ("body", "line", "told"),
    [
        ("return [(s.q, 1.0)", 4, "is not Python"),
        ("angle = s.q[7]\nreturn []", 4, "ut of bounds"),
        ("s.place('nose')\nreturn []", 4, "the model has no nose; it has"),
        ("x = 1\nreturn s.q", 5, "returns a SX, not a list of terms"),
        ("return [\n    (s.v[0], 1),\n    (s.q.T, 1),\n]", 6, "residual and weight of 1 by 2"),
        ("return [(s.q[0], s.q)]", 4, "and of 2 by 1"),
        ("return [(s.q[0], s.v[0])]", 4, "a weight that depends on q or v"),
        ("return [(s.q[0], -1.0)]", 4, "a negative weight"),
        ("return [s.q[0]]", 4, "term 0 is"),
        ("return [\n    (ca.log(s.q[0]), 1.0),\n]", 5, "term 0 is not a number"),
        ("return [(ca.sqrt(1 - ca.cos(s.q[0])), 1)]", 4, "has no slope"),
        ("return [(ca.floor(s.q[0]), 1.0)]", 4, "not differentiable: it has floor"),
        ("s.keep_below(ca.sign(s.q[0]), 1)\nreturn []", 4, "keep_below 0 is not"),
        ("s.keep_below(s.q.T, 1)\nreturn []", 4, "expression and weight of 1 by 2"),
        ("s.keep_below(s.q, s.v[0])\nreturn []", 4, "a weight that depends on q or v"),
        ("s.keep_below('q', 1)\nreturn []", 4, "keep_below 0 is of a str and a int, not"),
        ("s.keep_below(ca.SX.sym('q_0'), 1)\nreturn []", 4, "0 has a symbol of its own, q_0"),
        ("return [(s.q[0], ca.SX.sym('w'))]", 4, "term 0 has a symbol of its own, w"),
        ("s.keep_below(1e300 * s.q, 1)\nreturn []", 4, r"whose root makes it .*e\+300: "),
        ("s.keep_below(0, 1)\ns.keep_below(ca.sqrt(s.q[0]), 1)\nreturn []", 5,
         "keep_below 1 is not a number"),
        ("s.keep_below(s.q[0], float('nan'))\nreturn []", 4, "keep_below 0 is not a number"),
        ("s.keep_below(s.q[0], 1 - s.time_s)\nreturn []", 4, "keep_below 0 has a negative weight"),
        ("s.keep_below(s.q[0], 2e12)\nreturn []", 4, r"a weight of 2e\+12, .* 1e\+12"),
        ("s.keep_below(ca.if_else(s.q[0] > 1, 1, 0), 1)\nreturn []", 4, "0 .* it jumps at"),
        ("for _ in range(17):\n    s.keep_below(s.q, 1)\nreturn []", 5,
         "keep_below 16 makes it 34 rows at a node, and 32 are the most"),
        ("return [(ca.if_else(s.q[0] > 0.3, 1, 0), 1)]", 4, "not differentiable: it jumps at"),
        ("x = 0\nreturn [(s.q[0] * (s.v[1] <= 2), 1)]", 5, "not differentiable: it jumps at"),
    ],
)  # fmt: skip
def test_mistakes_are_told_with_their_line(tmp_path: Path, body: str, line: int, told: str) -> None:
    with pytest.raises(ValueError, match=told) as error:
        costs_of(tmp_path, body)
    assert f"costs.py:{line}: " in str(error.value)


def test_kinks_are_taken(tmp_path: Path) -> None:
    body = "s.keep_below(ca.fabs(s.v) - 1, 1)\nreturn [(ca.fmax(ca.fabs(s.q[0]) - 1, 0), 1)]"
    assert costs_of(tmp_path, body).rows == 2


def test_a_choice_that_does_not_jump_is_one(tmp_path: Path) -> None:
    """Of the state where both sides meet, of time wherever."""
    costs_of(
        tmp_path,
        "beyond = s.q[0] - 0.3\n"
        "return [(ca.if_else(beyond > 0, beyond**2, 0), 1), "
        "(ca.if_else(s.time_s > 3, s.q[0], s.q[1]), 1)]",
    )


def test_a_function_of_other_arguments_is_told_with_its_line(tmp_path: Path) -> None:
    source = tmp_path / "costs.py"
    source.write_text("import math\n\ndef objective(s, more):\n    return []\n")
    with pytest.raises(ValueError, match=rf"{source}:4: .*missing 1 required positional"):
        read_costs(source, machine_of("arm2"), np.zeros(2), {})


def test_parameters_that_nobody_asks_for(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=r"task\.parameters has speed, which .* it asks for: weight"
    ):
        costs_of(tmp_path, BODY, speed=1.0)


@pytest.mark.parametrize("command", ["run", "check"])
def test_a_wrong_file_ends_the_command(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "costs.py"
    source.write_text("def objective(s):\n    return s.q[0] / s.nothing\n")
    config = str(ROOT / "configs" / "furuta.yaml")
    assert main([command, config, "--set", f"task.file={source}"]) == 2
    told = capsys.readouterr()
    assert f"{source}:2: " in (told.out + told.err).replace("\n", "")
