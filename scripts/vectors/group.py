"""Vectors of a group's key: masked for a session's next frame, and out of one."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from line import line

from headway.firmware import _core

SIZE, HEADER = 26, 12
PAD_LOW, PAD_HIGH = 2, 3  # the labels under which the pad is hashed
COUNTERS = (0, 1, 254, 255, 256, (1 << 40) - 1, (1 << 48) - 2)


def _frame(key: bytes, counter: int, masked: bytes, number: int, sent: int) -> bytes:
    """A GROUP frame, without the tag, which is the session's affair."""
    message = counter.to_bytes(8, "little")
    words = [_core.siphash24(masked, prefix, message) for prefix in (PAD_LOW, PAD_HIGH)]
    pad = b"".join(word.to_bytes(8, "little") for word in words)
    header = bytes([1, 8, 0, 0, 0, 0]) + counter.to_bytes(6, "little")
    payload = bytes(a ^ b for a, b in zip(key, pad, strict=True))
    return header + payload + number.to_bytes(4, "little") + sent.to_bytes(6, "little")


def groups(rng: Random) -> Iterator[str]:
    """Each counter and number at its ends, every room, every cut."""
    for sent in COUNTERS:
        for number, group_sent in ((0, 0), (1, 2), ((1 << 32) - 1, (1 << 48) - 1)):
            yield line(
                "group-encode", send_key=rng.randbytes(16), sent=sent, group_key=rng.randbytes(16),
                group_number=number, group_sent=group_sent, capacity=SIZE,
            )  # fmt: skip
    for capacity in range(SIZE + 2):
        yield line(
            "group-encode", send_key=bytes(16), sent=6, group_key=rng.randbytes(16),
            group_number=9, group_sent=8, capacity=capacity,
        )  # fmt: skip
    for at in ("host", "device"):
        for counter in COUNTERS:
            key, session = rng.randbytes(16), rng.randbytes(16)
            number = rng.randrange(1, 1 << 32)
            frame = _frame(key, counter, session, number, rng.randrange(1 << 48))
            for own in (number, number ^ 1, number ^ 1 << 31, number - 1):  # its own is no group's
                yield line("group-decode", at=at, number=own, receive_key=session, frame=frame)
    whole = frame + b"\0"
    for size in range(HEADER, len(whole) + 1):
        yield line("group-decode", at="device", number=3, receive_key=session, frame=whole[:size])
