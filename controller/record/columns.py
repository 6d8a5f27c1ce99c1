"""Rows gathered into arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.controller.record.channels import CHANNELS, Channel

Arrays = dict[str, NDArray[Any]]

DTYPES = {"double": np.float64, "int": np.int64, "bool": np.bool_, "bytes": np.uint8}


class Columns:
    """Every field of every channel as one array, rows first.

    The names are CHANNEL_FIELD. A channel's system times [us] are CHANNEL_us, its times of the task
    [s] are CHANNEL_s (NaN without a task). What has any number of values in a row (lists, bytes) is
    one flat array, and row i is [offsets[i] : offsets[i + 1]] of it, with CHANNEL_FIELD_offsets.
    A channel without rows has empty arrays.
    """

    def __init__(self) -> None:
        self._times: dict[str, list[int]] = {name: [] for name in CHANNELS}
        self._values: dict[str, list[list[Any]]] = {
            name: [[] for _ in channel.fields] for name, channel in CHANNELS.items()
        }
        self._counts: dict[str, list[list[int]]] = {
            name: [[] for _ in channel.fields] for name, channel in CHANNELS.items()
        }

    def add(self, channel: Channel, time_us: int, values: Sequence[Any]) -> None:
        """Appends a row."""
        self._times[channel.name].append(time_us)
        for flat, counts, value in zip(
            self._values[channel.name], self._counts[channel.name], values, strict=True
        ):
            try:
                flat.extend(value)
                counts.append(len(value))
            except TypeError:
                flat.append(value)

    def arrays(self) -> Arrays:
        """All of them. Raises ValueError if the rows of a vector differ in length."""
        starts = self._values["task"][0]
        start_us = starts[0] if starts else None
        arrays: Arrays = {}
        for name, channel in CHANNELS.items():
            times_us = np.array(self._times[name], dtype=np.int64)
            arrays[f"{name}_us"] = times_us
            unknown = np.full(len(times_us), np.nan)
            arrays[f"{name}_s"] = unknown if start_us is None else (times_us - start_us) * 1e-6
            columns = zip(channel.fields, self._values[name], self._counts[name], strict=True)
            for field, flat, counts in columns:
                key, (kind, _, many) = f"{name}_{field.name}", field.kind.partition(" ")
                arrays[key] = np.array(flat, dtype=DTYPES[kind])
                if many == "vector":
                    arrays[key] = _rectangle(key, arrays[key], counts)
                elif many or kind == "bytes":
                    arrays[f"{key}_offsets"] = np.cumsum([0, *counts])
        return arrays


def _rectangle(key: str, flat: NDArray[Any], counts: list[int]) -> NDArray[Any]:
    if len(set(counts)) > 1:
        raise ValueError(f"{key}: the rows have from {min(counts)} to {max(counts)} values")
    return flat.reshape(len(counts), counts[0] if counts else 0)
