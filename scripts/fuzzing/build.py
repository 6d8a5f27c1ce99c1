"""Compiles the targets of tests/fuzz: for libFuzzer, or to count what files reach."""

from __future__ import annotations

import gzip
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SANITIZE = ("-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all")
INCLUDES = ("sim", "firmware", "tests/fuzz")  # the simulator's board comes first


class BuildError(Exception):
    """The compiler's message."""


@dataclass(frozen=True)
class Reached:
    """Of a file: branches, and how many of them ran."""

    file: str
    ran: int
    all: int


def missing() -> str:
    """The one command that brings what is not there; "" if all is."""
    if not shutil.which("clang"):
        return "please run: sudo apt-get install -y clang libclang-rt-dev"
    code = "int LLVMFuzzerTestOneInput(void) { return 0; }"
    command = ["clang", "-x", "c", "-fsanitize=fuzzer", "-", "-o", "/dev/null"]
    if subprocess.run(command, input=code, capture_output=True, text=True).returncode != 0:
        return "please run: sudo apt-get install -y libclang-rt-dev"
    return ""


def sources(root: Path, target: str) -> list[Path]:
    firmware = sorted((root / "firmware").glob("*.c"))
    board = [root / "sim" / "board.c", root / "sim" / "oscillator.c"]
    return [root / "tests" / "fuzz" / f"{target}.c", *firmware, *board]


def _compile(root: Path, program: Path, command: Sequence[str], more: Sequence[Path]) -> Path:
    flags = ["-std=c11", "-Wall", "-Wextra", "-Werror", *(f"-I{root / f}" for f in INCLUDES)]
    words = [*command, *flags, *map(str, more), "-o", str(program)]
    done = subprocess.run(words, cwd=program.parent, capture_output=True, text=True)
    if done.returncode != 0:
        raise BuildError(done.stderr)
    return program


def fuzzer(target: str, program: Path, root: Path = ROOT) -> Path:
    """Raises BuildError."""
    command = ["clang", "-O1", "-g", *SANITIZE]
    return _compile(root, program, command, sources(root, target))


def coverage(target: str, inputs: Sequence[Path], files: Sequence[str]) -> list[Reached]:
    """Branches of files in firmware/ that the inputs reach. Raises BuildError."""
    with tempfile.TemporaryDirectory(prefix="headway-fuzz-") as name:
        folder = Path(name)
        program = folder / "replay"
        more = [*sources(ROOT, target), ROOT / "tests" / "fuzz" / "replay.c"]
        _compile(ROOT, program, ["cc", "-O0", "--coverage"], more)
        for i in range(0, len(inputs), 1000):
            subprocess.run([program, *inputs[i : i + 1000]], cwd=folder, check=True)
        for data in folder.glob("*.gcda"):
            command = ["gcov", "--json-format", "--branch-probabilities", data.name]
            subprocess.run(command, cwd=folder, check=True, capture_output=True)
        branches: dict[str, dict[tuple[int, int], int]] = {file: {} for file in files}
        for report in folder.glob("*.gcov.json.gz"):
            _add(json.loads(gzip.decompress(report.read_bytes())), branches)
    return [
        Reached(file, sum(count > 0 for count in found.values()), len(found))
        for file, found in branches.items()
    ]


def _add(report: dict[str, list], branches: dict[str, dict[tuple[int, int], int]]) -> None:
    """Headers are compiled into several objects: what any of them ran is reached."""
    for entry in report["files"]:
        name = Path(entry["file"]).name
        if Path(entry["file"]).parent.name != "firmware" or name not in branches:
            continue
        for line in entry["lines"]:
            for i, branch in enumerate(line["branches"]):
                key = line["line_number"], i
                branches[name][key] = branches[name].get(key, 0) + branch["count"]


def fail(message: str) -> None:
    """Ends the program."""
    print(f"headway: {message}", file=sys.stderr)
    raise SystemExit(2)
