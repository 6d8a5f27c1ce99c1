"""Clocks that jump while a machine moves: a board's counter, or the host's clock, set by somebody.

Nothing armed jumps with them. What contradicts what was proven before is excluded; a jump that is
within what stamps can tell apart changes nothing; any other ends in rest, by the reason CLOCK."""

from pathlib import Path

import numpy as np
import pytest

from headway.configs.load import load_config
from headway.controller.tick import DeviceError
from headway.sim.lockstep import Lockstep

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
AT_S = 0.8
CLOCK = "its clock may be off by more than sync.limit_us"


def run(kind: str, step_us: int) -> tuple[Lockstep, str]:
    joint = "" if kind == "host_clock_step" else ", joint: q1"
    mishap = f"sim.mishaps=[{{kind: {kind}, at_s: {AT_S}, step_us: {step_us}{joint}}}]"
    lockstep = Lockstep(load_config(CONFIGS / "arm2.yaml", [mishap, "duration_s=1.6"]), CONFIGS)
    try:
        lockstep.run()
    except DeviceError as error:
        return lockstep, str(error)
    return lockstep, ""


def nobody_jumps(lockstep: Lockstep) -> None:
    """After the mishap the true motion is as smooth as a plan or a stop, and ends."""
    arrays = lockstep.record.arrays()
    time_us, velocity = arrays["truth_us"], arrays["truth_velocity"]
    steps = np.abs(np.diff(velocity, axis=0)) / 1e-3
    one_ms = np.diff(time_us) == 1000  # the host's time, which has jumped
    limits = [axis.acceleration_limit for axis in lockstep.config.machine.axes]
    assert (steps[one_ms] <= limits).all()
    # At rest: an axis that creeps in its friction gets a blow of a millisecond at each count.
    assert np.abs(velocity[-100:]).max() < 0.02
    assert np.ptp(arrays["truth_position"][-100:], axis=0).max() < 1e-4
    for axis, position in zip(
        lockstep.config.machine.axes, arrays["truth_position"].T, strict=True
    ):
        assert axis.position_min < position.min() and position.max() < axis.position_max


@pytest.mark.parametrize("kind", ["clock_step", "host_clock_step"])
@pytest.mark.parametrize("step_us", [40, -40])
def test_a_jump_within_what_is_told_is_taken_smoothly(kind: str, step_us: int) -> None:
    lockstep, said = run(kind, step_us)
    assert said == ""
    nobody_jumps(lockstep)
    assert lockstep.device_states() == ["HOLD", "HOLD"]


@pytest.mark.parametrize("kind", ["clock_step", "host_clock_step"])
@pytest.mark.parametrize("step_us", [300, -300, -5000])
def test_any_other_brings_the_machine_to_rest(kind: str, step_us: int) -> None:
    lockstep, said = run(kind, step_us)
    assert CLOCK in said
    nobody_jumps(lockstep)
    assert lockstep.device_states() == ["HOLD", "HOLD"]
    excluded = lockstep.record.arrays()["received_stamps_excluded"]
    assert excluded[:100].max() == 0 and excluded.max() >= 16


def test_a_counter_that_jumps_ahead_is_a_late_servo() -> None:
    """Five periods seem to have been missed: only the brake is safe then."""
    lockstep, said = run("clock_step", 5000)
    assert "its servo ran" in said and "us late" in said
    assert lockstep.device_states() == ["FAULT", "HOLD"]


@pytest.mark.parametrize("step_us", [5000, 1_000_000_000])
def test_a_host_set_ahead(step_us: int) -> None:
    """By a thousand seconds the host no longer knows what it has heard last."""
    lockstep, said = run("host_clock_step", step_us)
    assert CLOCK in said or "the device no longer answers" in said
    nobody_jumps(lockstep)
    assert lockstep.device_states() == ["HOLD", "HOLD"]
