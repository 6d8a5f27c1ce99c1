"""The combinations of a sweep: every value of each varied key with every value of the others."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from headway.configs.load import ConfigError, load_config
from headway.configs.mistakes.mistake import Mistake
from headway.configs.schema import Config


@dataclass(frozen=True)
class Varied:
    """A key with dots and its values, as they were typed."""

    key: str
    values: tuple[str, ...]


@dataclass(frozen=True)
class Combination:
    """A value for each varied key, and the config with it."""

    values: dict[str, str]
    changes: list[str]  # of the file, all of them, as for --set
    config: Config

    def __str__(self) -> str:
        return " ".join(f"{key}={value}" for key, value in self.values.items())

    def typed(self, key: str) -> Any:
        """A varied value as the config has it, or as it was typed if that is no single value."""
        value: Any = self.config.model_dump()
        for step in key.split("."):
            value = value[int(step)] if isinstance(value, list) else value[step]
        return value if isinstance(value, bool | int | float | str) else self.values[key]


def parse_varied(texts: list[str], changes: list[str]) -> list[Varied]:
    """From `key.path=value,value`; `changes` hold for all combinations.

    Raises ValueError with all that is wrong.
    """
    varied, mistakes = list[Varied](), []
    fixed = {change.partition("=")[0] for change in changes}
    if "seed" in fixed:
        mistakes.append("--set seed: every combination gets the seeds 0, 1, 2 ...: see --seeds")
    for text in texts:
        key, _, values_text = text.partition("=")
        key, values = key.strip(), tuple(split_values(values_text))
        if not key or not all(values):
            mistakes.append(
                f"--vary {text}: write key.path=value,value, like loop.knot_us=2048,4096"
            )
        elif key == "seed":
            mistakes.append(f"--vary {text}: seeds are varied anyway: say how many with --seeds")
        elif key in fixed:
            mistakes.append(f"--vary {text}: {key} is set for all runs; leave one of both out")
        elif key in (earlier.key for earlier in varied):
            mistakes.append(f"--vary {text}: {key} is varied already; give all values at once")
        varied.append(Varied(key, values))
    if mistakes:
        raise ValueError("\n".join(mistakes))
    return varied


def split_values(text: str) -> list[str]:
    """Parts a text at its commas, but for those within brackets, braces or quotes."""
    parts, depth, quote = [""], 0, ""
    for c in text:
        if c == "," and depth == 0 and not quote:
            parts.append("")
            continue
        parts[-1] += c
        if quote:
            quote = "" if c == quote else quote
        elif c in "'\"":
            quote = c
        else:
            depth += (c in "[{") - (c in "]}")
    return [part.strip() for part in parts]


def combinations(path: Path, changes: list[str], varied: list[Varied]) -> list[Combination]:
    """All of them, the last key varying fastest.

    Raises ConfigError with the mistakes of all, and ValueError if two are the same.
    """
    found, mistakes = dict[str, Combination](), dict[Mistake, None]()
    for values in itertools.product(*(key.values for key in varied)):
        by_key = {key.key: value for key, value in zip(varied, values, strict=True)}
        all_changes = [*changes, *(f"{key}={value}" for key, value in by_key.items())]
        try:
            config = load_config(path, all_changes)
        except ConfigError as error:
            mistakes |= dict.fromkeys(_as_typed(m, len(changes)) for m in error.mistakes)
            continue
        this = Combination(by_key, all_changes, config)
        same = found.setdefault(config.model_dump_json(), this)
        if same is not this:
            raise ValueError(f"--vary: {this} is the same as {same}")
    if mistakes:
        raise ConfigError(*mistakes)
    return list(found.values())


def _as_typed(mistake: Mistake, fixed: int) -> Mistake:
    """The changes after the `fixed` first ones have come from --vary."""
    place = mistake.place
    if place.order <= fixed:
        return mistake
    return replace(mistake, place=replace(place, source=place.source.replace("set", "vary", 1)))
