"""What packets tell of a device: how much plan it still held, which frames did not arrive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from headway.controller.record.columns import Arrays
from headway.devices.core import STATES

Array = NDArray[np.float64]

MOVES = [STATES.index("RUNNING"), STATES.index("COAST")]


@dataclass(frozen=True)
class Statuses:
    """The statuses of one device that reached the host, by when they were sent [s of the task].

    All counts are since the task began.
    """

    time_s: Array
    lead_s: Array  # of the plan it held, until it would stand still; NaN: at rest, or not known
    gap_s: Array  # since the one before was sent
    plans_lost: Array  # that did not arrive, or after a later frame
    plans_late: Array  # refused: a live point would have changed
    plans_refused: Array  # for other reasons
    frames_bad: Array  # not authentic, malformed or replayed
    statuses_lost: Array  # that did not reach the host


def statuses(arrays: Arrays, device: int, knot_us: int) -> Statuses:
    """What the record tells of a device, from the last status before the task on."""
    start_us = arrays["task_start_us"][0]
    mine = (arrays["received_device"] == device) & arrays["received_status"]
    mine &= arrays["received_synced"]  # else its clock, and so its stamps, are not yet right

    def field(name: str) -> NDArray[np.int64]:
        values: NDArray[np.int64] = arrays[f"received_{name}"][mine]
        return values

    sent_us = field("sent_us")
    first = max(0, int(np.searchsorted(sent_us, start_us)) - 1)
    since = slice(first, None)

    def count(total: NDArray[np.int64]) -> Array:
        counted: Array = (total - total[first])[since].astype(np.float64)
        return counted

    if not len(sent_us):
        return Statuses(*(np.empty(0) for _ in range(8)))
    gaps_us = np.diff(sent_us, prepend=sent_us[0])
    knots = np.diff(sent_us // knot_us, prepend=sent_us[0] // knot_us)  # one is sent in each
    missed = np.maximum(knots - 1, 0)
    seen, late, refused = field("plan_seen"), field("plans_late"), field("plans_refused")
    rest_us = _rest_knots(arrays, device, field("plan_accepted")) * knot_us
    moves = np.isin(field("state"), MOVES)
    lead_us = np.where(moves, np.maximum(rest_us - sent_us, 0), np.nan)
    return Statuses(
        time_s=(sent_us[since] - start_us) * 1e-6,
        lead_s=lead_us[since] * 1e-6,
        gap_s=gaps_us[since] * 1e-6,
        plans_lost=count(seen - field("plans_accepted") - late - refused),
        plans_late=count(late),
        plans_refused=count(refused),
        frames_bad=count(field("frames_bad")),
        statuses_lost=count(np.cumsum(missed)),
    )


def _rest_knots(arrays: Arrays, device: int, numbers: NDArray[np.int64]) -> Array:
    """The knot from which on each of these plans stands still; NaN for one that is not recorded.

    A plan's last three points are equal, and during [k, k+1) the points k-1 .. k+2 count: with l
    the last point's knot, it is l - 1 (firmware/device.c: where COAST becomes HOLD).
    """
    mine = (arrays["sent_device"] == device) & arrays["sent_plan"]
    sent = arrays["sent_number"][mine]  # rising
    counts = np.diff(arrays["sent_position_pq_offsets"])[mine]
    rest = arrays["sent_first_knot"][mine] + counts - 2
    if not len(sent):
        return np.full(len(numbers), np.nan)
    place = np.minimum(np.searchsorted(sent, numbers), len(sent) - 1)
    return np.where(sent[place] == numbers, rest[place], np.nan)


def summed(times_s: list[Array], counts: list[Array]) -> tuple[Array, Array]:
    """The sum of counts that change at different times: all times in order, and the sum there."""
    known = [(time_s, count) for time_s, count in zip(times_s, counts, strict=True) if len(time_s)]
    all_s = np.unique(np.concatenate([np.empty(0), *(time_s for time_s, _ in known)]))
    total = np.zeros(len(all_s))
    for time_s, count in known:
        place = np.searchsorted(time_s, all_s, side="right") - 1
        total += np.where(place < 0, 0.0, count[np.maximum(place, 0)])
    return all_s, total
