"""Postures that bring a tool to its places, and a run along them."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from headway.configs.load import load_config
from headway.controller.kinematics import postures
from headway.controller.reference import task_reference
from headway.models.machine import load_machine
from headway.sim.lockstep import Lockstep

ROOT = Path(__file__).resolve().parent.parent
CONFIGS = ROOT / "configs"
Array = NDArray[np.float64]


def tool_at(name: str, positions: Array) -> Array:
    """By MuJoCo."""
    model = mujoco.MjModel.from_xml_path(str(ROOT / "models" / name / f"{name}.xml"))
    data, places = mujoco.MjData(model), []
    for q in positions:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        places.append(data.site("tool").xpos.copy())
    return np.array(places)


@pytest.mark.parametrize("name", ["arm2", "arm6"])
@pytest.mark.parametrize("seed", range(3))
def test_the_tool_gets_to_its_places(name: str, seed: int) -> None:
    """Along places that some motion of the joints has, within their ranges, without a jump."""
    axes = load_config(CONFIGS / f"{name}.yaml").machine.axes
    low, high = np.array([(axis.lowest, axis.highest) for axis in axes]).T
    rng = np.random.default_rng(seed)
    ends = rng.uniform(0.2 * low, 0.6 * high, (2, len(axes)))
    share = np.linspace(0, 1, 40)[:, None]
    motion = ends[0] + share * (ends[1] - ends[0])
    places = tool_at(name, motion)
    machine = load_machine(ROOT / "models" / name / f"{name}.xml")
    found = postures(machine, "tool", places, motion[0], low, high)
    assert np.linalg.norm(tool_at(name, found) - places, axis=1).max() < 1e-4
    assert np.all((found >= low) & (found <= high))
    assert np.abs(np.diff(found, axis=0)).max() < 0.3


def circle(path: Path, radius_m: float) -> Path:
    """Of arm2's tool, in the plane of its links, from and to rest."""
    time_s = np.linspace(0, 2, 81)
    share = time_s / 2
    angle = 2 * np.pi * (share - np.sin(2 * np.pi * share) / (2 * np.pi))
    x, z = 0.4 + radius_m * np.cos(angle), 0.1 + radius_m * np.sin(angle)
    rows = [f"{t:.6f},{a:.9f},0,{b:.9f}" for t, a, b in zip(time_s, x, z, strict=True)]
    path.write_text("time_s,x_m,y_m,z_m\n" + "\n".join(rows) + "\n")
    return path


def tool_task(path: Path, tool: str = "tool") -> list[str]:
    return [f"task={{kind: track, file: {path}, tool: {tool}}}", "duration_s=2.2"]


def test_a_machine_follows_places_of_its_tool(tmp_path: Path) -> None:
    path = circle(tmp_path / "circle.csv", 0.08)
    config = load_config(
        CONFIGS / "arm2.yaml", [*tool_task(path), "sim.start_rad_or_m=[-0.6, 1.6]"]
    )
    lock = Lockstep(config, CONFIGS)
    lock.run()
    record = lock.record.arrays()
    during = (record["truth_s"] > 0.6) & (record["truth_s"] < 2)
    tool = tool_at("arm2", record["truth_position"][during][::10])
    off = np.hypot(tool[:, 0] - 0.4, tool[:, 2] - 0.1) - 0.08
    assert np.abs(off).max() < 1e-3
    assert np.ptp(tool[:, 0]) > 0.1


@pytest.mark.parametrize(
    ("radius_m", "tool", "told"),
    [
        (0.4, "tool", r"circle\.csv: line \d+: tool does not get to .* mm away"),
        (0.08, "hand", "the model has no hand; it has"),
    ],
)
def test_mistakes(tmp_path: Path, radius_m: float, tool: str, told: str) -> None:
    path = circle(tmp_path / "circle.csv", radius_m)
    config = load_config(CONFIGS / "arm2.yaml", tool_task(path, tool))
    with pytest.raises(ValueError, match=told):
        task_reference(config, CONFIGS)
