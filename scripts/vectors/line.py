"""One line of a vector file; tests/vectors/README.md describes it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

Value = int | str | bytes | Sequence[int]


def text(value: Value) -> str:
    """Bytes in hexadecimal, a list as 7,-5*3 for 7, -5, -5, -5."""
    if isinstance(value, str | int):
        return str(int(value) if isinstance(value, bool) else value)
    if isinstance(value, bytes):
        return value.hex()
    runs = [(number, len(list(run))) for number, run in groupby(value)]
    return ",".join(f"{number}*{count}" if count > 1 else f"{number}" for number, count in runs)


def line(word: str, **values: Value) -> str:
    """A vector without its answer."""
    return " ".join([word, *(f"{name}={text(value)}" for name, value in values.items())])
