"""A joint with neither motor nor encoder: it shows in how the others move, or is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from headway.cli.main import main
from headway.cli.summary import summarize
from headway.configs.load import ConfigError, load_config
from headway.controller.observable import unobservable
from headway.controller.record.columns import Arrays
from headway.sim.lockstep import Lockstep

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
Array = NDArray[np.float64]

BARE = (
    "machine.axes.1={joint: pendulum, passive: true, encoder: false, continuous: true, "
    "rest_rad: 3.141592653589793, rest_sigma_rad: 0.2}"
)
HANGING = (
    "task={kind: regulate, target_rad_or_m: [0.0, 3.141592653589793]}",
    "mpc.position_weight=[1.0e+4, 1.0e+3]", "mpc.velocity_weight=[1, 1]",
    "mpc.torque_step_weight=0.01", "mpc.fade_start=0.6",
    "estimator.acceleration_noise_rad_or_m_per_s15=0.5",
    "estimator.disturbance_noise_Nm_or_N_per_s05=0.02",
)  # fmt: skip
PUSH = "{kind: push, joint: pendulum, at_s: 1.5, for_s: 0.1, effort_Nm_or_N: 0.05}"


def ran(*overrides: str) -> tuple[Lockstep, Arrays]:
    lock = Lockstep(load_config(CONFIGS / "furuta.yaml", [BARE, *HANGING, *overrides]), CONFIGS)
    lock.run()
    return lock, lock.record.arrays()


def off(record: Arrays) -> tuple[Array, Array]:
    """Of the pendulum at each tick: its true angle from hanging, and the estimate's error [rad]."""
    true = record["actual_position"][:, 1]
    return true - np.pi, record["now_estimate"][:, 1] - true


def test_a_swing_that_nobody_told_of_is_found_and_calmed() -> None:
    """Against another mass, friction, weaker motors, delays and losses."""
    lock, record = ran(f"sim.mishaps=[{PUSH}]", "duration_s=6")
    angle, error = off(record)
    pushed, last = (
        slice(370, 500),
        slice(-250, None),
    )  # ticks: from 1.5 s on, and of the last second
    assert np.abs(angle[pushed]).max() > 0.4 and np.abs(error[pushed]).max() > 0.3
    assert np.abs(angle[last]).max() < 0.1
    deviation = np.sqrt(record["now_covariance"].reshape(-1, 6, 6)[:, 1, 1])
    assert deviation[0] > 0.15 and deviation[-1] < 0.07
    assert np.abs(error[last]).max() < 0.07
    assert lock.device_states() == ["HOLD"]
    assert np.abs(record["truth_position"][-250:, 0]).max() < 0.05
    summary = summarize(lock.config, lock, record)
    assert summary["at_rest_after_end"] and not summary["limits_violated"]
    assert len(summary["torque"]["max_abs"]) == len(summary["axes"]) == 2


def test_without_its_weights_nothing_calms_it() -> None:
    """What the test above says of the controller is not friction's doing."""
    _, record = ran(f"sim.mishaps=[{PUSH}]", "duration_s=6", "mpc.position_weight=[1.0e+4, 0]",
                    "mpc.velocity_weight=[1, 0]")  # fmt: skip
    assert np.abs(off(record)[0][-250:]).max() > 0.2


def test_there_is_no_board_for_it() -> None:
    lock, record = ran("duration_s=0.5")
    assert len(lock.plant.nodes) == len(lock.remotes) == lock.plant.model.nu == 1
    assert set(record["received_device"]) == set(record["sent_device"]) == {0}
    assert record["tick_states"].shape[1] == 1
    assert not np.any(record["servo_torque_tq"][:, 1])


def test_no_disturbance_is_estimated_at_it() -> None:
    _, record = ran("sim.start_rad_or_m=[0.4, 3.5]", "duration_s=1")
    assert np.abs(record["now_estimate"][:, 4]).max() > 1e-4
    assert not np.any(record["now_estimate"][:, 5])


FLAT = """<mujoco>
  <worldbody>
    <body name="cart">
      <inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/>
      <joint name="cart" type="slide" axis="1 0 0" damping="0.1"/>
      <body name="top">
        <inertial pos="{arm} 0 0" mass="0.2" diaginertia="1e-3 1e-3 1e-3"/>
        <joint name="top" type="hinge" axis="{axis}" damping="1e-4"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""
TOP = """
    - joint: top
      passive: true
      encoder: false
      continuous: true
      rest_rad: {rest}
"""


def written(tmp_path: Path, arm: float, axis: str, rest: float) -> Path:
    """A cart with a body on a hinge, of which nobody knows where it is."""
    (tmp_path / "flat.xml").write_text(FLAT.format(arm=arm, axis=axis))
    config = tmp_path / "flat.yaml"
    assert main(["init", str(tmp_path / "flat.xml"), "--out", str(config)]) == 0
    text = config.read_text()
    begin = text.index("    - joint: top")
    end = text.index("\nloop:")
    text = text[:begin] + TOP.format(rest=rest).lstrip("\n") + text[end:]
    config.write_text(text)
    return config


REGULATE = "--set=task={kind: regulate, target_rad_or_m: [0.0, 0.0]}"


@pytest.mark.parametrize(("arm", "axis"), [(0.1, "0 0 1"), (0.0, "0 1 0")])
def test_what_does_not_show_is_refused(
    arm: float, axis: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A top that nothing turns back, and one whose centre of mass is on its axis."""
    config = written(tmp_path, arm, axis, 0.0)
    capsys.readouterr()
    run = ["run", str(config), "--duration=0.1", f"--out={tmp_path / 'run'}", REGULATE]
    assert main(run) == 2
    said = capsys.readouterr().err
    assert "top: without an encoder" in said and "give it an encoder" in said
    assert "disturbance" not in said  # it would not help
    assert main(["check", str(config), "--json", REGULATE]) == 2
    rules = json.loads(capsys.readouterr().out)["rules"]
    (rule,) = [r for r in rules if r["name"] == "estimate: axes without an encoder"]
    assert rule["status"] == "FAIL" and "top" in rule["remedy"]


def test_what_hangs_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = written(tmp_path, 0.1, "0 1 0", np.pi / 2)  # its centre of mass below the hinge
    capsys.readouterr()
    main(["check", str(config), "--json", REGULATE])
    rules = json.loads(capsys.readouterr().out)["rules"]
    (rule,) = [r for r in rules if r["name"] == "estimate: axes without an encoder"]
    assert rule["status"] == "ok"


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(0, 3), st.integers(1, 2))
def test_the_unobservable_states_are_found(seed: int, seen: int, unseen: int, outputs: int) -> None:
    """In Kalman's form they can be read off; any other coordinates change nothing."""
    rng = np.random.default_rng(seed)
    n = seen + unseen
    rates = rng.normal(size=(n, n))
    rates[:seen, seen:] = 0
    output = np.hstack((rng.normal(size=(outputs, seen)), np.zeros((outputs, unseen))))
    turned, _ = np.linalg.qr(rng.normal(size=(n, n)))
    basis = unobservable(turned @ rates @ turned.T, output @ turned.T)
    assert basis.shape == (n, unseen)
    np.testing.assert_allclose(turned[:, :seen].T @ basis, 0, atol=1e-7)


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["machine.axes.1.encoder=false"], "counts_per_turn: is of an encoder: remove it"),
        ([BARE.replace("rest_rad: 3.141592653589793, ", "")], "rest_rad: missing"),
        ([BARE, "machine.axes.1.encoder=true"], "machine.axes.1.encoder"),
        (
            [BARE, "sim.mishaps=[{kind: encoder_stuck, at_s: 1, joint: pendulum}]"],
            "pendulum has none: only a push can happen to it",
        ),
        (
            [BARE, "sync.cables=[{joints: [arm, pendulum], ports: [1, 1]}]"],
            "the joints with boards are arm",
        ),
        ([BARE, "machine.coupling=[[1, 0], [0, 1]]"], "has neither: leave one of the two out"),
    ],
)
def test_mistakes(overrides: list[str], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        load_config(CONFIGS / "furuta.yaml", overrides)


def test_those_with_encoders_come_first(tmp_path: Path) -> None:
    text = (CONFIGS / "furuta.yaml").read_text()
    begin, end = text.index("    - joint: arm"), text.index("    - joint: pendulum")
    stop = text.index("\nloop:")
    arm = text[begin:end]
    bare = "    - {joint: pendulum, passive: true, encoder: false, continuous: true, rest_rad: 0}\n"
    path = tmp_path / "furuta.yaml"
    path.write_text(text[:begin] + bare + arm + text[stop:])
    with pytest.raises(ConfigError, match="pendulum has no encoder and comes before arm"):
        load_config(path)
