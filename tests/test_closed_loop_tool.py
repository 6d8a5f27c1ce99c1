"""The fixture `closed_loop`: what it asserts, what it keeps of a failing test, what it costs."""

import dataclasses
import itertools
import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from headway.cli.closed_loop import CACHED_MAX, ClosedLoop, ClosedLoopRun
from headway.cli.judge import beyond_limits, by_axis
from headway.cli.main import main
from headway.cli.pytest_plugin import Bench
from headway.cli.simulation import changes_of, replay_command
from headway.configs.load import ConfigError, load_config
from headway.controller.record.reader import read_run
from headway.controller.tick import DeviceError
from headway.devices.axis import AxisUnits

pytest_plugins = ["pytester"]

CART = Path(__file__).resolve().parent / "cart"
ARM2 = Path(__file__).resolve().parent.parent / "configs" / "arm2.yaml"
CONFIG = load_config(CART / "cart.yaml")

HEAD = f"""
import pytest

CART = {str(CART / "cart.yaml")!r}
"""


@pytest.fixture
def cart(closed_loop: ClosedLoop) -> ClosedLoopRun:
    """0.7 s of a slide that carries a hinge, with nothing to complain about."""
    return closed_loop("cart/cart.yaml", {"sim.to_device.loss": 0})


def failing(pytester: pytest.Pytester, tests: str, *arguments: str) -> pytest.RunResult:
    pytester.makepyfile(HEAD + tests)
    return pytester.runpytest_inprocess(*arguments)


# --- assertions, each where it passes and where it fails ---------------------------------------


def test_a_good_run_passes_all(cart: ClosedLoopRun) -> None:
    cart.assert_within_limits()
    cart.assert_within_limits(margin=0.1)
    cart.assert_tracks(rms_below_mrad=2, max_below_mrad=5, rms_below_mm=3, max_below_mm={"x": 4})
    cart.assert_estimates(rms_below_counts={"x": 4, "turn": 4})
    cart.assert_comes_to_rest()
    cart.assert_comes_to_rest(within_s=0.5)
    cart.assert_no_deadline_missed()
    cart.assert_no_plan_refused()
    assert cart.summary["limits_violated"] == []
    assert cart.summary["at_rest_after_end"] is True


AGAIN = r"\nagain: headway run \S*cart\.yaml --seed 0 --set sim\.to_device\.loss=0$"


def test_tracks_worse_than_asked(cart: ClosedLoopRun) -> None:
    rms, largest = cart.summary["tracking"]["rms"], cart.summary["tracking"]["max"]
    time_s, error = cart.arrays["truth_s"], 1e3 * np.abs(
        cart.arrays["truth_position"] - cart.arrays["truth_reference"]
    )  # fmt: skip
    judged = (time_s >= 0.5) & (time_s <= cart.arrays["tick_s"][-1])
    worst = [time_s[judged][np.argmax(error[judged][:, i])] for i in (0, 1)]
    bounds: dict[str, Any] = {"rms_below_mm": rms[0], "max_below_mrad": {"turn": largest[1]}}
    with pytest.raises(AssertionError, match=r"(?s)" + AGAIN) as failure:
        cart.assert_tracks(**bounds)
    lines = str(failure.value).splitlines()
    assert lines[:-1] == [
        f"x: rms tracking error {rms[0]:.4g} mm (worst at {worst[0]:.3f} s: {largest[0]:.4g} mm), "
        f"not below {rms[0]:g} mm",
        f"turn: max tracking error {largest[1]:.4g} mrad at {worst[1]:.3f} s, "
        f"not below {largest[1]:g} mrad",
    ]
    just = {"rms_below_mm": rms[0] * 1.000001, "max_below_mrad": largest[1] * 1.000001}
    cart.assert_tracks(**just)


def test_estimates_worse_than_asked(cart: ClosedLoopRun) -> None:
    rms = cart.summary["estimate"]["rms_now"][0] * 200_000  # counts/m
    cart.assert_estimates(rms_below_counts={"x": rms * 1.001})
    with pytest.raises(AssertionError, match=AGAIN) as failure:
        cart.assert_estimates(rms_below_counts={"x": rms * 0.999})
    assert str(failure.value).startswith(
        f"x: rms error of the estimated position {rms:.4g} counts (worst at 0."
    )


def test_too_short_to_judge_is_no_pass(cart: ClosedLoopRun) -> None:
    before = cart.arrays["tick_s"] < 0.5
    arrays = {**cart.arrays, "tick_s": cart.arrays["tick_s"][before]}
    arrays |= {key: cart.arrays[key][before] for key in ("now_s", "now_estimate")}
    arrays["actual_position"] = cart.arrays["actual_position"][before]
    short = dataclasses.replace(cart, arrays=arrays)
    with pytest.raises(AssertionError, match="nothing to judge"):
        short.assert_tracks(rms_below_mm=1e9)
    with pytest.raises(AssertionError, match="nothing to judge"):
        short.assert_estimates(rms_below_counts=1e9)


def test_beyond_limits(closed_loop: ClosedLoop) -> None:
    run = closed_loop(
        ARM2,
        {
            "mpc.enabled": False,
            "mpc.feedforward": "none",
            "task.axes.0.amplitude_rad": 0,
            "machine.axes.0.position_min_rad": 0.78,
        },
        duration_s=0.6,
    )
    position = run.arrays["truth_position"][:, 0]
    worst_s = run.arrays["truth_s"][np.argmin(position)]
    with pytest.raises(AssertionError) as failure:
        run.assert_within_limits()
    said = f"q1: position {np.min(position):.6g} rad at {worst_s:.3f} s, below 0.78\nagain: "
    assert str(failure.value).startswith(said)
    assert [text[:12] for text in run.summary["limits_violated"]] == ["q1: position"]


def test_less_room_than_asked_for(cart: ClosedLoopRun) -> None:
    with pytest.raises(AssertionError) as failure:
        cart.assert_within_limits(margin=0.45)  # 0.05 of 1 m on either side are left
    assert "x: position 0.1" in str(failure.value) and "above 0.05" in str(failure.value)
    for margin in (-0.1, 0.5, float("nan")):
        with pytest.raises(ValueError, match="margin"):
            cart.assert_within_limits(margin)


def test_moves_for_longer_than_asked(cart: ClosedLoopRun) -> None:
    with pytest.raises(AssertionError, match=r"(?s)x: moves until .*not within 0\.01 s" + AGAIN):
        cart.assert_comes_to_rest(within_s=0.01)


def test_does_not_come_to_rest(cart: ClosedLoopRun) -> None:
    drift = np.column_stack((np.zeros(len(cart.arrays["truth_s"])), cart.arrays["truth_s"] * 0.1))
    arrays = {**cart.arrays, "truth_position": cart.arrays["truth_position"] + drift}
    arrays["truth_velocity"] = cart.arrays["truth_velocity"] + [0, 0.1]
    with pytest.raises(AssertionError, match=r"^turn: still moves at 0\.(1|099\d|100\d) rad/s"):
        dataclasses.replace(cart, arrays=arrays).assert_comes_to_rest()
    arrays = {**cart.arrays, "end_states": np.array([[7, 5]])}
    with pytest.raises(AssertionError, match=r"^turn: its device ends in COAST, not in HOLD\n"):
        dataclasses.replace(cart, arrays=arrays).assert_comes_to_rest()


def test_a_deadline_missed(closed_loop: ClosedLoop) -> None:
    run = closed_loop("cart/cart.yaml", {"sim.stall_host_at_s": 0.3, "sim.stall_host_s": 0.02})
    misses = run.summary["deadline_misses"]
    assert misses > 1
    with pytest.raises(AssertionError) as failure:
        run.assert_no_deadline_missed()
    text = str(failure.value)
    assert text.startswith(f"{misses} deadlines missed, not 0: the first at 0.30")
    assert "at worst 24.6 ms without a tick, at 0.30" in text  # six knots
    assert "--set sim.stall_host_at_s=0.3 --set sim.stall_host_s=0.02" in text


def test_a_plan_refused(closed_loop: ClosedLoop) -> None:
    run = closed_loop("cart/cart.yaml", {"sim.to_device.loss": 0.3})
    frames = run.summary["frames"]
    assert frames["late_points"] > 0
    with pytest.raises(AssertionError) as failure:
        run.assert_no_plan_refused()
    text = str(failure.value)
    assert "plans refused, not 0: " in text and " s: late\n" in text
    told = sum(
        int(line.split()[1]) if line.startswith(("x:", "turn:")) else int(line.split()[0])
        for line in text.splitlines()[:-1]
    )
    assert told == frames["late_points"] + frames["gate_refused"]


numbers = st.floats(-2, 2) | st.just(float("nan"))


@given(
    rows=st.lists(st.tuples(*[numbers] * 6), min_size=1, max_size=4),
    margin=st.sampled_from([0, 0.1, 0.4]),
)
def test_limits_property(rows: list[tuple[float, ...]], margin: float) -> None:
    """An oracle that looks at one number after the other; all values in parts of the limits."""
    x, turn = CONFIG.machine.axes
    tq = [AxisUnits.of(axis, CONFIG.loop).tq_per_effort for axis in (x, turn)]
    parts = np.array(rows)
    efforts = np.nan_to_num(parts[:, 4:] * [x.effort_limit * tq[0], turn.effort_limit * tq[1]])
    arrays = {
        "truth_s": np.arange(len(rows)) * 1e-3,
        "servo_s": np.arange(len(rows)) * 1e-3,
        "truth_position": parts[:, :2] * [x.position_max, turn.position_max],
        "truth_velocity": parts[:, 2:4] * [x.velocity_limit, turn.velocity_limit],
        "servo_torque_tq": np.rint(efforts).astype(np.int64),
    }
    expected = set()
    for row in rows:
        for column, value in enumerate(row):
            bound = 1 - 2 * margin if column < 2 else 1 - margin  # both ranges lie around 0
            known = value == value or column < 4  # a torque is an integer: never NaN
            assume(not abs(abs(value) - bound) < 1e-9)  # where rounding decides
            if known and not abs(value) <= bound:
                kind = ("position", "velocity", "force" if column % 2 == 0 else "torque")
                expected.add(f"{('x', 'turn')[column % 2]}: {kind[column // 2]}")
    found = {" ".join(text.split()[:2]) for text in beyond_limits(CONFIG, arrays, margin)}
    assert found == expected


def test_bounds_that_make_no_sense(cart: ClosedLoopRun) -> None:
    for bounds, words in (
        ({}, "say how well"),
        ({"rms_below_mrad": {"q1": 1}}, "rms_below_mrad: q1 is none of turn"),
        ({"rms_below_mm": {"turn": 1}}, "rms_below_mm: turn is none of x"),
        ({"max_below_mm": 0}, "x cannot be below 0"),
        ({"max_below_mm": -1.0}, "x cannot be below -1.0"),
        ({"max_below_mm": float("nan")}, "x cannot be below nan"),
    ):
        with pytest.raises(ValueError, match=words):
            cart.assert_tracks(**bounds)
    with pytest.raises(ValueError, match="there is no such axis"):
        by_axis("rms_below_mm", 1.0, [])
    with pytest.raises(ValueError, match="y is none of x, turn"):
        cart.assert_estimates(rms_below_counts={"y": 1})


# --- one run for many tests --------------------------------------------------------------------


def test_equal_runs_are_simulated_once(closed_loop: ClosedLoop, cart: ClosedLoopRun) -> None:
    again = closed_loop(CART / "cart.yaml", {"sim.to_device.loss": 0.0, "duration_s": 0.7})
    assert again.simulation is cart.simulation
    again.summary["tracking"]["rms"][0] = 1e9  # one test's own copy
    assert closed_loop("cart/cart.yaml", {"sim.to_device.loss": 0}).summary == cart.summary
    with pytest.raises(ValueError, match="read-only"):
        cart.arrays["truth_position"][0, 0] = 1e9


def test_what_differs_is_run_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another value, another model at the same path; and only the latest runs are kept."""
    made: list[Any] = []

    class Fake:
        def __init__(self, config: Any, folder: Path) -> None:
            made.append(config)
            self.record, self.summary = SimpleNamespace(arrays=dict), {"seed": config.seed}

    monkeypatch.setattr("headway.cli.closed_loop.Simulation", Fake)
    shutil.copytree(CART, tmp_path / "cart")
    loop = ClosedLoop(tmp_path)
    loop.folders = [tmp_path]
    for _ in range(2):
        assert loop("cart/cart.yaml", seed=1).summary == {"seed": 1}
    assert len(made) == 1
    assert loop("cart/cart.yaml", seed=2).summary == {"seed": 2}
    model = tmp_path / "cart" / "cart.xml"
    model.write_text(model.read_text().replace('mass="4"', 'mass="5"'))
    loop("cart/cart.yaml", seed=2)
    assert len(made) == 3
    for seed in range(10, 10 + CACHED_MAX):
        loop("cart/cart.yaml", seed=seed)
    assert len(made) == 3 + CACHED_MAX
    loop("cart/cart.yaml", seed=10)
    assert len(made) == 3 + CACHED_MAX
    loop("cart/cart.yaml", seed=1)
    assert len(made) == 4 + CACHED_MAX


VALUES = st.one_of(
    st.booleans(),
    st.integers(-(2**40), 2**40),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(st.characters(codec="utf-8", exclude_categories=["C"]), max_size=8),
    st.lists(st.integers(0, 9) | st.floats(0, 1), max_size=3),
)


@given(values=st.dictionaries(st.sampled_from(["seed", "duration_s", "a.b", "c"]), VALUES))
def test_the_command_says_the_same(values: dict[str, Any]) -> None:
    """The command, read by the shell's rules and YAML's, asks for what was asked for."""
    from ruamel.yaml import YAML

    words = shlex.split(replay_command("my arm.yaml", changes_of(values), seed=5))
    assert words[:3] == ["headway", "run", "my arm.yaml"]
    told: dict[str, str] = {}
    for option, text in zip(words[3::2], words[4::2], strict=True):
        key, _, value = text.partition("=")
        named = {
            "--seed": ("seed", text),
            "--duration": ("duration_s", text),
            "--set": (key, value),
        }
        told.update([named[option]])
    read = {key: YAML(typ="safe", pure=True).load(value) for key, value in told.items()}
    assert read == {"seed": 5, **values}


def test_numbers_of_numpy_are_numbers() -> None:
    values = {"a": np.float64(0.5), "b": np.int32(3), "c": np.array([1.0, 2.0]), "d": (1, None)}
    assert changes_of(values) == ["a=0.5", "b=3", "c=[1.0, 2.0]", "d=[1, null]"]


# --- in someone else's tests -------------------------------------------------------------------


def test_a_failing_test_keeps_its_run(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = failing(
        pytester,
        """
@pytest.fixture(scope="module")
def run(closed_loop):
    return closed_loop(CART, {"sim.to_device.loss": 0.05}, duration_s=0.4, seed=3)

def test_passes(run):
    assert run.summary["seed"] == 3

@pytest.mark.parametrize("share", [0.3])
def test_by_itself(run, share):
    assert run.summary["seed"] == share

def test_by_ours(run):
    run.assert_comes_to_rest(within_s=1e-3)

def test_without(closed_loop):
    assert not closed_loop
""",
        "--basetemp=kept",
    )
    result.assert_outcomes(passed=1, failed=3)
    folder = pytester.path / "kept" / "headway"
    assert [path.name for path in folder.iterdir()] == [
        "test_a_failing_test_keeps_its_run.py-test_by_itself-0.3-cart"
    ]
    (kept,) = folder.iterdir()
    command = f"headway run {CART}/cart.yaml --duration 0.4 --seed 3 --set sim.to_device.loss=0.05"
    # pytest's summary repeats a whole message where CI is set, its first line elsewhere
    failures = itertools.takewhile(lambda line: "test summary" not in line, result.stdout.lines)
    lines = list(failures)
    assert lines.count(f"the run is kept in {kept}") == 2  # one run, which two tests have used
    assert lines.count(f"again: {command}") == 2
    assert f"E       again: {command}" in lines
    assert not any("headway/cli" in line or "scripts/cli" in line for line in lines)

    names = ["config.yaml", "run.mcap", "summary.json"]
    assert sorted(path.name for path in kept.iterdir()) == names
    record, summary = read_run(kept), json.loads((kept / "summary.json").read_text())
    assert record.complete and record.log_sha256 == summary["log_sha256"]
    monkeypatch.chdir(pytester.path)
    capsys.readouterr()
    assert main([*shlex.split(command)[1:], "--json", "--out", "again"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["log_sha256"] == summary["log_sha256"]
    assert shape_of(again) == shape_of(summary)


def shape_of(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: shape_of(inner) for key, inner in value.items()}
    return [shape_of(inner) for inner in value] if isinstance(value, list) else type(value)


def test_a_run_that_breaks_off(pytester: pytest.Pytester) -> None:
    """Its record goes as far as it got; a test that expects it to break off passes."""
    result = failing(
        pytester,
        """
from headway.controller.tick import DeviceError

STALL = {"sim.stall_host_at_s": 0.1, "sim.stall_host_s": 0.4}

def test_one(closed_loop):
    closed_loop(CART, STALL)

def test_two(closed_loop):
    with pytest.raises(DeviceError, match="came to rest"):
        closed_loop(CART, STALL)
""",
        "--headway-keep=here",
    )
    result.assert_outcomes(passed=1, failed=1)
    (kept,) = (pytester.path / "here").iterdir()
    assert kept.name == "test_a_run_that_breaks_off.py-test_one-cart"
    assert sorted(path.name for path in kept.iterdir()) == ["config.yaml", "run.mcap"]
    record = read_run(kept)
    assert not record.complete and record.messages["tick"] > 10
    result.stdout.fnmatch_lines([">       closed_loop(CART, STALL)", "E  *DeviceError: *"])
    assert not any("lockstep.py" in line for line in result.stdout.lines)


def test_records_beside_older_ones(tmp_path: Path) -> None:
    """Nothing is overwritten; and a folder that cannot be written is told, but fails nothing."""

    class Fake:
        config = CONFIG

        def __init__(self, number: int) -> None:
            self._number = number

        def keep(self, folder: Path) -> None:
            (folder / "it").write_text(str(self._number))

    def bench(*numbers: int, keep_in: Path = tmp_path / "a") -> Bench:
        loop: Any = ClosedLoop(tmp_path)
        loop.used = {Fake(number): f"replay {number}" for number in numbers}
        return Bench(loop, keep_in)

    first = bench(1, 2)
    for _ in range(2):
        lines = first.keep("a/test_x.py::test[b c]").splitlines()
    name = "a-test_x.py-test-b-c-cart"
    folders = [tmp_path / "a" / name, tmp_path / "a" / f"{name}-2", tmp_path / "a" / f"{name}-3"]
    assert lines[1::2] == ["again: replay 1", "again: replay 2"]
    assert lines[0::2] == [f"the run is kept in {folder}" for folder in folders[:2]]
    bench(3).keep("a/test_x.py::test[b c]")
    assert [(folder / "it").read_text() for folder in folders] == ["1", "2", "3"]
    assert len(list((tmp_path / "a").iterdir())) == 3
    said = bench(4, keep_in=folders[0] / "it").keep("t")
    assert said.startswith("the run could not be kept: ") and said.endswith("\nagain: replay 4")


def test_where_configs_are_looked_for(pytester: pytest.Pytester) -> None:
    """In the test's folder, then in the root; and nothing is left if all tests pass."""
    for folder, seed in (("", 1), ("deep/", 2)):
        shutil.copytree(CART, pytester.path / folder / "cart")
        text = (CART / "cart.yaml").read_text().replace("duration_s: 0.7", "duration_s: 0.1")
        (pytester.path / folder / "cart" / "cart.yaml").write_text(f"{text}\nseed: {seed}\n")
    test = """
def test_it(closed_loop):
    run = closed_loop("cart/cart.yaml")
    assert (run.config.seed, run.replay) == (%r, "headway run %s --seed %d")
"""
    for folder, seed, path in (
        ("other", 1, "cart/cart.yaml"),
        ("deep", 2, "deep/cart/cart.yaml"),
    ):
        file = pytester.path / folder / f"test_{folder}.py"
        file.parent.mkdir(exist_ok=True)
        file.write_text(test % (seed, path, seed))
    result = pytester.runpytest_inprocess("--basetemp=temp", f"--rootdir={pytester.path}")
    result.assert_outcomes(passed=2)
    assert list((pytester.path / "temp").iterdir()) == []


@pytest.mark.parametrize(
    ("call", "lines"),
    [
        (
            '"no.yaml"',
            ["E  *FileNotFoundError: there is no config /*/no.yaml"],
        ),
        (
            'CART, {"sim.to_device.los": 0.1}, seed=-1',
            ["E *ConfigError: --set sim.to_device.los=0.1: *loss*", "E *--set seed=-1: *"],
        ),
        ('CART, {"loop.knot_us": object()}', ["E  *TypeError: loop.knot_us: *object*"]),
    ],
)
def test_a_mistake_shows_the_line_of_the_test(
    pytester: pytest.Pytester, call: str, lines: list[str]
) -> None:
    result = failing(pytester, f"def test_it(closed_loop):\n    closed_loop({call})\n")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines([f">       closed_loop({call})", *lines])
    assert sum(line.startswith("test_a_mistake") for line in result.stdout.lines) <= 2


def test_the_exceptions_are_ours(closed_loop: ClosedLoop) -> None:
    with pytest.raises(ConfigError, match=r"duration_s"):
        closed_loop("cart/cart.yaml", duration_s=-1)
    with pytest.raises(ValueError, match="nobody"):
        closed_loop("cart/cart.yaml", {"machine.axes.0.joint": "nobody"})
    with pytest.raises(DeviceError, match="no answer"):
        closed_loop("cart/cart.yaml", {"sim.to_host.loss": 1})


def test_the_plugin_costs_nothing_before_it_is_used() -> None:
    """Neither its import nor a whole session without the fixture imports what takes time."""
    script = (
        "import sys, pytest\n"
        "before = set(sys.modules)\n"
        "import headway.cli.pytest_plugin\n"
        "print(sorted(set(sys.modules) - before))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    # Namespace packages and the module itself.
    assert done.stdout.strip() == str(["headway", "headway.cli", "headway.cli.pytest_plugin"])


def test_the_plugin_is_installed(pytestconfig: pytest.Config) -> None:
    """By its entry point, so that users' tests need not name it."""
    assert pytestconfig.pluginmanager.get_plugin("headway") is not None
