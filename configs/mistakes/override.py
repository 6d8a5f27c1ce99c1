"""Changes of a config from the command line: `--set key.path=value`."""

from __future__ import annotations

from headway.configs.mistakes.mistake import ConfigError, KeyPath, Mistake, Place, dotted
from headway.configs.mistakes.source import DEPTH_MAX, read_yaml
from headway.configs.mistakes.tree import Row, Table, at, changed
from headway.configs.mistakes.words import clean, shown


def override(tree: Table, text: str, order: int) -> tuple[Table, list[Mistake]]:
    """The tree with one change, and what is wrong with it: then the tree is as it was.

    `order` counts the changes from 1.
    """
    place = Place(f"--set {clean(text, 100)}", order=order)
    name, equals, value_text = text.partition("=")
    steps = name.split(".")
    words = all(step and step.isprintable() for step in steps)
    if not equals or not words or len(steps) > DEPTH_MAX:
        usage = "write key.path=value, like --set loop.margin_us=8192"
        return tree, [Mistake(place, (), usage)]
    try:
        value, mistakes = read_yaml(value_text, place)
    except ConfigError as error:
        return tree, error.mistakes
    path: KeyPath = ()
    changes = tree
    for number, step in enumerate(steps, 1):
        node = at(changes, path)
        if isinstance(node, Row):
            if not step.isdecimal() or len(step) > 9 or int(step) >= len(node):
                return tree, [Mistake(place, (*path, step), _no_entry(path, node))]
            path = (*path, int(step))
        elif isinstance(node, Table):
            path = (*path, step)
        else:
            told = f"{dotted(path)} is {shown(node)}, and nothing is below it"
            return tree, [Mistake(place, (*path, step), told)]
        if number < len(steps) and at(changes, path) is None:
            changes = changed(changes, path, Table(), (place, place))
    return changed(changes, path, value, (place, place)), mistakes


def _no_entry(path: KeyPath, row: Row) -> str:
    name = dotted(path)
    if not row:
        return f"no such entry: {name} is an empty list"
    return f"no such entry: the first is {name}.0, the last {name}.{len(row) - 1}"
