"""From a YAML file and `--set key.path=value` to a checked Config."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from headway.configs.mistakes.check import check
from headway.configs.mistakes.mistake import ConfigError, Mistake, Place
from headway.configs.mistakes.override import override
from headway.configs.mistakes.source import near, read_text, read_yaml
from headway.configs.mistakes.tree import Table, at, places_at
from headway.configs.mistakes.words import clean
from headway.configs.schema import Config

__all__ = ["ConfigError", "load_config"]

MODEL = ("machine", "model")


def load_config(path: Path, overrides: list[str] | None = None) -> Config:
    """Reads and checks a config file, and that the model which it names is there.

    `overrides` are `key.path=value` strings, the value in YAML. Raises ConfigError with all
    mistakes at once, each with its key and its line and column, or the override that it is in.
    """
    source = Place(clean(str(path), 4096))
    tree, mistakes = read_yaml(read_text(path), source)
    if not isinstance(tree, Table):
        raise ConfigError(*mistakes, Mistake(source, (), _no_section(tree)))
    if "tracks" in tree and "devices" in tree and "machine" not in tree:
        text = f"is a stage, without a machine: try headway play {clean(str(path), 4096)}"
        raise ConfigError(Mistake(source, (), text))
    for order, text in enumerate(overrides or [], 1):
        tree, more = override(tree, text, order)
        mistakes += more
    config, more = check(tree, source)
    mistakes += more + _model_missing(tree, path)
    if mistakes or config is None:
        raise ConfigError(*mistakes)
    return config


def _no_section(value: Any) -> str:
    if value is None:
        return "is empty: start from a copy of configs/arm2.yaml"
    what = "a list" if isinstance(value, list) else "a single value"
    return f"is {what}: a config is a section of keys, each with `: ` after it, like `name: arm2`"


def _model_missing(tree: Table, path: Path) -> list[Mistake]:
    """The mistake that the model is no file, if it is none."""
    name, places = at(tree, MODEL), places_at(tree, MODEL)
    if not isinstance(name, str) or not places:
        return []
    file = Path(os.path.abspath(path.parent / name))
    if os.path.isfile(file):
        return []
    text = (
        f"there is no file {clean(str(file), 4096)}; a relative path starts at the config's folder"
    )
    if found := near(file):
        text += f"; did you mean {clean(os.path.join(os.path.dirname(name), found))}?"
    return [Mistake(places[1], MODEL, text)]
