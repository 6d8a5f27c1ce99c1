"""Builds the judge with changed firmware, in a folder of its own, and has it judge."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

# What a C compiler lets pass with a warning, and what no change that matters would look like.
ILL_TYPED = ("-Werror=int-conversion", "-Werror=incompatible-pointer-types")
PLAIN = ("-O1",)
OPTIMIZED = ("-O3",)
SANITIZE = ("-O1", "-fsanitize=address,undefined,bounds-strict", "-fno-sanitize-recover=all")
HANG_S = 60  # of wall-clock time, for what waits without using the processor


class BuildError(Exception):
    """The compiler's or the linker's message."""


@dataclass
class Build:
    """The judge's sources and firmware, copied to `folder` and compiled with `options`."""

    root: Path
    folder: Path
    options: Sequence[str] = PLAIN
    cpu_s: int = 1
    compiler: str = "cc"
    uses: dict[str, set[str]] = field(default_factory=dict)  # each source: files it includes
    sound: dict[str, bytes] = field(default_factory=dict)  # each source: its object
    noticed: str = ""  # the file whose vectors noticed the last mutant: likely the next one, too

    def __post_init__(self) -> None:
        if self.uses:
            return  # a copy
        for name in ("firmware", "tests/judge"):
            shutil.copytree(self.root / name, self.folder / name, dirs_exist_ok=True)
        for source in self.sources():
            self.sound[source] = self._compile(source)
        needed = self._needed()
        for source in self.sources():  # what is not linked need not be compiled again
            if self._object(source).name not in needed:
                del self.uses[source]

    def copy(self, folder: Path) -> Build:
        """Another one like this, to work beside it."""
        shutil.copytree(self.folder, folder)
        return replace(self, folder=folder)

    def sources(self) -> list[str]:
        """All C files, from the folder."""
        folders = ("firmware", "tests/judge")
        paths = (path for name in folders for path in sorted((self.folder / name).glob("*.c")))
        return [str(path.relative_to(self.folder)) for path in paths]

    def _object(self, source: str) -> Path:
        return self.folder / (source.replace("/", "_") + ".o")

    def _run(self, *command: str | Path) -> str:
        done = subprocess.run(command, cwd=self.folder, capture_output=True, text=True)
        if done.returncode != 0:
            raise BuildError(done.stderr)
        return done.stdout

    def _compile(self, source: str) -> bytes:
        made, rule = self._object(source), self._object(source).with_suffix(".d")
        flags = ["-std=c11", *ILL_TYPED, *self.options, f"-DJUDGE_CPU_S={self.cpu_s}"]
        flags += ["-Ifirmware", "-Itests/judge", "-MMD", "-MF", str(rule)]
        self._run(self.compiler, *flags, "-c", source, "-o", made)
        self.uses.setdefault(source, set()).update(
            re.split(r"[\\\s]+", rule.read_text().partition(":")[2])
        )
        return made.read_bytes()

    def link(self) -> Path:
        """The program: the judge, and of the firmware what it calls."""
        program = self.folder / "judge"
        objects = [self._object(source) for source in self.uses]
        self._run(self.compiler, *self.options, *objects, "-o", program)
        return program

    def _needed(self) -> str:
        """What the linker says of the judge and of an archive of all firmware: what it takes."""
        program, archive = self.folder / "judge", self.folder / "firmware.a"
        objects = {source: self._object(source) for source in self.sources()}
        firmware = [made for source, made in objects.items() if source.startswith("firmware/")]
        self._run("ar", "rcs", archive, *firmware)
        judge = [made for made in objects.values() if made not in firmware]
        trace = "-Wl,--trace,--trace"  # twice: with what is taken of archives
        return self._run(self.compiler, *self.options, trace, *judge, archive, "-o", program)

    def compile_changed(self, file: str, text: str) -> bool:
        """Compiles what uses `file` with other text; whether any object differs for it.

        Raises BuildError if it does not compile. Call `restore` afterwards, in any case.
        """
        (self.folder / file).write_text(text)
        users = [source for source, used in self.uses.items() if file in used]
        if not users:
            raise BuildError(f"{file}: the judge calls nothing of it")
        return any([self._compile(source) != self.sound[source] for source in users])

    def restore(self, file: str, text: str) -> None:
        """The sound text and the objects made from it."""
        (self.folder / file).write_text(text)
        for source, used in self.uses.items():
            if file in used:
                self._object(source).write_bytes(self.sound[source])

    def judge(self, program: Path, vectors: Sequence[Path]) -> str:
        """What the judge disagrees with; "" if it agrees with all vectors."""
        vectors = sorted(vectors, key=lambda path: path.name != self.noticed)
        try:
            done = subprocess.run(
                [program, *vectors],
                cwd=self.folder,
                capture_output=True,
                timeout=HANG_S,
                env={"ASAN_OPTIONS": "detect_leaks=0"},
            )
        except subprocess.TimeoutExpired:
            return "does not come back"
        said = (done.stdout + done.stderr).decode(errors="replace")
        if done.returncode == 2:
            return f"the judge gave up: {said}"
        if done.returncode == 0:
            return ""
        self.noticed = Path(said.partition(":")[0]).name
        return said or f"ended with {done.returncode}"
