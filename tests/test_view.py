"""`headway run --view`: a window on the machine that the run does not notice."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar

import mujoco.viewer
import numpy as np
import pytest

from headway.cli import run as command
from headway.cli import view
from headway.cli.failure import ExitCode, Failure
from headway.cli.main import main

ARM2 = Path(__file__).resolve().parents[1] / "configs" / "arm2.yaml"
COMMAND = Path(sys.executable).with_name("headway")
ARGUMENTS = ["run", str(ARM2), "--duration", "0.7", "--json"]


class Window:
    """What MuJoCo's viewer would give, with someone in front of it who pulls at everything."""

    open: ClassVar[list["Window"]] = []

    def __init__(self, model: Any, data: Any, **_: bool) -> None:
        self.model, self.data = model, data
        self.seen: list[np.ndarray] = []
        self.closed_after = 10**9
        self.is_closed = False
        Window.open.append(self)

    def lock(self) -> "Window":
        return self

    def __enter__(self) -> None:
        pass

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        pass

    def is_running(self) -> bool:
        return len(self.seen) < self.closed_after

    def sync(self) -> None:
        self.seen.append(self.data.qpos.copy())
        self.data.qpos[:] = 1
        self.data.qvel[:] = 100
        self.data.xfrc_applied[:] = 1000
        self.model.opt.gravity[:] = 0
        self.model.body_mass[:] *= 2

    def close(self) -> None:
        self.is_closed = True


class Clock:
    """Real time, in which only sleeping takes any."""

    def __init__(self) -> None:
        self.now_s, self.slept_s = 1000.0, list[float]()

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        assert duration_s > 0
        self.slept_s.append(duration_s)
        self.now_s += duration_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Clock:
    """A display, with a viewer of ours, and a clock of ours."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "check_display", lambda: None)
    monkeypatch.setattr(mujoco.viewer, "launch_passive", Window)
    Window.open.clear()
    clock = Clock()
    monkeypatch.setattr(view, "time", clock)
    return clock


def summary(capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, Any]:
    assert main([*ARGUMENTS, *options]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_the_run_is_the_same(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    plain, watched = summary(capsys), summary(capsys, "--view")
    assert watched["log_sha256"] == plain["log_sha256"]
    (window,) = Window.open
    assert window.is_closed
    assert len(window.seen) > 25  # of 42 in 0.7 s
    assert np.ptp(window.seen, axis=0).min() > 0.2  # the machine moves in it


def test_it_takes_as_long_as_the_task(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    summary(capsys, "--view")
    assert sum(clock.slept_s) == pytest.approx(0.7, abs=0.03)


def test_lost_time_is_not_made_up_for(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    plant = type("Plant", (), {})()
    plant.model = mujoco.MjModel.from_xml_string("<mujoco/>")
    plant.data = mujoco.MjData(plant.model)
    with view.View(plant) as window:
        window.show(0.1)
        clock.now_s += 5  # something took long
        window.show(0.2)
        before_s = clock.now_s
        window.show(0.3)
    assert clock.now_s - before_s == pytest.approx(0.1)


def test_a_closed_window_holds_nothing_up(
    clock: Clock, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Window, "is_running", lambda window: len(window.seen) < 5)
    assert summary(capsys, "--view")["solver"]["ticks"] > 100
    assert sum(clock.slept_s) < 0.2


def test_without_a_display(tmp_path: Path) -> None:
    plain = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    done = subprocess.run(
        [COMMAND, *ARGUMENTS, "--view"],
        cwd=tmp_path,
        env=plain,
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1 and "there is no display" in done.stderr
    assert "headway report" in done.stderr
    assert not list(tmp_path.iterdir())


def test_without_glfw(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "glfw", None)
    with pytest.raises(Failure) as caught:
        view.check_display()
    assert caught.value.code is ExitCode.USAGE
