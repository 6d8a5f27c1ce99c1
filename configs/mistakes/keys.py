"""The keys that a config may have: the JSON schema of `Config`, and its parts in words."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from functools import cache
from typing import Any

from headway.configs.mistakes.mistake import KeyPath
from headway.configs.mistakes.tree import has
from headway.configs.mistakes.units import same_but_unit, told
from headway.configs.mistakes.words import clean, flow, listed, number
from headway.configs.schema import Config

Schema = dict[str, Any]

LISTED_MAX = 12  # keys of a section that a message lists

_LETTERS = re.compile(r"\^\[(.+)\]\{(\d+),(\d+)\}\$")  # ^[A-Za-z]{1,9}$


@cache
def schema() -> Schema:
    """The JSON schema of all that a config may say."""
    return Config.model_json_schema()


def kinds(node: Schema) -> list[Schema]:
    """What a value may be, without references and null: for an axis, rotary and linear."""
    if "$ref" in node:
        return kinds(schema()["$defs"][node["$ref"].rpartition("/")[2]])
    several = node.get("anyOf") or node.get("oneOf")
    if several:
        return [kind for alternative in several for kind in kinds(alternative)]
    return [] if node.get("type") == "null" else [node]


def keys(kind: Schema) -> dict[str, Schema]:
    """A section's keys; none of anything else."""
    properties: dict[str, Schema] = kind.get("properties", {})
    return properties


def best_first(node: Schema, value: Any) -> list[Schema]:
    """The node's kinds, in the order of how many of their keys a value has."""
    found = kinds(node)
    return sorted(found, key=lambda kind: -_common(kind, value)) if len(found) > 1 else found


def _common(kind: Schema, value: Any) -> int:
    """How many keys a value shares with a kind, all below included and in whatever unit."""
    if not isinstance(value, dict):
        return 0
    count = 0
    for key, inner in keys(kind).items():
        if key in value:
            count += 2 + max((_common(below, value[key]) for below in kinds(inner)), default=0)
        else:
            count += any(same_but_unit(other, key) for other in value)
    return count


def at_path(tree: Any, path: KeyPath) -> Schema | None:
    """What the schema has at a path; the tree decides where there are several kinds."""
    node, value = schema(), tree
    for step in path:
        for kind in best_first(node, value):
            inner = kind.get("items") if isinstance(step, int) else keys(kind).get(step)
            inner = inner or kind.get("additionalProperties")
            if isinstance(inner, dict):
                break
        else:
            return None
        node, value = inner, value[step] if has(value, step) else None
    return node


def sections(node: Schema | None = None, path: KeyPath = ()) -> Iterator[tuple[KeyPath, Schema]]:
    """All sections, with their paths; N stands for the index in a list."""
    for kind in kinds(node or schema()):
        if "items" in kind:
            yield from sections(kind["items"], (*path, "N"))
        elif keys(kind):
            yield path, kind
            for key, inner in keys(kind).items():
                yield from sections(inner, (*path, key))


def wanted(node: Schema, key: str) -> str:
    """What a value of `key` has to be: `a number from 0 to 10, in rad`."""
    unit = f", in {told(key)}" if told(key) else ""
    null = ", or null" if {"type": "null"} in node.get("anyOf", ()) else ""
    found = kinds(node)
    words = [_kind(found[0])]
    for kind in found[1:]:
        if not keys(kind):
            words.append("a list of such" if kind.get("items") == found[0] else _kind(kind))
    return listed(words, "or") + unit + null


def listed_keys(kind: Schema, limit: int = LISTED_MAX) -> str:
    """A section's keys: `knot_us and margin_us`."""
    names = list(keys(kind))
    return listed(names) if len(names) <= limit else ", ".join(names[:limit]) + ", ..."


def of_type(node: Schema, *types: str) -> Schema | None:
    """The first of a node's kinds that has one of these types."""
    return next((kind for kind in kinds(node) if kind.get("type") in types), None)


def fits(value: float, kind: Schema) -> bool:
    """Whether a number is in the range of a kind of number."""
    if kind["type"] == "integer" and not isinstance(value, int):
        return False
    low, high = kind.get("minimum", -math.inf), kind.get("maximum", math.inf)
    above, below = kind.get("exclusiveMinimum", -math.inf), kind.get("exclusiveMaximum", math.inf)
    return bool(low <= value <= high and above < value < below)


def _kind(kind: Schema) -> str:
    match kind:
        case {"const": value}:
            return f"`{flow(value)}`"
        case {"enum": values}:
            return listed(map(flow, values), "or")
        case {"type": "integer"}:
            return f"a whole number{_range(kind, 1)}"
        case {"type": "number"}:
            return f"a number{_range(kind, 0)}"
        case {"type": "boolean"}:
            return "true or false"
        case {"type": "string"}:
            return f"text{_letters(kind.get('pattern'))}"
        case {"type": "array", "items": dict(inner)}:
            low, high = kind.get("minItems"), kind.get("maxItems")
            least = f" of {low}" + " or more" * (low != high) if low else ""
            return f"a list{least}, each entry {_kind(kinds(inner)[0])}"
        case {"properties": _}:
            return f"a section with {listed_keys(kind, 6)}"
        case {"additionalProperties": dict(inner)}:
            return f"a section of names, each with {_kind(kinds(inner)[0])}"
    return "something else"


def _range(kind: Schema, step: int) -> str:
    """`step` is the distance of neighbouring numbers, 0 if there are none."""
    low, high = kind.get("minimum"), kind.get("maximum")
    above, below = kind.get("exclusiveMinimum"), kind.get("exclusiveMaximum")
    if step and above is not None:
        low, above = above + step, None
    if step and below is not None:
        high, below = below - step, None
    words = [
        f" from {number(low)}" if low is not None and high is not None else "",
        f" of at least {number(low)}" if low is not None and high is None else "",
        f" above {number(above)}" if above is not None else "",
        f" below {number(below)}" if below is not None else "",
        f"{' and up' if above is not None else ''} to {number(high)}" if high is not None else "",
    ]
    return "".join(words)


def _letters(pattern: str | None) -> str:
    if pattern is None:
        return ""
    if found := _LETTERS.fullmatch(pattern):
        letters = listed(re.findall(".-.|.", found[1]))
        return f" of {found[2]} to {found[3]} characters: {letters}"
    return f" that matches {clean(pattern)}"
