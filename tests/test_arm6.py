"""models/arm6 and its config: six axes in closed loop, by either solver."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from headway.configs.load import load_config
from headway.sim.lockstep import Lockstep

ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / "configs" / "arm6.yaml"


def test_the_model_has_the_configs_motors_and_encoders() -> None:
    model = mujoco.MjModel.from_xml_path(str(ROOT / "models" / "arm6" / "arm6.xml"))
    for axis, row in zip(load_config(CONFIG).machine.axes, model.actuator_user, strict=True):
        motor = axis.motor
        constants = motor.gear, motor.torque_constant_Nm_per_A, motor.resistance_ohm, motor.supply_V
        np.testing.assert_allclose(row[:5], [axis.counts_per_unit, *constants], rtol=1e-12)


def test_it_is_as_long_and_as_heavy_as_said() -> None:
    model = mujoco.MjModel.from_xml_path(str(ROOT / "models" / "arm6" / "arm6.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    reach = data.site("tool").xpos - [0, 0, 0.089159]
    np.testing.assert_allclose(reach, [0, 0.13585 - 0.1197 + 0.093 + 0.0823, 0.9119], atol=1e-12)
    np.testing.assert_allclose(model.body_mass.sum(), 17.0489, atol=1e-9)


def rms_mrad(*overrides: str) -> float:
    """Of all axes together, once the reference is reached."""
    lock = Lockstep(load_config(CONFIG, ["duration_s=2", *overrides]), CONFIG.parent)
    lock.run()
    record = lock.record.arrays()
    during = (record["truth_s"] > 0.6) & (record["truth_s"] < 2)
    error = (record["truth_position"] - record["truth_reference"])[during]
    return float(1e3 * np.sqrt(np.mean(error**2)))


def test_a_fifth_more_mass_than_known_costs_little() -> None:
    """Beside a plant that is the model; without dry friction, which costs more."""
    known = "coulomb_Nm_or_N=null", "viscous_scale=1", "motor_constant_scale=1"
    rest = [f"sim.plant.{number}" for number in known]
    assert rms_mrad(*rest) < 1.5 * rms_mrad(*rest, "sim.plant.mass_scale={}")


@pytest.mark.parametrize("backend", ["hpipm", "osqp", "riccati"])
def test_it_follows_and_rests(backend: str) -> None:
    """With a fifth more mass than it is known to have, friction and losses."""
    lock = Lockstep(
        load_config(CONFIG, [f"mpc.backend={backend}", "duration_s=1.5"]), CONFIG.parent
    )
    lock.run()
    record = lock.record.arrays()
    assert record["tick_accepted"].all()
    assert record["end_plans_refused"].max() == 0
    assert lock.device_states() == ["HOLD"] * 6
    during = (record["truth_s"] > 0.6) & (record["truth_s"] < 1.5)
    error = (record["truth_position"] - record["truth_reference"])[during]
    assert np.sqrt(np.mean(error**2, axis=0)).max() < 1e-3
