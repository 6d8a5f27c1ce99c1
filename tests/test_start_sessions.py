"""The loop's first phase: a session with every device, or an error that says what is wrong."""

from pathlib import Path

import pytest

from headway.configs.load import load_config
from headway.controller.tick import DeviceError, Phase
from headway.firmware import _core
from headway.sim.lockstep import Lockstep

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
JOINTS = ["q1", "q2"]


def powered_up(*overrides: str) -> Lockstep:
    return Lockstep(load_config(CONFIGS / "arm2.yaml", ["duration_s=0.1", *overrides]), CONFIGS)


def set_up_with_another_key(lockstep: Lockstep, device: int) -> None:
    node = lockstep.plant.nodes[device]
    settings = node.settings
    settings.key = bytes(16)
    node.flash(settings)


def damage(lockstep: Lockstep, devices: set[int]) -> None:
    """A flipped bit in every packet from these devices."""
    receive = lockstep.link.receive

    def noisy(now_us: int) -> list[tuple[int, int, bytes]]:
        packets = []
        for device, received_us, packet in receive(now_us):
            flipped = packet[:-3] + bytes([packet[-3] ^ 2]) + packet[-2:]
            packets.append((device, received_us, flipped if device in devices else packet))
        return packets

    lockstep.link.receive = noisy  # type: ignore[method-assign]


def test_every_device_gets_a_session_of_its_own() -> None:
    lockstep = powered_up()
    assert lockstep.loop.phase is Phase.HELLO
    lockstep.run()
    sessions = [node.session for node in lockstep.plant.nodes]
    assert None not in sessions and len(set(sessions)) == len(JOINTS)


def test_sessions_are_a_function_of_the_seed() -> None:
    numbers = []
    for seed in (3, 3, 4):
        lockstep = powered_up(f"seed={seed}")
        lockstep.run()
        numbers.append([node.session for node in lockstep.plant.nodes])
    assert numbers[0] == numbers[1] != numbers[2]


@pytest.mark.parametrize("device", [0, 1])
@pytest.mark.parametrize("what", ["wrong key", "line noise", "no answer"])
def test_the_error_names_the_joint_and_says_what(device: int, what: str) -> None:
    lockstep = powered_up()
    if what == "wrong key":
        set_up_with_another_key(lockstep, device)
    elif what == "line noise":
        damage(lockstep, {device})
    else:
        lockstep.link.cut({device})
    with pytest.raises(DeviceError, match=f"^{JOINTS[device]}: {what}[^;]*$"):
        lockstep.run()


def test_all_that_is_wrong_is_said_at_once() -> None:
    lockstep = powered_up()
    set_up_with_another_key(lockstep, 0)
    lockstep.link.cut({1})
    with pytest.raises(DeviceError, match=r"^q1: wrong key.*; q2: no answer"):
        lockstep.run()


def test_a_lossy_wire_takes_longer_and_succeeds() -> None:
    lockstep = powered_up("sim.to_device.loss=0.3", "sim.to_host.loss=0.3")
    while lockstep.loop.phase is Phase.HELLO:
        now_us = lockstep.epoch_us + lockstep.plant.true_us
        lockstep._advance_to(now_us - lockstep.epoch_us + lockstep.config.loop.knot_us)
        lockstep._host_tick(now_us)
    assert all(node.session is not None for node in lockstep.plant.nodes)
    assert all(_core.STATES[node.state] == "UNSYNCED" for node in lockstep.plant.nodes)
