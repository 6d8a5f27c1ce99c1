"""Stage files with one thing changed, and what is said of them."""

from pathlib import Path

import pytest

from headway.configs.mistakes.mistake import ConfigError
from headway.configs.stage import load_stage


def changed(folder: Path, whole: str, old: str, new: str) -> Path:
    """A file with the text, in which `old` stands once and is `new`."""
    assert whole.count(old) == 1
    file = folder / "stage.yaml"
    file.write_text(whole.replace(old, new))
    return file


def assert_mistake(file: Path, key: str, text: str) -> None:
    """The stage is refused, with the file, the key and the words."""
    with pytest.raises(ConfigError) as error:
        load_stage(file)
    said = str(error.value)
    assert key in said and text in said
    assert said.startswith(f"{file}:")
