"""What a sweep comes to: medians over the seeds, the worst seed, the runs that failed."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

Row = dict[str, Any]  # of one run, see flat.py

# A median would hide what happens in one run of ten: these are added up.
COUNTS = {
    "late": "frames.late_points",
    "refused": "frames.gate_refused",
    "missed": "deadline_misses",
}

WIDTH = 1000  # of the table at most: a terminal that is too narrow breaks lines, but no numbers


def sweep_report(axes: list[str], varied: list[str], rows: list[Row]) -> dict[str, Any]:
    """Ready for JSON. `rows` are in order; those of a combination differ in their seeds alone."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[f"vary.{key}"] for key in varied), []).append(row)
    done = next((row for row in rows if not row["error"]), {})
    return {
        "axes": axes,
        "unit": [done.get(f"tracking.unit.{axis}", "-") for axis in axes],
        "effort_unit": [done.get(f"torque.unit.{axis}", "-") for axis in axes],
        "varied": varied,
        "combinations": [
            {"values": list(values), **_combination(axes, group)}
            for values, group in groups.items()
        ],
    }


def _combination(axes: list[str], rows: list[Row]) -> dict[str, Any]:
    done = [row for row in rows if not row["error"]]
    worst = _worst(axes, rows)
    return {
        "seeds": len(rows),
        "failed": len(rows) - len(done),
        "beyond_limits": sum(bool(row["limits_violated"]) for row in done),
        "median": _medians(done),
        "total": {name: sum(row[key] for row in done) for name, key in COUNTS.items()},
        "worst_seed": worst["seed"],
        "worst_error": worst["error"],
        "replay": worst["replay"],
    }


def _worst(axes: list[str], rows: list[Row]) -> Row:
    """The first that failed; else the one whose tracking, on its worst axis, is furthest above that
    axis' median."""
    keys = [f"tracking.rms.{axis}" for axis in axes]
    medians = _medians([row for row in rows if not row["error"]])

    def badness(row: Row) -> float:
        if row["error"]:
            return float("inf")
        known = [row[key] / medians[key] for key in keys if row[key] is not None and medians[key]]
        return max(known, default=0.0)

    return max(rows, key=badness)


def _medians(rows: list[Row]) -> dict[str, float | None]:
    """Of every column of numbers."""
    medians = dict[str, float | None]()
    for key in rows[0] if rows else ():
        values = [row[key] for row in rows]
        numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
        if numbers and key != "seed" and not key.startswith("vary."):
            medians[key] = statistics.median(numbers)
    return medians


def print_sweep(report: dict[str, Any]) -> None:
    """On standard output: a table, and the commands that repeat the worst seeds."""
    axes = report["axes"]
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for key in report["varied"]:
        table.add_column(escape(_short(key, report["varied"])))
    by_axis = (
        ("rms", report["unit"], "tracking.rms", 1),
        ("max", report["unit"], "tracking.max", 1),
        ("noise", report["effort_unit"], "torque.noise_rms", 1),
        ("clipped", ["%"], "torque.clipped_share", 100),
    )
    for name, units, _, _ in by_axis:
        title = f"{name} [{', '.join(dict.fromkeys(units))}]"
        table.add_column(escape(f"{title}\n{_columns(axes)}"))
    for name in (*COUNTS, "p99\n[us]", "worst\nseed"):
        table.add_column(escape(name), justify="right")
    for combination in report["combinations"]:
        median = combination["median"]
        cells = [str(value).removesuffix(".0") for value in combination["values"]]
        for _, _, key, scale in by_axis:
            cells.append(_columns([_text(median.get(f"{key}.{axis}"), scale) for axis in axes]))
        cells += [str(count) for count in combination["total"].values()]
        p99_us = median.get("compute_us.p99")
        cells += ["-" if p99_us is None else f"{p99_us:.0f}", str(combination["worst_seed"])]
        table.add_row(*map(escape, cells))
    Console(width=WIDTH).print(table)
    print("Medians over the seeds; late, refused and missed are added up. The worst seeds again:")
    for combination in report["combinations"]:
        print(f"  {combination['replay']}")
        of = f"of {combination['seeds']} seeds"
        if combination["failed"]:
            print(f"    {combination['failed']} {of} failed; this: {combination['worst_error']}")
        if combination["beyond_limits"]:
            print(f"    {combination['beyond_limits']} {of} went beyond a limit")


def _short(key: str, keys: list[str]) -> str:
    """As much of a key's end as tells it from the others."""
    steps = key.split(".")
    for length in range(1, len(steps)):
        end = ".".join(steps[-length:])
        if sum(other.endswith(f".{end}") for other in keys) == 1:
            return end
    return key


def _columns(texts: list[str]) -> str:
    """One for each axis, below each other if their lines are."""
    return " ".join(f"{text:6}" for text in texts).rstrip()


def _text(value: float | None, scale: float = 1) -> str:
    return "-" if value is None else f"{scale * value:.3g}"


def write_parquet(rows: list[Row], path: Path) -> None:
    """A line for each row, a column for each key of any. Raises OSError."""
    import pyarrow
    import pyarrow.parquet

    table = {}
    for key in dict.fromkeys(key for row in rows for key in row):
        values = [row.get(key) for row in rows]
        if any(isinstance(value, str) for value in values):
            values = [None if value is None else str(value) for value in values]
        known = any(value is not None for value in values)
        table[key] = pyarrow.array(values, None if known else pyarrow.float64())
    pyarrow.parquet.write_table(pyarrow.table(table), path)
