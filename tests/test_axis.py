"""Axes, rotary and linear: which keys make which, and that nothing below knows the difference."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from headway.configs.axis import LinearAxis, RotaryAxis
from headway.configs.load import ConfigError, load_config
from headway.configs.save import save_config
from headway.configs.schema import Config, Device, Loop, Sync
from headway.devices.axis import AxisUnits, position_limits, torque_limits
from headway.devices.settings import device_settings
from headway.firmware import _core

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "configs" / "arm2.yaml").read_text().replace("../models", f"{ROOT}/models")

LINEAR = """\
      counts_per_m: 1000000
      position_min_m: -0.3
      position_max_m: 0.3
      velocity_limit_m_per_s: 1.5
      acceleration_limit_m_per_s2: 30
      force_limit_N: 400
      motor: {gear_rad_per_m: 200, torque_constant_Nm_per_A: 0.06, resistance_ohm: 1, supply_V: 48}
      servo: {kp_N_per_m: 12000, kd_N_s_per_m: 500}
"""


def with_a_slide(text: str = TEXT, sine: str = "{offset_m: 0.1, amplitude_m: 0.05}") -> str:
    """arm2's config with a slide in place of its second joint."""
    head, _, rest = text.partition("    - joint: q2\n")
    tail = rest[rest.index("\nloop:") :]
    old = "    - {offset_rad: 0.6, amplitude_rad: 0.7, harmonic: 2}"
    assert old in tail
    return head + "    - joint: q2\n" + LINEAR + tail.replace(old, f"    - {sine}")


@pytest.fixture
def load(tmp_path: Path) -> Callable[..., Config]:
    def load(text: str, *overrides: str) -> Config:
        path = tmp_path / "config.yaml"
        path.write_text(text)
        return load_config(path, list(overrides))

    return load


def test_the_keys_say_the_kind(load: Callable[..., Config]) -> None:
    q1, q2 = load(with_a_slide()).machine.axes
    assert isinstance(q1, RotaryAxis) and isinstance(q2, LinearAxis)
    assert (q1.unit, q1.effort_unit, q2.unit, q2.effort_unit) == ("rad", "Nm", "m", "N")
    assert (q1.position_min, q2.position_min) == (-2.8, -0.3)
    assert q1.counts_per_unit == q1.counts_per_turn / (2 * math.pi)
    assert q2.counts_per_unit == 1e6
    assert (q1.effort_limit, q2.effort_limit) == (12, 400)
    assert q2.motor.constant == 200 * 0.06
    assert q2.motor.damping == pytest.approx((200 * 0.06) ** 2 / 1)


def test_a_saved_config_keeps_both_kinds(load: Callable[..., Config], tmp_path: Path) -> None:
    config = load(with_a_slide(), "machine.axes.1.soft_max_m=0.2")
    save_config(config, tmp_path, tmp_path / "saved.yaml")
    written = YAML(typ="safe").load((tmp_path / "saved.yaml").read_text())
    assert written["machine"]["axes"][1]["soft_max_m"] == 0.2
    assert written["task"]["axes"][1]["amplitude_m"] == 0.05
    assert "amplitude_rad" in written["task"]["axes"][0]
    again = load_config(tmp_path / "saved.yaml")
    assert again.machine.axes == config.machine.axes and again.task == config.task


@pytest.mark.parametrize(
    ("old", "new", "messages"),
    [
        (
            "position_max_m: 0.3",
            "position_max_rad: 0.3",
            ["machine.axes.1.position_max_rad: ", "keys of one kind"],
        ),
        (
            "kp_N_per_m: 12000",
            "kp_Nm_per_rad: 12000",
            ["machine.axes.1.servo.kp_Nm_per_rad: ", "keys of one kind"],
        ),
        ("gear_rad_per_m: 200", "gear: 200", ["machine.axes.1.motor.gear: ", "keys of one kind"]),
        (
            "counts_per_m: 1000000",
            "counts_per_turn: 40000",
            ["machine.axes.1.counts_per_turn: ", "keys of one kind"],
        ),
        (
            "position_min_m: -0.3",
            "position_min_m: 0.4",
            ["machine.axes.1.position_min_m: must be below position_max_m"],
        ),
        ("force_limit_N: 400", "force_limit_N: -4", ["machine.axes.1.force_limit_N: "]),
        ("{offset_m: 0.1, amplitude_m", "{offset_m: 0.1, amplitude_rad", ["offset_m", "rad"]),
        (
            "{offset_m: 0.1, amplitude_m: 0.05}",
            "{offset_rad: 0.1, amplitude_rad: 0.05}",
            ["task.axes.1: is in rad, but q2 moves in m: use offset_m and amplitude_m"],
        ),
        ("offset_m: 0.1", "offset_m: 0.4", ["task.axes.1: ", "q2 would start at 0.4 m, outside"]),
    ],
)
def test_a_mistake_names_the_key(
    load: Callable[..., Config], old: str, new: str, messages: list[str]
) -> None:
    text = with_a_slide()
    assert old in text
    with pytest.raises(ConfigError) as caught:
        load(text.replace(old, new))
    told = str(caught.value)
    assert all(message in told for message in messages)
    assert len(told.splitlines()) == 1


@pytest.mark.parametrize("key", ["position_min_m", "servo", "motor"])
def test_a_rotary_axis_with_one_linear_key(load: Callable[..., Config], key: str) -> None:
    """One such key is enough to say so, wherever it is."""
    value = {
        "position_min_m": "-1",
        "servo": "{kp_N_per_m: 1, kd_Nm_s_per_rad: 1}",
        "motor": "{gear_rad_per_m: 3, torque_constant_Nm_per_A: 1, resistance_ohm: 1, supply_V: 9}",
    }[key]
    with pytest.raises(ConfigError, match="keys of one kind"):
        load(TEXT, f"machine.axes.0.{key}={value}")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["sim.start_rad_or_m=[2.9, 0]"], "q1 would start at 2.9 rad"),
        (["sim.start_rad_or_m=[0, -2.7]"], "q2 would start at -2.7 rad"),
        (["task.axes.0.phase_rad=1.5", "task.axes.0.amplitude_rad=2.5"], "q1 would start at 3.2"),
    ],
)
def test_a_start_outside_of_the_range(
    load: Callable[..., Config], overrides: list[str], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        load(TEXT, *overrides)


def test_a_start_inside_of_the_range_mends_a_task_that_begins_outside(
    load: Callable[..., Config],
) -> None:
    outside = ("task.axes.0.offset_rad=2.9",)
    with pytest.raises(ConfigError):
        load(TEXT, *outside)
    assert load(TEXT, *outside, "sim.start_rad_or_m=[0, 0]").sim.start_rad_or_m == [0, 0]


@pytest.mark.parametrize(
    ("soft", "good"),
    [
        ({"soft_min": -2.8, "soft_max": 2.8}, True),
        ({"soft_min": -2.9}, False),
        ({"soft_max": 2.9}, False),
        ({"soft_min": 1.0, "soft_max": 1.0}, False),
        ({"soft_max": -2.7}, True),
    ],
)
def test_soft_limits_lie_within_the_hard_ones(
    load: Callable[..., Config], soft: dict[str, float], good: bool
) -> None:
    overrides = [f"machine.axes.0.{key}_rad={value}" for key, value in soft.items()]
    if good:
        load(TEXT, *overrides)
    else:
        with pytest.raises(ConfigError, match="soft_min_rad: must be below soft_max_rad"):
            load(TEXT, *overrides)


# What is below the config works in SI at the joint: the same numbers give the same integers.

number = st.floats(1e-2, 1e3)
drives = st.fixed_dictionaries(
    {
        "counts": st.integers(1000, 60_000),
        "position": st.floats(0.1, 10),
        "velocity": st.floats(0.1, 50),
        "acceleration": st.floats(1, 1000),
        "effort": st.floats(0.05, 5000),
        "kp": st.floats(1, 1e4),
        "ki": st.floats(0.1, 1e3),
        "kd": st.floats(0.1, 500),
        "gear": st.floats(1, 300),
    }
)


def both_kinds(d: dict[str, Any]) -> tuple[RotaryAxis, LinearAxis]:
    """The same axis as a hinge and as a slide, in numbers."""
    motor = {"torque_constant_Nm_per_A": 0.06, "resistance_ohm": 2.0, "supply_V": 48.0}
    rotary = RotaryAxis(
        joint="j",
        counts_per_turn=d["counts"],
        position_min_rad=-d["position"],
        position_max_rad=d["position"],
        velocity_limit_rad_per_s=d["velocity"],
        acceleration_limit_rad_per_s2=d["acceleration"],
        torque_limit_Nm=d["effort"],
        motor={"gear": d["gear"], **motor},
        servo={"kp_Nm_per_rad": d["kp"], "ki_Nm_per_rad_s": d["ki"], "kd_Nm_s_per_rad": d["kd"]},
    )
    linear = LinearAxis(
        joint="j",
        counts_per_m=rotary.counts_per_unit,
        position_min_m=-d["position"],
        position_max_m=d["position"],
        velocity_limit_m_per_s=d["velocity"],
        acceleration_limit_m_per_s2=d["acceleration"],
        force_limit_N=d["effort"],
        motor={"gear_rad_per_m": d["gear"], **motor},
        servo={"kp_N_per_m": d["kp"], "ki_N_per_m_s": d["ki"], "kd_N_s_per_m": d["kd"]},
    )
    return rotary, linear


@settings(max_examples=200, deadline=None)
@given(drives)
def test_a_slide_is_a_hinge_in_other_units(d: dict[str, Any]) -> None:
    loop, device = Loop(margin_us=12288), Device()
    outcomes = []
    for axis in both_kinds(d):
        units = AxisUnits.of(axis, loop)
        try:
            servo = device_settings(axis, device, loop, Sync()).servo
            position, torque = position_limits(axis, units), torque_limits(axis, units)
        except ValueError as error:
            told = str(error).replace("_rad_per_s", "_m_per_s").replace("_rad", "_m")
            outcomes.append([told.replace(" rad ", " m ")])
            continue
        names = [name for name in dir(servo) if not name.startswith("_")]
        values = [getattr(servo, name) for name in names]
        scales = [(v.mantissa, v.shift) if hasattr(v, "mantissa") else v for v in values]
        bounds = [
            getattr(limits, bound)
            for limits in (position, torque)
            for bound in ("point_min", "point_max", "difference_max", "second_difference_max")
        ]
        outcomes.append([units, *scales, *bounds])
    assert outcomes[0] == outcomes[1]


@settings(max_examples=300, deadline=None)
@given(st.floats(1e-6, 1e9))
def test_a_torque_quantum_is_the_smallest_power_of_ten_that_fits(effort: float) -> None:
    rotary, _ = both_kinds(
        dict.fromkeys(("position", "velocity", "acceleration", "kp", "ki", "kd", "gear"), 1.0)
        | {"counts": 1000, "effort": effort}
    )
    per_effort = AxisUnits.of(rotary, Loop(margin_us=12288)).tq_per_effort
    assert effort * per_effort <= _core.TORQUE_MAX * (1 + 1e-12)
    assert effort * per_effort * 10 > _core.TORQUE_MAX
    assert math.log10(per_effort) == pytest.approx(round(math.log10(per_effort)), abs=1e-9)


def test_weights_may_differ_by_axis(load: Callable[..., Config]) -> None:
    assert load(TEXT, "mpc.position_weight=[1, 2]").mpc.position_weight == [1.0, 2.0]
    with pytest.raises(ConfigError, match=r"mpc\.torque_step_weight"):
        load(TEXT, "mpc.torque_step_weight=[1, 2, 3]")
    same = load(TEXT, "mpc.torque_start_weight=[20, 20]")
    assert np.all(np.array(same.mpc.torque_start_weight) == load(TEXT).mpc.torque_start_weight)
