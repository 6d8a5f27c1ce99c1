"""What goes wrong around a machine that moves: whatever it is, all axes come to rest, and stay."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
from rig import device_settings

from headway.cli.main import main
from headway.configs.load import ConfigError, load_config
from headway.controller.loop import Loop
from headway.controller.record.columns import Arrays
from headway.controller.record.recorder import Memory
from headway.controller.tick import DeviceError
from headway.devices.core import COAST_KNOTS
from headway.devices.remote import Remote
from headway.models.machine import load_machine
from headway.sim import _board
from headway.sim.lockstep import Lockstep
from headway.sim.mishaps import Mishaps

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
    loop, mpc = lockstep.config.loop, lockstep.config.mpc
    # The plan's end, and two time constants of the servos.
    assert_rests(lockstep, record, (loop.margin_us + mpc.horizon_us) * 1e-6 + 0.1)
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


class Boards:
    """Stands in for the plant and the network."""

    def __init__(self) -> None:
        self.nodes = [_board.Node(np.zeros(_board.NODE_NUMBERS)) for _ in range(2)]
        self.steps: list[tuple[int, int]] = []
        for node in self.nodes:
            node.flash(device_settings())

    def cut(self, devices: set[int]) -> None: ...

    def step_clock(self, true_us: int, step_us: int) -> None:
        self.steps.append((true_us, step_us))

    def at(self, true_us: int) -> list[int]:
        for node in self.nodes:
            node.poll(true_us, 0)
        return [node.system_us(true_us) - true_us for node in self.nodes]  # as nobody has set them


@pytest.mark.parametrize(("joint", "jumps"), [("q2", [0, -700]), (None, [-700, -700])])
def test_a_counter_jumps(joint: str | None, jumps: list[int]) -> None:
    where = f", joint: {joint}" if joint else ""
    change = f"sim.mishaps=[{{kind: clock_step, at_s: 1, step_us: -700{where}}}]"
    boards = Boards()
    mishaps = Mishaps(load_config(ROOT / "configs/arm2.yaml", [change]), boards, boards)  # type: ignore[arg-type]
    assert boards.at(5_000_000) == [0, 0]
    mishaps.happen(5_000_000, 0.99)
    assert boards.at(5_001_000) == [0, 0]
    mishaps.happen(5_001_000, 1.0)
    assert boards.at(5_001_250) == jumps
    mishaps.happen(5_002_000, 1.01)
    assert boards.at(5_002_000) == jumps  # once


@pytest.mark.parametrize("step_us", [-30_000, -1000, 1000, 30_000])
def test_the_hosts_clock_jumps(step_us: int) -> None:
    """Ticks lie on knots before and after, and none is left out; stamps jump as well."""
    change = f"sim.mishaps=[{{kind: host_clock_step, at_s: 0.2, step_us: {step_us}}}]"
    lockstep = Lockstep(
        load_config(ROOT / "configs/arm2.yaml", [change, "duration_s=0.3"]), ROOT / "configs"
    )
    epoch_us, true_us, host_us, stamps_us = lockstep.epoch_us, [], [], []
    receive, tick = lockstep.link.receive, lockstep._host_tick

    def note_receive(now_us: int) -> list[tuple[int, int, bytes]]:
        packets = receive(now_us)
        stamps_us.extend((lockstep.plant.true_us, at_us) for _, at_us, _ in packets)
        return packets

    def note_tick(now_us: int) -> None:
        true_us.append(lockstep.plant.true_us)
        host_us.append(now_us)
        tick(now_us)

    lockstep.link.receive, lockstep._host_tick = note_receive, note_tick  # type: ignore[method-assign]
    with contextlib.suppress(DeviceError):  # what devices and loop make of it is not at stake here
        lockstep.run()
    knot_us = lockstep.config.loop.knot_us
    assert lockstep._begun_us is not None
    assert lockstep.epoch_us == epoch_us + step_us
    epochs_us = np.array(host_us) - np.array(true_us)  # of each tick, but for physics steps
    after = (
        epochs_us > epoch_us + step_us / 2 if step_us > 0 else epochs_us < epoch_us + step_us / 2
    )
    assert np.abs(epochs_us - epoch_us - step_us * after).max() <= lockstep.plant.step_us
    first = int(np.argmax(after))
    assert after[first:].all() and not after[:first].any()
    assert abs(lockstep.elapsed_s(true_us[first]) - 0.2) < 0.004096 + 0.001
    assert all(now_us % knot_us == 0 for now_us in host_us)
    gaps_us, jump_us = np.diff(true_us), lockstep._begun_us + 200_000
    assert np.delete(gaps_us, first - 1).max() <= knot_us + 250
    assert true_us[first - 1] <= jump_us + 1000  # a ms for the mishap to be noticed ...
    assert true_us[first] <= jump_us + 1250 + knot_us  # ... and then the next knot
    late = [
        at_us - seen_us - epoch_us
        for seen_us, at_us in stamps_us
        if seen_us > true_us[first] + 5000
    ]
    assert late and max(late) <= step_us + 250 and min(late) > step_us - 8000


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
        ("sim.mishaps=[{kind: clock_step, at_s: 1}]", "needs a step_us other than 0"),
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
    # The torque that it takes over with is the model's, and friction holds what that lacks: 0.5 to
    # 3.4 mrad over seeds 0 to 5, whatever the network's random numbers are.
    assert np.abs(arrays["truth_position"][begun] - rested).max() < 5e-3
    late = (arrays["truth_s"] > 0.8) & (arrays["truth_s"] < 1.4)
    error = arrays["truth_position"][late] - arrays["truth_reference"][late][:, :2]
    assert np.abs(error).max() < 3e-3
    assert lockstep.device_states() == ["HOLD", "HOLD"]


def test_what_braking_feeds_back_is_burnt() -> None:
    """A bridge of 0.5 mF: its voltage rises to where the chopper works, and no further."""
    changes = ["duration_s=1.5", "sim.bridge_F=0.0005", "task.frequency_Hz=1"]
    lock = Lockstep(load_config(ROOT / "configs" / "arm2.yaml", changes), ROOT / "configs")
    nodes, highest, burnt = lock.plant.nodes, [0.0, 0.0], [0, 0]

    def progress(_: float) -> None:
        for i, node in enumerate(nodes):
            highest[i] = max(highest[i], node.supply_V)
            burnt[i] += node.chopper

    said = ""
    try:
        lock.run(progress)
    except DeviceError as error:
        said = str(error)
    assert said == ""
    assert max(highest) > 54 and max(highest) < 56  # the chopper's 54; OVERVOLTAGE is at 60
    assert min(burnt) > 0
