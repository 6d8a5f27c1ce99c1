"""Mistakes in a config, told so that the user can mend them."""

from __future__ import annotations

from dataclasses import dataclass

from headway.configs.mistakes.words import clean

SHOWN_MAX = 20  # mistakes that one message tells

KeyPath = tuple[int | str, ...]  # keys and list indices, from the top


@dataclass(frozen=True)
class Place:
    """Where something is written: a line and column of the file, or a `--set`.

    Lines and columns count from 1; 0 is unknown. `order` is 0 for the file and n for the nth
    `--set`.
    """

    source: str
    line: int = 0
    column: int = 0
    order: int = 0

    def __str__(self) -> str:
        return f"{self.source}:{self.line}:{self.column}" if self.line else self.source

    def within(self, line: int, column: int) -> Place:
        """A place in the same source; a `--set` has no lines."""
        return self if self.order else Place(self.source, line, column)

    @property
    def rank(self) -> tuple[int, int, int]:
        """Sorts mistakes as they are met in reading."""
        return self.order, self.line, self.column


@dataclass(frozen=True)
class Mistake:
    """One of them: where, at which key (empty: none), what is wrong and what to write."""

    place: Place
    key: KeyPath
    text: str

    def __str__(self) -> str:
        key = f"{dotted(self.key)}: " if self.key else ""
        return f"{self.place}: {key}{self.text}"


class ConfigError(Exception):
    """All that is wrong with a config: a line for each mistake, in the order of the file."""

    def __init__(self, *mistakes: Mistake) -> None:
        self.mistakes = sorted(mistakes, key=lambda mistake: mistake.place.rank)
        lines = [str(mistake) for mistake in self.mistakes[:SHOWN_MAX]]
        more = len(mistakes) - SHOWN_MAX
        if more > 0:
            lines.append(f"... and {more} more {'mistake' if more == 1 else 'mistakes'}")
        super().__init__("\n".join(lines))

    def __reduce__(self) -> tuple[type[ConfigError], tuple[Mistake, ...]]:
        return type(self), tuple(self.mistakes)


def dotted(path: KeyPath) -> str:
    """A path of keys as `--set` takes it."""
    return ".".join(clean(str(step)) for step in path)
