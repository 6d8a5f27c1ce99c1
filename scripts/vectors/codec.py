"""Vectors of COBS, SipHash-2-4 and the frame."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from line import line

from headway.firmware import _core

KEY = bytes(range(16))
HEADER, TAG, PAYLOAD_MAX = 12, 8, 1000
TO_DEVICE, TO_HOST = 0, 1


def _packets(rng: Random) -> Iterator[bytes]:
    """Short ones, and runs without a zero around whole blocks of 254."""
    yield from (b"", b"\0", b"\0\0", b"\x01", b"\xff", b"\x11\x22\0\x33", b"\0\x01\0", b"\x01\0\0")
    for size in (253, 254, 255, 508):
        for head in (b"", b"\x05\0") if size < 508 else (b"",):
            for tail in (b"", b"\0", b"\x07"):
                yield head + b"\xaa" * size + tail
    yield b"\x01" * 1020
    for _ in range(40):
        yield bytes(rng.choice([0, 1, 2, 254, 255]) for _ in range(rng.randrange(1, 40)))


def cobs(rng: Random) -> Iterator[str]:
    """Encode, decode, and what is no encoded packet."""
    seen = list(dict.fromkeys(_packets(rng)))
    for packet in seen:
        yield line("cobs-encode", packet=packet)
    for packet in seen:
        yield line("cobs-decode", bytes=_core.cobs_encode(packet))
    bad = [b"", b"\0", b"\x02", b"\x01\0", b"\x03\x05", b"\x02\0", b"\x03\x01\0", b"\x01\x05\x01"]
    bad += [b"\xff" + b"\x01" * 253, b"\xff" + b"\x01" * 254, b"\xff" + b"\x01" * 254 + b"\x01"]
    bad += [
        b"\xff" + b"\x01" * 255,
        b"\x02\x01\x02",
        b"\x02\x01\x02\0",
        b"\x01\0\x01",
        b"\x03\0\x01",
    ]
    for bytes_ in bad:
        yield line("cobs-decode", bytes=bytes_)
    for _ in range(60):
        size = rng.randrange(1, 12)
        noise = bytes(rng.choice([0, 1, 1, 2, 2, 3, 4, 5]) for _ in range(size))
        yield line("cobs-decode", bytes=noise)


def siphash(rng: Random) -> Iterator[str]:
    """The paper's message 0, 1, 2, ... of each length, then random ones."""
    for size in range(65):
        yield line("siphash", key=KEY, prefix=0, message=bytes(i + 1 for i in range(size)))
    for size in (*range(20), 255, 256, 1012):
        yield line(
            "siphash", key=rng.randbytes(16), prefix=rng.randrange(256), message=rng.randbytes(size)
        )


def _frame(
    payload: bytes, *, version: int = 1, kind: int = 2, session: int, counter: int, direction: int,
    key: bytes = KEY,
) -> bytes:  # fmt: skip
    """A frame put together byte by byte."""
    head = bytes([version, kind]) + session.to_bytes(4, "little") + counter.to_bytes(6, "little")
    body = head + payload
    return body + _core.siphash24(key, direction, body).to_bytes(TAG, "little")


def frames(rng: Random) -> Iterator[str]:
    """Seal; open with every error, and the order in which errors are looked for."""
    yield line("session-none")
    yield line("seal", type=1, payload=b"abc")
    yield line("open", frame=_frame(b"abc", session=0, counter=1, direction=0, key=bytes(16)))
    yield line("session-counters", sent=5, received=9, window=text64(1))
    yield line("open", frame=_frame(b"abc", session=0, counter=10, direction=0, key=bytes(16)))
    sent = (0, 1, 254, 255, 65535, 2**32 - 1, 2**40 + 3, 2**48 - 3, 2**48 - 2, 2**48 - 1)
    for at in ("host", "device"):
        for i, counter in enumerate(sent):
            payload = rng.randbytes((0, 1, 3, 4, 24, 77, 300, PAYLOAD_MAX, 2, 2)[i])
            number = (0, 1, 0xC0FFEE, 2**32 - 1)[i % 4]
            yield _session(at, number, rng.randbytes(16), rng.randbytes(16))
            yield line("session-counters", sent=counter, received=i, window=text64(ALL))
            for kind in ((1, 2, 3, 0, 255)[i % 5], 9):
                yield line("seal", type=kind, payload=payload)
        yield _session(at, 3, rng.randbytes(16), rng.randbytes(16))
        yield line("seal", type=4, payload=b"first")
    for at, other in (("host", TO_HOST), ("device", TO_DEVICE)):
        yield from _opened(rng, at, other)
        yield from _replays(rng, at, other)


ALL = (1 << 64) - 1


def text64(word: int) -> str:
    """As a hash is written."""
    return f"{word:016x}"


def _session(at: str, number: int, send_key: bytes, receive_key: bytes) -> str:
    return line("session", at=at, number=number, send_key=send_key, receive_key=receive_key)


def _opened(rng: Random, at: str, direction: int) -> Iterator[str]:
    session, send_key = 0x89ABCDEF, rng.randbytes(16)

    begun: list[tuple[int, bytes]] = []

    def opened(
        frame: bytes, received: int = 0, number: int = session, key: bytes = KEY
    ) -> Iterator[str]:
        if begun[-1:] != [(number, key)]:
            yield _session(at, number, send_key, key)
            begun.append((number, key))
        else:
            yield line("session-counters", sent=7, received=received, window=text64(ALL))
        yield line("open", frame=frame)

    def made(payload: bytes, counter: int, **other: int) -> bytes:
        values = {"session": session, "counter": counter, "direction": direction} | other
        return _frame(payload, **values)  # type: ignore[arg-type]

    for size in (0, 1, 7, 8, 40, PAYLOAD_MAX - 1, PAYLOAD_MAX):
        yield from opened(made(rng.randbytes(size), 1))
    yield from opened(made(rng.randbytes(PAYLOAD_MAX + 1), 1))  # too long
    good = made(b"headway", 5)
    for size in (0, 1, 11, 12, 19, 20, len(good) - 1):
        yield from opened(good[:size])
    for version in (0, 2, 255):
        yield from opened(made(b"", 1, version=version))
    for number in (0, session ^ 1, session ^ 1 << 31, session ^ 1 << 16):
        yield from opened(made(b"", 1, session=number))
        yield from opened(made(b"", 1), number=number)
    for counter in (1, 2, 255, 256, 2**24, 2**40, 2**48 - 1):
        for received in (0, counter - 2, counter - 1, counter, counter + 1, 2**48 - 1):
            if received >= 0:
                yield from opened(made(b"\x01", counter), received=received)
    yield from opened(made(b"", 0))
    yield from opened(made(b"abc", 1, direction=1 - direction))  # reflected to its sender
    yield from opened(_frame(b"abc", session=session, counter=1, direction=direction, key=send_key))
    yield from opened(good, key=bytes(16))
    for bit in range(0, 8 * len(good), 11):
        broken = bytearray(good)
        broken[bit // 8] ^= 1 << bit % 8
        yield from opened(bytes(broken))
    # several faults at once: the first of length, version, session, counter, tag is named
    for version in (1, 3):
        for number in (session, 5):
            for received in (0, 9):
                for tag in (direction, 1 - direction):
                    frame = made(b"xy", 9, version=version, session=number, direction=tag)
                    yield from opened(frame, received=received)
                    yield from opened(frame[:19], received=received)


def _replays(rng: Random, at: str, direction: int) -> Iterator[str]:
    """Frames that overtake each other, come twice, or come after the window has left them."""
    number, ends = 77, {"session": 77, "direction": direction}
    yield _session(at, number, bytes(16), KEY)
    order = [
        3,
        1,
        2,
        3,
        1,
        0,
        64,
        1,
        2,
        4,
        5,
        66,
        65,
        2,
        3,
        67,
        130,
        67,
        66,
        68,
        131,
        195,
        131,
        132,
    ]
    order += [259, 195, 196, 260, 324, 388, 324, 325, 300, 300, 388, 389]
    for counter in order:
        yield line("open", frame=_frame(b"", counter=counter, **ends))  # type: ignore[arg-type]
    forged = bytearray(_frame(b"x", counter=500, **ends))  # type: ignore[arg-type]
    forged[-1] ^= 1
    yield line("open", frame=bytes(forged))  # moves nothing
    for received, window in (
        (1000, 0), (1000, 1), (1000, 1 << 63), (1000, ALL >> 1), (1000, rng.randrange(ALL)),
        (30, 0), (2**48 - 1, 1),
    ):  # fmt: skip
        for back in (0, 1, 31, 32, 62, 63, 64, 65, -1, -62, -63, -64, -65):
            counter = received - back
            if 0 <= counter < 1 << 48:
                yield line("session-counters", sent=7, received=received, window=text64(window))
                yield line("open", frame=_frame(b"", counter=counter, **ends))  # type: ignore[arg-type]
    counter = 5000
    for _ in range(40):
        counter = max(
            1, counter + rng.choice([-64, -63, -20, -3, -2, -1, 0, 1, 1, 2, 3, 40, 63, 64])
        )
        yield line("open", frame=_frame(b"", counter=counter, **ends))  # type: ignore[arg-type]
