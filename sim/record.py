"""What a run leaves: every tick and the plant's truth at 1 kHz, as arrays."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

WALL_CLOCK = ("compute_us", "estimate_us", "linearize_us", "solve_us", "encode_us")


class Record:
    """Rows by channel name, gathered in lists and stacked at the end.

    Channels in WALL_CLOCK are measured times: they are kept, but not part of the hash.
    """

    def __init__(self) -> None:
        self._rows: dict[str, list[NDArray[np.float64]]] = {}

    def add(self, channel: str, row: object) -> None:
        """Appends one row (a number or a flat sequence) to a channel."""
        self._rows.setdefault(channel, []).append(np.array(row, dtype=np.float64))

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Every channel as one array, rows first."""
        return {name: np.array(rows) for name, rows in sorted(self._rows.items())}

    def sha256(self) -> str:
        """Hash of all deterministic channels, byte for byte."""
        digest = hashlib.sha256()
        for name, array in self.arrays().items():
            if name not in WALL_CLOCK:
                digest.update(f"{name}{array.shape}".encode())
                digest.update(array.tobytes())
        return digest.hexdigest()

    def save(self, path: Path) -> None:
        """Writes record.npz."""
        with path.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **self.arrays())
