"""Cables between the boards of a machine: who is asked at which port, and what that is good for."""

from pathlib import Path

import numpy as np
import pytest

from headway.configs.load import ConfigError, load_config
from headway.configs.schema import Channel
from headway.controller.settling import Settling
from headway.devices.settings import device_settings
from headway.sim.lockstep import Lockstep
from headway.sim.network import Wire
from headway.sim.plant_clock import PlantClock
from headway.sim.world import World

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
CABLE = "{joints: [q1, q2], ports: [1, 3]}"
CHANGES = [f"sync.cables=[{CABLE}]", "sync.ask_us=20000", "sync.cable_least_us=1900"]
CHANGES += ["sync.limit_us=5000"]


def test_a_board_asks_where_its_cables_are() -> None:
    config = load_config(CONFIGS / "arm2.yaml", CHANGES)
    first, second = (
        device_settings(axis, config.device, config.loop, config.sync)
        for axis in config.machine.axes
    )
    assert (first.neighbours, second.neighbours) == (0b10, 0b1000)
    for settings in (first, second):
        assert (settings.ask_us, settings.peer_least_us) == (20_000, 1900)
        assert settings.valid
    none = load_config(CONFIGS / "arm2.yaml")
    alone = device_settings(none.machine.axes[0], none.device, none.loop, none.sync)
    assert alone.neighbours == 0 and alone.valid


@pytest.mark.parametrize(
    ("cables", "told"),
    [
        ("{joints: [q1, q9], ports: [1, 1]}", "sync.cables.0.joints: has q9"),
        ("{joints: [q1, q1], ports: [1, 2]}", "sync.cables.0: joins q1 with itself"),
        (
            f"{CABLE}, {{joints: [q2, q1], ports: [3, 2]}}",
            "at port 3 of q2, and so is sync.cables.0",
        ),
        ("{joints: [q1, q2], ports: [0, 1]}", "sync.cables.0.ports.0"),
        ("{joints: [q1, q2], ports: [5, 1]}", "sync.cables.0.ports.0"),
        ("{joints: [q1], ports: [1, 1]}", "sync.cables.0.joints"),
    ],
)
def test_mistakes(cables: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told.replace(".", r"\.")):
        load_config(CONFIGS / "arm2.yaml", [f"sync.cables=[{cables}]"])


def watched(*changes: str) -> tuple[World, Settling]:
    config = load_config(CONFIGS / "arm2.yaml", [*changes])
    world = World(config, CONFIGS)
    names = [axis.joint for axis in config.machine.axes]
    clock = PlantClock(world)
    return world, Settling(names, config.loop.knot_us, world.remotes, world.link, clock)


@pytest.mark.parametrize("cabled", [True, False])
def test_by_a_cable_a_board_keeps_the_time_that_the_host_does_not_tell(cabled: bool) -> None:
    """All of a board's frames to and from the host get lost: its neighbour has the time, too."""
    world, settling = watched(*(CHANGES if cabled else []))
    settling.run(2.0)
    nodes = world.plant.nodes
    assert [node.synced for node in nodes] == [True, True]
    dead = Wire(Channel(loss=1.0), np.random.default_rng(0))
    world.link.to_device[1] = world.link.to_host[1] = dead
    for _ in range(40):
        settling.run(0.1)
        error_us = nodes[1].system_us(world.plant.true_us) - world.plant.true_us
        error_us -= world.link.epoch_us
        least, most = nodes[1].error_ns
        if nodes[1].synced:
            assert least / 1000 - 2 < error_us < most / 1000 + 2
    assert nodes[0].synced and nodes[0].excluded == 0
    assert nodes[1].excluded == 0
    assert (nodes[1].state == nodes[0].state) == cabled
    assert sum(node.dropped for node in nodes) == 0


def test_a_machine_with_a_cable_runs() -> None:
    changes = [*CHANGES, "duration_s=0.5"]
    lockstep = Lockstep(load_config(CONFIGS / "arm2.yaml", changes), CONFIGS)
    lockstep.run()
    assert lockstep.device_states() == ["HOLD", "HOLD"]
    for node in lockstep.plant.nodes:
        assert (node.status.frames_bad, node.excluded) == (0, 0)
