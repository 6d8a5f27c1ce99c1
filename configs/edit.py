"""One number of a config file changed, and nothing else."""

from __future__ import annotations

import re
from pathlib import Path

from headway.configs.mistakes.mistake import ConfigError, KeyPath, Mistake, Place
from headway.configs.mistakes.source import read_text, read_yaml
from headway.configs.mistakes.tree import at, changed, places_at
from headway.configs.replace import replace_text

VALUE = re.compile(r"[^\s,}\]]+")


def edit_number(path: Path, key: KeyPath, number: int) -> None:
    """Writes another number over the one that a config file has at `key`, in its place.

    Raises ConfigError for a file where that would change anything else, as with an anchor, and
    OSError; the file is then as it was.
    """
    text = read_text(path)
    source = Place(str(path))
    tree, _ = read_yaml(text, source)
    places = places_at(tree, key) or (source, source)
    edited = _over(text, tree, key, places[1], number) if isinstance(at(tree, key), int) else None
    if edited is None:
        words = f"is not a number by itself, so it stays: write {number} there"
        raise ConfigError(Mistake(places[1], key, words))
    replace_text(path, edited)


def _over(text: str, tree: object, key: KeyPath, place: Place, number: int) -> str | None:
    """The text with the number at `place`; None if it then says anything but that."""
    lines = text.split("\n")
    before, after = (
        lines[place.line - 1][: place.column - 1],
        lines[place.line - 1][place.column - 1 :],
    )
    lines[place.line - 1] = before + VALUE.sub(str(number), after, count=1)
    edited = "\n".join(lines)
    try:
        said, _ = read_yaml(edited, place)
    except ConfigError:
        return None
    return edited if said == changed(tree, key, number, (place, place)) else None
