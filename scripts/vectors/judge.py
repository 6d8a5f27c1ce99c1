"""The judge of tests/judge, compiled with the firmware as it is."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SANITIZE = ("-fsanitize=address,undefined,bounds-strict", "-fno-sanitize-recover=all")


def compiler() -> str:
    """The C compiler; ends the program if there is none."""
    found = shutil.which("cc")
    if not found:
        sys.exit("no C compiler: install cc (gcc or clang)")
    return found


def compile_judge(
    program: Path, options: Sequence[str] = (), prefix: str = "", more: Sequence[str] = ()
) -> Path:
    """Compiles tests/judge/ and what it calls of firmware/ into `program` and returns it.

    By the compiler whose tools begin with `prefix`, the host's if there is none; `more` is for the
    linker alone.
    """
    folders = ROOT / "firmware", ROOT / "tests" / "judge"
    firmware, judge = ([str(path) for path in sorted(folder.glob("*.c"))] for folder in folders)
    tool = f"{prefix}gcc" if prefix else compiler()
    flags = ["-std=c11", "-O1", "-Wall", "-Wextra", "-Werror", *options]
    flags += [f"-I{folder}" for folder in folders]
    with tempfile.TemporaryDirectory() as objects:
        _run(objects, tool, *flags, "-c", *firmware)
        made = [path.name for path in sorted(Path(objects).glob("*.o"))]
        _run(objects, f"{prefix}ar", "rcs", "firmware.a", *made)
        linked = [*judge, "firmware.a", *more, "-o", str(program.resolve())]
        _run(objects, tool, *flags, *linked)
    return program


def _run(folder: str, *command: str) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"the judge does not compile:\n{done.stderr}")
