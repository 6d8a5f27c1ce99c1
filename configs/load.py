"""From a YAML file and `--set key.path=value` to a checked Config."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from headway.configs.schema import Config


class ConfigError(Exception):
    """A mistake in a config, told so that the user can mend it."""


def load_config(path: Path, overrides: list[str] | None = None) -> Config:
    """Reads and checks a config file.

    `overrides` are `key.path=value` strings, the value in YAML. Raises ConfigError with all
    mistakes at once, each with its key and, where the file has it, its line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text (byte {error.start})") from error
    try:
        tree = YAML().load(text)
    except YAMLError as error:
        raise ConfigError(f"{path}: is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: a config is a mapping of keys, like `name: arm2`")
    for override in overrides or []:
        _apply(tree, override)
    try:
        return Config.model_validate(_plain(tree))
    except ValidationError as error:
        raise ConfigError(_describe(path, tree, error)) from error


def _plain(node: Any) -> Any:
    if isinstance(node, dict):
        return {str(key): _plain(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_plain(value) for value in node]
    return node


def _apply(tree: Any, override: str) -> None:
    key, equals, text = override.partition("=")
    if not equals or not key:
        raise ConfigError(f"--set {override}: write key.path=value, like --set loop.margin_us=8192")
    try:
        value = YAML(typ="safe").load(text)
    except YAMLError as error:
        raise ConfigError(f"--set {override}: the value is not YAML") from error
    *parents, last = key.split(".")
    node = tree
    try:
        for name in parents:
            node = node[int(name)] if isinstance(node, list) else node.setdefault(name, {})
        node[int(last) if isinstance(node, list) else last] = value
    except (ValueError, IndexError, TypeError, AttributeError) as error:
        raise ConfigError(f"--set {override}: there is no {key} in this config") from error


def _line(node: Any, location: tuple[int | str, ...]) -> int | None:
    """Line of the deepest part of `location` that the file has."""
    line = None
    for step in location:
        try:
            place = node.lc
            position = place.item(step) if hasattr(node, "append") else place.key(step)
            line = int(position[0]) + 1
            node = node[step]
        except (AttributeError, KeyError, IndexError, TypeError):
            break
    return line


def _describe(path: Path, tree: Any, error: ValidationError) -> str:
    lines = []
    for problem in error.errors():
        line = _line(tree, problem["loc"])
        place = f"{path}:{line}" if line else str(path)
        key = ".".join(str(step) for step in problem["loc"]) or "config"
        message = problem["msg"].removeprefix("Value error, ")
        if problem["type"] == "extra_forbidden":
            message = "unknown key"
        given = (
            "" if isinstance(problem["input"], dict | list) else f" (given: {problem['input']!r})"
        )
        lines.append(f"{place}: {key}: {message}{given}")
    return "\n".join(lines)
