"""A few boards beside each other on wires, without a plant: how they agree on the time.

True time is an argument. A board is polled at each of its servo periods, by its own counter,
whenever a packet arrives, and, if asked for, in between; a host sends a frame to its board at each
knot.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from headway.devices.bus import Bus as Marks
from headway.devices.core import COAST_KNOTS
from headway.devices.remote import Remote
from headway.devices.session import Session
from headway.firmware import _core
from headway.sim import _board
from headway.sim.bus import Bus
from headway.sim.network import Wire

HOST_PORT = 0
# What an event is, in place of a port's number.
SEND, RECEIVE = -1, -2


class End(NamedTuple):
    """Where a cable ends: at a port of a board."""

    board: int
    port: int


class Cable(NamedTuple):
    """Two ends, and the wires from the first to the second and back."""

    ends: tuple[End, End]
    wires: tuple[Wire, Wire]


class Crystal(NamedTuple):
    """The numbers of a board's oscillator, see _board.Oscillator."""

    offset: int = 0
    drift_ppb: int = 0
    wander_ppb_per_s: int = 0
    drift_bound_ppb: int = 1_000_000
    seed: int = 0


class Host:
    """A host as one board has it: a session, and stamps in both directions. Its clock is true time
    and `epoch_us`."""

    def __init__(
        self, board: int, key: bytes, wires: tuple[Wire, Wire], epoch_us: int, phase_us: int,
        knot_us: int, rng: np.random.Generator, marks: Marks | None = None,
    ) -> None:  # fmt: skip
        """`wires`: to the board and back. A frame leaves `phase_us` after each knot. `marks`: what
        this board and others see of one bus."""
        self.board, self.wires, self.epoch_us, self.knot_us = board, wires, epoch_us, knot_us
        self.phase_us = phase_us
        self.remote = Remote(Session(key, rng), COAST_KNOTS * knot_us, board, marks)

    def packets(self, now_us: int) -> list[bytes]:
        """What leaves now."""
        host_us = now_us + self.epoch_us
        return self.remote.stamp_packets(host_us) + self.remote.signal_packets(host_us)


class Boards:
    """Boards with settings and crystals of their own, from power-up on."""

    def __init__(
        self,
        settings: Sequence[_core.DeviceSettings],
        crystals: Sequence[Crystal],
        cables: Sequence[Cable],
        rng: np.random.Generator,
        hosts: Sequence[Host] = (),
        bus: Bus | None = None,
        poll_us: int = 0,
    ) -> None:
        """One of `settings` and of `crystals` for each board; they name the ports in use. `rng`:
        for the boards' own random numbers. `bus`: whose starts of frames all boards see. `poll_us`:
        between a board's polls, at random and on average; 0: none but at periods and arrivals."""
        self.nodes, self._state = list[_board.Node](), []
        self.crystals = list(crystals)
        polls_rng = rng.spawn(1)[0]
        self._polled = _board.Polled()
        for each, crystal in zip(settings, crystals, strict=True):
            self._state.append(np.zeros(_board.NODE_NUMBERS))
            node = _board.Node(self._state[-1])
            node.random = int(rng.integers(2**63))
            node.supply_V = (each.monitor.supply_min_mV + each.monitor.supply_max_mV) / 2000
            node.flash(each, *crystal)
            if bus is not None:
                node.join_bus(bus.phase_ps, bus.period_ps, int(rng.integers(2**63)))
            self.nodes.append(node)
            self._polled.add(node, poll_us, int(polls_rng.integers(2**63)))
        self.hosts, self.now_us = {h.board: h for h in hosts}, 0
        self._ports = [{e.port for c in cables for e in c.ends if e.board == i} for i in self.range]
        self._ways = {
            cable.ends[i]: (cable.ends[1 - i], cable.wires[i]) for cable in cables for i in (0, 1)
        }
        # What a board's encoder shows at a true time; else 0.
        self.encoders: dict[int, Callable[[int], int]] = {}
        self._cut = False
        # What comes next: (time, running number, board, its port or what it is, packet).
        self._events: list[tuple[int, int, int, int, bytes]] = []
        self._number = 0
        for host in hosts:
            self._put(host.phase_us, host.board, SEND, b"")

    @property
    def range(self) -> range:
        return range(len(self.nodes))

    def cut_hosts(self, cut: bool) -> None:
        """From now on nothing passes between hosts and boards, or all does."""
        self._cut = cut

    def advance(self, true_us: int) -> None:
        """To a true time, not before the last one."""
        while True:
            due_us = min(true_us, self._events[0][0]) if self._events else true_us
            board = self._polled.run(due_us, self.encoders)
            if board is not None:
                self._collect(board)
            elif self._events and self._events[0][0] <= true_us:
                self._happen(*heapq.heappop(self._events))
            else:
                break
        self.now_us = true_us

    def shown_us(self) -> list[int]:
        """What the boards' clocks show now."""
        return [node.system_us(self.now_us) for node in self.nodes]

    def told_ns(self) -> list[tuple[int, int]]:
        """Least and most error that each board told at its last servo period."""
        return [node.error_ns for node in self.nodes]

    def _put(self, time_us: int, board: int, port: int, packet: bytes) -> None:
        self._number += 1
        heapq.heappush(self._events, (time_us, self._number, board, port, packet))

    def _happen(self, now_us: int, _: int, board: int, what: int, packet: bytes) -> None:
        if what == SEND:
            self._send_from(self.hosts[board], now_us)
            return
        if what == RECEIVE:
            host = self.hosts[board]
            host.remote.receive(packet, now_us + host.epoch_us)
            return
        self.arrive(End(board, what), now_us, packet)
        encoder = self.encoders.get(board)
        if self.nodes[board].poll(now_us, encoder(now_us) if encoder else 0):
            self._collect(board)

    def arrive(self, end: End, now_us: int, packet: bytes) -> None:
        """Hands a board what has arrived at one of its ports."""
        self.nodes[end.board].deliver(now_us, packet, end.port)

    def _send_from(self, host: Host, now_us: int) -> None:
        self._put(now_us + host.knot_us, host.board, SEND, b"")
        for packet in host.packets(now_us):
            for arrival_us in host.wires[0].carry(now_us, len(packet)):
                if not self._cut:
                    self._put(arrival_us, host.board, HOST_PORT, packet)

    def _collect(self, board: int) -> None:
        node = self.nodes[board]
        if board in self.hosts:
            for sent_us, reply in node.collect(HOST_PORT):
                for arrival_us in self.hosts[board].wires[1].carry(sent_us, len(reply)):
                    if not self._cut:
                        self._put(arrival_us, board, RECEIVE, reply)
        for own in self._ports[board]:
            for sent_us, frame in node.collect(own):
                self.carry(End(board, own), sent_us, frame)

    def carry(self, start: End, sent_us: int, frame: bytes) -> None:
        """Takes what a board sends another one to the cable's other end."""
        end, wire = self._ways[start]
        for arrival_us in wire.carry(sent_us, len(frame)):
            self._put(arrival_us, end.board, end.port, frame)
