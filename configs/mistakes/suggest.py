"""For a key that does not exist: the one that was probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from headway.configs.mistakes.keys import (
    Schema,
    at_path,
    best_first,
    fits,
    keys,
    listed_keys,
    of_type,
    sections,
    wanted,
)
from headway.configs.mistakes.mistake import KeyPath, dotted
from headway.configs.mistakes.tree import at, has, places_at
from headway.configs.mistakes.units import LENGTH_MAX, PURE, factor, split, told
from headway.configs.mistakes.words import flow, listed

SIMILAR = 0.6  # difflib's ratio, in the same section
SIMILAR_ELSEWHERE = 0.8


@dataclass(frozen=True)
class Suggestion:
    """What to do about an unknown key: in words and, where it is clear, as a path and a value."""

    text: str
    path: KeyPath = ()
    value: Any = None


def suggest(tree: Any, path: KeyPath) -> Suggestion:
    """For the unknown key at the end of `path`."""
    return _Search(tree, path).best()


def snippet(path: KeyPath, value: Any, in_set: bool) -> str:
    """What to write for a value at `path`, in the file or as a `--set`."""
    return f"{dotted(path)}={flow(value)}" if in_set else f"{path[-1]}: {flow(value)}"


class _Search:
    """From the surest guess to none."""

    def __init__(self, tree: Any, path: KeyPath) -> None:
        self.tree, self.path, self.section, self.key = tree, path, path[:-1], str(path[-1])
        self.value, places = at(tree, path), places_at(tree, path)
        self.in_set = places is not None and places[0].order > 0
        node = at_path(tree, self.section) or {}
        self.here = best_first(node, at(tree, self.section))
        self.there = [(where, kind) for where, kind in sections() if kind not in self.here]

    def best(self) -> Suggestion:
        return (
            self._other_unit(self.section, self.here)
            or self._other_place()
            or self._similar()
            or self._other_unit_elsewhere()
            or self._similar_elsewhere()
            or Suggestion(f"{dotted(self.section) or 'a config'} has {listed_keys(self.here[0])}")
        )

    def _other_unit(self, section: KeyPath, found: Iterable[Schema]) -> Suggestion | None:
        """The same but for the unit: `margin_us` for `margin_ms`, or for `margin`."""
        stem, units = split(self.key)
        stem = stem.lower()
        same = [
            (key, node, factor(self.key, key))
            for kind in found
            for key, node in keys(kind).items()
            if split(key)[0].lower() == stem and not units == split(key)[1] == [PURE]
        ]
        for key, node, scale in same:
            if scale is not None:
                return self._write((*section, key), node, _scaled(self.value, scale, node))
        for key, _, _ in same:
            if stem:
                unit = f", in {told(key)}" if told(key) else ""
                return Suggestion(f"did you mean `{key}`{unit}?", (*section, key))
        return None

    def _write(self, path: KeyPath, node: Schema, value: Any) -> Suggestion:
        key = str(path[-1])
        if has(at(self.tree, path[:-1]), key) and not self.in_set:
            return Suggestion(f"`{key}` is given as well: keep one of the two")
        if not _all_fit(value, node):
            return Suggestion(f"did you mean `{key}`, {wanted(node, key)}?", path)
        unit = f"{dotted(path)} is in {told(key)}" if told(key) else f"{dotted(path)} has no unit"
        where = "" if path[:-1] == self.section else f" under `{dotted(path[:-1])}`"
        text = snippet(path, value, self.in_set)
        return Suggestion(f"write `{text}`{where} ({unit})", path, value)

    def _other_place(self) -> Suggestion | None:
        """The same key is one of another section's."""
        above, _, key = self.key.rpartition(".")  # `loop.margin_us: 8192` is meant as in --set
        where = [self._filled(path) for path, kind in self.there if key in keys(kind)]
        where = [path for path in dict.fromkeys(where) if dotted(path).endswith(above)]
        if not where:
            return None
        if len(where) == 1 and "N" not in where[0]:
            target, value = (*where[0], key), self.value
        else:
            target, value = (), None
        names = listed((f"`{dotted(path)}`" if path else "the top" for path in where), "or")
        under = "at" if where == [()] else "under"
        return Suggestion(f"`{key}` belongs {under} {names}", target, value)

    def _filled(self, path: KeyPath) -> KeyPath:
        """A section's path with the indices that it shares with this one."""
        filled: KeyPath = ()
        for i, step in enumerate(path):
            shared = step == "N" and filled == self.section[:i] and i < len(self.section)
            filled = (*filled, self.section[i] if shared else step)
        return filled

    def _similar(self) -> Suggestion | None:
        for kind in self.here:
            if found := _closest(self.key, keys(kind), SIMILAR):
                twice = has(at(self.tree, self.section), found) and not self.in_set
                text = f"did you mean `{found}`{', which is given as well' if twice else ''}?"
                return Suggestion(text, (*self.section, found), self.value)
        return None

    def _other_unit_elsewhere(self) -> Suggestion | None:
        for path, kind in self.there:
            found = self._other_unit(self._filled(path), [kind])
            if found and found.value is not None:
                return found
        return None

    def _similar_elsewhere(self) -> Suggestion | None:
        names = {key: path for path, kind in self.there for key in keys(kind)}
        found = _closest(self.key, names, SIMILAR_ELSEWHERE)
        if not found:
            return None
        path = self._filled(names[found])
        where = f"under `{dotted(path)}`" if path else "at the top"
        return Suggestion(f"did you mean `{found}` {where}?")


def _closest(key: str, names: Iterable[str], cutoff: float) -> str | None:
    by_case = {name.lower(): name for name in names}
    plain = key[:LENGTH_MAX].lower().replace("-", "_").replace(" ", "_")
    begun = [name for name in by_case if name.startswith(f"{plain}_")]
    found = begun or difflib.get_close_matches(plain, by_case, 1, cutoff)
    return by_case[found[0]] if found else None


def _all_fit(value: Any, node: Schema) -> bool:
    """Whether it is a number that the schema allows, or a list of such."""
    if isinstance(value, list):
        row = of_type(node, "array")
        return row is not None and all(_all_fit(item, row["items"]) for item in value)
    kind = of_type(node, "integer", "number")
    return kind is not None and isinstance(value, int | float) and fits(value, kind)


def _scaled(value: Any, scale: float, node: Schema) -> Any:
    """A number, or a list of them, in the other unit; None of anything else."""
    if isinstance(value, list):
        inner = (of_type(node, "array") or {}).get("items", {})
        items = [_scaled(item, scale, inner) for item in value]
        return None if None in items or not items else items
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    scaled = float(f"{value * scale:.12g}")
    whole = of_type(node, "integer") is not None and abs(scaled) < 1e15
    return round(scaled) if whole else scaled
