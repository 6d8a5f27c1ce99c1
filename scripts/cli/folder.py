"""The folder that a run leaves: complete, or not there at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from headway.cli.failure import ExitCode, Failure

RUNS = Path("runs")  # below the current directory


def stamp() -> str:
    """Local time to the millisecond, for names: 20260131-142501-123."""
    return datetime.now().strftime("%Y%m%d-%H%M%S-%f")[:-3]


def check_free(folder: Path) -> None:
    """Raises Failure if `folder` exists and is not an empty folder."""
    if folder.exists() and not folder.is_dir():
        raise Failure(ExitCode.USAGE, f"--out {folder}: there is a file of that name")
    if folder.is_dir() and any(folder.iterdir()):
        raise Failure(ExitCode.USAGE, f"--out {folder}: the folder exists and is not empty")


@contextmanager
def written_whole(folder: Path) -> Iterator[Path]:
    """Gives a hidden sibling to write into; renames it to `folder` at the end.

    If anything is raised meanwhile the sibling is removed. Raises Failure where it cannot write.
    """
    folder = folder.resolve()
    sibling = folder.with_name(f".{folder.name}.{os.getpid()}")
    try:
        sibling.mkdir(parents=True)
    except OSError as error:
        raise Failure(ExitCode.USAGE, f"{folder}: cannot be made: {error.strerror}") from error
    try:
        yield sibling
        sibling.rename(folder)  # takes the place of an empty folder, too
    except OSError as error:
        raise Failure(ExitCode.USAGE, f"{folder}: cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(sibling, ignore_errors=True)
