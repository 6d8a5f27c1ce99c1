"""The headway command: exit codes, what it writes, what it prints, and that it cleans up."""

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from processes import ticks_in
from slower import slower

from headway.cli.main import main
from headway.cli.progress import Bar
from headway.controller import loop, program
from headway.controller._tick import Tick
from headway.controller.record.channels import CHANNELS
from headway.controller.record.reader import read_run
from headway.devices import core
from headway.sim.lockstep import Lockstep

ARM2 = Path(__file__).resolve().parent.parent / "configs" / "arm2.yaml"
COMMAND = Path(sys.executable).with_name("headway")
SHORT = ("--duration", "0.7")

# The arm sags below its range while the reference, at its edge, stays within.
SAGGING = (
    "--set=mpc.enabled=false",
    "--set=mpc.feedforward=none",
    "--set=task.axes.0.amplitude_rad=0",
    "--set=machine.axes.0.position_min_rad=0.78",
)


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every test starts there, and gets its signals back."""
    monkeypatch.chdir(tmp_path)
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGPIPE)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


def headway(*arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([COMMAND, *arguments], capture_output=True, text=True, timeout=100)


def summary_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    duration = () if "--duration" in arguments else SHORT
    code = main(["run", str(ARM2), *duration, "--json", *arguments])
    out = capsys.readouterr().out
    assert code in (0, 3)
    return json.loads(out)  # type: ignore[no-any-return]


# The summary's shape: numbers, lists by axis (2) and by state (4).
AXES, STATES = [float] * 2, [float] * 4
SHAPE: dict[str, Any] = {
    "config": str,
    "seed": int,
    "duration_s": float,
    "rate_hz": float,
    "margin_us": int,
    "axes": [str, str],
    "tracking": {"rms": AXES, "max": AXES, "unit": [str] * 2, "by": str},
    "estimate": {"rms_now": STATES, "rms_commit": STATES, "nis_mean": float},
    "torque": {
        "max_abs": AXES,
        "max_unclipped": AXES,
        "clipped_share": AXES,
        "limit": AXES,
        "noise_rms": AXES,
        "unit": [str] * 2,
    },
    "compute_us": {"p50": float, "p99": float, "p999": float, "max": float},
    "compute_split_us": {
        step: {"p50": float, "p99": float} for step in ("estimate", "prepare", "solve", "encode")
    },
    "solver": {
        "ticks": int,
        "accepted": int,
        "rejected": int,
        "refused_by_gate": {},
        "part_way": int,
        "iterations_p50": float,
    },
    "frames": {"sent": int, "lost": int, "late_points": int, "gate_refused": int},
    "deadline_misses": int,
    "at_rest_after_end": bool,
    "limits_violated": [],
    "log_sha256": str,
    "record": {"complete": bool, "batches_dropped": int, "messages": dict.fromkeys(CHANNELS, int)},
    "versions": dict.fromkeys(
        ("python", "headway", "mujoco", "casadi", "osqp", "numpy", "pin"), str
    ),
}


def shape_of(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: shape_of(inner) for key, inner in value.items()}
    return [shape_of(inner) for inner in value] if isinstance(value, list) else type(value)


def test_a_run_as_a_process() -> None:
    done = headway("run", str(ARM2), *SHORT, "--json", "--out", "kept")
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert shape_of(summary) == SHAPE
    assert sorted(p.name for p in Path().iterdir()) == ["kept"]
    names = ["config.yaml", "run.mcap", "summary.json"]
    assert sorted(p.name for p in Path("kept").iterdir()) == names
    assert json.loads(Path("kept/summary.json").read_text()) == summary
    recorded = read_run(Path("kept"))
    assert recorded.complete and recorded.log_sha256 == summary["log_sha256"]
    assert recorded.config_text == Path("kept/config.yaml").read_text()
    again = headway("run", "kept/config.yaml", "--json")
    assert json.loads(again.stdout)["log_sha256"] == summary["log_sha256"]
    assert len(list(Path("runs").iterdir())) == 1


def test_summary_is_plausible(capsys: pytest.CaptureFixture[str]) -> None:
    summary = summary_of(capsys, "--set=sim.to_device.loss=0.1")
    assert summary["duration_s"] == 0.7
    assert summary["rate_hz"] == 244.140625
    assert all(0 < rms < 20 for rms in summary["tracking"]["rms"])
    for rms, largest in zip(summary["tracking"]["rms"], summary["tracking"]["max"], strict=True):
        assert rms < largest
    now, commit = summary["estimate"]["rms_now"], summary["estimate"]["rms_commit"]
    assert all(0 < e < 2e-3 for e in now[:2])
    assert all(a < b for a, b in zip(now[:2], commit[:2], strict=True))
    solver, frames = summary["solver"], summary["frames"]
    assert solver["accepted"] + solver["rejected"] == solver["ticks"]
    assert frames["sent"] == 2 * solver["ticks"]
    assert 0.03 < frames["lost"] / frames["sent"] < 0.2
    assert summary["compute_us"]["p50"] <= summary["compute_us"]["max"]
    assert summary["at_rest_after_end"] is True


def test_without_mpc(capsys: pytest.CaptureFixture[str]) -> None:
    summary = summary_of(capsys, "--set=mpc.enabled=false")
    assert summary["solver"]["iterations_p50"] is None
    assert summary["solver"]["ticks"] > 100
    assert summary["compute_split_us"]["solve"] == {"p50": None, "p99": None}


def test_too_short_to_judge(capsys: pytest.CaptureFixture[str]) -> None:
    summary = summary_of(capsys, "--duration", "0.05")
    assert summary["tracking"]["rms"] == [None, None]
    assert summary["estimate"]["rms_commit"] == [None] * 4
    assert summary["torque"]["noise_rms"] == [None, None]


def test_seed_decides(capsys: pytest.CaptureFixture[str]) -> None:
    hashes = [summary_of(capsys, "--seed", seed)["log_sha256"] for seed in ("1", "1", "2")]
    assert hashes[0] == hashes[1] != hashes[2]


def test_table_and_default_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(ARM2), *SHORT]) == 0
    out = capsys.readouterr().out
    for text in ("arm2: 0.7 s at 244.1 Hz", "rms [mrad]", "q1", "q2", "0 deadlines missed"):
        assert text in out
    (folder,) = Path("runs").iterdir()
    assert re.fullmatch(r"arm2-\d{8}-\d{6}-\d{3}", folder.name)
    assert str(folder) in out


def test_out_takes_an_empty_folder() -> None:
    Path("out").mkdir()
    assert main(["run", str(ARM2), *SHORT, "--out", "out"]) == 0
    assert Path("out/summary.json").exists()


@pytest.mark.parametrize("kind", ["full", "file"])
def test_out_is_refused(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    if kind == "full":
        Path("out").mkdir()
        Path("out/mine").write_text("")
    else:
        Path("out").write_text("")
    before = sorted(Path().rglob("*"))
    assert main(["run", str(ARM2), *SHORT, "--out", "out"]) == 2
    assert "--out out: " in capsys.readouterr().err
    assert sorted(Path().rglob("*")) == before


def test_out_cannot_be_made(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(ARM2), *SHORT, "--out", "/proc/none/out"]) == 2
    assert "/proc/none/out: cannot be made" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "CONFIG"),
        (["{arm2}", "--durations", "3"], "--durations"),
        (["{arm2}", "--duration", "long"], "long"),
        (["{arm2}", "--duration", "-1"], "--set duration_s=-1.0: duration_s: "),
        (["{arm2}", "--duration", "nan"], "--set duration_s=nan: duration_s: "),
        (["{arm2}", "--seed", "-1"], "--set seed=-1: seed: "),
        (["none.yaml"], "none.yaml: cannot be read"),
        (["."], ".: cannot be read"),
        (["{arm2}", "--set", "loop.margin=3"], "loop.margin: unknown key"),
        (["{arm2}", "--set", "loop.margin_us"], "write key.path=value"),
        (["{arm2}", "--set", "machine.axes.0.joint=q7"], "no joint q7"),
        (["{arm2}", "--set", "machine.model=none.xml"], "machine.model: there is no file"),
        (["{arm2}", "--set", "machine.model=arm2.yaml"], "arm2.yaml: could not find decoder"),
        (["{arm2}", "--set", "task.axes=[]"], "task: a task of the kind sines needs axes"),
        (["{arm2}", "--set", "sim.plant.mass_scale.link9=2"], "no body link9"),
        (["{arm2}", "--set", "machine.axes.0.position_max_rad=500"], "position_max_rad is 500"),
        (["{arm2}", "--set", "mpc.horizon_us=1949696"], "points; a frame holds 128"),
    ],
)
def test_mistakes(arguments: list[str], message: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["run", *(a.format(arm2=ARM2) for a in arguments)]) == 2
    out, err = capfd.readouterr()
    assert message in err
    assert out == "" and "Traceback" not in err
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("knot_us:", "knots_us:", "3: loop.knots_us: unknown key; did you mean `knot_us`?"),
        ("gear: 30", "gear: [30]", "15: machine.axes.0.motor.gear: must be a number"),
        ("duration_s: 10", "name: arm2", "1: name: this key is given twice"),
    ],
)
def test_mistakes_in_the_file(
    old: str, new: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = ARM2.read_text()
    line = 1 + text[: text.index(old)].count("\n")
    Path("mine.yaml").write_text(text.replace(old, new))
    assert main(["run", "mine.yaml"]) == 2
    assert f"mine.yaml:{line}:{message}" in capsys.readouterr().err


def test_mistake_as_a_process() -> None:
    done = headway("run", "none.yaml", "--json")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"none.yaml: cannot be read: there is no such file in {Path.cwd()}\n"


def test_no_plan_passes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The machine has stood still all the time: that is not what was asked for."""
    monkeypatch.setattr("headway.controller.loop.Loop._passing", lambda *_: None)
    assert main(["run", str(ARM2), "--duration", "0.6"]) == 3
    assert "headway check" in capsys.readouterr().err


def test_what_the_gate_here_refuses_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the axis, the track and the check, in the record, the summary and the table."""
    monkeypatch.setattr(loop, "position_limits", slower(10))
    assert main(["run", str(ARM2), "--duration", "1.5", "--json", "--out", "out"]) in (0, 3)
    solver = json.loads(capsys.readouterr().out)["solver"]
    arrays = read_run(Path("out")).arrays
    counts, wanted = solver["refused_by_gate"], "q2: position, speed"
    rows = zip(*(arrays[f"refused_{row}"] for row in ("axis", "sink", "result")), strict=True)
    told = [tuple(row) for row in rows]
    assert next(iter(counts)) == wanted and sum(counts.values()) > 20
    assert told.count((1, 0, core.GATE_RESULTS.index("speed"))) == counts[wanted]
    assert len(told) == sum(counts.values())
    part_way = arrays["refused_share"] > 0
    assert 0 < solver["part_way"] == np.sum(part_way) < len(told)
    sent = np.isin(arrays["refused_us"], arrays["tick_us"][arrays["tick_accepted"]])
    assert np.array_equal(sent, part_way)
    assert main(["run", str(ARM2), "--duration", "1.5"]) in (0, 3)
    said = " ".join(capsys.readouterr().out.split())
    assert "refused by the gate here: q2: position, speed (" in said
    assert f"of {solver['part_way']} a part of the way was sent" in said


def test_limit_violated(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(ARM2), *SHORT, "--json", "--out", "out", *SAGGING]) == 3
    out, err = capsys.readouterr()
    (violation,) = json.loads(out)["limits_violated"]
    assert re.fullmatch(r"q1: position 0\.\d+ rad below 0\.78", violation)
    assert f"limit violated: {violation}" in err
    assert np.min(read_run(Path("out")).arrays["truth_position"][:, 0]) < 0.78


@pytest.mark.parametrize("way", ["to_device", "to_host"])
def test_dead_link(way: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(ARM2), *SHORT, "--out", "out", f"--set=sim.{way}.loss=1"]) == 4
    assert "no answer" in capsys.readouterr().err
    assert list(Path().iterdir()) == []


def test_unstable_plant(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--out", "out", "--set=sim.plant.motor_constant_scale=100"]
    assert main(["run", str(ARM2), *SHORT, *arguments]) == 2
    assert "motion is unstable" in capsys.readouterr().err
    assert not Path("out").exists()


def test_our_mistake(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def run(*_: object) -> None:
        raise ValueError("a broken\nthing")

    monkeypatch.setattr(Lockstep, "run", run)
    assert main(["run", str(ARM2)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("internal error: ValueError: a broken thing (traceback: runs/crash-")
    (crash,) = Path("runs").iterdir()
    assert "Traceback" in crash.read_text()


def hold_back(pid: int, number: int) -> list[bool]:
    """For each thread but the first: whether it never gets this signal."""
    threads = [path for path in Path(f"/proc/{pid}/task").iterdir() if path.name != str(pid)]
    masks = [re.search(r"^SigBlk:\t(\w+)$", (t / "status").read_text(), re.M) for t in threads]
    return [bool(int(mask[1], 16) >> number - 1 & 1) for mask in masks if mask]


def test_ctrl_c() -> None:
    command = [str(COMMAND), "run", str(ARM2), "--duration", "1000", "--json", "--out", "out"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        try:
            while ticks_in(Path("out")) <= 0:  # until the task is under way
                assert run.poll() is None
                time.sleep(0.1)
            others = hold_back(run.pid, signal.SIGINT)  # OSQP's handler would print in one of them
            assert others and all(others)
            run.send_signal(signal.SIGINT)
            out, err = run.communicate(timeout=120)
        finally:
            run.kill()
    assert run.returncode == 130, err
    assert "interrupted; the machine was brought to rest" in err
    summary = json.loads(out)
    assert summary == json.loads(Path("out/summary.json").read_text())
    assert summary["at_rest_after_end"] is True
    assert summary["solver"]["ticks"] > 0
    record = read_run(Path("out"))
    assert record.complete and record.messages["tick"] == summary["solver"]["ticks"]
    assert record.arrays["truth_s"][-1] > record.arrays["tick_s"][-1] + 1
    assert [p.name for p in Path().iterdir()] == ["out"]


def press_ctrl_c(times: int) -> Callable[[Bar, float], None]:
    """In place of Bar.update: presses once the task is well under way."""

    def update(_: Bar, done_s: float) -> None:
        if done_s > 0.3:
            for _press in range(times):
                os.kill(os.getpid(), signal.SIGINT)

    return update


def test_ctrl_c_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Bar, "update", press_ctrl_c(1))
    assert main(["run", str(ARM2), "--duration", "1000", "--out", "out"]) == 130
    assert json.loads(Path("out/summary.json").read_text())["at_rest_after_end"] is True


def test_ctrl_c_twice(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(Bar, "update", press_ctrl_c(2))
    assert main(["run", str(ARM2), "--duration", "1000", "--out", "out"]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "interrupted; nothing was written"
    assert list(Path().iterdir()) == []


def test_ctrl_c_that_osqp_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    class InterruptedAtLast:
        def __init__(self, *parts: Any) -> None:
            self._tick, self._solved = Tick(*parts), itertools.count()
            self.prepare = self._tick.prepare

        def feedback(self) -> Any:
            if next(self._solved) < 50:
                return self._tick.feedback()
            return SimpleNamespace(
                status=10, iterations=1, residual=0.0, stationarity=0.0, complementarity=0.0,
                accepted=False, solve_us=0,
            )  # fmt: skip

    monkeypatch.setattr(program, "Tick", InterruptedAtLast)
    assert main(["run", str(ARM2), "--duration", "1000", "--out", "out"]) == 130
    assert json.loads(Path("out/summary.json").read_text())["solver"]["ticks"] == 51


def test_progress_of_a_long_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("headway.cli.progress.PATIENCE_S", 0.0)
    assert main(["run", str(ARM2), *SHORT, "--json"]) == 0
    out, err = capsys.readouterr()
    json.loads(out)
    assert "of 0.7 s" in err and "left" in err


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["--help"], ["headway run configs/arm2.yaml", "Exit codes", "run "]),
        (["run", "--help"], ["headway run configs/arm2.yaml", "--duration", "--set", "KEY.PATH"]),
        (["--version"], ["0."]),
        ([], ["headway run configs/arm2.yaml"]),
    ],
)
def test_help(arguments: list[str], texts: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 0
    out, err = capsys.readouterr()
    assert err == ""
    for text in texts:
        assert text in out
