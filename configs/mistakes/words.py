"""Values and lists as messages about a config show them: short, in one line, as YAML has them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

TEXT_MAX = 60  # characters of something given that a message repeats


def clean(text: str, limit: int = TEXT_MAX) -> str:
    """`text` in one line that any terminal can show, cut to `limit` characters."""
    kept = text if len(text) <= limit else text[:limit] + "..."
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in kept)


def listed(items: Iterable[object], last: str = "and") -> str:
    """`a, b and c`."""
    *first, end = [str(item) for item in items]
    return f"{', '.join(first)} {last} {end}" if first else end


def number(value: float) -> str:
    """A number in YAML, to 12 digits: 1e12, 0.05, .inf."""
    if isinstance(value, int):
        return clean(str(value))
    if not math.isfinite(value):
        return ".nan" if math.isnan(value) else "-.inf" if value < 0 else ".inf"
    short = f"{value:g}"
    text = short if float(short) == value else f"{value:.12g}"
    return text.replace("e+", "e").replace("e0", "e").replace("e-0", "e-")


def scalar(value: Any) -> str:
    """A value in YAML; text in quotes only if it would be read as something else."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return number(value) if isinstance(value, int | float) else clean(str(value))


def shown(value: Any) -> str:
    """A value in words: `'12 ms'`, `a list of 3`, `nothing`."""
    if value is None:
        return "nothing"
    if isinstance(value, str):
        quote = '"' if "'" in value else "'"
        return f"{quote}{clean(value)}{quote}"
    if isinstance(value, list):
        return f"a list of {len(value)}" if value else "an empty list"
    if isinstance(value, dict):
        keys = clean(", ".join(value))
        return f"a section with {keys}" if value else "an empty section"
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return f"{value:.1f}"  # where an integer is wanted, this is the difference
    return scalar(value)


def flow(value: Any) -> str:
    """A value in YAML, in one line: `{gear: 30, supply_V: 48}`."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {flow(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(flow(inner) for inner in value) + "]"
    return "null" if value is None else scalar(value)
