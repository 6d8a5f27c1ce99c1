"""The controller's model against pinocchio, MuJoCo, an ODE integrator and finite differences."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from trees import random_mjcf

from headway.configs.load import load_config
from headway.controller._tick import Filter
from headway.controller.equations import COULOMB_SPEED
from headway.controller.prediction import Prediction, ServoLaw
from headway.models.dynamics import (
    Tree,
    forward_derivatives,
    forward_dynamics,
    inverse_dynamics,
)
from headway.models.machine import Machine, load_machine
from headway.sim.plant import BRAKE

ROOT = Path(__file__).resolve().parent.parent
ARM2 = ROOT / "models" / "arm2" / "arm2.xml"

Array = NDArray[np.float64]


def joints_in(model: mujoco.MjModel) -> list[str]:
    return [model.joint(j).name for j in range(model.njnt)]


@pytest.fixture(params=["arm2", "arm6", "furuta", "cartpole", *range(12)], scope="module")
def machine(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path of a model: the shipped ones, then random trees."""
    if isinstance(request.param, str):
        return ROOT / "models" / request.param / f"{request.param}.xml"
    path = tmp_path_factory.mktemp("tree") / "tree.xml"
    path.write_text(random_mjcf(request.param))
    return path


def as_functions(tree: Tree) -> tuple[ca.Function, ca.Function]:
    q, v, w = (ca.SX.sym(name, tree.count) for name in "qvw")
    forward = ca.Function("forward", [q, v, w], [forward_dynamics(tree, q, v, w)])
    inverse = ca.Function("inverse", [q, v, w], [inverse_dynamics(tree, q, v, w)])
    return forward, inverse


def states(count: int, seed: int) -> list[tuple[Array, Array, Array]]:
    """Positions, velocities, and torques or accelerations."""
    rng = np.random.default_rng(seed)
    return [
        (rng.uniform(-2, 2, count), rng.normal(0, 3, count), rng.normal(0, 10, count))
        for _ in range(25)
    ]


def test_forward_dynamics_agree_with_pinocchio(machine: Path) -> None:
    loaded = load_machine(machine)
    model, data = loaded.model, loaded.model.createData()
    forward, _ = as_functions(loaded.tree)
    for q, v, tau in states(model.nv, 1):
        expected = pin.aba(model, data, q, v, tau - model.damping * v)
        got = np.array(forward(q, v, tau)).ravel()
        assert np.abs(got - expected).max() <= 1e-12 * np.abs(expected).max()


def test_derivatives_of_the_dynamics_agree_with_pinocchios(machine: Path) -> None:
    """With its own analytical ones; damping, which it does not know, is the torque's."""
    loaded = load_machine(machine)
    model, data = loaded.model, loaded.model.createData()
    q, v, w = (ca.SX.sym(name, loaded.tree.count) for name in "qvw")
    ours = ca.Function("ours", [q, v, w], list(forward_derivatives(loaded.tree, q, v, w)))
    for at, speed, tau in states(model.nv, 3):
        net = tau - model.damping * speed
        by_q, by_v, by_tau = pin.computeABADerivatives(model, data, at, speed, net)
        accelerations = pin.aba(model, data, at, speed, net)
        a, by_state, by_torque = (np.array(each) for each in ours(at, speed, tau))
        expected = np.hstack((by_q, by_v - by_tau * model.damping))
        assert np.abs(a.ravel() - accelerations).max() <= 1e-10 * np.abs(accelerations).max()
        assert np.abs(by_torque - by_tau).max() <= 1e-8 * np.abs(by_tau).max()
        assert np.abs(by_state - expected).max() <= 1e-8 * np.abs(expected).max()


def test_inverse_dynamics_agree_with_pinocchio(machine: Path) -> None:
    loaded = load_machine(machine)
    model, data = loaded.model, loaded.model.createData()
    _, inverse = as_functions(loaded.tree)
    for q, v, a in states(model.nv, 2):
        expected = pin.rnea(model, data, q, v, a) + model.damping * v
        got = np.array(inverse(q, v, a)).ravel()
        assert np.abs(got - expected).max() <= 1e-12 * np.abs(expected).max()


def test_armature_and_damping_are_in_the_models_that_are_compared(machine: Path) -> None:
    model = load_machine(machine).model
    assert np.any(model.armature > 0) and np.all(model.damping > 0)


def test_accelerations_are_mujocos(machine: Path) -> None:
    """Two readers of the same file: pinocchio's for the controller, MuJoCo's for the plant."""
    loaded = load_machine(machine)
    forward, _ = as_functions(loaded.tree)
    model = mujoco.MjModel.from_xml_path(str(machine))
    if model.nu:
        model.actuator_user[:, BRAKE] = 0  # at power-up the bridge is open and the brake on
    assert list(loaded.joints) == joints_in(model)
    model.jnt_limited[:] = 0  # stops are no part of the controller's model
    data = mujoco.MjData(model)
    for q, v, tau in states(model.nv, 3):
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, tau
        mujoco.mj_forward(model, data)
        assert np.all(data.actuator_force == 0)
        got = np.array(forward(q, v, tau)).ravel()
        np.testing.assert_allclose(got, data.qacc, rtol=1e-6, atol=1e-6 * np.abs(data.qacc).max())


def test_random_trees_have_both_kinds_of_joints_and_branches() -> None:
    """What the comparisons above rest on."""
    kinds, branching, sizes = set(), 0, set()
    for seed in range(12):
        model = mujoco.MjModel.from_xml_string(random_mjcf(seed))
        kinds |= set(model.jnt_type.tolist())
        parents = model.body_parentid[1:].tolist()
        branching += len(set(parents)) < len(parents)
        sizes.add(model.nv)
    assert kinds == {mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE}
    assert branching >= 4 and sizes == {2, 3, 4, 5, 6}


BODY = '<inertial pos="0.1 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>'
HINGE = BODY + '<joint name="{}" axis="0 1 0"/>'


@pytest.mark.parametrize(
    ("bodies", "what"),
    [
        (
            f'<body name="a">{HINGE.format("j")}</body><body name="b">{HINGE.format("k")}</body>',
            "joints j, MuJoCo j, k",
        ),
        (
            '<body name="base" euler="0 60 0"><geom size="0.1"/>'
            f'<body name="a">{HINGE.format("j")}</body></body>',
            "bias force",
        ),
        (
            f'<body>{HINGE.format("j")}<body pos="1 0 0">{HINGE.format("k")}'
            f'<body pos="1 0 0">{HINGE.format("l")}</body></body></body>',
            "joints k, l, MuJoCo j, k, l",
        ),
    ],
    ids=["two roots", "fixed base with a pose", "bodies without names"],
)
def test_what_pinocchio_misreads_is_refused(tmp_path: Path, bodies: str, what: str) -> None:
    path = tmp_path / "misread.xml"
    path.write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    with pytest.raises(ValueError, match=rf"misread\.xml: .*{what}"):
        load_machine(path)


@pytest.mark.parametrize("joint", ['<freejoint name="{0}"/>', '<joint name="{0}" type="ball"/>'])
def test_a_joint_of_many_degrees_of_freedom_is_refused_by_name(tmp_path: Path, joint: str) -> None:
    path = tmp_path / "loose.xml"
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    path.write_text(
        f'<mujoco><worldbody><body name="a">{joint.format("wobbly")}{inertial}'
        f'<body name="b" pos="1 0 0"><joint name="elbow" axis="0 0 1"/>{inertial}</body>'
        "</body></worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match=r"loose\.xml: joint wobbly: only hinge and slide joints"):
        load_machine(path)


def test_an_unreadable_model_is_a_valueerror_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "torn.xml"
    path.write_text("<mujoco><worldbody>")
    with pytest.raises(ValueError, match=r"torn\.xml"):
        load_machine(path)


# The compiled prediction.

INTERVALS, HORIZON = 3, 4


def law_of(count: int) -> ServoLaw:
    """The arm's servos with friction, repeated as needed."""
    axes = load_config(ROOT / "configs" / "arm2.yaml").machine.axes
    law = ServoLaw.of([axes[i % 2] for i in range(count)])
    return ServoLaw(law.kp, law.kd, law.emf, law.limit, np.linspace(0.1, 0.2, count))


CRANE = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="cart"><inertial pos="0 0 0" mass="2" diaginertia="0.1 0.1 0.1"/>
    <joint name="drive" type="slide" axis="1 0 0" damping="0.5" armature="0.3"/>
    <body name="boom" pos="0 0 0.1">
      <inertial pos="0.2 0 0" mass="0.7" diaginertia="0.001 0.01 0.01"/>
      <joint name="lift" type="hinge" axis="0 -1 0" damping="0.1" armature="0.01"/>
    </body></body></worldbody></mujoco>"""


@pytest.fixture(params=["arm2", "crane"], scope="module")
def predicted(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Machine, Prediction]:
    """The arm, and a slide that carries a hinge."""
    path = ARM2
    if request.param == "crane":
        path = tmp_path_factory.mktemp("crane") / "crane.xml"
        path.write_text(CRANE)
    loaded = load_machine(path)
    return loaded, Prediction(loaded, law_of(len(loaded.joints)), INTERVALS, HORIZON)


def central(function: Callable[[Array], Array], at: Array, h: float = 1e-5) -> Array:
    """Jacobian by central differences of fourth order."""
    columns = []
    for i in range(at.size):
        e = np.zeros(at.size)
        e[i] = h
        near, far = (function(at + k * e) - function(at - k * e) for k in (1, 2))
        columns.append((8 * near - far) / (12 * h))
    return np.stack(columns, axis=-1)


def step(prediction: Prediction, z: Array, tracks: Array, dt: float) -> tuple[Array, Array]:
    """The state after, and its derivatives; z = [x, d]."""
    n, pool = prediction.n, dict[str, Array]()
    rate, slope = (prediction.call(name, pool).bound for name in ("servoed", "slope"))
    noise = np.ones(n), np.ones(n), np.ones(n), np.ones(3 * n), 9.0, 20
    return Filter(rate, slope, *noise, 8, 1, 5000).step(z, tracks, dt)


def servo_cases(prediction: Prediction, saturated: bool) -> list[tuple[Array, Array]]:
    """States [q, v, d] and tracks whose torques stay clear of the clip's corners."""
    rng, n, cases = np.random.default_rng(7), prediction.n, []
    law = prediction.law
    while len(cases) < 12:
        q, v, d = rng.uniform(-2, 2, n), rng.normal(0, 1.5, n), rng.normal(0, 1, n)
        r, rate, f = q + rng.normal(0, 0.01, n), v + rng.normal(0, 0.1, n), rng.normal(0, 1, n)
        if saturated:
            r += 0.5 * rng.choice([-1, 1], n)
        gains = law.feedback * rng.uniform(0.3, 1, 2 * n)
        tracks = np.tile(np.concatenate((r, rate, f, gains)), (3, 1))
        tracks += rng.normal(0, 1e-3, (3, 5 * n))
        at, speed, effort, kp, damping = tracks.reshape(3, 5, n).swapaxes(0, 1)
        torque = effort + kp * (at - q) + damping * (speed - v)
        clear = np.abs(torque) > 1.3 * law.limit if saturated else np.abs(torque) < 0.7 * law.limit
        if clear.all():
            cases.append((np.concatenate((q, v, d)), tracks))
    return cases


@pytest.mark.parametrize("saturated", [False, True])
def test_derivatives_of_a_servoed_step(
    predicted: tuple[Machine, Prediction], saturated: bool
) -> None:
    """They are those of the slope half-way: the share of a column that errs goes with the square of
    the step at least, where the tracks stay as they are."""
    _, prediction = predicted
    errors = []
    for z, (_, tracks, _) in servo_cases(prediction, saturated):
        for dt in (0.001, 0.0005):

            def after(z: Array, t: Array = tracks, dt: float = dt) -> tuple[Array, Array]:
                return step(prediction, z, np.array([t, t, t]), dt)

            expected = central(lambda z, after=after: after(z)[0], z)  # type: ignore[misc]
            size = np.abs(expected).max(axis=0)
            errors.append((np.abs(after(z)[1] - expected) / size).max())
    longer, shorter = np.reshape(errors, (-1, 2)).T
    assert shorter.max() < 1e-3
    assert np.median(longer / shorter) > 3.7


@pytest.mark.parametrize("saturated", [False, True])
def test_the_servos_torques_are_those_of_their_law(
    predicted: tuple[Machine, Prediction], saturated: bool
) -> None:
    _, prediction = predicted
    n, law = prediction.n, prediction.law
    for z, tracks in servo_cases(prediction, saturated):
        for axis, torque in enumerate(prediction.given(z[: 2 * n], tracks[0])):
            at, rate, effort, kp, damping = tracks[0, axis::n]
            wanted = effort + kp * (at - z[axis]) + damping * (rate - z[n + axis])
            assert torque == pytest.approx(
                max(-law.limit[axis], min(wanted, law.limit[axis])), rel=1e-12
            )


def linearize(
    prediction: Prediction, x: Array, u0: Array, u1: Array, d: Array, dt: float
) -> list[Array]:
    """Intervals side by side, as the compiled function has them."""
    call = prediction.call("linearize")
    for target, value in zip(call.inputs, (x, u0, u1, d[:, None], dt), strict=True):
        target[...] = value
    return call.run()


def test_derivatives_of_the_linearized_intervals(predicted: tuple[Machine, Prediction]) -> None:
    _, prediction = predicted
    rng, n, dt = np.random.default_rng(8), prediction.n, 0.008
    for _ in range(8):
        x = np.vstack((rng.uniform(-2, 2, (n, INTERVALS)), rng.normal(0, 1.5, (n, INTERVALS))))
        u0, u1 = rng.normal(0, 4, (2, n, INTERVALS))
        d = rng.normal(0, 1, n)
        _, *parts = linearize(prediction, x, u0, u1, d, dt)

        def after(
            w: Array, i: int, x: Array = x, u0: Array = u0, u1: Array = u1, d: Any = d
        ) -> Any:
            x, u0, u1 = x.copy(), u0.copy(), u1.copy()
            x[:, i], u0[:, i], u1[:, i] = w[: 2 * n], w[2 * n : 3 * n], w[3 * n :]
            return linearize(prediction, x, u0, u1, d, dt)[0][:, i]

        for i in range(INTERVALS):
            w = np.concatenate((x[:, i], u0[:, i], u1[:, i]))
            expected = central(lambda w, i=i, after=after: after(w, i), w)  # type: ignore[misc]
            blocks = [part.reshape(2 * n, INTERVALS, -1)[:, i] for part in parts]
            size = np.abs(expected).max(axis=0)
            assert np.all(np.abs(np.hstack(blocks) - expected) <= 1e-6 * size)


def test_a_servoed_step_is_the_machine_under_its_servo_law(
    predicted: tuple[Machine, Prediction],
) -> None:
    """Against an adaptive integrator over pinocchio's dynamics, with the law written out again."""
    loaded, prediction = predicted
    model, data, law, n = loaded.model, loaded.model.createData(), prediction.law, prediction.n
    dt = 2e-4
    for z, tracks in servo_cases(prediction, False) + servo_cases(prediction, True):
        d, held = z[2 * n :], np.tile(tracks[1], (3, 1))

        def derivative(_: float, x: Array, d: Array = d, held: Array = held) -> Array:
            r, rate, f, kp, damping = np.split(held[0], 5)
            q, v = x[:n], x[n:]
            torque = f + kp * (r - q) + damping * (rate - v)
            torque = np.clip(torque, -law.limit, law.limit) + d - model.damping * v
            torque = torque - law.coulomb * np.tanh(v / COULOMB_SPEED)
            return np.concatenate((v, pin.aba(model, data, q, v, torque)))

        exact = solve_ivp(
            derivative, (0, dt), z[: 2 * n], method="DOP853", rtol=1e-11, atol=1e-12
        ).y[:, -1]
        got, _ = step(prediction, z, held, dt)
        moved = np.abs(exact - z[: 2 * n]).max()
        assert np.abs(got - exact).max() <= 1e-5 * moved


def test_a_roll_out_is_a_chain_of_steps(predicted: tuple[Machine, Prediction]) -> None:
    _, prediction = predicted
    rng, n = np.random.default_rng(9), prediction.n
    z, first = servo_cases(prediction, False)[0]
    tracks = first[0] + rng.normal(0, 1e-3, (3, HORIZON, 5 * n))
    call = prediction.call("rollout")
    call.inputs[0][:, 0], call.inputs[1][...] = z[: 2 * n], z[2 * n :, None]
    for i in range(3):
        call.inputs[2 + i][...] = tracks[i].T
    call.inputs[5][...] = 0.004
    rolled = call.run()[0].T.copy()
    x = z[: 2 * n]
    for k in range(HORIZON):
        x, _ = step(prediction, np.concatenate((x, z[2 * n :])), tracks[:, k], 0.004)
        np.testing.assert_allclose(rolled[k], x, rtol=1e-13, atol=1e-13)


def test_inverse_dynamics_undo_the_open_loop_step(predicted: tuple[Machine, Prediction]) -> None:
    """The torque of a motion, put into the open-loop interval, gives the motion's acceleration."""
    _, prediction = predicted
    rng, n, dt = np.random.default_rng(10), prediction.n, 1e-5
    q, v = rng.uniform(-2, 2, (HORIZON + 1, n)), rng.normal(0, 2, (HORIZON + 1, n))
    a = rng.normal(0, 20, (HORIZON + 1, n))
    torque = prediction.inverse_dynamics(q, v, a)[:INTERVALS]
    q, v, a = q[:INTERVALS], v[:INTERVALS], a[:INTERVALS]
    x = np.hstack((q, v)).T
    after = linearize(prediction, x, torque.T, torque.T, np.zeros(n), dt)[0]
    np.testing.assert_allclose((after[n:].T - v) / dt, a, atol=0.02 * np.abs(a).max())


def test_holding_torque_carries_gravity_less_what_the_disturbance_carries(
    predicted: tuple[Machine, Prediction],
) -> None:
    loaded, prediction = predicted
    q, d = np.linspace(-1, 1, prediction.n), np.linspace(0.5, 0.7, prediction.n)
    gravity = pin.computeGeneralizedGravity(loaded.model, loaded.model.createData(), q)
    np.testing.assert_allclose(prediction.holding(q, d), gravity - d, atol=1e-12)
