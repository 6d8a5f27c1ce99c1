"""Motors that are not at the joints: dynamics against MuJoCo's tendons, machines that run."""

from collections.abc import Iterator
from pathlib import Path

import casadi as ca
import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from trees import random_mjcf

from headway.cli.main import main
from headway.configs.load import load_config
from headway.controller.kinematics import postures
from headway.controller.record.columns import Arrays
from headway.models.coupling import Coupling
from headway.models.dynamics import forward_derivatives, forward_dynamics, inverse_dynamics
from headway.models.machine import Machine, load_machine
from headway.sim.lockstep import Lockstep

ROOT = Path(__file__).resolve().parent.parent
MACHINES = ROOT / "tests" / "machines"
CORE_XY = [[1, 1, 0], [1, -1, 0], [0, 0, 1]]  # two belts over a carriage's both directions
AT_THE_BASE = [[1, 0, 0], [1, 1, 0], [1, 1, 1]]  # each link's direction has a motor of its own
Array = NDArray[np.float64]


class Tendons:
    """A model whose motors pull at fixed tendons: MuJoCo's, by itself."""

    def __init__(self, path: Path, joints: tuple[str, ...], rows: Array) -> None:
        spec = mujoco.MjSpec.from_file(str(path))
        for element in (*spec.actuators, *spec.keys):
            spec.delete(element)
        for axis, row in enumerate(rows):
            tendon = spec.add_tendon(name=f"axis{axis}")
            for joint, share in zip(joints, row, strict=True):
                tendon.wrap_joint(joint, share)
            spec.add_actuator(
                trntype=mujoco.mjtTrn.mjTRN_TENDON, target=tendon.name, gainprm=np.eye(1, 10)[0]
            )
        self.model = spec.compile()
        self.model.opt.disableflags |= int(
            mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
        )
        self.model.dof_frictionloss[:] = 0
        self.data = mujoco.MjData(self.model)

    def stand(self, q: Array, v: Array, effort: Array) -> None:
        """`q`, `v`: by joint, in MuJoCo's order."""
        self.data.qpos[:], self.data.qvel[:], self.data.ctrl[:] = q, v, effort
        mujoco.mj_forward(self.model, self.data)

    def acceleration(self) -> Array:
        """Of the tendons, whose lengths are linear in the joints' positions."""
        moment = np.zeros((self.model.nu, self.model.nv))
        data = self.data
        mujoco.mju_sparse2dense(
            moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        )
        return np.array(moment @ data.qacc)


def random_coupling(rng: np.random.Generator, n: int) -> Array:
    while True:
        rows = rng.normal(0, 1, (n, n)) + 2 * np.eye(n)
        if np.linalg.cond(rows) < 30:
            return np.array(rows)


@pytest.mark.parametrize("seed", range(8))
def test_the_axes_accelerate_as_mujoco_s_tendons_do(seed: int, tmp_path: Path) -> None:
    path = tmp_path / "tree.xml"
    path.write_text(random_mjcf(seed))
    rng = np.random.default_rng(seed)
    joints = load_machine(path).joints
    rows = random_coupling(rng, len(joints))
    machine, tendons = load_machine(path, rows.tolist()), Tendons(path, joints, rows)
    tree, n = machine.tree, len(joints)
    q, v, w = (ca.SX.sym(name, n) for name in "qvw")
    a, by_state, by_torque = forward_derivatives(tree, q, v, w)
    answers = ca.Function(
        "answers", [q, v, w], [a, forward_dynamics(tree, q, v, w), by_state, by_torque]
    )
    inverse = ca.Function("inverse", [q, v, w], [inverse_dynamics(tree, q, v, w)])

    def accelerate(at: Array, speed: Array, effort: Array) -> Array:
        return np.array(answers(at, speed, effort)[0]).ravel()

    order = [tendons.model.joint(name).dofadr[0] for name in joints]
    for _ in range(10):
        place, pace = np.empty(n), np.empty(n)
        place[order], pace[order] = rng.uniform(-1, 1, n), rng.normal(0, 2, n)
        effort = rng.normal(0, 5, n)
        tendons.stand(place, pace, effort)
        lengths, speeds = tendons.data.ten_length.copy(), tendons.data.ten_velocity.copy()
        expected = tendons.acceleration()
        first, second, slope, mobility = (np.array(x) for x in answers(lengths, speeds, effort))
        scale = 1 + np.abs(expected).max()
        assert first.ravel() == pytest.approx(expected, abs=1e-9 * scale, rel=1e-7)
        assert second.ravel() == pytest.approx(expected, abs=1e-9 * scale, rel=1e-7)
        needed = np.array(inverse(lengths, speeds, expected)).ravel()
        assert needed == pytest.approx(effort, abs=1e-6 * (1 + np.abs(effort).max() * scale))
        step = 1e-6
        for i in range(n):
            by = step * np.eye(n)[i]
            for column, (dq, dv, dw) in {
                i: (by, 0 * by, 0 * by),
                n + i: (0 * by, by, 0 * by),
                2 * n + i: (0 * by, 0 * by, by),
            }.items():
                ahead = accelerate(lengths + dq, speeds + dv, effort + dw)
                back = accelerate(lengths - dq, speeds - dv, effort - dw)
                difference = (ahead - back) / (2 * step)
                exact = np.hstack((slope, mobility))[:, column]
                assert difference == pytest.approx(exact, rel=1e-4, abs=1e-5 * scale)
        numbers(machine, lengths, speeds, effort, expected)


def numbers(machine: Machine, q: Array, v: Array, effort: Array, a: Array) -> None:
    """What is computed without CasADi: the same machine."""
    rows = q[None], v[None], a[None]
    scale = 1 + np.abs(effort).max() * (1 + np.abs(a).max())
    assert machine.efforts(*rows)[0] == pytest.approx(effort, abs=1e-6 * scale)
    still = machine.efforts(q[None], 0 * v[None], 0 * a[None])[0]
    assert machine.holding(q[None])[0] == pytest.approx(still, abs=1e-9)
    moved = machine.efforts(q[None], 0 * v[None], a[None])[0] - still
    assert machine.mass(q[None])[0] @ a == pytest.approx(moved, rel=1e-9, abs=1e-9 * scale)
    step = 1e-6 * np.eye(len(q))
    change = (machine.holding(q + step) - machine.holding(q - step)) / 2e-6
    assert machine.holding_slope(q[None])[0] == pytest.approx(change.T, rel=1e-5, abs=1e-5)


def test_the_damping_of_an_axis_is_no_less_than_that_of_all_together() -> None:
    machine = load_machine(MACHINES / "planar3.xml", AT_THE_BASE)
    turned = np.linalg.inv(np.array(AT_THE_BASE))
    whole = turned.T @ np.diag(machine.model.damping) @ turned
    assert np.linalg.eigvalsh(np.diag(machine.damping) - whole).min() >= -1e-12


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    yield tmp_path


def coupled(
    name: str, folder: Path, rows: list[list[int]], *changes: str
) -> tuple[Lockstep, Arrays]:
    """The machine as `headway init` makes it, with its motors elsewhere: a run of two seconds."""
    target = folder / f"{name}.yaml"
    assert main(["init", str(MACHINES / f"{name}.xml"), "--out", str(target)]) == 0
    overrides = [f"machine.coupling={rows}", "duration_s=2", *changes]
    lockstep = Lockstep(load_config(target, overrides), folder)
    lockstep.run()
    return lockstep, lockstep.record.arrays()


@pytest.mark.parametrize(
    ("name", "rows", "most"), [("gantry", CORE_XY, 5e-5), ("planar3", AT_THE_BASE, 2e-3)]
)
def test_a_machine_with_its_motors_elsewhere_follows_its_task(
    name: str, rows: list[list[int]], most: float, folder: Path
) -> None:
    """Each axis, and so what MuJoCo's own joints do."""
    lockstep, arrays = coupled(name, folder, rows)
    during = (arrays["truth_s"] > 1) & (arrays["truth_s"] < 2)
    error = arrays["truth_position"][during] - arrays["truth_reference"][during]
    assert np.sqrt(np.mean(error**2, axis=0)).max() < most
    assert np.abs(lockstep.plant.velocity).max() < 0.02 and not arrays["end_plans_refused"][-1]
    plant = lockstep.plant
    joints = [axis.joint for axis in lockstep.config.machine.axes]
    there = np.array([plant.data.joint(joint).qpos[0] for joint in joints])
    assert plant.position == pytest.approx(np.array(rows) @ there, abs=1e-12)


def test_a_push_and_friction_are_the_axis_s(folder: Path) -> None:
    target = folder / "gantry.yaml"
    assert main(["init", str(MACHINES / "gantry.xml"), "--out", str(target)]) == 0
    friction = "sim.plant.coulomb_Nm_or_N=[3, 5, 2]"
    config = load_config(target, [f"machine.coupling={CORE_XY}", friction])
    plant = Lockstep(config, folder).plant
    plant.push(1, 7.0)
    x, y, z = (float(plant.data.joint(name).qfrc_applied[0]) for name in "xyz")
    assert (x, y, z) == (7.0, -7.0, 0.0)
    model = plant.model
    assert model.tendon_frictionloss.tolist() == [3, 5]
    assert model.dof_frictionloss[model.joint("z").dofadr[0]] == 2
    assert model.dof_frictionloss[model.joint("x").dofadr[0]] == 0


def test_the_tool_gets_to_its_places() -> None:
    machine = load_machine(MACHINES / "planar3.xml", AT_THE_BASE)
    rows, rng = np.array(AT_THE_BASE, dtype=float), np.random.default_rng(0)
    joints = np.array([0.4, 0.7, -0.5]) + np.cumsum(rng.normal(0, 0.02, (20, 3)), axis=0)
    plain = load_machine(MACHINES / "planar3.xml")
    at = ca.SX.sym("q", 3)
    place = ca.Function("place", [at], [plain.place("hand", at)])
    places = np.array([np.array(place(q)).ravel() for q in joints])
    low, high = np.full(3, -3.0), np.full(3, 3.0)
    found = postures(machine, "hand", places, joints[0] @ rows.T, low, high)
    reached = np.array([np.array(place(np.linalg.solve(rows, q))).ravel() for q in found])
    assert reached == pytest.approx(places, abs=1e-4)
    coupled_place = ca.Function("place", [at], [machine.place("hand", at)])
    assert np.array(coupled_place(found[0])).ravel() == pytest.approx(reached[0], abs=1e-12)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([[1, 1], [1, -1]], "needs 3 rows of 3 numbers"),
        ([[1, 1, 0], [1, 1], [0, 0, 1]], "needs 3 rows of 3 numbers"),
        ([[1, 1, 0], [2, 2, 0], [0, 0, 1]], "no row may depend on others"),
    ],
)
def test_a_coupling_that_is_none(
    rows: list[list[int]], words: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["init", str(MACHINES / "gantry.xml"), "--out", "gantry.yaml"]) == 0
    capsys.readouterr()
    assert main(["run", "gantry.yaml", "--set", f"machine.coupling={rows}", "--out", "out"]) == 2
    assert words in capsys.readouterr().err
    assert not Path("out").exists()


def test_without_one_each_axis_is_its_joint() -> None:
    values = np.random.default_rng(0).normal(0, 1, (50, 4))
    plain = Coupling.of(None, 4)
    for same in (plain.joints(values), plain.axes(values), plain.efforts(values)):
        assert np.array_equal(same, values)
