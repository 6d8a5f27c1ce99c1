"""models/arm2: its numbers, MuJoCo's own viewer as its README has it, and its picture."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from headway.configs.load import load_config

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "models" / "arm2"


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / "arm2.xml"))


def run_python(
    code: str, *arguments: str, **environment: str
) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code, *arguments],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_the_links_are_thin_rods_and_the_armature_is_the_rotors(model: mujoco.MjModel) -> None:
    config = load_config(ROOT / "configs" / "arm2.yaml")
    for axis, (name, rotor) in enumerate({"link1": 1.2e-5, "link2": 0.8e-5}.items()):
        body, motor = model.body(name).id, config.machine.axes[axis].motor
        mass, length = model.body_mass[body], 2 * model.body_ipos[body][0]
        assert (mass, length) == (1.0, 0.3)
        np.testing.assert_allclose(
            model.body_inertia[body], [0.0005, *[mass * length**2 / 12] * 2], rtol=1e-12
        )
        np.testing.assert_allclose(model.dof_armature[axis], motor.gear**2 * rotor, rtol=1e-12)
        np.testing.assert_allclose(
            model.actuator_user[axis, :5],
            [
                config.machine.axes[axis].counts_per_unit,
                motor.gear,
                motor.torque_constant_Nm_per_A,
                motor.resistance_ohm,
                motor.supply_V,
            ],
            rtol=1e-15,
        )
    np.testing.assert_array_equal(model.body("link2").pos, [0.3, 0, 0])


def test_positive_angles_lift(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    for q, tool in (((0, 0), (0.6, 0)), ((np.pi / 2, 0), (0, 0.6)), ((0, np.pi / 2), (0.3, 0.3))):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.site("tool").xpos[[0, 2]], tool, atol=1e-12)


def test_stepping_with_noise_gives_no_warning(model: mujoco.MjModel) -> None:
    data, rng = mujoco.MjData(model), np.random.default_rng(3)
    for _ in range(4000):
        data.qfrc_applied[:] = rng.normal(0, 40, 2)  # above the brakes' strength
        mujoco.mj_step(model, data)
    assert [int(w.number) for w in data.warning] == [0] * len(data.warning)
    assert np.all(np.isfinite(data.qpos)) and np.abs(data.qpos).max() > 1e-3


# The viewer's window needs a display; all that comes before it does not. The module runs as it is
# but for the window, which steps a hundred times once the model has been loaded, and then closes.
VIEWER = """
import contextlib, json, runpy, sys, threading
import glfw, mujoco
from mujoco import _simulate

class Window:
    def __init__(self, *arguments):
        self.loaded, self.exitrequest, self.load_error = threading.Event(), False, ""
        self.droploadrequest = self.uiloadrequest = self.run = self.busywait = 0
        self.model = None
    def load_message(self, path): pass
    def load_message_clear(self): self.loaded.set()
    def load(self, model, data, path):
        self.model, self.data, self.path = model, data, path
        self.loaded.set()
    def lock(self): return contextlib.nullcontext()
    def exit(self): self.exitrequest = True
    def destroy(self): pass
    def render_loop(self):
        self.loaded.wait(60)
        self.exit()
        if self.model is None:
            raise SystemExit(self.load_error)
        data = mujoco.MjData(self.model)
        for _ in range(100):
            mujoco.mj_step(self.model, data)
        print(json.dumps({"path": self.path, "time": data.time, "plugins": self.model.nplugin,
                          "warnings": [int(w.number) for w in data.warning]}))

_simulate.Simulate, glfw.init, glfw.terminate = Window, lambda: True, lambda: None
sys.argv = sys.argv[1:]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""


def documented_command() -> list[str]:
    text = (FOLDER / "README.md").read_text()
    found = re.findall(r"^    \.venv/bin/python (-m mujoco\.viewer .*)$", text, re.MULTILINE)
    assert len(found) == 1
    return str(found[0]).split()


def test_the_documented_command_opens_the_model_in_mujocos_viewer() -> None:
    option, module, *arguments = documented_command()
    assert option == "-m"
    done = run_python(VIEWER, module, *arguments)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    shown = json.loads(done.stdout)
    assert shown["path"] == "models/arm2/arm2.xml" and (ROOT / shown["path"]).exists()
    assert shown["plugins"] == 2
    assert shown["time"] == pytest.approx(100 * 0.00025)
    assert set(shown["warnings"]) == {0}


PICTURE = """
import sys
import numpy as np
import mujoco
try:
    from mujoco.egl import GLContext
    GLContext(16, 16).free()
except Exception as error:
    print(f"no EGL here: {error}")
    sys.exit(77)
model = mujoco.MjModel.from_xml_path("models/arm2/arm2.xml")
data = mujoco.MjData(model)
pictures = []
for q in ([0.7, 0.6], [0.7, -0.6]):
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 240, 320) as renderer:
        renderer.update_scene(data, camera="side")
        pictures.append(renderer.render().astype(int))
first, second = pictures
blue = (first[..., 2] > first[..., 0] + 40).mean()
orange = (first[..., 0] > first[..., 2] + 40).mean()
print(blue, orange, (np.abs(first - second).max(axis=2) > 40).mean())
"""


def test_a_picture_shows_both_links() -> None:
    done = run_python(PICTURE, MUJOCO_GL="egl")
    if done.returncode == 77:
        pytest.skip(done.stdout.strip())
    assert done.returncode == 0, done.stderr
    blue, orange, moved = map(float, done.stdout.split())
    # Shares of the picture: link 1, link 2, and what changes when link 2 turns.
    assert 0.001 < blue < 0.2 and 0.001 < orange < 0.2 and 0.002 < moved < 0.2
