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
    n = len(axes)
    rows = {
        "tracking error, rms [mrad]": tracking["rms"],
        "tracking error, max [mrad]": tracking["max"],
        "estimate at now, rms [mrad]": _milli(estimate["rms_now"][:n]),
        "estimate at commit, rms [mrad]": _milli(estimate["rms_commit"][:n]),
        "torque, max [Nm]": torque["max_abs"],
        "torque limit [Nm]": torque["limit"],
        "torque noise, rms [Nm]": torque["noise_rms"],
        "torque clipped [%]": [100 * share for share in torque["clipped_share"]],
    }
    for name, values in rows.items():
        table.add_row(escape(name), *(_text(value) for value in values))
    return Group(Text(heading), table, Text(_whole_run(summary)))


def _whole_run(summary: dict[str, Any]) -> str:
    solver, frames, compute = summary["solver"], summary["frames"], summary["compute_us"]
    return "\n".join(
        (
            f"{solver['ticks']} ticks: {solver['rejected']} plans rejected, "
            f"{summary['deadline_misses']} deadlines missed",
            f"{frames['sent']} frames sent: {frames['lost']} lost, "
            f"{frames['late_points']} too late, {frames['gate_refused']} refused by the gate",
            f"compute [us]: {_text(compute['p50'])} median, {_text(compute['p99'])} p99, "
            f"{_text(compute['max'])} max",
            f"at rest after the end: {'yes' if summary['at_rest_after_end'] else 'NO'}",
        )
    )


def _milli(values: list[float | None]) -> list[float | None]:
    return [None if value is None else 1e3 * value for value in values]


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
