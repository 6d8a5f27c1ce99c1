"""Mappings and lists that know where each of their entries is written."""

from __future__ import annotations

from copy import copy
from typing import Any

from headway.configs.mistakes.mistake import KeyPath, Place

Places = tuple[Place, Place]  # of an entry's key and of its value; in a list they are the same


class Table(dict[str, Any]):
    """A mapping. `entries` and `depth` count what is in it, with all that is shared repeated."""

    def __init__(self) -> None:
        super().__init__()
        self.places: dict[str, Places] = {}
        self.entries, self.depth = 1, 1

    def put(self, key: str, value: Any, places: Places) -> None:
        """Adds an entry, or changes it."""
        self[key], self.places[key] = value, places
        _count(self, value)

    def remove(self, key: str) -> None:
        del self[key], self.places[key]

    def __copy__(self) -> Table:
        other = Table()
        other.update(self)
        other.places, other.entries, other.depth = dict(self.places), self.entries, self.depth
        return other


class Row(list[Any]):
    """A list, as Table is a mapping."""

    def __init__(self) -> None:
        super().__init__()
        self.places: list[Places] = []
        self.entries, self.depth = 1, 1

    def add(self, value: Any, place: Place) -> None:
        """Adds an entry at the end."""
        self.append(value)
        self.places.append((place, place))
        _count(self, value)

    def put(self, index: int, value: Any, places: Places) -> None:
        """Changes an entry."""
        self[index], self.places[index] = value, places

    def remove(self, index: int) -> None:
        del self[index], self.places[index]

    def __copy__(self) -> Row:
        other = Row()
        other.extend(self)
        other.places, other.entries, other.depth = list(self.places), self.entries, self.depth
        return other


def _count(node: Table | Row, value: Any) -> None:
    if isinstance(value, Table | Row):
        node.entries += value.entries
        node.depth = max(node.depth, value.depth + 1)
    else:
        node.entries += 1


def has(node: Any, step: int | str) -> bool:
    """Whether a node has an entry of that key or index."""
    if isinstance(node, Row):
        return isinstance(step, int) and 0 <= step < len(node)
    return isinstance(node, Table) and step in node


def at(tree: Any, path: KeyPath) -> Any:
    """What is at a path; None if there is nothing."""
    for step in path:
        if not has(tree, step):
            return None
        tree = tree[step]
    return tree


def places_at(tree: Any, path: KeyPath) -> Places | None:
    """Of the deepest part of a path that the tree has; None if it has no part of it."""
    places = None
    for step in path:
        if not has(tree, step):
            break
        places, tree = tree.places[step], tree[step]
    return places


def changed(tree: Any, path: KeyPath, value: Any, places: Places) -> Any:
    """The tree with another value at `path`, whose parents it has to have.

    The rest is shared with `tree`, which stays as it is: so what an alias repeats is changed in
    this place alone.
    """
    node, step = copy(tree), path[0]
    if len(path) == 1:
        node.put(step, value, places)
    else:
        node[step] = changed(node[step], path[1:], value, places)
    return node


def without(tree: Any, path: KeyPath) -> Any:
    """The tree without what is at `path`; shared as in `changed`."""
    node, step = copy(tree), path[0]
    if len(path) == 1:
        node.remove(step)
    else:
        node[step] = without(node[step], path[1:])
    return node
