"""A device as the host knows it: its session, its last status and the tracks it holds.

The host cannot see what arrived; it is told (holding.cpp). Plans still under way are presumed to
arrive, and each status settles those it has an answer for. A plan that was lost is dropped: the
next one repeats its points. When a plan is refused, those that were sent after it are taken to be
refused as well, since they repeat its points, and the device is planned as what it is: continuing
the last plan it accepted.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from headway.devices._tracks import Holding
from headway.devices.bus import NONE, Bus, Mark
from headway.devices.clock import RemoteClock
from headway.devices.session import Session
from headway.devices.signals import Signals
from headway.firmware import _core

GAIN_SINKS = (_core.TRACK_KP, _core.TRACK_KI, _core.TRACK_KD)
# Control points of a device's tracks (sinks, m), position and torque first; of those of several
# devices, which a plan has, there is one array (devices, sinks, m).
Points = NDArray[np.int32]


@dataclass(frozen=True)
class Command:
    """Something asked of the device besides plans, until it answers."""

    number: int
    kind: int
    argument: int
    epoch: int


class Remote:
    """One device at the far end of a link."""

    def __init__(
        self, session: Session, patience_us: int, device: int = 0, bus: Bus | None = None
    ) -> None:
        """`patience_us`: what has no answer after this long counts as lost. `bus`: what this
        device, by its index, and others see at once."""
        self._device, self._bus = device, bus
        self._patience_us = patience_us
        self._session = session
        self.greeting = "no answer"  # to HELLO, until there is a session; else why there is none
        self._holding = Holding()
        # The device's count and our time of statuses, each echoed once and in order.
        self._echoes: deque[tuple[int, int]] = deque(maxlen=8)
        self._command: Command | None = None
        self._commands = 0
        self.epoch = 0  # of the plans that are sent
        self.number = 0
        self.status: _core.Status | None = None
        self.clock = RemoteClock()
        self.frames_bad = 0
        self.statuses = 0  # received in this session
        self.settings: _core.DeviceSettings | None = None  # as it told them, without its key
        self.faults: list[_core.Fault] | None = None  # its log, oldest first
        self.firmware: int | None = None  # its version, as it told it with them
        self._wanted: bytes | None = None  # settings to be told; b"": those that it has
        self.signals = Signals()

    def receive(self, packet: bytes, received_us: int) -> _core.Status | None:
        """Opens a packet; returns its status, or None for what is none (counted)."""
        opened = self._session.open(packet)
        if isinstance(opened, str):
            self._unopened(packet)
            return None
        kind, payload = opened
        if kind != _core.FRAME_STATUS:
            self._take_other(kind, payload)
            return None
        status = _core.status_decode(payload)
        if status is None:
            self.frames_bad += 1
            return None
        self.statuses += 1
        if not self._session.overtaken:  # else only its samples are news
            self._echoes.append((status.sent_count_us, received_us))
            self.status = status
            self.clock.note(status, received_us)
            if self._bus is not None:
                self._bus.tell(self._device, status.mark)
            if self._command and status.command_number >= self._command.number:
                self._command = None
            self._holding.settle(status, self._patience_us)
        return status

    def _unopened(self, packet: bytes) -> None:
        """A packet that is no frame of the session: before there is one, perhaps its beginning."""
        if self._session.established:
            self.frames_bad += 1
            return
        verdict = self._session.welcome(packet)
        if verdict != "another frame":  # as of a session that an earlier host has had
            self.greeting = verdict

    def _take_other(self, kind: int, payload: bytes) -> None:
        """A frame that is no status."""
        if kind == _core.FRAME_READINGS:
            report = _core.report_decode(payload)
            self.frames_bad += report is None
            if report is not None and not self._session.overtaken:
                self.signals.note(report)
        elif not self._answered(kind, payload):
            self.frames_bad += 1

    def _answered(self, kind: int, payload: bytes) -> bool:
        """Takes what was asked for besides statuses; False if it is nothing of that."""
        if kind == _core.FRAME_SETTINGS:
            settings = _core.DeviceSettings.decode(payload[:-1])
            if settings is not None:
                self.settings, self.firmware, self._wanted = settings, payload[-1], None
            return settings is not None
        if kind == _core.FRAME_FAULTS:
            faults = _core.faults_decode(payload)
            if faults is not None:
                self.faults = faults
            return faults is not None
        return False

    def ask_settings(self, wanted: _core.DeviceSettings | None = None) -> None:
        """Has the device asked for its settings, or told others, until it has answered with those
        that it has then."""
        self.settings, self._wanted = None, b"" if wanted is None else wanted.encode()

    def questions(self) -> list[bytes]:
        """Seals what waits for an answer: a command, settings."""
        packets = []
        if (asked := self._command) is not None:
            payload = _core.command_encode(asked.number, asked.kind, asked.argument, asked.epoch)
            packets.append(self._session.seal(_core.FRAME_COMMAND, payload))
        if self._wanted is not None:
            packets.append(self._session.seal(_core.FRAME_SETTINGS, self._wanted))
        return packets

    @property
    def lost(self) -> int:
        """Frames of this session that the device has sent and that have not arrived (yet)."""
        return self._session.lost

    def ask(self, kind: str, argument: int = 0) -> None:
        """Has a command (one of COMMANDS) sent until the device has answered it. To arm and to
        resume begin a new epoch of plans."""
        if kind in ("ARM", "RESUME"):
            known = self.epoch if self.status is None else max(self.epoch, self.status.epoch)
            self.epoch = known % 0xFFFF + 1
            self._holding.forget()
        self._commands += 1
        number = _core.COMMANDS.index(kind)
        self._command = Command(self._commands, number, argument, self.epoch)

    def answer(self) -> str | None:
        """The result of the last command, by name; None while there is none."""
        if self._command or self.status is None or self.status.command_number == 0:
            return None
        return _core.COMMAND_RESULTS[self.status.command_result]

    def overdue(self, now_us: int) -> bool:
        """Whether the next status is."""
        return self.status is None or now_us - self.status.sent_us > self._patience_us

    def silent(self, now_us: int) -> bool:
        """Whether the last status, or the answer to a plan, is overdue."""
        if self.overdue(now_us):
            return True
        return now_us - self._holding.waiting_since_us > self._patience_us

    def track(self, sink: int) -> _core.Track:
        """The track as it will be once what is under way has arrived: always the same object."""
        return self._holding.track(sink)

    def _mark(self) -> Mark:
        return NONE if self._bus is None else self._bus.mark()

    def _stamps(self, sent_us: int) -> tuple[int, int, int]:
        echo = self._echoes.popleft() if self._echoes else (0, 0)  # (0, 0): no sample
        return (*echo, sent_us)

    def plan_packet(self, first_knot: int, points: Points, sent_us: int) -> bytes:
        """Seals a plan and remembers it as under way."""
        self.number += 1
        payload = self._holding.send(
            self._stamps(sent_us), self._mark(), self.number, self.epoch, first_knot, points
        )
        return self._session.seal(_core.FRAME_PLAN, payload)

    def signal_packets(self, sent_us: int) -> list[bytes]:
        """What the device has no part of yet of its signals."""
        if not self._session.established:
            return []
        return self.signals.packets(self._session.seal, sent_us)

    @property
    def established(self) -> bool:
        """Whether there is a session, and the device has answered in it."""
        return self._session.established

    def stamp_packets(self, sent_us: int) -> list[bytes]:
        """What is sent when there is no plan: stamps alone. Until the device has answered in a
        session it is asked for one; once it has welcomed that, stamps prove who the host is."""
        packets = [] if self._session.established else [self._session.hello()]
        if self._session.established or self._session.welcomed:
            payload = _core.sync_encode(self._stamps(sent_us), self._mark())
            packets.append(self._session.seal(_core.FRAME_SYNC, payload))
        return packets
