"""The simulated network: one channel a direction, with delay, jitter, loss and reordering."""

from __future__ import annotations

import heapq

import numpy as np

from headway.configs.schema import Channel


class Wire:
    """One direction to or from one device. Same generator state, same fate of every packet."""

    def __init__(self, channel: Channel, rng: np.random.Generator) -> None:
        self._channel, self._rng = channel, rng
        self.sent = self.lost = self.last_sent_us = 0
        # Two states (Gilbert, Bell Syst. Tech. J. 39, 1960): a run of lost packets ends with each
        # of them at 1 / its mean length, and begins so often that the share of the lost is as
        # configured. At the length that chance alone gives, both probabilities are the same.
        mean = max(channel.loss_run, 1 / (1 - channel.loss) if channel.loss < 1 else 1.0)
        self._loss_after_loss = 1 - 1 / mean if channel.loss < 1 else 1.0
        self._loss = channel.loss / (mean * (1 - channel.loss)) if channel.loss < 1 else 1.0
        self._burst = False  # the last packet was lost

    def carry(self, sent_us: int) -> int | None:
        """Arrival time of a packet sent at `sent_us`, or None if it is lost."""
        c = self._channel
        lost, late, jitter = self._rng.random(3).tolist()
        self.sent += 1
        self.last_sent_us = sent_us
        self._burst = lost < self._loss_after_loss if self._burst else lost < self._loss
        if self._burst:
            self.lost += 1
            return None
        delay_us: int = c.delay_us + round((2 * jitter - 1) * c.jitter_us)
        return sent_us + delay_us + (c.reorder_us if late < c.reorder else 0)


class Mailbox:
    """Packets on their way to the host, handed out in order of arrival."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, int, bytes]] = []
        self._count = 0

    def put(self, arrival_us: int, device: int, packet: bytes) -> None:
        """Adds a packet that arrives at `arrival_us`."""
        heapq.heappush(self._heap, (arrival_us, self._count, device, packet))
        self._count += 1

    def take(self, now_us: int) -> list[tuple[int, int, bytes]]:
        """(device, arrival_us, packet) of all that arrived up to `now_us`."""
        taken = []
        while self._heap and self._heap[0][0] <= now_us:
            arrival_us, _, device, packet = heapq.heappop(self._heap)
            taken.append((device, arrival_us, packet))
        return taken
