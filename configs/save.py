"""From a checked Config back to a YAML file."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

from ruamel.yaml import YAML

from headway.configs.schema import Config


def config_text(config: Config, base: Path) -> str:
    """A config as YAML with every key filled in, so that loading it gives the same config.

    Relative paths in it start at `base`; they are written as absolute ones, since the new file
    lies elsewhere.
    """
    tree = config.model_dump(mode="json")
    tree["machine"]["model"] = str((base / config.machine.model).resolve())
    if config.task.file is not None:
        tree["task"]["file"] = str((base / config.task.file).resolve())
    yaml = YAML(typ="safe")
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = None  # keys in the schema's order
    text = StringIO()
    text.write("# The config as used: every key, its default if nothing else was said.\n")
    yaml.dump(tree, text)
    return text.getvalue()


def save_config(config: Config, base: Path, path: Path) -> None:
    """Writes `config_text` to a file. Raises OSError."""
    path.write_text(config_text(config, base), encoding="utf-8")
