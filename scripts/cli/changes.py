"""A config as the command line asks for it: the file, and `--set` for what differs this once."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from headway.cli.failure import ExitCode, Failure

if TYPE_CHECKING:
    from headway.configs.schema import Config

Changes = Annotated[
    list[str] | None,
    Parameter(name="--set", metavar="KEY.PATH=VALUE", negative_iterable=()),
]


def changed_config(path: Path, changes: list[str]) -> Config:
    """Raises Failure with everything that is wrong with the file or the changes."""
    from headway.configs.load import ConfigError, load_config  # here: help should not wait for it

    try:
        return load_config(path, changes)
    except ConfigError as error:
        raise Failure(ExitCode.USAGE, str(error)) from error
