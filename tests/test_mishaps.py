"""What goes wrong around a machine that moves: whatever it is, all axes come to rest, and stay."""

from pathlib import Path

import numpy as np
import pytest

from headway.cli.main import main
from headway.configs.load import ConfigError, load_config
from headway.controller.loop import Loop
from headway.controller.record.columns import Arrays
from headway.controller.record.recorder import Memory
from headway.controller.tick import DeviceError
from headway.devices.core import COAST_KNOTS
from headway.devices.remote import Remote
from headway.models.machine import load_machine
from headway.sim.lockstep import Lockstep

ROOT = Path(__file__).resolve().parent.parent
AT_S = 1.3  # both joints of arm2 move fast


def struck(*changes: str, machine: str = "configs/arm2.yaml") -> tuple[Lockstep, Arrays, str]:
    """A run with a mishap; its record and what the host said in the end."""
    path = ROOT / machine
    lockstep = Lockstep(load_config(path, [f"duration_s={AT_S + 0.4}", *changes]), path.parent)
    said = ""
    try:
        lockstep.run()
    except DeviceError as error:
        said = str(error)
    return lockstep, lockstep.record.arrays(), said


def mishap(kind: str, joint: str = "q1", **more: float) -> str:
    parts = {"kind": kind, "at_s": AT_S, "joint": joint, **more}
    return "sim.mishaps=[{" + ", ".join(f"{key}: {value}" for key, value in parts.items()) + "}]"


def assert_rests(lockstep: Lockstep, record: Arrays, within_s: float) -> None:
    """All axes, inside their limits, and none moves or sags afterwards."""
    after = record["truth_s"] >= AT_S
    time_s, speed = record["truth_s"][after] - AT_S, np.abs(record["truth_velocity"][after])
    position = record["truth_position"][after]
    assert speed[0].min() > 0.5  # it was worth stopping
    assert time_s[np.flatnonzero((speed > 0.02).any(axis=1))[-1]] < within_s
    assert np.ptp(position[time_s > within_s + 0.25], axis=0).max() < 1e-3
    for axis, q in zip(lockstep.config.machine.axes, position.T, strict=True):
        assert axis.position_min < q.min() and q.max() < axis.position_max


@pytest.mark.parametrize("joint", ["q1", "q2"])
@pytest.mark.parametrize(
    ("kind", "more", "state", "words"),
    [
        ("encoder_stuck", {}, "FAULT", "encoder stands still"),
        ("encoder_reversed", {}, "FAULT", "leaving it against its motor"),
        ("encoder_spike", {}, "FAULT", "encoder jumped by"),
        ("supply_sag", {"supply_V": 20}, "FAULT", "the supply is at 20 V, at least 33.6"),
        ("reset", {}, "UNSYNCED", "no longer answers"),
        ("firmware_hangs", {}, "RUNNING", "no longer answers"),
        ("firmware_hangs", {"for_s": 0.03}, "FAULT", "us late, allowed 4000"),
        ("firmware_hangs", {"for_s": 0.3}, "FAULT", "no longer answers"),
        ("partition", {}, "HOLD", "no longer answers"),
    ],
)
def test_one_board(joint: str, kind: str, more: dict[str, float], state: str, words: str) -> None:
    """It stops in its own way, the other ends its plan."""
    lockstep, record, said = struck(mishap(kind, joint, **more))
    axis = ("q1", "q2").index(joint)
    states = lockstep.device_states()
    assert states[axis] == state and states[1 - axis] == "HOLD"
    assert f"{joint}: " in said and words in said
    assert_rests(lockstep, record, 0.6)


def test_emergency_line() -> None:
    lockstep, record, said = struck(f"sim.mishaps=[{{kind: emergency_stop, at_s: {AT_S}}}]")
    assert lockstep.device_states() == ["ESTOP", "ESTOP"]
    assert "q1: the emergency line is open" in said
    assert_rests(lockstep, record, 0.56)
    for node in lockstep.plant.nodes:
        assert node.brake and not node.power


def test_hung_boards_are_braked_by_their_guards() -> None:
    """All of them at once, for ever: nobody but their timers is left to stop the machine."""
    lockstep, record, said = struck(f"sim.mishaps=[{{kind: firmware_hangs, at_s: {AT_S}}}]")
    assert lockstep.device_states() == ["RUNNING", "RUNNING"] and "no longer answers" in said
    assert_rests(lockstep, record, 0.1)
    for node in lockstep.plant.nodes:
        assert node.tripped and node.brake and not node.power and node.duty_q15 == 0


def test_killed_host_takes_both_axes_to_rest_together() -> None:
    lockstep, record, said = struck(f"sim.kill_host_at_s={AT_S}")
    assert said == "" and lockstep.device_states() == ["HOLD", "HOLD"]
    assert_rests(lockstep, record, 0.25)
    moving = record["servo_setpoint_rate_pq"] != 0
    last_s = [record["truth_s"][np.flatnonzero(axis)[-1]] for axis in moving.T]
    assert abs(last_s[0] - last_s[1]) <= 0.004


def test_a_short_partition_stops_nobody() -> None:
    """Two frames: more than what the margin bridges, less than it takes to come to rest."""
    _, record, said = struck(mishap("partition", for_s=0.008))
    assert said == "" and record["tick_s"][-1] > AT_S + 0.35
    assert np.abs(record["truth_velocity"][record["truth_s"] < AT_S + 0.3]).max() > 0.5
    assert record["tick_accepted"][-20:].all()


def test_an_overload_is_no_broken_encoder() -> None:
    """A reference that asks for more torque than there is: the axis lags, on its way."""
    _, record, said = struck("task.frequency_Hz=0.8")
    assert record["servo_torque_tq"][:, 0].max() >= 11_999_000  # the limit is 12 Nm
    assert said == "" or "following error" in said


@pytest.mark.parametrize("method", ["index", "switch"])
@pytest.mark.parametrize("backwards", ["false", "true"])
def test_a_machine_that_has_to_be_homed(method: str, backwards: str) -> None:
    """Its encoder starts anywhere; the start-up finds the mark, and the task runs as ever."""
    mark = -0.01 if backwards == "true" else 0.01  # within a turn: the first index pulse on the way
    homing = (
        f"machine.axes.0.homing={{method: {method}, backwards: {backwards}, mark_m: {mark}, "
        "speed_m_per_s: 0.05, force_N: 20, way_m: 0.1}"
    )
    lockstep, record, said = struck(homing, "duration_s=2.5", machine="tests/cart/cart.yaml")
    assert said == "" and all(node.status.homed for node in lockstep.plant.nodes)
    assert abs(lockstep.plant.nodes[0].encoder_offset) > 100  # it did not know by chance
    error = record["now_estimate"][50:, 0] - record["actual_position"][50:, 0]
    # A pulse is stamped with its count; a switch is seen up to a period of the search later.
    assert abs(np.median(error)) < (1e-5 if method == "index" else 1e-4)


def test_a_search_without_a_mark_ends() -> None:
    homing = (
        "machine.axes.0.homing={method: switch, mark_m: 0.4, speed_m_per_s: 0.05, force_N: 20, "
        "way_m: 0.02}"
    )
    lockstep, _, said = struck(homing, machine="tests/cart/cart.yaml")
    assert said == "x: the device stopped: no mark within 4000 counts"
    assert lockstep.device_states()[0] == "HOLD"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            "sim.mishaps=[{kind: reset, at_s: 1, joint: q9}]",
            "joint: is q9; the machine's joints are",
        ),
        ("sim.mishaps=[{kind: fire, at_s: 1}]", "kind"),
        ("device.torque_gap=zero", "would drop q1, q2"),
        ("device.position_gap=hold", "position_gap"),
    ],
)
def test_mistakes(change: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match=words):
        load_config(ROOT / "configs/arm2.yaml", [change])
    assert main(["check", str(ROOT / "configs/arm2.yaml"), "--set", change]) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_another_host_takes_over_a_resting_machine() -> None:
    """The first one dies, the devices hold; the next greets them, and nothing sags on the way."""
    lockstep, _, _ = struck(f"sim.kill_host_at_s={AT_S}")
    rested = lockstep.plant.position.copy()
    path = ROOT / "configs/arm2.yaml"
    lockstep.config = config = load_config(path, ["duration_s=1.5"])
    sessions = [remote._session for remote in lockstep.remotes]
    for session in sessions:
        session.renew()
    patience_us = COAST_KNOTS * config.loop.knot_us
    lockstep.remotes = [Remote(session, patience_us) for session in sessions]
    machine = load_machine(path.parent / config.machine.model)
    lockstep.record = record = Memory()
    lockstep.loop = Loop(config, machine, lockstep.remotes, lockstep.reference, record)
    lockstep.run()
    arrays = record.arrays()
    begun = arrays["truth_s"] < 0.02  # as the first plan begins
    assert np.abs(arrays["truth_position"][begun] - rested).max() < 1e-3
    late = (arrays["truth_s"] > 0.8) & (arrays["truth_s"] < 1.4)
    error = arrays["truth_position"][late] - arrays["truth_reference"][late][:, :2]
    assert np.abs(error).max() < 3e-3
    assert lockstep.device_states() == ["HOLD", "HOLD"]
