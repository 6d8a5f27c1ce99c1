"""What boards in a row hear of each other, and the tightest interval that it leaves them."""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from clocks import tight
from clocks.exchanges import EPOCH_US, ticks_of
from headway.firmware import _core
from headway.sim.boards import Boards, Crystal, End

REQUEST, RESPONSE = 10, 11
REQUEST_BYTES, RESPONSE_BYTES = 18, 47  # firmware/peer.h
FIELDS = struct.Struct("<BBQqqiiIBQ")
OPEN_NS = 2**31 - 1


class Answer(NamedTuple):
    """That counted: true times of the question and of the arrival, and what it says [us]."""

    asked_us: int
    arrived_us: int
    received: int
    sent: int
    least: float
    most: float


class Tapped(Boards):
    """Boards whose cables are listened to. `heard`: by board, in order of arrival."""

    def __init__(self, *of: object, **more: object) -> None:
        super().__init__(*of, **more)  # type: ignore[arg-type]
        self.heard: list[list[Answer]] = [[] for _ in self.nodes]
        self._asked: dict[End, tuple[int, int]] = {}  # what is open: the nonce, and when

    def carry(self, start: End, sent_us: int, frame: bytes) -> None:
        packet = _core.cobs_decode(frame)
        assert packet is not None
        if packet[1] == REQUEST:
            assert len(packet) == REQUEST_BYTES
            self._asked[start] = int.from_bytes(packet[2:10], "little"), sent_us
        super().carry(start, sent_us, frame)

    def arrive(self, end: End, now_us: int, packet: bytes) -> None:
        super().arrive(end, now_us, packet)
        frame = _core.cobs_decode(packet) if end in self._asked else None
        if frame is None or frame[1] != RESPONSE:
            return
        _, _, nonce, received, sent, least, most, _, _, _ = FIELDS.unpack(frame)
        if nonce != self._asked[end][0]:
            return
        _, asked_us = self._asked.pop(end)
        if least > -OPEN_NS and most < OPEN_NS:
            answer = Answer(asked_us, now_us, received, sent, least * 1e-3, most * 1e-3)
            self.heard[end.board].append(answer)


def proofs(
    heard: list[Answer], crystal: Crystal, now_ticks: int, least_us: int, base_us: int
) -> tight.Proofs:
    """What the answers that had arrived at `now_ticks` prove. `base_us` is the host's time minus
    the ticks, nearly; `least_us` the least delay, either way."""
    columns = (np.array(column) for column in zip(*heard, strict=True))
    asked_us, arrived_us, received, sent, least, most = columns
    echo, arrived = (ticks_of(crystal, true_us) for true_us in (asked_us, arrived_us))
    known = (arrived <= now_ticks) & (arrived >= now_ticks - tight.AGE_MAX_US)
    echoed = known & (echo >= now_ticks - tight.AGE_MAX_US)
    lower = sent - arrived - base_us - tight.STAMP_US + least_us - most
    upper = received - echo - base_us + tight.STAMP_US - least_us - least
    return tight.Proofs(
        now_ticks - np.concatenate((arrived[known], echo[echoed])).astype(float),
        np.concatenate((lower[known], upper[echoed])),
        np.repeat((False, True), (known.sum(), echoed.sum())),
    )


def widths(
    boards: Tapped, board: int, period_us: int, least_us: int,
    drift_ppm: float, wander_ppm_per_s: float,
) -> tuple[float, float]:  # fmt: skip
    """What a board told at its last servo period, and the tightest there is by what its neighbours
    say: of their clocks and of the intervals of these [us]."""
    crystal = boards.crystals[board]
    ticks = int(ticks_of(crystal, np.array([boards.now_us]))[0])
    now = ticks - (ticks - crystal.offset) % period_us
    known = proofs(boards.heard[board], crystal, now, least_us, boards.now_us + EPOCH_US - ticks)
    low, high = tight.tightest(known, drift_ppm, wander_ppm_per_s)
    least_ns, most_ns = boards.nodes[board].error_ns
    return (most_ns - least_ns) * 1e-3, high - low
