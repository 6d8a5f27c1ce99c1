"""For each key a value that may stand there."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from headway.configs.mistakes.keys import Schema, at_path, best_first, kinds
from headway.configs.mistakes.mistake import ConfigError, KeyPath, Place
from headway.configs.mistakes.source import read_text, read_yaml
from headway.configs.mistakes.tree import at
from headway.configs.schema import Config


def example(tree: Any, path: KeyPath) -> Any:
    """From a config that comes with Headway or, where none has the key, made up. None if the
    schema has no such path."""
    node = at_path(tree, path)
    if node is None:
        return None
    kind = best_first(node, at(tree, path))[0]
    first = tuple(0 if isinstance(step, int) else step for step in path)
    for shipped in _shipped():
        for where in (path, first):
            value = at(shipped, where)
            if value is not None and best_first(node, value)[0] == kind:
                return value
    return _made_up(node, kind)


@cache
def _shipped() -> list[Any]:
    """The valid configs beside this file: the user may be changing them."""
    trees = []
    for path in sorted(Path(__file__).parents[1].glob("*.yaml")):
        try:
            tree, _ = read_yaml(read_text(path), Place(str(path)))
            Config.model_validate(tree)
        except (ConfigError, ValidationError):
            continue
        trees.append(tree)
    return trees


def _made_up(node: Schema, kind: Schema) -> Any:
    if node.get("default") is not None:
        return node["default"]
    match kind:
        case {"const": value} | {"enum": [value, *_]}:
            return value
        case {"type": "integer" | "number"}:
            low = kind.get("minimum", kind.get("exclusiveMinimum", 1))
            return max(low, min(1, kind.get("maximum", 1)))
        case {"type": "boolean"}:
            return False
        case {"type": "string"}:
            return "..."
        case {"type": "array", "items": dict(inner)}:
            return [_made_up(inner, kinds(inner)[0])] * kind.get("minItems", 0)
        case {"properties": dict(inner)}:
            return {
                key: _made_up(inner[key], kinds(inner[key])[0]) for key in kind.get("required", ())
            }
    return {}
