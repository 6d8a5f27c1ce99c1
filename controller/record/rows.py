"""From notes to rows of the channels, in which packets are decoded."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from math import nan
from typing import Any

from headway.controller.record.channels import CHANNELS, Channel, Field
from headway.controller.record.note import thaw
from headway.devices import packet
from headway.devices.core import TRACK_POSITION, TRACK_TORQUE

Row = tuple[Channel, int, list[Any]]  # channel, system time [us], a value for each field


def rows(frozen: bytes) -> Iterator[Row]:
    """The rows of notes. Raises ValueError for a value that is not of its field's kind."""
    for name, time_us, values in thaw(frozen):
        expand: Expand = EXPAND.get(name, _as_it_is)
        for channel_name, row_us, row in expand(name, time_us, *values):
            channel = CHANNELS[channel_name]
            fields = zip(channel.fields, row, strict=True)
            yield channel, row_us, [_checked(channel, field, value) for field, value in fields]


def _checked(channel: Channel, field: Field, value: Any) -> Any:
    """The value as the message takes it."""
    kind = field.kind
    if kind == "double vector" and isinstance(value, bytes) and len(value) % 8 == 0:
        return struct.unpack(f"<{len(value) // 8}d", value)
    if kind == "double":  # a number of numpy's is noted as its bytes
        return struct.unpack("<d", value)[0] if isinstance(value, bytes) else float(value)
    if kind in ("double vector", "int vector", "int list"):
        single = float if kind == "double vector" else int
        if isinstance(value, (list, tuple)) and all(type(v) is single for v in value):
            return value
    elif type(value) is {"int": int, "bool": bool, "bytes": bytes}[kind]:
        return value
    raise ValueError(f"{channel.name}.{field.name} is no {kind}: {value!r}")


Raw = Iterator[tuple[str, int, Sequence[Any]]]
Expand = Callable[..., Raw]


def _as_it_is(name: str, time_us: int, *values: Any) -> Raw:
    yield name, time_us, values


def _received(_: str, now_us: int, packets: list[tuple[int, int, bytes]], good: list[bool]) -> Raw:
    for (device, received_us, raw), is_status in zip(packets, good, strict=True):
        status = packet.status(raw) if is_status else None
        decoded: list[Any]
        if status is None:
            decoded = [ZERO[field.kind] for field in CHANNELS["received"].fields[3:]]
        else:
            samples = status.samples
            lists = {
                "sample_time_us": [time_us for time_us, _ in samples],
                "sample_count": [count for _, count in samples],
            }
            names = [field.name for field in CHANNELS["received"].fields[3:]]
            decoded = [lists[n] if n in lists else getattr(status, n) for n in names]
        yield "received", received_us, (device, status is not None, raw, *decoded)


def _sent(_: str, sent_us: int, planned: bool, packets: list[tuple[int, bytes]]) -> Raw:
    for device, raw in packets:
        plan = packet.plan(raw) if planned else None
        decoded: tuple[Any, ...] = 0, 0, (), ()
        if plan is not None:
            number, first_knot, points = plan
            both = points[TRACK_POSITION].tolist(), points[TRACK_TORQUE].tolist()
            decoded = number, first_knot, *both
        yield "sent", sent_us, (device, plan is not None, raw, *decoded)


def _tick(
    _: str,
    now_us: int,
    outcome: tuple[Any, ...],
    torques: tuple[bytes | None, bytes | None],
    now: tuple[bytes, bytes],
    commit: tuple[bytes, bytes],
    commit_us: int,
    solver: tuple[tuple[Any, ...], tuple[float, float]] | None,
    split_us: tuple[float, float, float],
) -> Raw:
    *_rest, states = outcome
    unknown = [nan] * len(states)
    yield "tick", now_us, (*outcome, *(unknown if each is None else each for each in torques))
    yield "now", now_us, now
    yield "commit", commit_us, commit
    prepare_us = solve_us = nan
    if solver is not None:
        outcome, (prepare_us, solve_us) = solver
        yield "solver", now_us, outcome
    total_us, estimate_us, encode_us = split_us
    yield "timing", now_us, (total_us, estimate_us, prepare_us, solve_us, encode_us)


ZERO: dict[str, Any] = {"int": 0, "bool": False, "int list": ()}
EXPAND: dict[str, Expand] = {"received": _received, "sent": _sent, "tick": _tick}
