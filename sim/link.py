"""The simulated network as the loop sees it, cables between boards, and the host's clock."""

from __future__ import annotations

import numpy as np

from headway.configs.schema import Config
from headway.sim.bus import Bus
from headway.sim.network import Mailbox, Wire
from headway.sim.plant import Plant
from headway.sim.profiles import profile_of


class SimLink:
    """Carries packets between the host and the boards of a plant."""

    def __init__(
        self, config: Config, plant: Plant, epoch_us: int, seeds: list[np.random.Generator]
    ):
        """`epoch_us`: the host's time at true time 0; `seeds`: two for each board, and one."""
        n = len(plant.nodes)
        self._cut: set[int] = set()
        self._plant, self._mailbox = plant, Mailbox()
        self.epoch_us = epoch_us
        self._stamped: list[tuple[int, int, bytes]] = []  # arrived before the clock jumped
        to_device, to_host = profile_of(config.sim)
        frame_us = to_device.frame_us or to_host.frame_us
        self.bus = Bus.of(frame_us, seeds[2 * n]) if frame_us else None
        self.to_device = [Wire(to_device, rng, self.bus) for rng in seeds[:n]]
        self.to_host = [Wire(to_host, rng, self.bus) for rng in seeds[n : 2 * n]]
        # By board and port: the same at the other end, and the wire there. It is like a board's
        # from the host, as it ends at a board, too.
        joints = [axis.joint for axis in config.machine.axes]
        self._cables: dict[tuple[int, int], tuple[int, int, Wire]] = {}
        for cable in config.sync.cables:
            (a, b), (here, there) = map(joints.index, cable.joints), cable.ports
            out, back = (Wire(to_device, rng, self.bus) for rng in seeds[2 * n].spawn(2))
            self._cables |= {(a, here): (b, there, out), (b, there): (a, here, back)}

    def count_anew(self) -> None:
        """From here on, frames are counted from zero."""
        for wire in (*self.to_device, *self.to_host):
            wire.sent = wire.lost = wire.duplicated = 0

    def cut(self, devices: set[int]) -> None:
        """No packet passes to or from these devices."""
        self._cut = devices

    def step_clock(self, true_us: int, step_us: int) -> None:
        """The host's clock jumps at a true time. What has arrived by then keeps its stamp."""
        self.collect()
        self._stamped = self.receive(true_us + self.epoch_us)
        self.epoch_us += step_us

    def collect(self) -> None:
        """Puts what the devices have sent on its way, to the host and to each other."""
        for device, node in enumerate(self._plant.nodes):
            for sent_us, packet in node.collect():
                for arrival_us in self.to_host[device].carry(sent_us, len(packet)):
                    if device not in self._cut:
                        self._mailbox.put(arrival_us, device, packet)
        for (device, port), (other, its_port, wire) in self._cables.items():
            for sent_us, packet in self._plant.nodes[device].collect(port):
                for arrival_us in wire.carry(sent_us, len(packet)):
                    if not {device, other} & self._cut:
                        self._plant.nodes[other].deliver(arrival_us, packet, its_port)

    @property
    def due_us(self) -> int:
        """When the next packet arrives at the host, in the host's time."""
        return self._mailbox.due_us + self.epoch_us

    def receive(self, now_us: int) -> list[tuple[int, int, bytes]]:
        """(device, received_us, packet) of all that has arrived, in the host's time."""
        arrived = self._mailbox.take(now_us - self.epoch_us)
        stamped, self._stamped = self._stamped, []
        return stamped + [
            (device, at_us + self.epoch_us, packet) for device, at_us, packet in arrived
        ]

    def send(self, device: int, packet: bytes, now_us: int) -> None:
        """Sends a packet at a time of the host's."""
        for arrival_us in self.to_device[device].carry(now_us - self.epoch_us, len(packet)):
            if device not in self._cut:
                self._plant.nodes[device].deliver(arrival_us, packet)
