"""The folders and files that commands leave."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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
def written_whole(path: Path) -> Iterator[Path]:
    """Gives a hidden sibling's name, to make a file or a folder of it; renames it at the end.

    If anything is raised meanwhile the sibling is removed. Raises Failure if `path` exists or
    cannot be written.
    """
    if path.exists():
        raise Failure(ExitCode.USAGE, f"{path}: exists already: remove it, or name another --out")
    path = path.resolve()
    sibling = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield sibling
            sibling.rename(path)
        finally:
            if sibling.is_dir():
                shutil.rmtree(sibling)
            sibling.unlink(missing_ok=True)
    except OSError as error:
        raise Failure(ExitCode.USAGE, f"{path}: cannot be written: {error.strerror}") from error


@dataclass
class Made:
    """A run's folder while the run writes into it."""

    path: Path
    keep: bool = False  # whatever happens


@contextmanager
def run_folder(folder: Path) -> Iterator[Made]:
    """Makes a folder, which may exist if it is empty.

    If anything is raised meanwhile, all of it is removed again that was not there before, unless
    `keep` has been set. Raises Failure where it cannot be made or written.
    """
    made, folder = Made(folder), folder.resolve()
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise Failure(ExitCode.USAGE, f"{folder}: another run is writing there")
    except OSError as error:
        raise Failure(ExitCode.USAGE, f"{folder}: cannot be made: {error.strerror}") from error
    try:
        yield made
    except BaseException as error:
        if not made.keep:
            _empty(folder)
            for path in new:
                path.rmdir()
        if isinstance(error, OSError):
            reason = f"{folder}: cannot be written: {error.strerror}"
            raise Failure(ExitCode.USAGE, reason) from error
        raise


def _empty(folder: Path) -> None:
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
