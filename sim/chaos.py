"""What goes wrong on real wires, made to order: between a controller and its devices, by seed.

Each device's wire is cut in two: a port on the device's side, an outlet on the controller's. What
is read at one end is written at the other, after what a channel of the simulated network does to it
(network.py), and what is here: flipped bits, and times in which nothing passes.
"""

from __future__ import annotations

import heapq
import select
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from headway.configs.schema import Channel
from headway.devices.port import Port
from headway.firmware import _core
from headway.sim.network import Wire
from headway.sim.outlet import Outlet
from headway.sim.realtime import Clock

LOOK_US = 100_000  # at most from look to look
FOREVER_US = 2**62


@dataclass(frozen=True)
class Trouble:
    """Beyond what a channel does."""

    corrupt: float = 0.0  # share of packets in which a bit is flipped
    partition_every_us: int = 0  # on average, from the end of one to the next; 0: none
    partition_us: int = 100_000  # how long nothing passes


class Chaos:
    """All wires of a machine. What is counted: passed, lost, corrupted, cut."""

    def __init__(
        self,
        ports: Sequence[Port],
        outlets: Sequence[Outlet],
        channel: Channel,
        trouble: Trouble,
        clock: Clock,
        rng: np.random.Generator,
    ) -> None:
        """`ports` and `outlets` by device. Raises ValueError for a channel with frames of a bus."""
        self._ports, self._outlets = list(ports), list(outlets)
        self._ends = [port.fileno() for port in ports] + [outlet.fileno() for outlet in outlets]
        self._clock, self._trouble = clock, trouble
        streams = rng.spawn(2 * len(self._ports) + 2)
        self._wires = [Wire(channel, stream) for stream in streams[:-2]]
        self._bits, self._cuts = streams[-2:]
        self._pending: list[tuple[int, int, int, bool, bytes]] = []
        self._number = 0
        self._cut_from_us = FOREVER_US
        self.passed = self.lost = self.corrupted = self.cut = 0
        self.stopping = False

    def run(self) -> None:
        """Until `stopping` is set. Raises PortError when a device's port has gone."""
        self._plan_cut(self._clock.now_us())
        while not self.stopping:
            due_us = self._pending[0][0] if self._pending else FOREVER_US
            wait_us = max(0, min(due_us - self._clock.now_us(), LOOK_US))
            select.select(self._ends, [], [], self._clock.seconds(wait_us))
            for device, (port, outlet) in enumerate(zip(self._ports, self._outlets, strict=True)):
                for packet in outlet.read():
                    self._follow(outlet, packet)
                    self._take(device, True, packet, self._clock.now_us())
                for packet in port.read():
                    self._take(device, False, packet, self._clock.now_us())
            self._deliver(self._clock.now_us())

    def _follow(self, outlet: Outlet, packet: bytes) -> None:
        """Here nobody can tell who is authentic: answers go to who spoke last."""
        header = _core.frame_header(packet)
        if header is not None and header[1] != _core.FRAME_HELLO:
            outlet.took(*header[2:])

    def _take(self, device: int, to_device: bool, packet: bytes, now_us: int) -> None:
        if self._partitioned(now_us):
            self.cut += 1
            return
        arrivals = self._wires[2 * device + to_device].carry(now_us, len(packet))
        self.lost += not arrivals
        for arrival_us in arrivals:
            self._number += 1
            broken = self._broken(packet)
            heapq.heappush(self._pending, (arrival_us, self._number, device, to_device, broken))

    def _broken(self, packet: bytes) -> bytes:
        if not packet or self._bits.random() >= self._trouble.corrupt:
            return packet
        self.corrupted += 1
        bytes_ = bytearray(packet)
        bit = int(self._bits.integers(8 * len(packet)))
        bytes_[bit // 8] ^= 1 << bit % 8
        return bytes(bytes_)

    def _partitioned(self, now_us: int) -> bool:
        until_us = self._cut_from_us + self._trouble.partition_us
        if now_us >= until_us:
            self._plan_cut(until_us)
        return self._cut_from_us <= now_us < self._cut_from_us + self._trouble.partition_us

    def _plan_cut(self, after_us: int) -> None:
        """When the next time begins in which nothing passes."""
        if self._trouble.partition_every_us:
            pause_us = self._cuts.exponential(self._trouble.partition_every_us)
            self._cut_from_us = after_us + round(pause_us)

    def _deliver(self, now_us: int) -> None:
        while self._pending and self._pending[0][0] <= now_us:
            _, _, device, to_device, packet = heapq.heappop(self._pending)
            self.passed += 1
            if to_device:
                self._ports[device].write(packet)
            else:
                self._outlets[device].write(packet)
