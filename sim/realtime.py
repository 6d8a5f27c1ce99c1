"""The plant as other processes have it: devices at real wires, in the time of a clock.

True time is the clock's. What arrives at an outlet goes through the simulated network and into the
board; what a board sends comes back the same way. So a frame is under way for what the config says
and for what the real wire takes beyond that.
"""

from __future__ import annotations

import heapq
import select
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from headway.configs.schema import Config
from headway.controller.record.recorder import Recorder
from headway.devices.keys import Keys
from headway.sim.outlet import Outlet
from headway.sim.truth import TRUTH_US, note_truth
from headway.sim.world import World

SLICE_US = 500  # of true time, from look to look at the wires
BURST_US = 10_000  # stepped at most without a look
BEHIND_US = 20_000  # what counts as behind
NOTED_US = 1_000_000  # the record goes on for so long after the last output went off


class Clock(Protocol):
    """What the plant's true time follows."""

    def now_us(self) -> int: ...

    def seconds(self, span_us: int) -> float:
        """How long a span of it takes, to wait."""


class Realtime:
    """A machine's devices and plant, from power-up on. Raises ValueError for mistakes."""

    def __init__(
        self,
        config: Config,
        folder: Path,
        keys: Keys,
        outlets: Sequence[Outlet],
        clock: Clock,
        record: Recorder | None,
    ) -> None:
        """`folder` is where the config's relative paths start; `outlets` by device."""
        world = World(config, folder, keys)
        self.plant, self.link = world.plant, world.link
        self._outlets, self._clock, self._record = list(outlets), clock, record
        self._epoch_us = 0
        self._flying: list[tuple[int, int, int, bytes]] = []  # on their way to boards
        self._number = 0
        self._unknown = np.full(len(config.machine.axes), np.nan)
        self._noted_until_us = -1
        self.behind = 0  # times that the computer was too slow
        self.behind_us = 0  # at worst
        self._late = False
        self.stopping = False

    def run(self) -> None:
        """From power-up until `stopping` is set. Raises UnstableError."""
        self._epoch_us = self.link.epoch_us = self._clock.now_us()
        while not self.stopping:
            self._listen()
            now_us = self._clock.now_us() - self._epoch_us
            self._advance(now_us)
            self._tell(now_us)
            slice_us = self.plant.true_us + SLICE_US + self._epoch_us
            spare_us = min(slice_us, self.link.due_us) - self._clock.now_us()
            select.select(self._outlets, [], [], max(0.0, self._clock.seconds(spare_us)))
        self._note_end()

    def _listen(self) -> None:
        """What has been read came before now: a stamp may be late, never early."""
        for device, outlet in enumerate(self._outlets):
            packets = outlet.read()
            now_us = self._clock.now_us() - self._epoch_us
            for packet in packets:
                for arrival_us in self.link.to_device[device].carry(now_us, len(packet)):
                    self._number += 1
                    heapq.heappush(self._flying, (arrival_us, self._number, device, packet))

    def _advance(self, now_us: int) -> None:
        """Up to now, or as far as one look allows."""
        plant = self.plant
        late_us = now_us - plant.true_us
        if late_us > BEHIND_US:
            self.behind += not self._late
            self.behind_us = max(self.behind_us, late_us)
        self._late = late_us > BEHIND_US
        end_us = min(now_us, plant.true_us + BURST_US)
        while plant.true_us + plant.step_us <= end_us:
            self._deliver(plant.true_us + plant.step_us)
            next_us = (plant.true_us // TRUTH_US + 1) * TRUTH_US
            if self._flying:
                next_us = min(next_us, self._flying[0][0])
            plant.step(max(1, (min(next_us, end_us) - plant.true_us) // plant.step_us))
            if self._record is not None and plant.true_us % TRUTH_US == 0:
                self._note(self._record)

    def _deliver(self, until_us: int) -> None:
        """What arrives by then; a board's inbox holds no more than a board's does."""
        while self._flying and self._flying[0][0] <= until_us:
            arrival_us, _, device, packet = heapq.heappop(self._flying)
            self.plant.nodes[device].deliver(arrival_us, packet)

    def _tell(self, now_us: int) -> None:
        self.link.collect()
        for node, outlet in zip(self.plant.nodes, self._outlets, strict=True):
            outlet.took(node.session, node.received)
        for device, _, packet in self.link.receive(now_us + self._epoch_us):
            self._outlets[device].write(packet)

    def _note(self, record: Recorder) -> None:
        """While there is something to tell: with an output on, and a second beyond."""
        true_us = self.plant.true_us
        if any(node.power for node in self.plant.nodes):
            self._noted_until_us = true_us + NOTED_US
        if true_us <= self._noted_until_us:
            note_truth(record, self.plant, true_us + self._epoch_us, self._unknown)
            record.publish()

    def _note_end(self) -> None:
        if self._record is None:
            return
        statuses = [node.status for node in self.plant.nodes]
        counts = (
            0, 0, 0, 0,
            sum(status.plans_late for status in statuses),
            sum(status.plans_refused for status in statuses),
            [node.state for node in self.plant.nodes],
        )  # fmt: skip
        self._record.add(("end", self.plant.true_us + self._epoch_us, counts))
        self._record.publish()
