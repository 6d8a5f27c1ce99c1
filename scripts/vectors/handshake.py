"""Vectors of how a session begins: the CRC, nonces, HELLO, WELCOME, and the keys of both."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from random import Random

from line import line

from headway.firmware import _core

SIZE, NONCE = 46, 16
HELLO, WELCOME = 6, 7
PROOF = 1  # the label under which a device's proof is hashed


def _ended(body: bytes, size: int = SIZE) -> bytes:
    """Zeros up to the size, and the CRC."""
    body = body.ljust(size - 4, b"\0")
    return body + zlib.crc32(body).to_bytes(4, "little")


def _welcome(
    key: bytes, host: bytes, device: bytes, version: int = 1, kind: int = WELCOME
) -> bytes:
    proof = _core.siphash24(key, PROOF, host + device)
    return _ended(bytes([version, kind]) + host + device + proof.to_bytes(8, "little"))


def handshakes(rng: Random) -> Iterator[str]:
    """Each frame made and judged; every byte of it damaged, and every verdict."""
    for message in (b"", b"\0", b"123456789", bytes(range(256)), b"\xff" * 42):
        yield line("crc", message=message)
    for size in range(1, 42, 5):
        yield line("crc", message=rng.randbytes(size))
    for boot, session, word in ((0, 0, 0), (1, 2, 3), (2**32 - 1,) * 2 + (2**64 - 1,)):
        yield line("nonce", boot=boot, session=session, random=f"{word:016x}")
    boot, session, word = rng.randrange(2**32), rng.randrange(2**32), rng.randrange(2**64)
    yield line("nonce", boot=boot, session=session, random=f"{word:016x}")
    for _ in range(3):
        host = rng.randbytes(NONCE)
        yield line("hello-encode", host=host)
        yield line("hello-decode", frame=_ended(bytes([1, HELLO]) + host))
    hello = _ended(bytes([1, HELLO]) + host)
    yield from _damaged(hello, lambda frame: line("hello-decode", frame=frame))
    for version, kind in ((0, HELLO), (2, HELLO), (1, WELCOME), (1, HELLO - 1), (2, WELCOME)):
        yield line("hello-decode", frame=_ended(bytes([version, kind]) + host))
    yield line("hello-decode", frame=_ended(bytes([1, HELLO]) + host + b"\x05"))  # not looked at
    for _ in range(3):
        key, host, device = (rng.randbytes(16) for _ in range(3))
        yield line("welcome-encode", key=key, host=host, device=device)
        yield line("welcome-decode", key=key, host=host, frame=_welcome(key, host, device))
        for at in ("host", "device"):
            yield line("handshake", at=at, key=key, host=host, device=device)
            yield line("handshake", at=at, key=key, host=device, device=host)

    def judged(frame: bytes, key: bytes = key, host: bytes = host) -> str:
        return line("welcome-decode", key=key, host=host, frame=frame)

    yield from _damaged(_welcome(key, host, device), judged)
    yield judged(_welcome(key, host, device), host=device)
    yield judged(_welcome(key, host, device), key=host)
    for i in range(16):  # each byte of a nonce counts
        other = bytes(b ^ (i == k) for k, b in enumerate(host))
        yield judged(_welcome(key, other, device))
        proof = bytearray(_welcome(key, host, device)[:-4])
        proof[18 + i] ^= 128
        yield judged(_ended(bytes(proof)))
        proof[18 + i] ^= 128
        proof[34 + i // 2] ^= 1 << i // 2
        yield judged(_ended(bytes(proof)))
    # several faults at once: noise, version, type, nonce, proof, in this order
    for version in (1, 0, 2):
        for kind in (WELCOME, HELLO, 3, WELCOME + 1):
            for nonce in (host, device):
                for key_ in (key, host):
                    yield judged(_welcome(key_, nonce, device, version, kind))
    for size in (SIZE - 1, SIZE + 1, 2 * SIZE):  # whole, but of another size
        longer = _welcome(key, host, device)[:-4][: size - 4]
        yield judged(_ended(longer, size))
        yield line("hello-decode", frame=_ended(hello[:18], size))
    for size in (0, 1, 2, 3, 20, 45, 46, 47, 1020):  # frames of another size, and cut ones
        for kind in (WELCOME, 3, WELCOME + 1):
            frame = bytes([1, kind]) + bytes(1018)
            yield judged(frame[:size])
            yield line("hello-decode", frame=frame[:size])


def _damaged(frame: bytes, judged: Callable[[bytes], str]) -> Iterator[str]:
    for at in range(SIZE):
        broken = bytearray(frame)
        broken[at] ^= 1 << at % 8
        yield judged(bytes(broken))
    yield judged(frame[:-1])
    yield judged(frame + b"\0")
