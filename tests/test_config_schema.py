"""The JSON schema: it is the one that belongs to the models, and jsonschema judges as we do."""

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from headway.configs import describe
from headway.configs.load import ConfigError, load_config

CONFIGS = sorted((Path(__file__).resolve().parent.parent / "configs").glob("*.yaml"))
CONFIGS = [path for path in CONFIGS if path.stem not in ("strobe", "gear")]  # stages
TREES = {path.name: YAML(typ="safe").load(path.read_text()) for path in CONFIGS}
SCHEMA = json.loads(describe.FILES["schema"].read_text())
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)

Path_ = tuple[int | str, ...]


def loads(tree: dict[str, Any], folder: Path) -> bool:
    """With a model that is there."""
    changed = deepcopy(tree)
    machine = changed.get("machine")
    if isinstance(machine, dict) and isinstance(machine.get("model"), str):
        machine["model"] = str(CONFIGS[0])
    with (folder / "config.yaml").open("w") as file:
        YAML(typ="safe").dump(changed, file)
    try:
        load_config(folder / "config.yaml")
    except ConfigError:
        return False
    return True


def nodes(node: Any, path: Path_ = ()) -> list[Path_]:
    """Paths of all that is in a tree."""
    items = node.items() if isinstance(node, dict) else enumerate(node)
    found = []
    for key, inner in items:
        found.append((*path, key))
        if isinstance(inner, dict | list):
            found += nodes(inner, (*path, key))
    return found


def container(tree: Any, path: Path_) -> Any:
    for step in path[:-1]:
        tree = tree[step]
    return tree


@pytest.mark.parametrize("name", describe.FILES)
def test_is_written_from_the_models(name: str) -> None:
    written = describe.FILES[name].read_text(encoding="utf-8")
    made = {"schema": describe.json_schema, "page": describe.page}[name]()
    assert written == made, "run: .venv/bin/python -m headway.configs.describe"


def test_is_a_schema() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_shipped_configs(path: Path) -> None:
    assert load_config(path).name == TREES[path.name]["name"]
    VALIDATOR.validate(TREES[path.name])
    assert path.read_text().startswith("# yaml-language-server: $schema=schema.json\n")


@pytest.mark.parametrize("name", TREES)
def test_every_mistake_is_one_for_both(name: str, tmp_path: Path) -> None:
    """Each key once of a wrong type, below its range, missing and joined by an unknown one."""
    count = 0
    for path in nodes(TREES[name]):
        for change in ("type", "range", "missing", "unknown"):
            tree = deepcopy(TREES[name])
            inside = container(tree, path)
            if change == "unknown" and isinstance(inside[path[-1]], dict):
                inside[path[-1]]["zzz"] = "text"
            elif change == "type":
                inside[path[-1]] = [[None]]
            elif change == "range" and isinstance(inside[path[-1]], int | float):
                inside[path[-1]] = -1e300
            elif change == "missing" and isinstance(inside, dict):
                del inside[path[-1]]
            else:
                continue
            valid = VALIDATOR.is_valid(tree)
            assert valid or not loads(tree, tmp_path), (path, change)
            assert not valid or change == "missing", (path, change)
            count += not valid
    assert count > 150


anything = st.none() | st.booleans() | st.integers(-9, 10**20) | st.floats() | st.text(max_size=4)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.sampled_from(sorted(TREES)),
    st.integers(0, 10**6),
    st.sampled_from(["replace", "remove", "add"]),
    anything | st.lists(anything, max_size=3),
)
def test_what_loads_is_valid(
    tmp_path: Path, name: str, index: int, change: str, value: Any
) -> None:
    tree = deepcopy(TREES[name])
    found = nodes(tree)
    path = found[index % len(found)]
    inside = container(tree, path)
    if change == "remove":
        del inside[path[-1]]
    elif change == "add" and isinstance(inside, dict):
        inside[f"{path[-1]}_"] = value
    else:
        inside[path[-1]] = value
    if loads(tree, tmp_path):
        VALIDATOR.validate(tree)


def test_every_key_is_told() -> None:
    """What an editor shows when the pointer rests on a key."""
    sections = [SCHEMA, *SCHEMA["$defs"].values()]
    bare = [key for kind in sections for key, node in kind["properties"].items() if not told(node)]
    assert all(kind.get("description") for kind in sections)
    assert bare == []


def told(node: dict[str, Any]) -> bool:
    """A section has a description of its own."""
    return bool(node.get("description") or "$ref" in node or "$ref" in json.dumps(node))
