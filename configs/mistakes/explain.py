"""What is wrong with a value, or missing, in plain words, and what to write instead."""

from __future__ import annotations

import difflib
import re
from typing import Any

from headway.configs.mistakes.examples import example
from headway.configs.mistakes.keys import Schema, at_path, best_first, fits, wanted
from headway.configs.mistakes.mistake import KeyPath
from headway.configs.mistakes.suggest import snippet
from headway.configs.mistakes.tree import at, places_at
from headway.configs.mistakes.units import LENGTH_MAX, convert
from headway.configs.mistakes.words import flow, listed, number, shown

EXAMPLE_MAX = 100  # characters
TRUE, FALSE = ("yes", "on", "y"), ("no", "off", "n")

_PLAIN = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_GROUPED = re.compile(r"[-+]?\d{1,3}([_', ]\d{3})+(\.\d+)?")  # 1,000,000.5
_COMMA = re.compile(r"[-+]?\d*,\d+")  # 1,5


def missing(tree: Any, path: KeyPath) -> str:
    """For a key that has to be there."""
    node = at_path(tree, path) or {}
    text = f"missing: {wanted(node, str(path[-1]))}"
    value = example(tree, path)
    places = places_at(tree, path[:-1])
    line = snippet(path, value, in_set=places is not None and places[0].order > 0)
    if len(line) <= EXAMPLE_MAX:
        text += f"; for example `{line}`"
    told = " ".join(node.get("description", "").split())
    return f"{text} ({told})" if told else text


def wrong(tree: Any, path: KeyPath) -> str:
    """For a value of the wrong type, or out of its range."""
    key = next((step for step in reversed(path) if isinstance(step, str)), "")
    value, node = at(tree, path), at_path(tree, path) or {}
    text = f"must be {wanted(node, key)} (given: {shown(value)})"
    hints = (_hint(value, kind, key) for kind in best_first(node, value))
    hint = next(filter(None, hints), None)
    return f"{text}; write {hint}" if hint else text


def broken_rule(tree: Any, section: KeyPath, text: str) -> list[tuple[KeyPath, str]]:
    """The keys and the words of what a section's own check says: `KEY must be ...; KEY has ...`.

    What begins with none of the keys below the section is about the section.
    """
    found: list[tuple[KeyPath, str]] = []
    for part in text.split("; "):
        word, _, rest = part.partition(" ")
        word = word.removesuffix(":")
        key = (*section, *(int(step) if step.isdecimal() else step for step in word.split(".")))
        if rest and (at(tree, key) is not None or at_path(tree, key) is not None):
            found.append((key, rest))
        elif found:
            found[-1] = found[-1][0], f"{found[-1][1]}; {part}"
        else:
            found.append((section, part))
    return [(key, words + _given(at(tree, key), words)) for key, words in found]


def _given(value: Any, words: str) -> str:
    told = isinstance(value, int | float) and words.startswith("must")
    return f" (given: {shown(value)})" if told else ""


def _hint(value: Any, kind: Schema, key: str) -> str | None:
    """What to write for a value that can be understood nevertheless."""
    if isinstance(value, list) and "items" not in kind:
        only = value[0] if len(value) == 1 else None
        return f"{flow(only)} without brackets" if isinstance(only, str | int | float) else None
    match kind:
        case {"enum": values}:
            return _nearest(value, values)
        case {"const": only}:
            return flow(only)
        case {"type": "integer" | "number"}:
            return _number(value, kind, key)
        case {"type": "boolean"}:
            word = str(value).lower()
            return "true" if word in (*TRUE, "1") else "false" if word in (*FALSE, "0") else None
        case {"type": "string"} if isinstance(value, int | float) and not isinstance(value, bool):
            return f'"{number(value)}", in quotes'
    return None


def _number(value: Any, kind: Schema, key: str) -> str | None:
    if isinstance(value, str):
        meant = _readings(value, key)
        how = " without quotes" if meant and _PLAIN.fullmatch(value) else ""
    else:
        how, meant = "", [value] if isinstance(value, float) else []
    fitting = [number(_whole(m, kind)) + how for m in meant if fits(_whole(m, kind), kind)]
    return listed(dict.fromkeys(fitting), "or") if fitting else None


def _readings(text: str, key: str) -> list[float]:
    """The numbers that a text may mean."""
    if len(text) > LENGTH_MAX:
        return []
    if _PLAIN.fullmatch(text):
        return [float(text)]
    with_unit = convert(text, key)
    found = [] if with_unit is None else [with_unit]
    if _COMMA.fullmatch(text):
        found.append(float(text.replace(",", ".")))
    if _GROUPED.fullmatch(text):
        found.append(float(re.sub(r"[_', ]", "", text)))
    return found


def _whole(value: float, kind: Schema) -> float:
    """An integer where one is wanted and it is one but for rounding."""
    if kind["type"] == "integer" and abs(value) < 1e15 and abs(value - round(value)) < 1e-6:
        return round(value)
    return value


def _nearest(value: Any, values: list[Any]) -> str | None:
    """One of the values, if it is similar."""
    if isinstance(value, str):
        texts = [text for text in values if isinstance(text, str)]
        found = difflib.get_close_matches(value.lower(), texts, 1)
        return found[0] if found else None
    numbers = [n for n in values if isinstance(n, int | float)]
    if isinstance(value, bool) or not isinstance(value, int | float) or not numbers:
        return None
    nearest = min(numbers, key=lambda n: abs(n - value))
    return number(nearest) if nearest / 2 < value < nearest * 2 else None
