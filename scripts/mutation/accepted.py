"""tests/mutants.toml: which files are judged, and which surviving mutants are accepted, and why."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

SHARE_MAX = 0.03  # of all mutants that compile and differ


@dataclass(frozen=True)
class Key:
    """What identifies a mutant, wherever its line moves to."""

    file: str
    function: str  # "" outside of all
    line: str  # source text without its indentation
    mutation: str  # as the survivor was printed; the second like it in this line ends with " #2"

    def __str__(self) -> str:
        return f"{self.file}: {self.function}: {self.line}: {self.mutation}"


@dataclass(frozen=True)
class Judged:
    """The contents of tests/mutants.toml."""

    files: tuple[str, ...]
    survivors: dict[Key, str]  # and the argument for each
    uncovered: dict[tuple[str, str], str]  # file and line of code: why the judge never gets there


class MistakeError(Exception):
    """What is wrong with the file, to be told to its author."""


def load(path: Path) -> Judged:
    """Reads the list. Raises MistakeError."""
    try:
        data = tomllib.loads(path.read_text())
        files = tuple(str(name) for name in data["files"])
        survivors: dict[Key, str] = {}
        for entry in data.get("survivor", []):
            file, function, code = (str(entry[name]) for name in ("file", "function", "line"))
            one_or_more = entry["mutation"]
            for name in [one_or_more] if isinstance(one_or_more, str) else one_or_more:
                key = Key(file, function, code, str(name))
                if key in survivors:
                    raise MistakeError(f"{path}: listed twice: {key}")
                survivors[key] = str(entry["argument"])
        uncovered = {
            (str(e["file"]), str(e["line"])): str(e["argument"]) for e in data.get("uncovered", [])
        }
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise MistakeError(f"{path}: {error}") from error
    except KeyError as error:
        raise MistakeError(f"{path}: an entry without {error}") from error
    for what, argument in [*survivors.items(), *uncovered.items()]:
        if len(argument.split()) < 4:
            raise MistakeError(f"{path}: no argument for {what}")
    return Judged(files, survivors, uncovered)


def numbered(mutations: Iterable[tuple[str, str, str]]) -> list[str]:
    """Names of mutations, given with function and line, that are unique within these."""
    seen: Counter[tuple[str, str, str]] = Counter()
    names = []
    for entry in mutations:
        seen[entry] += 1
        names.append(entry[2] + (f" #{seen[entry]}" if seen[entry] > 1 else ""))
    return names
