"""Any model becomes a plant: boards on its joints, and what would fight with them is gone."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from headway.configs.axis import Axis, LinearAxis, RotaryAxis
from headway.configs.schema import Machine
from headway.configs.schema import Plant as PlantConfig
from headway.models.source import read_spec
from headway.sim.drives import driven_model
from headway.sim.plant import Plant

ROOT = Path(__file__).resolve().parent.parent
MACHINES = ROOT / "tests" / "machines"
MOTOR = {"torque_constant_Nm_per_A": 0.05, "resistance_ohm": 1.5, "supply_V": 48.0}


def hinge(name: str, limit: float = 20.0) -> RotaryAxis:
    return RotaryAxis(
        joint=name,
        counts_per_turn=40000,
        position_min_rad=-3.0,
        position_max_rad=3.0,
        velocity_limit_rad_per_s=10.0,
        acceleration_limit_rad_per_s2=200.0,
        torque_limit_Nm=limit,
        motor={"gear": 40.0, **MOTOR},
        servo={"kp_Nm_per_rad": 100.0, "kd_Nm_s_per_rad": 5.0},
    )


def slide(name: str, limit: float = 150.0) -> LinearAxis:
    return LinearAxis(
        joint=name,
        counts_per_m=1e6,
        position_min_m=-0.5,
        position_max_m=0.5,
        velocity_limit_m_per_s=1.0,
        acceleration_limit_m_per_s2=20.0,
        force_limit_N=limit,
        motor={"gear_rad_per_m": 300.0, **MOTOR},
        servo={"kp_N_per_m": 5000.0, "kd_N_s_per_m": 100.0},
    )


AXES: dict[str, list[Axis]] = {
    "planar3": [hinge("shoulder", 60), hinge("elbow"), hinge("wrist", 5)],
    "scara": [hinge("j1"), hinge("j2"), slide("z"), hinge("spin", 2)],
    "gantry": [slide("x"), slide("y"), slide("z")],
}
STARTS = {"planar3": [0.5, -0.5, 0.3], "scara": [0.3, 0.3, -0.1, 0], "gantry": [0.1, 0, -0.05]}


def machine(name: str, axes: list[Axis] | None = None) -> Machine:
    return Machine(model=f"{name}.xml", axes=axes or AXES[name])


def built(name: str, servo_period_us: int = 1000) -> mujoco.MjModel:
    return driven_model(MACHINES / f"{name}.xml", machine(name), servo_period_us, STARTS[name])


@pytest.mark.parametrize("name", AXES)
def test_each_axis_has_its_motor_and_nothing_else_drives(name: str) -> None:
    model = built(name)
    assert (model.nu, model.nsensor, model.nkey) == (len(AXES[name]), 0, 0)
    for i, axis in enumerate(AXES[name]):
        assert model.actuator_trnid[i, 0] == model.joint(axis.joint).id
        assert model.actuator_plugin[i] >= 0
        motor = axis.motor
        assert model.actuator_user[i, :5].tolist() == [
            axis.counts_per_unit,
            motor.gear,
            motor.torque_constant_Nm_per_A,
            motor.resistance_ohm,
            motor.supply_V,
        ]
        assert 0 < model.actuator_user[i, 5] <= 1.5 * axis.effort_limit
    assert not model.jnt_actfrclimited.any()  # the board has its own limit
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert model.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE


@pytest.mark.parametrize("name", AXES)
def test_the_mechanics_are_the_models(name: str) -> None:
    """What the controller's model was checked against is what is simulated."""
    ours, theirs = built(name), read_spec(MACHINES / f"{name}.xml").compile()
    for field in ("body_mass", "body_inertia", "dof_armature", "dof_damping", "dof_frictionloss"):
        np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))
    np.testing.assert_array_equal(ours.jnt_range, theirs.jnt_range)
    np.testing.assert_array_equal(ours.opt.gravity, theirs.opt.gravity)
    np.testing.assert_array_equal(ours.geom_contype, theirs.geom_contype)


def test_a_model_made_for_us_is_used_as_it_is() -> None:
    path = ROOT / "models" / "arm2" / "arm2.xml"
    ours = driven_model(path, machine("arm2", [hinge("q1"), hinge("q2")]), 1000, [0, 0])
    theirs = mujoco.MjModel.from_xml_path(str(path))
    images = []
    for model in (ours, theirs):
        image = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, image)
        images.append(image.tobytes())
    assert images[0] == images[1]


def test_boards_of_the_model_and_boards_of_the_config(tmp_path: Path) -> None:
    """A model with one of our boards gets the other one from the config."""
    text = (ROOT / "models" / "arm2" / "arm2.xml").read_text()
    start = text.index('    <plugin name="q2"')
    path = tmp_path / "half.xml"
    path.write_text(text[:start] + text[text.index("\n", start) + 1 :])
    model = driven_model(path, machine("half", [hinge("q1"), hinge("q2")]), 1000, [0, 0])
    assert model.actuator_user[:, 1].tolist() == [30, 40]
    assert [model.joint(j).name for j in model.actuator_trnid[:, 0]] == ["q1", "q2"]


@pytest.mark.parametrize(
    ("period_us", "step_us"), [(1000, 250), (500, 250), (700, 233), (300, 150)]
)
def test_steps_divide_the_servo_period(period_us: int, step_us: int) -> None:
    if period_us % step_us:
        step_us = max(s for s in range(50, 251) if period_us % s == 0)
    assert round(built("gantry", period_us).opt.timestep * 1e6) == step_us


@pytest.mark.parametrize(
    ("name", "axes", "period_us", "message"),
    [
        ("gantry", [slide("x"), slide("y"), slide("w")], 1000, "no joint w; the .* x, y, z"),
        (
            "gantry",
            [slide("x"), slide("y"), hinge("z")],
            1000,
            "z slides: use the keys of a linear",
        ),
        ("planar3", [hinge("shoulder"), hinge("elbow"), slide("wrist")], 1000, "wrist turns"),
        ("gantry", AXES["gantry"], 997, "device.servo_period_us is 997"),
    ],
)
def test_what_does_not_fit_is_told(
    name: str, axes: list[Axis], period_us: int, message: str
) -> None:
    path = MACHINES / f"{name}.xml"
    with pytest.raises(ValueError, match=message) as caught:
        driven_model(path, machine(name, axes), period_us, [0.0] * 3)
    assert str(path) in str(caught.value)


def contacts(model: mujoco.MjModel, position: list[float]) -> set[frozenset[str]]:
    data = mujoco.MjData(model)
    data.qpos[:] = position
    mujoco.mj_forward(model, data)
    pairs = [model.geom_bodyid[list(contact.geom)] for contact in data.contact]
    return {frozenset(model.body(int(body)).name for body in pair) for pair in pairs}


def test_bodies_that_touch_where_the_task_starts_never_collide_and_others_do(
    tmp_path: Path,
) -> None:
    """A column that reaches into the inner arm, and a floor within the quill's reach."""
    text = (MACHINES / "scara.xml").read_text()
    old = '<geom name="column" type="cylinder" size="0.06 0.2" pos="0 0 -0.25"/>'
    assert old in text
    floor = '<geom type="plane" size="1 1 0.1" pos="0 0 -0.185"/>'
    path = tmp_path / "scara.xml"
    path.write_text(text.replace(old, old.replace("-0.25", "-0.2") + floor))
    up, down = [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, -0.15, 0.0]
    bare = read_spec(path).compile()
    assert contacts(bare, up) == {frozenset({"world", "inner"})}
    assert contacts(bare, down) == contacts(bare, up) | {frozenset({"world", "flange"})}
    from_up, from_down = (driven_model(path, machine("scara"), 1000, s) for s in (up, down))
    assert (contacts(from_up, up), contacts(from_up, down)) == (
        set(),
        {frozenset({"world", "flange"})},
    )
    assert contacts(from_down, up) == contacts(from_down, down) == set()


@pytest.mark.parametrize("name", AXES)
def test_brakes_hold_the_machine_at_power_up(name: str) -> None:
    """Half a second under gravity, kicked about: nothing gives way, nothing is unstable."""
    plant = Plant(MACHINES / f"{name}.xml", machine(name), PlantConfig(), 1000, STARTS[name])
    rng = np.random.default_rng(2)
    strength = plant.model.actuator_user[:, 5]
    for _ in range(2000):
        plant.data.qfrc_applied[plant._dof] = 0.2 * strength * rng.uniform(-1, 1, len(strength))
        plant.step(1)
    assert all(node.brake for node in plant.nodes)
    assert np.all(np.abs(plant.position - STARTS[name]) < 0.01)
    assert np.all(np.abs(plant.velocity) < 0.5)
    assert sum(int(warning.number) for warning in plant.data.warning) == 0


def test_a_brake_too_strong_for_its_joint_is_weakened(tmp_path: Path) -> None:
    """A stiff brake on next to no inertia would shake itself to pieces at this step."""
    path = tmp_path / "light.xml"
    path.write_text(
        '<mujoco><compiler autolimits="true"/><worldbody><body name="b">'
        '<joint name="j" axis="0 0 1" range="-90 90"/>'
        '<inertial pos="0 0 0" mass="0.1" diaginertia="1e-5 1e-5 1e-5"/></body></worldbody>'
        "</mujoco>"
    )
    plant = Plant(path, machine("light", [hinge("j", 100)]), PlantConfig(), 1000, [0.2])
    assert plant.model.actuator_user[0, 5] < 0.1
    plant.data.qvel[0] = 1.0
    plant.step(2000)
    assert abs(plant.velocity[0]) < 1e-3 and abs(plant.position[0] - 0.2) < 0.1


def test_deviations_of_the_plant_reach_its_boards() -> None:
    config: Any = PlantConfig(motor_constant_scale=0.9, mass_scale={"spindle": 2.0})
    plant = Plant(MACHINES / "gantry.xml", machine("gantry"), config, 1000, STARTS["gantry"])
    np.testing.assert_allclose(plant.model.actuator_user[:, 2], 0.9 * 0.05)
    assert plant.model.body("spindle").mass[0] == pytest.approx(5.0)
