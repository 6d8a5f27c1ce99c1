"""The numbers of summary.json as tables, of one run or of two beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from headway.cli.page.section import Rows
from headway.cli.page.shown import Shown

Summary = dict[str, Any]


@dataclass(frozen=True)
class Quantity:
    """Values by axis, or the one of a whole run."""

    name: str
    units: list[str]
    values: list[float | None]


def tables(shown: Sequence[Shown]) -> list[Rows]:
    """What concerns the axes, then what concerns the whole run; none if a run has no summary."""
    summaries = [run.summary for run in shown if run.summary is not None]
    if len(summaries) < len(shown):
        return []
    joints = shown[0].joints
    if len(summaries) == 1:
        axes = [[_named(q), *_cells(q)] for q in _of_axes(summaries[0])]
        whole = [[_named(q), *_cells(q)] for q in _of_run(summaries[0])]
        return [Rows(["", *joints], axes, len(joints)), Rows(["", "whole run"], whole, 1)]
    head = [*(run.name for run in shown), "ratio"]
    axes = [
        [f"{_named(a)}, {joint}", *row]
        for a, b in zip(*map(_of_axes, summaries), strict=True)
        for joint, row in zip(joints, _beside(a, b), strict=True)
    ]
    whole = [[_named(a), *_beside(a, b)[0]] for a, b in zip(*map(_of_run, summaries), strict=True)]
    return [Rows(["", *head], axes, 3), Rows(["whole run", *head], whole, 3)]


def _of_axes(summary: Summary) -> list[Quantity]:
    tracking, torque, estimate = summary["tracking"], summary["torque"], summary["estimate"]
    length, effort, n = tracking["unit"], torque["unit"], len(summary["axes"])
    words = {"Nm": "torque", "N": "force"}
    word = " or ".join(dict.fromkeys(words[unit] for unit in effort))
    return [
        Quantity("tracking error, rms", length, tracking["rms"]),
        Quantity("tracking error, max", length, tracking["max"]),
        Quantity("estimate at now, rms", length, _times(1e3, estimate["rms_now"][:n])),
        Quantity("estimate at commit, rms", length, _times(1e3, estimate["rms_commit"][:n])),
        Quantity(f"{word}, max", effort, torque["max_abs"]),
        Quantity(f"{word} limit", effort, torque["limit"]),
        Quantity(f"{word} noise, rms", effort, torque["noise_rms"]),
        Quantity(f"{word} clipped", ["%"], _times(100, torque["clipped_share"])),
    ]


def _of_run(summary: Summary) -> list[Quantity]:
    solver, frames, compute = summary["solver"], summary["frames"], summary["compute_us"]
    return [
        Quantity("ticks", [""], [solver["ticks"]]),
        Quantity("plans rejected", [""], [solver["rejected"]]),
        Quantity("deadlines missed", [""], [summary["deadline_misses"]]),
        Quantity("iterations, median", [""], [solver["iterations_p50"]]),
        Quantity("frames sent", [""], [frames["sent"]]),
        Quantity("frames lost", [""], [frames["lost"]]),
        Quantity("plans too late", [""], [frames["late_points"]]),
        Quantity("plans refused", [""], [frames["gate_refused"]]),
        Quantity("computing time, median", ["us"], [compute["p50"]]),
        Quantity("computing time, p99", ["us"], [compute["p99"]]),
        Quantity("computing time, max", ["us"], [compute["max"]]),
    ]


def _times(factor: float, values: list[float | None]) -> list[float | None]:
    return [None if value is None else factor * value for value in values]


def _named(quantity: Quantity) -> str:
    """With the unit, if all values have the same."""
    units = set(quantity.units)
    return (
        f"{quantity.name} [{units.pop()}]" if len(units) == 1 and units != {""} else quantity.name
    )


def _cells(quantity: Quantity) -> list[str]:
    if len(set(quantity.units)) == 1:
        return [_text(value) for value in quantity.values]
    pairs = zip(quantity.values, quantity.units, strict=True)
    return [f"{_text(value)} {unit}" for value, unit in pairs]


def _beside(first: Quantity, second: Quantity) -> list[list[str]]:
    """For each axis both values, and how many times the first the second is."""
    ratios = [
        "-" if a is None or b is None or not a else f"{b / a:.3g}"
        for a, b in zip(first.values, second.values, strict=True)
    ]
    return [list(row) for row in zip(_cells(first), _cells(second), ratios, strict=True)]


def _text(value: float | None) -> str:
    """Four digits; whole numbers, and what is larger, without a fraction."""
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) and abs(value) < 1e4 else f"{value:.0f}"
