"""From a YAML file and `--set key.path=value` to a checked Config."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError

from headway.configs.schema import Config

SIZE_MAX = 200_000  # bytes; YAML is slow to read, and more than this is some other file
GIVEN_MAX = 60  # characters of a wrong value that a message repeats

Location = tuple[int | str, ...]


class ConfigError(Exception):
    """A mistake in a config, told so that the user can mend it."""


def load_config(path: Path, overrides: list[str] | None = None) -> Config:
    """Reads and checks a config file.

    `overrides` are `key.path=value` strings, the value in YAML. Raises ConfigError with all
    mistakes at once, each with its key and, where the file has it, its line.
    """
    tree = _parse(_read(path), str(path))
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: a config is a mapping of keys, like `name: arm2`")
    changed = {_apply(tree, override): override for override in overrides or []}
    try:
        return Config.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(_describe(path, tree, changed, error)) from error


def _read(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(SIZE_MAX + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    if len(content) > SIZE_MAX:
        raise ConfigError(f"{path}: is too large for a config (more than {SIZE_MAX} bytes)")
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text (byte {error.start})") from error


def _parse(text: str, source: str) -> Any:
    try:
        return YAML().load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"{source}:{mark.line + 1}" if mark else source
        raise ConfigError(f"{place}: is not YAML: {error.problem or error}") from error
    except Exception as error:  # YAML has many ways to go wrong: `!!int x` is a ValueError
        raise ConfigError(f"{source}: is not YAML: {' '.join(str(error).split())}") from error


def _apply(tree: Any, override: str) -> Location:
    """Changes one key of the tree; returns where the tree differs."""
    key, equals, text = override.partition("=")
    if not equals or not key:
        raise ConfigError(f"--set {override}: write key.path=value, like --set loop.margin_us=8192")
    value = _parse(text, f"--set {override}")
    node, location, new = tree, list[int | str](), None
    *parents, last = key.split(".")
    try:
        for name in parents:
            location.append(_step(node, name))
            if isinstance(node, dict) and name not in node:
                node[name] = {}
                new = new or len(location)
            node = node[location[-1]]
        location.append(_step(node, last))
        node[location[-1]] = value
    except (ValueError, LookupError, TypeError) as error:
        raise ConfigError(f"--set {override}: there is no {key} in this config") from error
    return tuple(location[:new])


def _step(node: Any, name: str) -> int | str:
    """A key of a mapping, or an index of a list."""
    return int(name) if isinstance(node, list) else name


def _line(node: Any, location: Location) -> int | None:
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


def _describe(path: Path, tree: Any, changed: dict[Location, str], error: ValidationError) -> str:
    """One line for each mistake: where, which key, what is wrong, what was given."""
    lines = []
    for problem in error.errors():
        location = problem["loc"]
        line = _line(tree, location)
        place = f"{path}:{line}" if line else str(path)
        for where, override in changed.items():
            if location[: len(where)] == where:
                place = f"--set {override}"
        key = ".".join(str(step) for step in location) or "config"
        message = problem["msg"].removeprefix("Value error, ")
        if problem["type"] == "extra_forbidden":
            message = "unknown key"
        given = "" if isinstance(problem["input"], dict | list) else _given(problem["input"])
        lines.append(f"{place}: {key}: {message}{given}")
    return "\n".join(lines)


def _given(value: object) -> str:
    text = repr(value)
    return f" (given: {text if len(text) <= GIVEN_MAX else text[:GIVEN_MAX] + '...'})"
