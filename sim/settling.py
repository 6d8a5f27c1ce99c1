"""A machine whose boards get stamps and nothing else, until their clocks have settled."""

from __future__ import annotations

from pathlib import Path

from headway.configs.schema import Config
from headway.controller.settle import Settle
from headway.devices.clock import ClockState
from headway.sim.world import World


class Settling:
    """The host says hello and sends stamps, one frame a knot. Raises ValueError for mistakes."""

    def __init__(self, config: Config, folder: Path) -> None:
        """`folder` is where the config's relative paths start."""
        self._world = World(config, folder)
        joints = [axis.joint for axis in config.machine.axes]
        self._settle = Settle(joints, self._world.remotes)
        self._knot_us = config.loop.knot_us
        self._now_us = self._world.link.epoch_us + self._world.plant.true_us
        self._began_us = self._now_us

    @property
    def time_s(self) -> float:
        """Since power-up."""
        return (self._now_us - self._began_us) * 1e-6

    @property
    def settled_s(self) -> float:
        """For how long all clocks have stayed settled; below 0: they are not."""
        return self._settle.settled_us(self._now_us) * 1e-6

    def unsettled(self) -> list[str]:
        """Who is not settled, and why."""
        return self._settle.unsettled(self._now_us)

    def run(self, duration_s: float) -> list[ClockState]:
        """Goes on for so long; returns how each clock is then."""
        states = []
        for _ in range(max(1, round(duration_s * 1e6 / self._knot_us))):
            states = self._tick()
        return states

    def _tick(self) -> list[ClockState]:
        plant, link, remotes = self._world.plant, self._world.link, self._world.remotes
        self._now_us += self._knot_us
        ahead_us = self._now_us - link.epoch_us - plant.true_us
        plant.step(-(-ahead_us // plant.step_us))
        link.collect()
        for device, received_us, packet in link.receive(self._now_us):
            remotes[device].receive(packet, received_us)
        for device, remote in enumerate(remotes):
            for packet in remote.stamp_packets(self._now_us):
                link.send(device, packet, self._now_us)
        return self._settle.tick(self._now_us)
