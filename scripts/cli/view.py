"""The simulated machine in MuJoCo's own viewer while it runs."""

from __future__ import annotations

import copy
import time
import warnings
from typing import TYPE_CHECKING

from headway.cli.failure import ExitCode, Failure

if TYPE_CHECKING:
    from headway.sim.plant import Plant

FRAME_S = 1 / 60


def check_display() -> None:
    """Raises Failure if no window can be opened: the viewer itself would wait for ever."""
    try:
        import glfw

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns of what it returns
            there = bool(glfw.init())
    except (ImportError, RuntimeError):
        there = False
    if not there:
        raise Failure(
            ExitCode.USAGE,
            "--view: there is no display to open a window on: run without it, and look at the run "
            "afterwards with `headway report RUN`",
        )


class View:
    """A window on a plant, at most at real time. The plant does not notice: the window has a model
    and a state of its own, so nothing that is done in it reaches the run."""

    def __init__(self, plant: Plant) -> None:
        """Opens the window; there must be a display."""
        import mujoco
        import mujoco.viewer

        self._plant = plant
        self._model = copy.copy(plant.model)
        self._data = mujoco.MjData(self._model)
        self._copy_pose()
        self._window = mujoco.viewer.launch_passive(
            self._model, self._data, show_left_ui=False, show_right_ui=False
        )
        self._shown_s = -FRAME_S
        self._began_s = time.monotonic()  # when the task's second 0 is shown

    def __enter__(self) -> View:
        return self

    def __exit__(self, *_: object) -> None:
        self._window.close()

    def show(self, done_s: float) -> None:
        """Shows the plant at this time of the task, not before that much has passed."""
        if done_s - self._shown_s < FRAME_S or not self._window.is_running():
            return
        self._shown_s = done_s
        early_s = self._began_s + done_s - time.monotonic()
        if early_s > 0:
            time.sleep(early_s)
        else:
            self._began_s -= early_s  # it does not make up for lost time
        with self._window.lock():
            self._copy_pose()
        self._window.sync()

    def _copy_pose(self) -> None:
        import mujoco

        self._data.qpos[:] = self._plant.data.qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
