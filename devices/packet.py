"""What is in a packet, for those who have no key: records of what was sent and received.

Nothing here checks whether a packet is authentic.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from headway.firmware import _core


def status(packet: bytes) -> _core.Status | None:
    """The status in a packet from a device; None if there is none."""
    payload = _payload(packet, _core.FRAME_STATUS)
    return None if payload is None else _core.status_decode(payload)


def plan(packet: bytes) -> tuple[int, int, dict[int, NDArray[np.int32]]] | None:
    """Number, first knot and points by sink of the plan in a packet; None if there is none."""
    payload = _payload(packet, _core.FRAME_PLAN)
    decoded = None if payload is None else _core.plan_decode(payload)
    return None if decoded is None else (decoded[1], *decoded[3:])


def _payload(packet: bytes, kind: int) -> bytes | None:
    frame = _core.cobs_decode(packet)
    if frame is None or frame[1:2] != bytes([kind]):
        return None
    header, tag = _around()
    return frame[header : len(frame) - tag]


@cache
def _around() -> tuple[int, int]:
    """Bytes before and after a frame's payload, as the codec makes it."""
    probe = b"the payload"
    frame = _core.cobs_decode(
        _core.Session(bytes(16), bytes(16), 1).seal(_core.FRAME_STATUS, probe)
    )
    assert frame is not None
    header = frame.index(probe)
    return header, len(frame) - header - len(probe)
