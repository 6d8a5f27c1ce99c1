"""headway check: for each rule a config that breaks it alone; what is shipped breaks none."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from headway.cli.main import main
from headway.cli.rules import Rule, Status, Subject, all_rules
from headway.cli.rules.rule import at_least, at_most, worst
from headway.cli.rules.task import EFFORT_FAIL
from headway.configs.load import load_config
from headway.controller.reference import Sines

ROOT = Path(__file__).resolve().parent.parent
ARM2 = ROOT / "configs" / "arm2.yaml"
MACHINES = ROOT / "tests" / "machines"
Array = NDArray[np.float64]
COMMAND = Path(sys.executable).with_name("headway")


@pytest.fixture(scope="module")
def planar3(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A config without boards in its model, so that its encoder and motor can be changed."""
    path = tmp_path_factory.mktemp("planar3") / "planar3.yaml"
    assert main(["init", str(MACHINES / "planar3.xml"), "--out", str(path)]) == 0
    return path


def rules_of(config: Path, *overrides: str) -> list[Rule]:
    checked = load_config(config, list(overrides))
    return all_rules(Subject(checked, (config.parent / checked.machine.model).resolve()))


def not_ok(rules: list[Rule]) -> dict[str, str]:
    assert all(bool(rule.remedy) is (rule.status is not Status.OK) for rule in rules)
    return {r.name: str(r.status) for r in rules if r.status is not Status.OK}


def axis(index: int, **values: float) -> tuple[str, ...]:
    return tuple(f"machine.axes.{index}.{key}={value}" for key, value in values.items())


# Each with all that it breaks, and how badly.
ARM2_CASES: list[tuple[tuple[str, ...], dict[str, str]]] = [
    ((), {}),
    (axis(0, soft_max_rad=1.5), {"task: room to the position limits": "warn"}),
    (axis(0, position_max_rad=1.587), {"task: room to the position limits": "warn"}),
    (axis(0, position_max_rad=1.5), {"task: room to the position limits": "FAIL"}),
    (("sim.start_rad_or_m=[2.799, 0.6]",), {"task: room to the position limits": "warn"}),
    (axis(0, position_max_rad=2.9), {"range: beyond the model's": "FAIL"}),
    (axis(1, velocity_limit_rad_per_s=4.2), {"task: speed at the gate": "warn"}),
    (axis(1, velocity_limit_rad_per_s=3.9), {"task: speed at the gate": "FAIL"}),
    (
        (
            *axis(0, velocity_limit_rad_per_s=2.67, acceleration_limit_rad_per_s2=8.6),
            *("mpc.intervals=22", "mpc.horizon_us=450560"),
        ),
        {"task: acceleration at the gate": "warn"},
    ),
    (
        axis(0, torque_limit_Nm=10),
        {"task: effort along it": "warn", "stop: effort for its deceleration": "warn"},
    ),
    (
        (*axis(0, torque_limit_Nm=6.5), "task.axes.0={offset_rad: 1.5708, amplitude_rad: 0.01}"),
        {"range: effort to hold any pose": "warn", "stop: effort for its deceleration": "warn"},
    ),
    (
        (
            *axis(0, torque_limit_Nm=6.5),
            "task.axes.0={offset_rad: 1.5708, amplitude_rad: 0.01}",
            "sim.start_rad_or_m=[0, 0]",
        ),
        {
            "range: effort to hold any pose": "warn",
            "start: effort to hold it": "warn",
            "stop: effort for its deceleration": "warn",
        },
    ),
    (
        axis(0, acceleration_limit_rad_per_s2=60),
        {"horizon: to stop from the speed limit": "FAIL"},
    ),
    (
        (
            *axis(0, acceleration_limit_rad_per_s2=280),
            *("mpc.intervals=8", "mpc.horizon_us=65536"),
        ),
        {"horizon: to stop from the task": "warn"},
    ),
    (
        axis(0, stop_deceleration_rad_per_s2=25),
        {"stop: effort for its deceleration": "warn"},
    ),
    (axis(0, soft_min_rad=-2.79, soft_max_rad=2.79), {}),
    (
        axis(0, soft_min_rad=-2.79, soft_max_rad=2.79, stop_deceleration_rad_per_s2=5),
        {"soft limits: speed with room to stop behind them": "warn"},
    ),
    (axis(0, soft_min_rad=-2.79, stop_deceleration_rad_per_s2=5), {}),
    (("machine.axes.0.motor.gear=31",), {"board: motor as in the model": "FAIL"}),
    (
        ("machine.axes.0.servo.ki_Nm_per_rad_s=1e-9",),
        {"board: limits and gains as integers": "FAIL"},
    ),
    (("loop.margin_us=8192",), {"margin: in time, bridging 0 lost frames": "warn"}),
    (("loop.margin_us=4096",), {"margin: in time, bridging 0 lost frames": "FAIL"}),
    (
        ("sim.to_device.reorder=0.1",),
        {"margin: in time, bridging 0 lost frames": "warn"},
    ),
    (("sim.compute_us=5000", "loop.margin_us=16384"), {"compute: within a knot": "warn"}),
    (("sim.compute_us=17000", "loop.margin_us=32768"), {"compute: within a knot": "FAIL"}),
    (("mpc.horizon_us=573440",), {"plan: points": "FAIL"}),
    (("sync.to_device_least_us=2001",), {"clocks: least delay to_device": "FAIL"}),
    (("sync.to_host_least_us=2001",), {"clocks: least delay to_host": "FAIL"}),
    (
        ("sim.network=usb", "sync.limit_us=2000", "sync.to_device_least_us=63"),
        {"clocks: least delay to_host": "FAIL"},
    ),
    (("sync.drift_ppm=29",), {"clocks: drift_ppm of the simulated boards": "FAIL"}),
    (
        ("sim.clocks.wander_ppm_per_s=0.9", "sync.wander_ppm_per_s=0.5"),
        {"clocks: wander_ppm_per_s of the simulated boards": "FAIL"},
    ),
]
PLANAR3_CASES: list[tuple[tuple[str, ...], dict[str, str]]] = [
    ((), {}),
    (axis(0, counts_per_turn=12000), {"encoder: effort of one count": "warn"}),
    (axis(0, counts_per_turn=3000), {"encoder: effort of one count": "FAIL"}),
    (
        (
            *axis(2, counts_per_turn=24),
            *("machine.axes.2.servo.kd_Nm_s_per_rad=0", "machine.axes.2.servo.kp_Nm_per_rad=1.5"),
        ),
        {"encoder: acceleration of one quantum": "FAIL"},
    ),
    (
        axis(0, counts_per_turn=4000000),
        {"encoder: counts over the range": "FAIL", "board: limits and gains as integers": "FAIL"},
    ),
    (("machine.axes.0.servo.kp_Nm_per_rad=8000",), {"servo: phase margin": "warn"}),
    (("machine.axes.0.servo.kp_Nm_per_rad=100000",), {"servo: phase margin": "FAIL"}),
    (("machine.axes.0.servo.kp_Nm_per_rad=8",), {"servo: stiffness that gravity takes": "warn"}),
    (("machine.axes.0.motor.supply_V=38",), {"motor: voltage at both limits": "warn"}),
    (
        ("machine.axes.0.motor.supply_V=5",),
        {"motor: voltage at both limits": "warn", "motor: voltage in the task": "FAIL"},
    ),
    (
        (
            *axis(0, acceleration_limit_rad_per_s2=40000, velocity_limit_rad_per_s=60),
            *("machine.axes.0.motor.supply_V=400", "mpc.intervals=125", "mpc.horizon_us=512000"),
        ),
        {"plan: fits a frame": "warn"},
    ),
    (axis(2, coulomb_Nm=0.048), {"prediction: fastest decay in a step": "warn"}),
    (axis(2, coulomb_Nm=2), {"prediction: fastest decay in a step": "FAIL"}),
]


@pytest.mark.parametrize(("overrides", "broken"), ARM2_CASES)
def test_a_rule_is_broken_alone(overrides: tuple[str, ...], broken: dict[str, str]) -> None:
    assert not_ok(rules_of(ARM2, *overrides)) == broken


@pytest.mark.parametrize(("overrides", "broken"), PLANAR3_CASES)
def test_a_rule_of_the_drives_is_broken_alone(
    planar3: Path, overrides: tuple[str, ...], broken: dict[str, str]
) -> None:
    assert not_ok(rules_of(planar3, *overrides)) == broken


def test_bodies_that_touch_on_the_way(planar3: Path, tmp_path: Path) -> None:
    text = (MACHINES / "planar3.xml").read_text()
    (tmp_path / "low.xml").write_text(text.replace("0 0 -1.2", "0 0 0.5"))
    assert "0 0 0.5" in (tmp_path / "low.xml").read_text()
    rules = rules_of(planar3, f"machine.model={tmp_path}/low.xml")
    assert not_ok(rules) == {"task: bodies that touch on the way": "FAIL"}
    (touch,) = [rule for rule in rules if rule.status is Status.FAIL]
    assert "world and hand at " in touch.remedy


def test_a_rule_has_a_case() -> None:
    named = {name for _, broken in ARM2_CASES + PLANAR3_CASES for name in broken}
    named.add("task: bodies that touch on the way")
    rules = rules_of(ARM2, *axis(0, soft_min_rad=-2.5, soft_max_rad=2.5))
    assert {rule.name.split(",")[0] for rule in rules} == {n.split(",")[0] for n in named}


@pytest.mark.parametrize("name", ["arm2", "arm2-fast", "arm6"])
def test_what_is_shipped_passes(name: str) -> None:
    told = not_ok(rules_of(ROOT / "configs" / f"{name}.yaml"))
    assert told == ({"task: effort along it": "warn"} if name == "arm2-fast" else {})


# The rules' figures against other ways to get them.


def figures(rules: list[Rule]) -> dict[str, Rule]:
    return {rule.name: rule for rule in rules}


fuzz = settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@fuzz
@given(frequency=st.floats(0.05, 1.2), amplitude=st.floats(0.05, 1.5))
def test_effort_and_gate_of_a_slow_or_fast_task(frequency: float, amplitude: float) -> None:
    """The oracles: closed forms of the sine and of the stretched arm's weight."""
    rules = figures(
        rules_of(
            ARM2,
            f"task.frequency_Hz={frequency}",
            "task.axes.0={offset_rad: 0, amplitude_rad: 0}",
            f"task.axes.1={{offset_rad: 0, amplitude_rad: {amplitude}}}",
        )
    )
    rate = 2 * np.pi * frequency
    speed, acceleration = rules["task: speed at the gate"], rules["task: acceleration at the gate"]
    h = 4096e-6
    hull = 6 / (4 + 2 * np.cos(rate * h))  # control points of a sine: a little further out
    assert speed.value == pytest.approx(2 * amplitude * hull * np.sin(rate * h / 2) / h, rel=1e-4)
    expected = 4 * amplitude * hull * np.sin(rate * h / 2) ** 2 / h**2
    assert acceleration.value == pytest.approx(expected, rel=1e-3)
    load = rules["start: effort to hold it"]
    assert load.value == pytest.approx(9.81 * (0.15 + 0.45))
    effort = rules["task: effort along it"]
    assert effort.value is not None and load.value is not None and effort.limit is not None
    assert effort.value >= load.value * (1 - 1e-6)  # it passes through the stretched pose
    expected_status = "ok" if effort.value <= effort.limit else "warn"
    if effort.value > EFFORT_FAIL * 12:
        expected_status = "FAIL"
    assert str(effort.status) == expected_status


def mujocos_effort(q: Array, v: Array, a: Array) -> Array:
    """Of arm2's motors along a motion (m, 2), by MuJoCo's inverse dynamics."""
    model = mujoco.MjModel.from_xml_path(str(ROOT / "models" / "arm2" / "arm2.xml"))
    data, efforts = mujoco.MjData(model), []
    for data.qpos[:], data.qvel[:], data.qacc[:] in zip(q, v, a, strict=True):
        mujoco.mj_inverse(model, data)
        efforts.append(data.qfrc_inverse.copy())
    return np.array(efforts)


def test_effort_and_stop_by_mujoco() -> None:
    """The task's effort with friction that is known; and the longest time that a straight stop at
    constant deceleration takes, when each is as short as the limits allow."""
    friction = ("machine.axes.0.coulomb_Nm=0.3", "machine.axes.1.coulomb_Nm=0.02")
    fast = ("task.frequency_Hz=0.6", "machine.axes.1.torque_limit_Nm=4")
    rules = figures(rules_of(ARM2, *fast, *friction))
    config = load_config(ARM2, [*fast, *friction])
    limits = np.array([axis.effort_limit for axis in config.machine.axes])
    time_s = np.arange(0, 1 / 0.6, 4096e-6)
    q, v, a = Sines(config.task).at(time_s)
    efforts = np.abs(mujocos_effort(q, v, a) + np.array([0.3, 0.02]) * np.sign(v))
    shares = efforts.max(axis=0) / limits
    along = rules["task: effort along it"]
    assert along.axis == ["q1", "q2"][int(shares.argmax())]
    assert along.value == pytest.approx(shares.max() * limits[shares.argmax()], rel=1e-6)

    longest, s = 0.0, np.linspace(0, 1, 30)[:, None]
    for q0, v0 in zip(q[::10], v[::10], strict=True):
        for stop_s in np.geomspace(1e-3, 1.0, 200):
            position, speed = q0 + v0 * stop_s * (s - s**2 / 2), v0 * (1 - s)
            needed = mujocos_effort(position, speed, np.tile(-v0 / stop_s, (30, 1)))
            needed += np.array([0.3, 0.02]) * np.sign(speed)
            if np.all(np.abs(needed) <= limits):
                longest = max(longest, stop_s)
                break
    assert rules["horizon: to stop from the task"].value == pytest.approx(longest, rel=0.15)


@fuzz
@given(
    margin=st.integers(1024, 60_000),
    compute=st.integers(0, 9000),
    delay=st.integers(1000, 9000),
    jitter=st.integers(0, 1000),
)
def test_margin_counts_what_is_late(margin: int, compute: int, delay: int, jitter: int) -> None:
    """The oracle: send a plan each knot and see how many in a row may be lost."""
    config = load_config(
        ARM2,
        [
            f"loop.margin_us={margin}",
            f"sim.compute_us={compute}",
            f"sim.to_device={{delay_us: {delay}, jitter_us: {jitter}}}",
        ],
    )
    subject = Subject(config, ROOT / "models" / "arm2" / "arm2.xml")
    (rule,) = [r for r in all_rules(subject) if r.name.startswith("margin")]
    knot = config.loop.knot_us
    due = config.loop.margin_knots * knot  # of a plan that was decided at 0
    bridged = 0
    while (bridged + 1) * knot + compute + delay + jitter <= due:
        bridged += 1
    in_time = compute + delay + jitter <= due
    assert f"bridging {bridged} lost frame" in rule.name
    assert str(rule.status) == ("ok" if bridged else "warn" if in_time else "FAIL")


@pytest.mark.parametrize(
    ("value", "status"), [(1.0, "ok"), (8.5, "ok"), (8.6, "warn"), (15, "warn"), (15.1, "FAIL")]
)
def test_at_most(value: float, status: str) -> None:
    rule = at_most("n", value, 10, "Nm", "less", warn=0.85, fail=1.5)
    assert (str(rule.status), rule.limit) == (status, 8.5)
    assert rule.remedy == ("" if status == "ok" else "less")


@pytest.mark.parametrize(
    ("value", "status"), [(10.0, "ok"), (9.9, "warn"), (4.0, "warn"), (3.9, "FAIL")]
)
def test_at_least(value: float, status: str) -> None:
    assert str(at_least("n", value, 10, "deg", "more", fail=4).status) == status


def test_the_worst_axis_is_shown() -> None:
    def rule(value: float, axis: str) -> Rule:
        return at_most("n", value, 10, "", "", axis, warn=0.8)

    assert worst([rule(1, "a"), rule(7, "b"), rule(-3, "c")]).axis == "b"
    assert worst([rule(7.9, "a"), rule(8.1, "b"), rule(0, "c")]).axis == "b"
    assert worst([rule(11, "a"), rule(9, "b")]).axis == "a"


# The command.


@pytest.fixture
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    yield
    assert list(tmp_path.iterdir()) == []


Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def check(_in_an_empty_folder: None, capsys: pytest.CaptureFixture[str]) -> Run:
    def check(*arguments: str) -> tuple[int, str, str]:
        code = main(["check", *arguments])
        out, err = capsys.readouterr()
        return code, out, err

    return check


def test_json(check: Run) -> None:
    code, out, err = check(str(ARM2), "--json", "--set", "loop.margin_us=8192")
    assert (code, err) == (0, "")
    rules: list[dict[str, Any]] = json.loads(out)["rules"]
    assert {frozenset(rule) for rule in rules} == {
        frozenset({"name", "value", "limit", "unit", "status", "axis", "remedy"})
    }
    (warned,) = [rule for rule in rules if rule["status"] != "ok"]
    assert warned["name"].startswith("margin") and warned["value"] == 8192
    assert warned["limit"] == 3500 + 4000 + 4096 and warned["unit"] == "us"
    assert "loop.margin_us of 11596" in warned["remedy"]


def test_json_of_what_never_ends(check: Run) -> None:
    """No stop is possible where gravity is too much: infinity is not JSON."""
    code, out, _ = check(str(ARM2), "--json", "--set", "machine.axes.0.torque_limit_Nm=1")
    assert code == 2
    (stop,) = [r for r in json.loads(out)["rules"] if r["name"] == "horizon: to stop from the task"]
    assert (stop["value"], stop["status"]) == (None, "FAIL")


def test_table(check: Run) -> None:
    overrides = axis(0, torque_limit_Nm=10, stop_deceleration_rad_per_s2=10)
    code, out, err = check(str(ARM2), *(f"--set={override}" for override in overrides))
    assert (code, err) == (0, "")
    (line,) = [line for line in out.splitlines() if line.startswith("warn  ")]
    assert line.split()[-3:] == ["8.86", "8.5", "Nm"] and " q1 " in line
    assert "torque_limit_Nm" in out.partition("warn task: effort along it\n")[2]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["loop.margin=3"], "loop.margin: "),
        (["seed=[", "loop.knot_us=3"], "loop.knot_us: "),
        (["machine.axes.0.joint=q7"], "q7"),
        (["machine.model=../tests/machines/gantry.xml"], "x, y, z"),
        (["machine.model=arm2.yaml"], "arm2.yaml"),
        (["device.servo_period_us=997"], None),
    ],
)
def test_what_cannot_be_checked_is_one_failure(
    check: Run, overrides: list[str], message: str | None
) -> None:
    code, out, err = check(str(ARM2), "--json", *(f"--set={o}" for o in overrides))
    rules = json.loads(out)["rules"]
    if message is None:  # arm2 has boards and a step of its own
        assert code == 0
        return
    assert (code, err) == (2, "")
    assert rules[-1]["status"] == "FAIL" and message in rules[-1]["remedy"]
    assert all(rule["status"] == "ok" for rule in rules[:-1])


def test_no_such_file(check: Run) -> None:
    code, out, _ = check("none.yaml")
    assert code == 2 and "none.yaml: cannot be read" in out and "Traceback" not in out


def test_as_a_process() -> None:
    done = subprocess.run([COMMAND, "check", ARM2], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("ok ") == len(rules_of(ARM2)) + 2
