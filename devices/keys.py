"""The keys of a machine's devices: one file each, that nobody but its owner may read.

In a machine's folder q1.key holds the long-term key of the device q1, as 32 hexadecimal digits, and
sync.key the one that boards share among themselves. docs/security.md: what a leak of each means.
"""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

KEY_BYTES = 16
SYNC = "sync"


class KeyFileError(Exception):
    """A key file is missing or not as it should be, told so that the user knows what to do."""


@dataclass(frozen=True)
class Keys:
    """Of a machine. Not to be printed."""

    devices: dict[str, bytes]  # by name
    sync: bytes

    def __repr__(self) -> str:
        return f"Keys of {', '.join(self.devices)}"


def key_path(folder: Path, name: str) -> Path:
    """The file of a device's key, or of SYNC's."""
    return folder / f"{name}.key"


def draw_key(folder: Path, name: str) -> Path:
    """Makes a new key, and the folder where there is none. Raises KeyFileError if there is a key
    of that name, or where it cannot be written."""
    path = key_path(folder, name)
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(file, "w") as text:
            text.write(secrets.token_hex(KEY_BYTES) + "\n")
            text.flush()
            os.fsync(file)
    except FileExistsError as error:
        raise KeyFileError(f"{path}: there is a key already; a board may have it") from error
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be written: {error.strerror}") from error
    return path


def draw_keys(folder: Path, devices: Sequence[str]) -> None:
    """Makes all keys of a machine. Raises KeyFileError."""
    for name in (*devices, SYNC):
        draw_key(folder, name)


def read_keys(folder: Path, devices: Sequence[str]) -> Keys:
    """Raises KeyFileError."""
    return Keys({name: read_key(folder, name) for name in devices}, read_key(folder, SYNC))


def read_key(folder: Path, name: str) -> bytes:
    """Raises KeyFileError for a file that is missing, that others may read, or that is no key."""
    path = key_path(folder, name)
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            text = file.read(4 * KEY_BYTES)
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be read: {error.strerror}") from error
    if status.st_uid != os.geteuid():
        raise KeyFileError(f"{path}: belongs to somebody else: chown it, or name another --keys")
    if stat.S_IMODE(status.st_mode) & 0o077:
        raise KeyFileError(
            f"{path}: others may read or change it: draw a new key, or if nobody has, chmod 600"
        )
    try:
        key = bytes.fromhex(text.decode())
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise KeyFileError(f"{path}: is no key, which is {2 * KEY_BYTES} hexadecimal digits")
    return key
