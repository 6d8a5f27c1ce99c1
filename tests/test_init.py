"""headway init: from a model that nobody has seen to a machine that moves, with no edit between."""

import importlib.metadata
import json
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from headway.cli.main import main
from headway.configs.load import load_config
from headway.configs.schema import Config
from headway.models.envelope import envelope
from headway.models.machine import load_machine
from headway.models.stated import stated

ROOT = Path(__file__).resolve().parent.parent
MACHINES = ROOT / "tests" / "machines"
ROBOTS = Path(
    str(
        importlib.metadata.distribution("example-robot-data").locate_file(
            "cmeel.prefix/share/example-robot-data/robots"
        )
    )
)
MODELS = {
    "planar3": MACHINES / "planar3.xml",
    "scara": MACHINES / "scara.xml",
    "gantry": MACHINES / "gantry.xml",
    "double_pendulum": ROBOTS / "double_pendulum_description" / "urdf" / "double_pendulum.urdf",
    "ur5": ROBOTS / "ur_description" / "urdf" / "ur5_joint_limited_robot.urdf",
}
# Largest rms error of any axis in one second [mrad, mm]: about twice what was measured.
RMS_MAX = {"planar3": 0.8, "scara": 0.5, "gantry": 0.05, "double_pendulum": 0.8, "ur5": 0.5}


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    yield


def lines_of(path: Path) -> dict[str, tuple[str, bool]]:
    """Each value of a config, by dotted key: as text, and whether it is marked as guessed."""
    found: dict[str, tuple[str, bool]] = {}
    text = path.read_text().splitlines()

    def walk(node: Any, prefix: str) -> None:
        items = node.items() if isinstance(node, dict) else enumerate(node)
        for key, value in items:
            line = node.lc.value(key)[0] if isinstance(node, dict) else node.lc.item(key)[0]
            flow_list = isinstance(value, list) and value.fa.flow_style()
            if isinstance(value, dict | list) and not flow_list:
                walk(value, f"{prefix}{key}.")
            else:
                found[f"{prefix}{key}"] = (str(value), "# guessed: " in text[line])

    walk(YAML().load(path.read_text()), "")
    return found


@pytest.mark.parametrize("name", MODELS)
def test_init_check_run(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    """No edit between: nothing fails, no plan is refused, no limit is violated, and it rests."""
    config = Path(f"{MODELS[name].stem}.yaml")
    assert main(["init", str(MODELS[name])]) == 0
    assert main(["check", str(config), "--json"]) == 0
    capfd.readouterr()
    assert main(["run", str(config), "--duration", "1", "--json", "--out", "out"]) == 0
    summary = json.loads(capfd.readouterr().out)
    assert summary["limits_violated"] == []
    assert summary["at_rest_after_end"] is True
    assert summary["solver"]["rejected"] == summary["frames"]["gate_refused"] == 0
    assert summary["deadline_misses"] == 0
    assert all(rms < RMS_MAX[name] for rms in summary["tracking"]["rms"])
    units = [axis.unit for axis in load_config(config).machine.axes]
    assert summary["tracking"]["unit"] == [f"m{unit}" for unit in units]
    assert max(summary["torque"]["clipped_share"]) == 0


def test_a_payload_that_the_model_does_not_know() -> None:
    """Guessed weights and noises still hold with a wrist a quarter heavier and friction in it."""
    assert main(["init", str(MODELS["planar3"])]) == 0
    deviations = ("mass_scale={hand: 1.25}", "viscous_scale=1.6", "motor_constant_scale=0.97")
    overrides = [f"--set=sim.plant.{deviation}" for deviation in deviations]
    overrides.append("--set=sim.plant.coulomb_Nm_or_N=[0.5, 0.2, 0.05]")
    assert main(["run", "planar3.yaml", "--duration", "1.5", "--out", "out", *overrides]) == 0
    summary = json.loads(Path("out/summary.json").read_text())
    assert all(rms < 1.5 for rms in summary["tracking"]["rms"])
    assert summary["solver"]["rejected"] == 0


# What the model states is in the file as it is; all else is marked.


@pytest.mark.parametrize("name", MODELS)
def test_what_the_model_states_is_kept_and_the_rest_is_marked(name: str) -> None:
    model = MODELS[name]
    assert main(["init", str(model), "--out", "machine.yaml"]) == 0
    config, lines = load_config(Path("machine.yaml")), lines_of(Path("machine.yaml"))
    machine = load_machine(model)
    assert tuple(axis.joint for axis in config.machine.axes) == machine.joints
    for i, (axis, joint) in enumerate(
        zip(config.machine.axes, stated(model, machine.joints), strict=True)
    ):
        assert (axis.unit == "m") is joint.linear
        position = joint.position or (None, None)
        known = {
            "position_min": position[0],
            "position_max": position[1],
            "velocity_limit": joint.velocity,
            "effort_limit": joint.effort,
            "coulomb": joint.coulomb or None,
        }
        for attribute, value in known.items():
            key = f"machine.axes.{i}.{axis.key(attribute)}"
            if key not in lines:
                assert attribute == "coulomb" and value is None
                continue
            kept = value is not None and getattr(axis, attribute) == pytest.approx(value, rel=1e-9)
            assert lines[key][1] is not kept
            if value is not None and not kept:  # then it is less, and says so
                assert getattr(axis, attribute) < value
                line = Path("machine.yaml").read_text().splitlines()
                assert any(f"the model has {value:g}" in text for text in line)
    guessed = {key.rpartition(".")[2] for key, (_, marked) in lines.items() if marked}
    assert {"frequency_Hz", "horizon_us", "position_weight"} <= guessed
    free = {"name", "duration_s", "model", "joint", "kind", "knot_us", "margin_us"}
    assert free.isdisjoint(guessed)


def test_a_motor_that_the_model_has_is_no_guess() -> None:
    assert main(["init", str(ROOT / "models" / "arm2" / "arm2.xml")]) == 0
    lines = lines_of(Path("arm2.yaml"))
    shipped = load_config(ROOT / "configs" / "arm2.yaml").machine.axes
    for i, axis in enumerate(load_config(Path("arm2.yaml")).machine.axes):
        assert axis.motor == shipped[i].motor
        assert axis.counts_per_unit == shipped[i].counts_per_unit
        for key in ("counts_per_turn", "motor.gear", "motor.supply_V"):
            assert lines[f"machine.axes.{i}.{key}"][1] is False


# The guesses against the dynamics that they are to follow from.


@pytest.mark.parametrize("name", MODELS)
def test_guesses_follow_from_the_dynamics(name: str) -> None:
    assert main(["init", str(MODELS[name]), "--out", "machine.yaml"]) == 0
    axes = load_config(Path("machine.yaml")).machine.axes
    reach = envelope(
        load_machine(MODELS[name]),
        np.array([axis.position_min for axis in axes]),
        np.array([axis.position_max for axis in axes]),
    )
    for i, axis in enumerate(axes):
        most, load = float(reach.inertia_max[i]), float(reach.holding_max[i])
        motor = axis.motor
        volts = motor.constant * axis.velocity_limit
        volts += motor.resistance_ohm * axis.effort_limit / motor.constant
        assert 0.5 * motor.supply_V < volts < 0.9 * motor.supply_V
        total = axis.servo.kd + motor.damping
        assert motor.damping == pytest.approx(total / 3, rel=0.02)
        assert total <= 45 * most * 1.01
        zeta = total / (2 * np.sqrt(axis.servo.kp * most))
        assert 0.3 < zeta < 1.0
        count = axis.servo.kd / axis.counts_per_unit / 1e-3
        assert count <= 0.08 * axis.effort_limit
        assert axis.effort_limit > load
        spare = axis.effort_limit - load
        assert 0 < axis.deceleration <= 0.71 * max(spare, 0.05 * axis.effort_limit) / most
        assert axis.deceleration <= 8.1 * axis.velocity_limit
    damping = np.array([axis.servo.kd + axis.motor.damping for axis in axes])
    assert reach.fastest(damping)[0] < 510
    assert reach.toppling(np.array([axis.servo.kp for axis in axes]))[0] < 0.41


def chain(folder: Path, size: float, joint: str = "hinge") -> Path:
    """A link of length `size`, of steel."""
    path = folder / f"link{size:g}.xml"
    path.write_text(
        f'<mujoco><worldbody><body name="b"><joint name="j" type="{joint}" axis="0 1 0"/>'
        f'<geom type="capsule" fromto="0 0 0 {size} 0 0" size="{size / 20}" density="7800"/>'
        "</body></worldbody></mujoco>"
    )
    return path


@pytest.mark.parametrize("joint", ["hinge", "slide"])
@pytest.mark.parametrize("size", [0.02, 0.2, 2.0])
def test_from_a_finger_to_a_crane(
    tmp_path: Path, size: float, joint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nine orders of magnitude in inertia, and the rules hold for each."""
    model = chain(tmp_path, size, joint)
    assert main(["init", str(model), "--out", "m.yaml", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rules"] == []
    (axis,) = load_config(Path("m.yaml")).machine.axes
    lines = lines_of(Path("m.yaml"))
    keys = [key for key in lines if key.startswith("machine.axes.0.") and key[-6:] != ".joint"]
    assert len(keys) == 13 and all(lines[key][1] for key in keys)  # the model says nothing
    assert axis.unit == ("rad" if joint == "hinge" else "m")


def test_a_limit_that_nobody_knew_is_not_believed(tmp_path: Path) -> None:
    """A thousand newton metres on a link of ten grams."""
    model = tmp_path / "finger.xml"
    big = '<actuator><motor joint="j" ctrlrange="-1000 1000"/></actuator></mujoco>'
    model.write_text(chain(tmp_path, 0.05).read_text().replace("</mujoco>", big))
    assert main(["init", str(model)]) == 0
    (axis,) = load_config(Path("finger.yaml")).machine.axes
    assert axis.effort_limit < 1
    assert (
        "# guessed: the model has 1000, for an inertia of only" in Path("finger.yaml").read_text()
    )


def test_the_task_keeps_clear_of_what_is_in_the_way(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two posts beside the spindle, which could go 90 mm either way without them."""
    post = '<geom type="box" size="0.01 0.3 0.5" pos="{x} 0 0"/>'
    text = MODELS["gantry"].read_text()
    bed = text[text.index('<geom name="bed"') :].splitlines()[0]
    model = tmp_path / "posts.xml"
    model.write_text(text.replace(bed, post.format(x=0.03) + post.format(x=0.18)))
    assert main(["init", str(model), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rules"] == []
    free = load_config(Path("posts.yaml")).task.axes[0]
    assert abs(free.offset) > 0.02 or free.amplitude < 0.08


def test_a_weak_machine_plans_further_ahead(tmp_path: Path) -> None:
    """A fifth of a newton takes longer to stop half a kilogram than a hundred do."""
    horizons = []
    for force in (0.2, 100):
        model = tmp_path / f"slide{force}.xml"
        motor = f'<actuator><motor joint="j" ctrlrange="-{force} {force}"/></actuator></mujoco>'
        text = chain(tmp_path, 0.2, "slide").read_text().replace("</mujoco>", motor)
        model.write_text(text.replace("axis=", 'range="-0.3 0.3" axis='))
        assert main(["init", str(model)]) == 0
        horizons.append(load_config(Path(f"slide{force}.yaml")).mpc.horizon_us)
    assert horizons[0] > 1.5 * horizons[1]


# The command.


def test_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", str(MODELS["gantry"]), "--json"]) == 0
    out, err = capsys.readouterr()
    written = json.loads(out)
    assert written["config"] == "gantry.yaml" and written["rules"] == []
    assert written["guessed"] == Path("gantry.yaml").read_text().count("# guessed: ")
    assert err == ""


def test_the_model_is_found_from_wherever_the_config_is(tmp_path: Path) -> None:
    elsewhere = tmp_path / "some" / "other folder"
    elsewhere.mkdir(parents=True)
    model = tmp_path / "my machine's.xml"
    model.write_text(MODELS["gantry"].read_text())
    assert main(["init", str(model), "--out", str(elsewhere / "m.yaml")]) == 0
    config = load_config(elsewhere / "m.yaml")
    assert not Path(config.machine.model).is_absolute()
    assert (elsewhere / config.machine.model).samefile(model)
    first = (elsewhere / "m.yaml").read_text().splitlines()[0]
    schema = first.removeprefix("# yaml-language-server: $schema=")
    assert (elsewhere / schema).samefile(ROOT / "configs" / "schema.json")
    assert config.name == "my_machine_s"


@pytest.mark.parametrize("joint", ["true", "1e3", "- a: b", "null", "'", "a#b", "x y"])
def test_any_name_of_a_joint_survives(tmp_path: Path, joint: str) -> None:
    model = tmp_path / "odd.xml"
    model.write_text(chain(tmp_path, 0.2).read_text().replace('name="j"', f'name="{joint}"'))
    assert main(["init", str(model)]) == 0
    assert load_config(Path("odd.yaml")).machine.axes[0].joint == joint


Refused = Callable[..., str]


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Refused:
    """Runs init, which has to refuse and to leave nothing behind; returns what it says."""

    def refused(*arguments: str) -> str:
        before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
        assert main(["init", *arguments]) == 2
        after = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
        assert after == before
        out, err = capsys.readouterr()
        assert out == "" and "Traceback" not in err
        return err

    return refused


def test_an_existing_file_is_refused(refused: Refused) -> None:
    Path("gantry.yaml").write_text("mine")
    assert "gantry.yaml: exists already" in refused(str(MODELS["gantry"]))


def test_a_file_that_appears_meanwhile_is_not_overwritten(
    refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = os.link

    def late(source: str, target: str) -> None:
        Path(target).write_text("somebody else's")
        try:
            link(source, target)
        finally:
            assert Path(target).read_text() == "somebody else's"
            Path(target).unlink()

    monkeypatch.setattr(os, "link", late)
    assert "cannot be written: File exists" in refused(str(MODELS["gantry"]))


def test_a_full_disk_leaves_nothing(refused: Refused, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, text: str, **_: object) -> None:
        with path.open("w") as file:
            file.write(text[: len(text) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    assert "No space left" in refused(str(MODELS["gantry"]))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("", "", None),
        ('type="slide" axis="1 0 0" range="-0.3 0.3"', 'type="ball"', "only hinge and slide"),
        ('<joint name="x"', '<freejoint/><joint name="x"', "machine.xml: "),
        (
            '<body name="portal"',
            '<body name="rock"/><body name="portal"',
            "hang all bodies from one",
        ),
        ('damping="40"', 'stiffness="40"', "springs"),
        ("<mujoco", "<mujok", "machine.xml: "),
    ],
)
def test_a_model_that_cannot_be_used(
    refused: Refused, tmp_path: Path, old: str, new: str, message: str | None
) -> None:
    text = MODELS["gantry"].read_text()
    assert old in text
    model = tmp_path / "machine.xml"
    model.write_text(text.replace(old, new) if old else text)
    if message is None:
        assert main(["init", str(model)]) == 0
    else:
        assert re.search(message, refused(str(model)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.xml"], "none.xml: there is no such file"),
        (["."], ".: there is no such file"),
        ([], "MODEL"),
        ([str(MODELS["gantry"]), "--out", "/proc/none/m.yaml"], "cannot be written"),
        ([str(ROBOTS / "iris_description" / "robots" / "iris_simple.urdf")], "has no joint"),
    ],
)
def test_mistakes(refused: Refused, arguments: list[str], message: str) -> None:
    assert message in refused(*arguments)


def test_a_machine_that_cannot_hold_itself(refused: Refused, tmp_path: Path) -> None:
    text = chain(tmp_path, 1.0).read_text().replace('name="j"', 'name="j" range="-30 30"')
    weak = '<actuator><motor joint="j" gear="20" ctrlrange="-1 1"/></actuator></mujoco>'
    model = tmp_path / "weak.xml"
    model.write_text(text.replace("</mujoco>", weak))
    assert "no pose was found that the drives can hold" in refused(str(model))


def test_a_config_from_init_is_complete() -> None:
    """It names every weight and noise that depends on the machine: none is left to arm2 alone."""
    assert main(["init", str(MODELS["scara"])]) == 0
    tree = YAML(typ="safe").load(Path("scara.yaml").read_text())
    scalars = {"enabled", "feedforward", "fade_start", "fade_end", "torque_share_end"}
    scalars |= {
        "later",
        "max_iterations",
        "sqp_iterations",
        "disturbance",
        "measurement_noise_counts",
        "gate_sigma",
    }
    for section in ("mpc", "estimator"):
        known = set(Config.model_fields[section].annotation.model_fields)
        assert known - scalars == set(tree[section])
