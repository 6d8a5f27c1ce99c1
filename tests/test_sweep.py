"""`headway sweep`: which runs, what comes of them, and what is kept when something goes wrong."""

import contextlib
import itertools
import json
import multiprocessing
import os
import shlex
import signal
import statistics
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pyarrow.parquet
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headway.cli import pool, sweep_report
from headway.cli.flat import flatten
from headway.cli.main import main
from headway.cli.progress import Bar
from headway.cli.vary import combinations, parse_varied, split_values
from headway.configs.load import ConfigError

CART = Path(__file__).resolve().parent / "cart" / "cart.yaml"
ARM2 = Path(__file__).resolve().parent.parent / "configs" / "arm2.yaml"
SHORT = ("--duration", "0.1", "--set=sim.to_host.loss=0")
LOSS, MARGIN, STALL = "sim.to_device.loss", "loop.margin_us", "sim.stall_host_s"


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every test starts there, and gets its signals back."""
    monkeypatch.chdir(tmp_path)
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGPIPE)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


@pytest.fixture
def in_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs happen in this process, in an executor that is not ours: any executor will do."""

    @contextlib.contextmanager
    def processes(count: int) -> Iterator[Executor]:
        with ThreadPoolExecutor(1) as executor:
            yield executor

    monkeypatch.setattr("headway.cli.pool.processes", processes)


def sweep(*arguments: str) -> int:
    out = () if any(text.startswith("--out") for text in arguments) else ("--out=out",)
    return main(["sweep", str(CART), *SHORT, *out, *arguments])


def rows(folder: str = "out") -> list[dict[str, Any]]:
    return pyarrow.parquet.read_table(Path(folder) / "sweep.parquet").to_pylist()  # type: ignore[no-any-return]


# --- which runs --------------------------------------------------------------------------------

scalars = st.sampled_from(["1", "-2.5e3", "true", "null", "a", "'it, is'", '"a, [b"', "x y"])
values = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=3).map(lambda parts: f"[{', '.join(parts)}]")
        | st.lists(inner, max_size=3).map(
            lambda parts: f"{{{', '.join(f'k{i}: {part}' for i, part in enumerate(parts))}}}"
        )
    ),
    max_leaves=6,
)


@given(st.lists(values, min_size=1, max_size=5), st.sampled_from([",", " , ", ", "]))
def test_values_come_apart_where_they_were_joined(texts: list[str], comma: str) -> None:
    assert split_values(comma.join(texts)) == texts


def test_every_combination_in_order() -> None:
    varied = parse_varied([f"{LOSS}=0,0.5", "sim.start_rad_or_m=[0,0],[0.1, 0.2]"], [])
    found = combinations(CART, ["duration_s=1"], varied)
    starts = ["[0,0]", "[0.1, 0.2]"]
    assert [list(c.values.values()) for c in found] == [
        list(pair) for pair in itertools.product(["0", "0.5"], starts)
    ]
    last = found[-1]
    assert last.config.sim.to_device.loss == 0.5
    assert last.config.sim.start_rad_or_m == [0.1, 0.2]
    assert last.config.duration_s == 1
    assert (last.typed(LOSS), last.typed("sim.start_rad_or_m")) == (0.5, "[0.1, 0.2]")
    (all_as_it_is,) = combinations(CART, [], [])
    assert all_as_it_is.values == {}


@pytest.mark.parametrize(
    ("varied", "lines"),
    [
        (
            [f"{LOSS}=0,2,x", f"{MARGIN}=8192,1", "sim.nothing=1"],
            [
                f"--vary {LOSS}=2: {LOSS}: ",
                f"--vary {LOSS}=x: {LOSS}: ",
                f"--vary {MARGIN}=1: {MARGIN}: ",
                "--vary sim.nothing=1: sim.nothing: unknown key",
            ],
        ),
        (
            ["a", "b=", "c=1,,2", "=1", "seed=1,2", f"{LOSS}=0", f"{LOSS}=1"],
            [
                "--vary a: write key.path=value,value",
                "--vary b=: write",
                "--vary c=1,,2: write",
                "--vary =1: write",
                "--vary seed=1,2: seeds are varied anyway",
                f"--vary {LOSS}=1: {LOSS} is varied already",
            ],
        ),
        (
            [f"{LOSS}=0.5,5e-1", f"{MARGIN}=8192"],
            [f"--vary: {LOSS}=5e-1 {MARGIN}=8192 is the same as {LOSS}=0.5 {MARGIN}=8192"],
        ),
        (["mpc.horizon_us=212992,[1,2"], ["--vary mpc.horizon_us=[1,2: "]),
        (
            ["duration_s=1,2", "sim.to_host.loss=0,1"],
            [
                "--vary duration_s=1,2: duration_s is set for all runs",
                "--vary sim.to_host.loss=0,1: sim.to_host.loss is set for all runs",
            ],
        ),
    ],
)
def test_all_mistakes_before_any_run(
    varied: list[str], lines: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert sweep(*(f"--vary={text}" for text in varied)) == 2
    out, err = capsys.readouterr()
    said = err.splitlines()
    assert (out, len(said)) == ("", len(lines)), err
    for text, beginning in zip(said, lines, strict=True):
        assert text.startswith(beginning)
    assert list(Path().iterdir()) == []


def test_mistakes_of_the_file_and_of_set_are_told_once() -> None:
    Path("cart.yaml").write_text(CART.read_text().replace("frequency_Hz: 0.5", "frequency_Hz: -1"))
    with pytest.raises(ConfigError) as error:
        combinations(Path("cart.yaml"), ["mpc.x=1"], parse_varied([f"{LOSS}=0,2,3"], []))
    texts = [str(mistake) for mistake in error.value.mistakes]
    assert len(texts) == 5
    assert [text.startswith(("--set mpc.x=1:", f"--vary {LOSS}=")) for text in texts] == (
        [False, False, True, True, True]
    )


@pytest.mark.parametrize("option", ["--seeds=0", "--jobs=0", "--seeds=x", "--set=seed=3"])
def test_options_that_make_no_sense(option: str) -> None:
    assert sweep(option) == 2
    assert list(Path().iterdir()) == []


def test_a_model_that_does_not_fit(capsys: pytest.CaptureFixture[str]) -> None:
    assert sweep("--set=machine.axes.0.joint=nobody") == 2
    err = capsys.readouterr().err
    assert "nobody" in err and "Traceback" not in err
    assert list(Path().iterdir()) == []


def test_pyarrow_is_asked_for_first(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("headway.cli.sweep.importlib.util.find_spec", lambda name: None)
    assert sweep() == 2
    assert "pip install pyarrow" in capsys.readouterr().err
    assert list(Path().iterdir()) == []


def test_an_out_folder_that_is_in_use(capsys: pytest.CaptureFixture[str]) -> None:
    Path("out").mkdir()
    Path("out/mine").touch()
    assert sweep() == 2
    assert "not empty" in capsys.readouterr().err


# --- what comes of them ------------------------------------------------------------------------


def test_one_process_or_two(capsys: pytest.CaptureFixture[str]) -> None:
    """The same rows in the same order, but for the wall clock's; and failed runs are rows."""
    stall = ("--set=sim.stall_host_at_s=0.1", f"--vary={STALL}=0.01,0.4")  # longer than a plan
    options = ("sweep", str(CART), *stall, "--seeds=2", "--duration=0.55")
    for jobs in ("1", "2"):
        assert main([*options, "--jobs", jobs, "--out", jobs]) == 4
    out, err = capsys.readouterr()
    assert "4 runs, 2 at a time" in err
    one, two = (
        [{k: v for k, v in row.items() if not k.startswith("compute_")} for row in rows(folder)]
        for folder in ("1", "2")
    )
    assert one == two
    order = [(row[f"vary.{STALL}"], row["seed"]) for row in one]
    assert order == [(0.01, 0), (0.01, 1), (0.4, 0), (0.4, 1)]
    assert all(row["tracking.rms.x"] > 0 and row["error"] == "" for row in one[:2])
    assert one[0]["log_sha256"] != one[1]["log_sha256"]
    assert all("came to rest" in row["error"] and row["log_sha256"] is None for row in one[2:])
    assert "    2 of 2 seeds failed; this: " in out

    # The command beside a row gives that row; and the printed one is that of the worst seed.
    row = one[1]
    assert main([*shlex.split(row["replay"])[1:], "--json", "--out", "again"]) == 0
    again = flatten(json.loads(capsys.readouterr().out))
    known = {key: value for key, value in again.items() if not key.startswith("compute_")}
    assert {key: row[key] for key in known} == known
    report = json.loads(Path("1/sweep.json").read_text())
    assert [c["values"] for c in report["combinations"]] == [[0.01], [0.4]]
    for combination in report["combinations"]:
        assert f"  {combination['replay']}\n" in out


@pytest.mark.usefixtures("in_threads")
def test_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    assert sweep("--seeds=1", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads(Path("out/sweep.json").read_text())
    # The arm sags below its range while the reference, at its edge, stays within.
    sagging = (
        "--set=mpc.enabled=false",
        "--set=mpc.feedforward=none",
        "--set=task.axes.0.amplitude_rad=0",
        "--vary=machine.axes.0.position_min_rad=0,0.78",
    )
    assert main(["sweep", str(ARM2), *SHORT, *sagging, "--seeds=1", "--out=sags"]) == 3
    assert "1 of 1 seeds went beyond a limit" in capsys.readouterr().out
    assert [bool(row["limits_violated"]) for row in rows("sags")] == [False, True]
    big = "--vary=machine.axes.0.servo.kp_N_per_m=12000,1e11"
    assert sweep("--seeds=1", big, "--out=big") == 4
    assert "range" in rows("big")[1]["error"]


@pytest.mark.usefixtures("in_threads")
def test_a_mistake_of_ours_is_a_row(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(argument: Any) -> Any:
        raise KeyError("oh")

    monkeypatch.setattr("headway.cli.sweep.simulate", broken)
    assert sweep("--seeds=2") == 1
    assert [row["error"] for row in rows()] == ["internal error: KeyError('oh')"] * 2
    assert "2 of 2 seeds failed" in capsys.readouterr().out


def test_the_model_is_compiled_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """For each shape of the problem; and gains are no part of it."""
    command = [Path(sys.executable).with_name("headway"), "sweep", CART, *SHORT, "--seeds=2"]
    gains = "--vary=machine.axes.0.servo.kp_N_per_m=12000,13000"
    done = subprocess.run(
        [*command, gains, "--jobs=2"],
        env={**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")},
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("compiling machine") == 1
    (folder,) = Path("runs").iterdir()
    assert folder.name.startswith("cart-sweep-")
    assert f"written to runs/{folder.name}\n" in done.stdout


def press_ctrl_c(monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    """As soon as so many runs are done."""
    update = Bar.update

    def pressed(bar: Bar, done: float) -> None:
        update(bar, done)
        if done == after:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Bar, "update", pressed)


def test_ctrl_c_keeps_what_is_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    press_ctrl_c(monkeypatch, after=2)
    assert sweep("--seeds=500", "--jobs=2") == 130
    out, err = capsys.readouterr()
    done = rows()
    assert 2 <= len(done) < 10
    assert f"interrupted: {len(done)} of 500 runs are in out\n" in err
    assert "The worst seeds again:" in out
    assert [row["seed"] for row in done] == sorted(row["seed"] for row in done)
    assert multiprocessing.active_children() == []


def test_ctrl_c_before_anything_is_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    press_ctrl_c(monkeypatch, after=0)
    assert sweep("--seeds=500", "--jobs=2") == 130
    assert capsys.readouterr().err.splitlines()[-1] == "interrupted; nothing was written"
    assert list(Path().iterdir()) == []
    assert multiprocessing.active_children() == []


# --- the processes -----------------------------------------------------------------------------


def test_each_gives_all_that_comes_of_it() -> None:
    with ThreadPoolExecutor(3) as executor:
        outcomes = dict(pool.each(executor, float, ["1", "x", "3"]))
    assert {i: outcome.result() for i, outcome in outcomes.items() if i != 1} == {0: 1.0, 2: 3.0}
    assert isinstance(outcomes[1].exception(), ValueError)


def test_a_process_that_dies_ends_nothing_else() -> None:
    Path("script.py").write_text("""
import os
from headway.cli.pool import each, processes

if __name__ == "__main__":
    with processes(1) as executor:
        ((_, outcome),) = each(executor, os._exit, [1])
    print(type(outcome.exception()).__name__)
""")
    done = subprocess.run([sys.executable, "script.py"], capture_output=True, timeout=300)
    assert (done.returncode, done.stdout) == (0, b"BrokenProcessPool\n")


def test_no_process_outlives_a_killed_parent() -> None:
    """They would hold on to standard error: it has its end when the last of them is gone."""
    Path("script.py").write_text("""
import os, signal
from headway.cli.pool import processes

if __name__ == "__main__":
    with processes(2) as executor:
        executor.submit(signal.pause)
        executor.submit(os.getpid).result()
        os.kill(os.getpid(), signal.SIGKILL)
""")
    done = subprocess.run([sys.executable, "script.py"], capture_output=True, timeout=300)
    assert done.returncode == -signal.SIGKILL


# --- the figures -------------------------------------------------------------------------------

runs = st.lists(
    st.none() | st.tuples(*[st.floats(0.1, 10)] * 2, st.integers(0, 3)), min_size=1, max_size=6
)


@given(groups=st.lists(runs, min_size=1, max_size=3))
def test_medians_totals_and_the_worst(groups: list[list[tuple[float, float, int] | None]]) -> None:
    """A run is None if it failed, else (rms of x, rms of y, late plans)."""
    made = []
    for value, group in enumerate(groups):
        for seed, run in enumerate(group):
            row = {"vary.a.b": value, "seed": seed, "error": "" if run else "oh", "replay": "..."}
            if run:
                row |= {"tracking.rms.x": run[0], "tracking.rms.y": run[1]}
                row |= {"frames.late_points": run[2], "frames.gate_refused": 1}
                row |= {"deadline_misses": 0, "limits_violated": "", "at_rest_after_end": True}
            made.append(row)
    report = sweep_report.sweep_report(["x", "y"], ["a.b"], made)
    assert [c["values"] for c in report["combinations"]] == [[i] for i in range(len(groups))]
    for combination, group in zip(report["combinations"], groups, strict=True):
        done = [run for run in group if run]
        assert (combination["seeds"], combination["failed"]) == (
            len(group),
            len(group) - len(done),
        )
        assert combination["total"] == {
            "late": sum(run[2] for run in done),
            "refused": len(done),
            "missed": 0,
        }
        if len(done) < len(group):
            assert combination["worst_seed"] == group.index(None)
        if not done:
            assert combination["median"] == {}
            continue
        medians = [statistics.median(run[i] for run in done) for i in (0, 1)]
        assert combination["median"]["tracking.rms.x"] == medians[0]
        assert combination["median"]["tracking.rms.y"] == medians[1]
        assert "seed" not in combination["median"] and "vary.a.b" not in combination["median"]
        if len(done) == len(group):
            badness = [max(run[0] / medians[0], run[1] / medians[1]) for run in done]
            assert badness[combination["worst_seed"]] == max(badness)


def test_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is cut, however narrow the terminal; names are as short as they can be."""
    row = {
        "vary.sim.to_device.loss": 0.125, "vary.sim.to_host.loss": 1000000.0,
        "seed": 4, "error": "", "replay": "headway run it", "limits_violated": "",
        "tracking.unit.x": "mm", "tracking.unit.turn": "mrad",
        "torque.unit.x": "N", "torque.unit.turn": "Nm",
        "tracking.rms.x": 0.123456, "tracking.rms.turn": 12.3456,
        "tracking.max.x": None, "tracking.max.turn": 99.9,
        "torque.noise_rms.x": 1.0, "torque.noise_rms.turn": 0.5,
        "torque.clipped_share.x": 0.0, "torque.clipped_share.turn": 0.0123,
        "frames.late_points": 7, "frames.gate_refused": 8, "deadline_misses": 9,
        "compute_us.p99": 12345.6,
    }  # fmt: skip
    varied = ["sim.to_device.loss", "sim.to_host.loss"]
    sweep_report.print_sweep(sweep_report.sweep_report(["x", "turn"], varied, [row]))
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == "rms [mm, mrad] max [mm, mrad] noise [N, Nm] clipped [%] p99 worst"
    assert lines[1].startswith("to_device.loss to_host.loss x turn x turn x turn x turn late refus")
    assert lines[2] == "0.125 1000000 0.123 12.3 - 99.9 1 0.5 0 1.23 7 8 9 12346 4"
    assert lines[-1] == "headway run it"


def test_columns_of_any_kind(tmp_path: Path) -> None:
    """Numbers stay numbers, what is mixed becomes text, and what nobody knows is empty."""
    table = [
        {"a": 1, "b": None, "c": 0.5, "d": True},
        {"a": 2.5, "b": None, "c": "[1, 2]", "d": None, "e": "x"},
    ]
    sweep_report.write_parquet(table, tmp_path / "t")
    assert pyarrow.parquet.read_table(tmp_path / "t").to_pylist() == [
        {"a": 1.0, "b": None, "c": "0.5", "d": True, "e": None},
        {"a": 2.5, "b": None, "c": "[1, 2]", "d": None, "e": "x"},
    ]


def test_flat_names() -> None:
    summary = {
        "axes": ["x", "turn"],
        "seed": 3,
        "tracking": {"rms": [1.0, None], "unit": ["mm", "mrad"]},
        "estimate": {"rms_now": [1, 2, 3, 4]},
        "limits_violated": ["x: too far", "turn: too fast"],
    }
    assert flatten(summary) == {
        "seed": 3,
        "tracking.rms.x": 1.0,
        "tracking.rms.turn": None,
        "tracking.unit.x": "mm",
        "tracking.unit.turn": "mrad",
        "estimate.rms_now.position.x": 1,
        "estimate.rms_now.position.turn": 2,
        "estimate.rms_now.velocity.x": 3,
        "estimate.rms_now.velocity.turn": 4,
        "limits_violated": "x: too far; turn: too fast",
    }
