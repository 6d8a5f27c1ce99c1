"""Feed-forward along the position track: what it buys, when it is taken, where it has no place."""

from pathlib import Path

import numpy as np
import pytest

from headway.configs.load import ConfigError, load_config
from headway.configs.schema import Config
from headway.devices.axis import AxisUnits
from headway.devices.settings import device_settings
from headway.firmware import _core
from headway.sim.lockstep import Lockstep

CART = Path(__file__).resolve().parent / "cart" / "cart.yaml"
BARE = ("mpc.enabled=false", "mpc.feedforward=none", "duration_s=3")
# The slide's mass with what it carries, and its friction: cart.xml's own numbers.
MASS_KG, DAMPING = 5.0, 10.0
GAINS = (
    f"machine.axes.0.servo.acceleration_N_s2_per_m={MASS_KG}",
    f"machine.axes.0.servo.velocity_N_s_per_m={DAMPING}",
)


def config(*overrides: str) -> Config:
    return load_config(CART, list(overrides))


def worst_m(*overrides: str) -> float:
    """The largest distance of the slide from its reference, once it is under way."""
    lock = Lockstep(config(*BARE, *overrides), CART.parent)
    lock.run()
    record = lock.record.arrays()
    under_way = (record["truth_s"] > 1) & (record["truth_s"] < 2.9)
    error = (record["truth_position"] - record["truth_reference"])[under_way, 0]
    return float(np.abs(error).max())


def test_with_the_mass_and_the_friction_known_little_is_left_to_follow() -> None:
    without = worst_m()
    only_friction = worst_m(GAINS[1])
    both = worst_m(*GAINS)
    assert both < only_friction < without
    assert both < without / 5  # the hinge, which turns as well, is nobody's here
    assert worst_m(*GAINS, "machine.axes.0.servo.ahead_us=4000") > 1.5 * both


def scaled(scale: _core.Scale, value: float) -> float:
    return scale.mantissa * value / 2.0**scale.shift


def test_a_gain_is_effort_by_what_the_track_does() -> None:
    made = config(*BARE, *GAINS)
    axis = made.machine.driven[0]
    units = AxisUnits.of(axis, made.loop)
    servo = device_settings(axis, made.device, made.loop, made.sync).servo
    knot_s = made.loop.knot_us * 1e-6
    speed_pq = 0.7 * units.pq_per_unit * knot_s  # of 0.7 m/s, in a knot
    curve_pq = 3.1 * units.pq_per_unit * knot_s**2
    assert scaled(servo.velocity_tq, speed_pq) / units.tq_per_effort == pytest.approx(
        0.7 * DAMPING, rel=1e-4
    )
    assert scaled(servo.acceleration_tq, curve_pq) / units.tq_per_effort == pytest.approx(
        3.1 * MASS_KG, rel=1e-4
    )


def test_it_leads_by_half_a_period_or_as_told() -> None:
    def ahead_us(*overrides: str) -> int:
        made = config(*overrides)
        axis = made.machine.driven[0]
        return device_settings(axis, made.device, made.loop, made.sync).servo.ahead_us

    assert ahead_us() == 500
    assert ahead_us("device.servo_period_us=250") == 125
    assert ahead_us("machine.axes.0.servo.ahead_us=0") == 0
    assert ahead_us("machine.axes.0.servo.ahead_us=1700") == 1700


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            GAINS[:1],
            r"axes.0.servo.acceleration_N_s2_per_m:? would add to the effort that is planned",
        ),
        (
            (*GAINS[1:], "mpc.enabled=false"),
            r"axes.0.servo.velocity_N_s_per_m:? would add .* mpc.feedforward: none",
        ),
        (
            ("machine.axes.1.servo.ahead_us=4097",),
            r"axes.1.servo.ahead_us:? is 4097; .* at most loop.knot_us = 4096",
        ),
    ],
)
def test_what_does_not_fit_is_refused(overrides: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        config(*overrides)


def test_a_gain_that_no_scale_holds_is_named() -> None:
    made = config(*BARE, "machine.axes.0.servo.acceleration_N_s2_per_m=1e12")
    axis = made.machine.driven[0]
    with pytest.raises(ValueError, match=r"x: servo.acceleration_N_s2_per_m is 1e\+12; .* 0, or"):
        device_settings(axis, made.device, made.loop, made.sync)
