"""Axes without a motor: a pendulum and a pole that are swung up, held and pushed."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from headway.configs.load import ConfigError, load_config
from headway.controller.record.columns import Arrays
from headway.controller.tick import Phase
from headway.devices.settings import device_settings
from headway.firmware import _core
from headway.sim.lockstep import Lockstep

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
Array = NDArray[np.float64]


def ran(name: str, *overrides: str) -> tuple[Lockstep, Arrays]:
    lock = Lockstep(load_config(CONFIGS / f"{name}.yaml", list(overrides)), CONFIGS)
    lock.run()
    return lock, lock.record.arrays()


def off_upright(record: Arrays) -> Array:
    """How far the passive joint is from upright, while the task runs [rad]."""
    running = record["truth_s"] <= record["tick_s"][-1]
    angle = record["truth_position"][running, 1]
    off: Array = np.abs((angle + np.pi) % (2 * np.pi) - np.pi)
    return off


@pytest.mark.parametrize("name", ["furuta", "cartpole"])
@pytest.mark.parametrize("backend", ["hpipm", "osqp", "riccati"])
def test_it_is_swung_up_and_stays_there(name: str, backend: str) -> None:
    """Against another mass, friction, weaker motors, delays and losses; the actuated joint comes to
    rest at the end, within its limits."""
    lock, record = ran(name, f"mpc.backend={backend}", "duration_s=4")
    off = off_upright(record)
    assert off[0] > 3
    assert off[-1000:].max() < 0.1
    axis = lock.config.machine.axes[0]
    assert axis.lowest < record["truth_position"][:, 0].min()
    assert record["truth_position"][:, 0].max() < axis.highest
    assert lock.device_states() == ["HOLD", "UNSYNCED"]  # nobody has told it the time for a second


@pytest.mark.parametrize("sign", [1, -1])
def test_it_recovers_from_pushes(sign: int) -> None:
    """From one that it can balance, and from one that throws it down."""
    pushes = ", ".join(
        f"{{kind: push, joint: pendulum, at_s: {at}, for_s: 0.1, effort_Nm_or_N: {sign * push}}}"
        for at, push in ((2, 0.01), (3, 0.12))
    )
    _, record = ran("furuta", f"sim.mishaps=[{pushes}]", "duration_s=7")
    off = off_upright(record)
    assert off[1800:2000].max() < 0.05
    assert 0.01 < off[2000:3000].max() < 0.5
    assert off[3000:].max() > 2
    assert off[-1000:].max() < 0.1


def test_nobody_sends_it_a_plan_or_arms_it() -> None:
    lock, record = ran("furuta", "duration_s=0.5")
    pendulum = lock.plant.nodes[1].status
    assert pendulum.plan_seen == 0 and pendulum.epoch == 0
    assert set(record["tick_states"][:, 1]) == {_core.STATES.index("IDLE")}
    assert np.all(record["servo_torque_tq"][:, 1] == 0)


def test_its_board_takes_no_track() -> None:
    config = load_config(CONFIGS / "furuta.yaml")
    settings = device_settings(config.machine.axes[1], config.device, config.loop, config.sync)
    assert _core.DeviceSettings.decode(settings.encode()) is not None  # which refuses bad ones
    for sink in range(_core.TRACK_KD + 1):
        assert settings.limits(sink).difference_max == 0


def test_the_loop_ends_when_it_falls_silent() -> None:
    lock = Lockstep(load_config(CONFIGS / "furuta.yaml", [
        "duration_s=2", "sim.mishaps=[{kind: partition, joint: pendulum, at_s: 0.6}]",
    ]), CONFIGS)  # fmt: skip
    with pytest.raises(Exception, match="pendulum: the device no longer answers"):
        lock.run()
    assert lock.loop.phase is Phase.RUN
    assert lock.device_states()[0] == "HOLD"


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("machine.axes.0.passive=true", "a passive axis has no motor: remove it"),
        ("machine.axes.1.passive=false", "machine.axes.1"),
        ("sim.mishaps=[{kind: push, at_s: 1, effort_Nm_or_N: 1}]", "a push needs a joint"),
        ("sim.mishaps=[{kind: push, at_s: 1, joint: arm}]", "a push needs a joint"),
    ],
)
def test_mistakes(override: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        load_config(CONFIGS / "furuta.yaml", [override])


def test_something_has_to_move(tmp_path: Path) -> None:
    text = (CONFIGS / "furuta.yaml").read_text()
    begin, end = text.index("    - joint: arm"), text.index("    - joint: pendulum")
    path = tmp_path / "furuta.yaml"
    path.write_text(text[:begin] + text[end:])
    with pytest.raises(ConfigError, match="every axis is passive: nothing can move the machine"):
        load_config(path)
