"""The summary as a person reads it."""

from __future__ import annotations

from typing import Any

from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text


def summary_table(summary: dict[str, Any]) -> Group:
    """A table with a column for each axis, and below it what concerns the whole run."""
    axes = summary["axes"]
    tracking, torque, estimate = summary["tracking"], summary["torque"], summary["estimate"]
    heading = (
        f"{summary['config']}: {summary['duration_s']:g} s at {summary['rate_hz']:.1f} Hz, "
        f"margin {summary['margin_us'] / 1000:g} ms, seed {summary['seed']}"
    )
    table = Table("", *(escape(axis) for axis in axes))
    n, length, effort = len(axes), tracking["unit"], torque["unit"]
    rows = (
        ("tracking error, rms", length, tracking["rms"]),
        ("tracking error, max", length, tracking["max"]),
        ("estimate at now, rms", length, _times(1e3, estimate["rms_now"][:n])),
        ("estimate at commit, rms", length, _times(1e3, estimate["rms_commit"][:n])),
        (f"{_effort(effort)}, max", effort, torque["max_abs"]),
        (f"{_effort(effort)} limit", effort, torque["limit"]),
        (f"{_effort(effort)} noise, rms", effort, torque["noise_rms"]),
        (f"{_effort(effort)} clipped", ["%"], _times(100, torque["clipped_share"])),
    )
    for name, units, values in rows:
        table.add_row(*_row(name, units, values))
    return Group(Text(heading), table, Text(_whole_run(summary)))


def _effort(units: list[str]) -> str:
    words = {"Nm": "torque", "N": "force"}
    return " or ".join(words[unit] for unit in dict.fromkeys(units))


def _row(name: str, units: list[str], values: list[float | None]) -> list[str]:
    """The unit stands beside the name, or where axes differ, beside each value."""
    if len(set(units)) == 1:
        return [escape(f"{name} [{units[0]}]"), *(_text(value) for value in values)]
    return [name, *(f"{_text(value)} {unit}" for value, unit in zip(values, units, strict=True))]


def _whole_run(summary: dict[str, Any]) -> str:
    solver, frames, compute = summary["solver"], summary["frames"], summary["compute_us"]
    by_gate = [f"{what} ({count})" for what, count in solver["refused_by_gate"].items()]
    if part_way := solver["part_way"]:
        by_gate.append(f"of {part_way} a part of the way was sent")
    lost = "nobody knows how many" if frames["lost"] is None else frames["lost"]
    return "\n".join(
        (
            f"{solver['ticks']} ticks: {solver['rejected']} plans rejected, "
            f"{summary['deadline_misses']} deadlines missed",
            *([f"refused by the gate here: {'; '.join(by_gate)}"] if by_gate else []),
            f"{frames['sent']} frames sent: {lost} lost, "
            f"{frames['late_points']} too late, {frames['gate_refused']} refused by the gate",
            f"compute [us]: {_text(compute['p50'])} median, {_text(compute['p99'])} p99, "
            f"{_text(compute['max'])} max",
            f"at rest after the end: {'yes' if summary['at_rest_after_end'] else 'NO'}",
        )
    )


def _times(factor: float, values: list[float | None]) -> list[float | None]:
    """What nobody knows stays unknown."""
    return [None if value is None else factor * value for value in values]


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
