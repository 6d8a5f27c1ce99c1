"""Line and branch coverage of the judged files under the judge, as gcov counts it."""

from __future__ import annotations

import gzip
import json
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from builder import Build, BuildError

OPTIONS = ("-O0", "--coverage")


@dataclass
class Line:
    """How often a line ran, and each of its branches."""

    count: int = 0
    branches: list[int] = field(default_factory=list)

    def add(self, count: int, branches: list[int]) -> None:
        """The same line in another object: a header's."""
        self.count += count
        if len(branches) == len(self.branches):
            self.branches = [a + b for a, b in zip(self.branches, branches, strict=True)]
        elif count or not self.branches:
            self.branches = branches


def measure(
    root: Path, files: Sequence[str], vectors: Sequence[Path]
) -> dict[str, dict[int, Line]]:
    """Executable lines of each file, by number. Raises BuildError."""
    found: dict[str, dict[int, Line]] = {file: {} for file in files}
    with tempfile.TemporaryDirectory(prefix="headway-coverage-") as name:
        folder = Path(name).resolve()
        build = Build(root, folder, OPTIONS, cpu_s=20)
        if by := build.judge(build.link(), [path.resolve() for path in vectors]):
            raise BuildError(f"the firmware as it is disagrees with its vectors:\n{by}")
        for data in sorted(folder.glob("*.gcno")):
            command = ["gcov", "--json-format", "--branch-probabilities", data.name]
            subprocess.run(command, cwd=folder, check=True, capture_output=True)
        for report in sorted(folder.glob("*.gcov.json.gz")):
            _add(json.loads(gzip.decompress(report.read_bytes())), folder, found)
    return found


def _add(report: dict[str, object], folder: Path, found: dict[str, dict[int, Line]]) -> None:
    files = report["files"]
    assert isinstance(files, list)
    for entry in files:
        path = folder / entry["file"]
        name = str(path.resolve().relative_to(folder)) if path.exists() else ""
        for row in entry["lines"] if name in found else []:
            line = found[name].setdefault(row["line_number"], Line())
            line.add(row["count"], [branch["count"] for branch in row["branches"]])
