"""The simulated network: a channel a direction. Packets wait, queue, are late, lost or doubled."""

from __future__ import annotations

import heapq
from collections.abc import Iterator

import numpy as np

from headway.configs.schema import Channel
from headway.sim.bus import Bus

BLOCK = 512  # packets whose fates are drawn at once: numpy's calls cost more than its numbers


class Wire:
    """One direction to or from one device. Same generator state, same fate of every packet.

    A packet waits for its slot if there are frames, then for those before it while they are sent,
    bit by bit, if there is a bandwidth; then it is under way. All times are true times [us].
    """

    def __init__(self, channel: Channel, rng: np.random.Generator, bus: Bus | None = None) -> None:
        """Raises ValueError for a channel with frames and no bus to have them."""
        if channel.frame_us and bus is None:
            raise ValueError("a channel with frames is one of a bus")
        self._channel, self._rng = channel, rng
        self._bus = bus if channel.frame_us else None
        self.sent = self.lost = self.duplicated = self.last_sent_us = 0
        # Two states (Gilbert, Bell Syst. Tech. J. 39, 1960): a run of lost packets ends with each
        # of them at 1 / its mean length, and begins so often that the share of the lost is as
        # configured. At the length that chance alone gives, both probabilities are the same.
        mean = max(channel.loss_run, 1 / (1 - channel.loss) if channel.loss < 1 else 1.0)
        self._loss_after_loss = 1 - 1 / mean if channel.loss < 1 else 1.0
        self._loss = channel.loss / (mean * (1 - channel.loss)) if channel.loss < 1 else 1.0
        self._burst = False  # the last packet was lost
        self._free_ns = -(2**62)  # when all before has been sent
        self._latest_us = -(2**62)  # arrival of what arrived last
        self._fates = self._draw()

    def carry(self, sent_us: int, size_bytes: int) -> list[int]:
        """Arrival times of a packet sent at `sent_us`: none if it is lost, two if it is doubled,
        in order."""
        c = self._channel
        chance, delay_us, copy_us = next(self._fates)
        self.sent += 1
        self.last_sent_us = sent_us
        if self._bus is not None:
            sent_us = self._bus.leave(sent_us, c.slot_us)
        if c.bandwidth_bit_per_s:
            begin_ns = max(sent_us * 1000, self._free_ns)
            self._free_ns = begin_ns + size_bytes * 8_000_000_000 // c.bandwidth_bit_per_s
            sent_us = -(-self._free_ns // 1000)
        self._burst = chance < (self._loss_after_loss if self._burst else self._loss)
        if self._burst:
            self.lost += 1
            return []
        arrival_us = sent_us + delay_us
        if c.in_order:
            arrival_us = self._latest_us = max(arrival_us, self._latest_us)
        if copy_us < 0:
            return [arrival_us]
        self.duplicated += 1
        again_us = sent_us + copy_us
        if c.in_order:
            again_us = self._latest_us = max(again_us, self._latest_us)
        return [arrival_us, again_us] if again_us >= arrival_us else [again_us, arrival_us]

    def _draw(self) -> Iterator[tuple[float, int, int]]:
        """Without end: the chance that decides about a loss, the delay, and that of a copy or -1.

        A packet has the same chances whatever the channel is, so runs that differ in one of its
        numbers can be compared.
        """
        c = self._channel
        while True:
            chance = self._rng.random((9, BLOCK))
            delay_us = self._delays(*chance[1:4])
            delay_us += np.where(chance[4] < c.reorder, c.reorder_us, 0)
            copy_us = np.where(chance[5] < c.duplicate, self._delays(*chance[6:9]), -1)
            yield from zip(chance[0].tolist(), delay_us.tolist(), copy_us.tolist(), strict=True)

    def _delays(
        self,
        jitter: np.ndarray[tuple[int], np.dtype[np.float64]],
        tail: np.ndarray[tuple[int], np.dtype[np.float64]],
        length: np.ndarray[tuple[int], np.dtype[np.float64]],
    ) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Of shape (n,), from chances of the same shape."""
        c = self._channel
        delay_us = c.delay_us + np.rint((2 * jitter - 1) * c.jitter_us)
        delay_us += np.where(tail < c.tail, np.rint(-c.tail_us * np.log1p(-length)), 0)
        return delay_us.astype(np.int64)


class Mailbox:
    """Packets on their way to the host, handed out in order of arrival."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, int, bytes]] = []
        self._count = 0

    def put(self, arrival_us: int, device: int, packet: bytes) -> None:
        """Adds a packet that arrives at `arrival_us`."""
        heapq.heappush(self._heap, (arrival_us, self._count, device, packet))
        self._count += 1

    @property
    def due_us(self) -> int:
        """When the next packet arrives; far in the future if there is none."""
        return self._heap[0][0] if self._heap else 2**62

    def take(self, now_us: int) -> list[tuple[int, int, bytes]]:
        """(device, arrival_us, packet) of all that arrived up to `now_us`."""
        taken = []
        while self._heap and self._heap[0][0] <= now_us:
            arrival_us, _, device, packet = heapq.heappop(self._heap)
            taken.append((device, arrival_us, packet))
        return taken
