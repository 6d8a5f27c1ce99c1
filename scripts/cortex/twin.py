"""A simulated node, and beside it the same device on the emulated core.

The core takes the device's state over, byte by byte, and from then on lives through the same polls:
the state and all that is sent stay the same, or a poll raises Different.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from emulator import Emulator, Tally
from numpy.typing import NDArray

from headway.sim import _board

PACKET, PACKETS = 1112, 8  # board.c
HEAD = struct.Struct("<IiiiiiIIQ")  # struct board, up to its packets


class Different(Exception):
    """The two have not lived the same."""


class Twin:
    """Stands in for a `_board.Node` whose array is `memory` and whose board has `counter`."""

    def __init__(
        self, node: _board.Node, memory: NDArray[np.float64], counter: _board.Oscillator,
        core: Emulator,
    ) -> None:  # fmt: skip
        self._node, self._memory, self._counter, self._core = node, memory, counter, core
        sizes = struct.unpack("<3I", core.read(core.address("the_sizes"), 12))
        self._size, self._board = sizes[0], core.address("the_board")
        if sizes[1:] != (HEAD.size + 2 * PACKETS * PACKET, PACKET):
            raise ValueError(f"board.c lays its structs out otherwise: {sizes}")
        core.write(core.address("the_device"), self._state())
        self._waiting: list[tuple[int, int, bytes]] = []
        self.tallies: list[Tally] = []  # of each poll

    def __getattr__(self, name: str) -> Any:
        return getattr(self._node, name)

    def _state(self) -> bytes:
        return self._memory.tobytes()[: self._size]

    def deliver(self, arrival_us: int, packet: bytes, port: int = 0) -> bool:
        self._waiting.append((arrival_us, port, packet))
        return self._node.deliver(arrival_us, packet, port)

    def poll(self, true_us: int, encoder_count: int) -> None:
        random = self._next_random()
        arrived = [w for w in self._waiting if w[0] <= true_us]
        self._waiting = [w for w in self._waiting if w[0] > true_us]
        head = HEAD.pack(
            self._counter.count_at(true_us), encoder_count, int(self._node.supply_V * 1000),
            len(arrived), 0, 0, 0, 0, random,
        )  # fmt: skip
        packets = b"".join(
            struct.pack("<iiI", len(p), port, self._counter.count_at(at)) + p.ljust(PACKET - 12)
            for at, port, p in sorted(arrived, key=lambda w: w[0])
        )
        self._core.write(self._board, head + packets)
        self._core.call("the_poll")
        tally = self._core.take()
        tally.packets = len(arrived)
        self.tallies.append(tally)
        self._node.poll(true_us, encoder_count)
        if self._core.read(self._core.address("the_device"), self._size) != self._state():
            raise Different(f"after the poll at {true_us} us")

    def _next_random(self) -> int:
        """What the board's generator gives next: splitmix64, which is moved by one constant."""
        state = (self._node.random + 0x9E3779B97F4A7C15) % 2**64
        mixed = (state ^ state >> 30) * 0xBF58476D1CE4E5B9 % 2**64
        mixed = (mixed ^ mixed >> 27) * 0x94D049BB133111EB % 2**64
        return mixed ^ mixed >> 31
