"""What every benchmark does with its figures: a table, its goals, a JSON file."""

from __future__ import annotations

import argparse
import json
import operator
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

COMPARE = {"<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt}


def arguments(
    description: str, add: Callable[[argparse.ArgumentParser], None] | None = None
) -> argparse.Namespace:
    """The options that all benchmarks share, and those that `add` adds."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--long", action="store_true", help="what the docs quote")
    parser.add_argument("--json", type=Path, metavar="FILE", help="rows and goals")
    if add is not None:
        add(parser)
    return parser.parse_args()


def goal(name: str, value: float, op: str, limit: float) -> dict[str, Any]:
    """A figure and what it should be."""
    met = bool(COMPARE[op](value, limit))
    return {"name": name, "value": float(value), "op": op, "limit": float(limit), "met": met}


def machine() -> str:
    """The computer, in a line."""
    model = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    return f"{model}, Python {platform.python_version()}, {platform.system()}"


def _figure(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def table(title: str, rows: list[dict[str, Any]]) -> None:
    """Prints rows of equal keys."""
    view = Table(title=title, title_justify="left")
    for key in rows[0]:
        view.add_column(key, justify="left" if isinstance(rows[0][key], str) else "right")
    for row in rows:
        view.add_row(*(v if isinstance(v, str) else _figure(v) for v in row.values()))
    Console(width=140).print(view)


def finish(rows: list[dict[str, Any]], goals: list[dict[str, Any]], file: Path | None) -> None:
    """Prints the goals and writes the JSON."""
    for g in goals:
        mark = "met   " if g["met"] else "MISSED"
        print(f"{mark}  {g['name']}: {g['value']:.4g} {g['op']} {g['limit']:.4g}")
    print(f"on {machine()}")
    if file:
        file.write_text(json.dumps({"rows": rows, "goals": goals}, indent=1))
