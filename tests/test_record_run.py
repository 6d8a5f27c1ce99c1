"""The record that `headway run` leaves: equal to the summary, and there when the run is not."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from processes import ticks_in

from headway.cli.main import main
from headway.cli.progress import Bar
from headway.cli.summary import summarize
from headway.configs.load import load_config
from headway.controller.record import recording as recording_module
from headway.controller.record.reader import MAGIC, read_run
from headway.controller.record.recording import Recording
from headway.sim.lockstep import Lockstep

ARM2 = Path(__file__).resolve().parent.parent / "configs" / "arm2.yaml"
COMMAND = Path(sys.executable).with_name("headway")


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every test starts there, and gets its signals back."""
    monkeypatch.chdir(tmp_path)
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGPIPE)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


def test_the_summary_is_in_the_record(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--duration", "0.8", "--set", "sim.to_device.loss=0.1", "--json"]
    assert main(["run", str(ARM2), *options, "--out", "out"]) == 0
    summary, run = json.loads(capsys.readouterr().out), read_run(Path("out"))
    arrays = run.arrays
    assert summary["record"] == {"complete": True, "batches_dropped": 0, "messages": run.messages}
    assert summary["log_sha256"] == run.log_sha256
    assert summary["seed"] == run.seed and summary["versions"] == run.versions
    assert run.config() == load_config(Path("out/config.yaml"))
    ticks = summary["solver"]["ticks"]
    assert run.messages["tick"] == run.messages["now"] == run.messages["timing"] == ticks
    assert arrays["end_ticks"] == ticks
    task = arrays["sent_us"] > arrays["tick_us"][0]
    assert summary["frames"]["sent"] == arrays["end_frames_sent"] == task.sum()
    assert summary["frames"]["lost"] == arrays["end_frames_lost"] > 0
    assert summary["deadline_misses"] == arrays["end_deadline_misses"]
    assert summary["compute_us"]["max"] == arrays["timing_compute_us"].max()
    # The same in memory: the same summary, but for what was measured by the wall clock.
    lockstep = Lockstep(run.config(), Path())
    lockstep.run()
    again = summarize(lockstep.config, lockstep, lockstep.record.arrays())
    measured = {"compute_us", "compute_split_us", "record"}
    assert {k: v for k, v in again.items() if k not in measured} == {
        k: v for k, v in summary.items() if k not in measured
    }


def wait_until(condition: Callable[[], bool], process: "subprocess.Popen[bytes] | None") -> None:
    """Looks again and again; a test that waits in vain ends by its process' limit."""
    while not condition():
        assert process is None or process.poll() is None
        time.sleep(0.01)


def test_a_killed_run_leaves_its_record() -> None:
    command = [str(COMMAND), "run", str(ARM2), "--duration", "1000", "--out", "out"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    folder = Path("out")
    wait_until(lambda: ticks_in(folder) > 100, process)
    seen = read_run(folder)
    assert not seen.complete
    process.send_signal(signal.SIGKILL)
    process.communicate()
    path = folder / "run.mcap"
    wait_until(lambda: path.read_bytes()[8:].endswith(MAGIC), None)  # the writer ends it
    run = read_run(folder)
    assert not run.complete and run.batches_dropped == 0
    assert run.messages["tick"] >= seen.messages["tick"] > 100
    for key in ("truth_position", "received_packet", "now_covariance"):
        np.testing.assert_array_equal(run.arrays[key][: len(seen.arrays[key])], seen.arrays[key])
    with path.open("rb") as stream:
        topics = [c.topic for _, c, _ in make_reader(stream, validate_crcs=True).iter_messages()]
    assert topics.count("tick") == run.messages["tick"]
    assert sorted(p.name for p in folder.iterdir()) == ["config.yaml", "run.mcap"]
    assert run.config() == load_config(folder / "config.yaml")


def kill_the_writer(monkeypatch: pytest.MonkeyPatch, at_s: float, ticks: int) -> None:
    """Once the task is so far, and so many ticks are in the file."""
    started, start = [], Recording.__init__

    def started_too(self: Recording, *arguments: Any) -> None:
        start(self, *arguments)
        started.append(self._process)

    def update(_: Bar, done_s: float) -> None:
        (writer,) = started
        if done_s > at_s and writer.poll() is None:
            wait_until(lambda: ticks_in(Path("out")) >= ticks, writer)
            writer.kill()
            writer.wait()

    monkeypatch.setattr(Recording, "__init__", started_too)
    monkeypatch.setattr(Bar, "update", update)


def test_a_killed_writer_does_not_stop_the_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kill_the_writer(monkeypatch, at_s=0.5, ticks=1)
    monkeypatch.setattr(recording_module, "CAPACITY_BYTES", 100_000)
    monkeypatch.setattr(recording_module, "QUEUE_BATCHES", 100)
    assert main(["run", str(ARM2), "--duration", "2.5", "--json", "--out", "out"]) == 5
    out, err = capsys.readouterr()
    summary = json.loads(out)
    assert not summary["record"]["complete"]
    assert summary["solver"]["ticks"] > 600  # the run went on
    assert 0 < summary["record"]["messages"]["tick"] < 600
    assert err.splitlines()[-1] == (
        "the record is incomplete, and so is the summary: its writer was ended by SIGKILL"
    )
    run = read_run(Path("out"))
    assert run.messages == summary["record"]["messages"] and not run.complete


@pytest.mark.parametrize("channel", ["now", "commit", "truth", "servo", "solver", "timing"])
def test_a_writer_that_was_killed_within_a_tick(channel: str) -> None:
    """What it lacks of the last one costs that row alone."""
    config = load_config(ARM2, ["duration_s=0.7"])
    lockstep = Lockstep(config, ARM2.parent)
    lockstep.run()
    arrays = lockstep.record.arrays()
    whole = summarize(config, lockstep, arrays)
    cut = {
        name: rows[:-1] if name.startswith(f"{channel}_") else rows for name, rows in arrays.items()
    }
    told = summarize(config, lockstep, cut)
    for name in ("rms_now", "rms_commit"):
        np.testing.assert_allclose(told["estimate"][name], whole["estimate"][name], rtol=0.2)
    for name in ("max_abs", "noise_rms"):
        np.testing.assert_allclose(told["torque"][name], whole["torque"][name], rtol=0.2)


def test_a_writer_that_wrote_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kill_the_writer(monkeypatch, at_s=-1, ticks=0)
    assert main(["run", str(ARM2), "--duration", "0.5", "--out", "out"]) == 5
    out, err = capsys.readouterr()
    assert out == ""
    assert err.endswith(
        "run.mcap: nothing of the task was recorded: its writer was ended by SIGKILL\n"
    )


def test_a_device_that_fails_leaves_the_record(capsys: pytest.CaptureFixture[str]) -> None:
    stall = ["--set=sim.stall_host_at_s=0.4", "--set=sim.stall_host_s=0.5"]
    assert main(["run", str(ARM2), "--duration", "2", "--out", "out", *stall]) == 4
    told, reason = capsys.readouterr().err.splitlines()
    assert "out" in told and "came to rest" in reason
    assert sorted(p.name for p in Path("out").iterdir()) == ["config.yaml", "run.mcap"]
    run = read_run(Path("out"))
    assert not run.complete and run.messages["tick"] > 50 and run.messages["end"] == 1
    assert 7 in run.arrays["received_state"][-2:]  # HOLD: what the loop failed at is there


def test_no_folder_of_a_run_that_never_began() -> None:
    Path("empty").mkdir()
    for out in ("empty", "a/b/c"):
        assert main(["run", str(ARM2), "--out", out, "--set=machine.model=none.xml"]) == 2
    assert [p.name for p in Path().iterdir()] == ["empty"]
    assert list(Path("empty").iterdir()) == []


def test_an_interrupted_run_is_complete(monkeypatch: pytest.MonkeyPatch) -> None:
    def update(_: Bar, done_s: float) -> None:
        if done_s > 0.3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Bar, "update", update)
    assert main(["run", str(ARM2), "--duration", "1000", "--out", "out"]) == 130
    run = read_run(Path("out"))
    assert run.complete and run.arrays["end_states"].tolist() == [[7, 7]]
