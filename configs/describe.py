"""Writes what a config may say: configs/schema.json for editors, docs/config.md for people.

python -m headway.configs.describe, in a checkout, whenever the schema has changed.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from headway.configs.mistakes.keys import Schema, keys, kinds, schema, sections, wanted
from headway.configs.mistakes.mistake import KeyPath, dotted
from headway.configs.mistakes.words import flow

ROOT = Path(__file__).resolve().parent.parent
FILES = {"schema": ROOT / "configs" / "schema.json", "page": ROOT / "docs" / "config.md"}
DIALECT = "https://json-schema.org/draft/2020-12/schema"

HEAD = """\
# The config

A config is one YAML file: a machine, its task and its simulated world. Start from a copy of
`configs/arm2.yaml`. A key's name ends in its unit. YAML is read as version 1.2 says: text needs no
quotes unless it would mean something else; `on` is text, `true` is not.

`--set key.path=value` changes one key for one run; entries of lists count from 0. What is wrong is
told all at once, with its line and column and what to write instead.

Editors with a YAML language server complete and check the keys by `configs/schema.json`, which the
first line of a config names.

These tables are written by `python -m headway.configs.describe`. N stands for an entry of a list.
"""


def json_schema() -> str:
    """The schema of all keys, for editors."""
    return json.dumps({"$schema": DIALECT, **_untitled(schema())}, indent=1) + "\n"


def page() -> str:
    """A table of its keys for each section, in Markdown."""
    return "\n".join([HEAD, *(_table(path, kind) for path, kind in sections())])


def _untitled(node: Any) -> Any:
    """Without pydantic's titles, which say the keys again."""
    if isinstance(node, list):
        return [_untitled(inner) for inner in node]
    if not isinstance(node, dict):
        return node
    return {k: _untitled(v) for k, v in node.items() if k != "title" or not isinstance(v, str)}


def _table(path: KeyPath, kind: Schema) -> str:
    rows = [
        f"## {dotted(path) or 'At the top'}\n",
        f"{kind['description']}\n",
        "| key | value | default | |",
        "|---|---|---|---|",
    ]
    for key, node in keys(kind).items():
        required = key in kind.get("required", ())
        section = any(keys(inner) for inner in kinds(node))
        default = "" if section else flow(node.get("default"))
        cells = (f"`{key}`", _value(node, key), "required" if required else default, _told(node))
        rows.append(f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |")
    return "\n".join(rows) + "\n"


def _value(node: Schema, key: str) -> str:
    found = kinds(node)
    if any(keys(kind) for kind in found):
        return "a section"
    if any("items" in kind and any(map(keys, kinds(kind["items"]))) for kind in found):
        return "a list of sections"
    return wanted(node, key)


def _told(node: Schema) -> str:
    return " ".join(str(node.get("description", "")).split())


if __name__ == "__main__":
    FILES["schema"].write_text(json_schema(), encoding="utf-8")
    FILES["page"].write_text(page(), encoding="utf-8")
