"""The mutants of the judged files, and what becomes of each."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

from accepted import Key, numbered
from builder import OPTIMIZED, PLAIN, SANITIZE, Build, BuildError
from operators import Mutant, Mutator, enumerations
from tokens import Source

KILLED, SURVIVED, EQUIVALENT, BROKEN = "killed", "survived", "equivalent", "does not compile"


@dataclass(frozen=True)
class Case:
    """A mutant of a file."""

    key: Key
    line: int
    mutant: Mutant
    text: str  # of the whole file, sound

    @property
    def changed(self) -> str:
        """The whole file, with the change."""
        return self.text[: self.mutant.start] + self.mutant.new + self.text[self.mutant.end :]

    @property
    def shown(self) -> str:
        """The changed line or lines, in one."""
        start = self.text.rfind("\n", 0, self.mutant.start) + 1
        end = self.text.find("\n", self.mutant.end)
        after = self.text[start : self.mutant.start] + self.mutant.new
        return " ".join((after + self.text[self.mutant.end : end]).split())


@dataclass(frozen=True)
class Result:
    """What became of a mutant; `by` is what the judge said."""

    case: Case
    outcome: str
    by: str = ""


def cases(root: Path, file: str) -> list[Case]:
    """All mutants of a file, by their place in it."""
    text = (root / file).read_text()
    headers = [path.read_text() for path in sorted((root / file).parent.glob("*.[ch]"))]
    mutants = Mutator(Source(text), enumerations(headers)).mutants()
    lines = [text.count("\n", 0, m.start) for m in mutants]
    rows = text.splitlines()
    shown = [rows[at].strip() for at in lines]
    entries = [(m.function, s, m.label) for m, s in zip(mutants, shown, strict=True)]
    names = numbered(entries)
    return [
        Case(Key(file, m.function, s, name), at + 1, m, text)
        for m, s, at, name in zip(mutants, shown, lines, names, strict=True)
    ]


@dataclass(frozen=True)
class Judge:
    """A judge without sanitizers, for most, and one with them for what that one lets live.

    What both let live is compiled once more, with all optimizations: where these come to the same
    code, the compiler has proved that the mutant is no other program (trivial compiler equivalence,
    Papadakis et al., ICSE 2015).
    """

    plain: Build
    sanitized: Build
    optimized: Build

    def copy(self, folder: Path) -> Judge:
        """Another one, for another thread."""
        return Judge(
            self.plain.copy(folder / "plain"),
            self.sanitized.copy(folder / "sanitized"),
            self.optimized.copy(folder / "optimized"),
        )

    def try_out(self, case: Case, vectors: Sequence[Path]) -> Result:
        """Compiles one mutant and judges it."""
        try:
            with _changed(self.plain, case) as differs:
                if not differs:
                    return Result(case, EQUIVALENT)
                by = self.plain.judge(self.plain.link(), vectors)
            if not by:
                with _changed(self.sanitized, case):
                    by = self.sanitized.judge(self.sanitized.link(), vectors)
            if not by:
                with _changed(self.optimized, case) as differs:
                    if not differs:
                        return Result(case, EQUIVALENT)
        except BuildError as error:
            return Result(case, BROKEN, str(error))
        return Result(case, KILLED if by else SURVIVED, by)


def digest(root: Path, vectors: Sequence[Path]) -> str:
    """Of all that a verdict depends on but the compiler, in hexadecimal."""
    paths = [*sorted((root / "firmware").glob("*.[ch]")), *sorted((root / "tests/judge").iterdir())]
    whole = hashlib.sha256()
    for path in [*paths, *vectors]:
        whole.update(f"{path.name} {path.stat().st_size}\n".encode() + path.read_bytes())
    return whole.hexdigest()


@contextmanager
def _changed(build: Build, case: Case) -> Iterator[bool]:
    try:
        yield build.compile_changed(case.key.file, case.changed)
    finally:
        build.restore(case.key.file, case.text)


def run(
    root: Path,
    chosen: Sequence[Case],
    vectors: Sequence[Path],
    workers: int,
    known: dict[Key, Result],
    progress: Callable[[int, Result], None],
) -> list[Result]:
    """Judges mutants in `workers` threads, but for the `known`; all results in the same order.

    Raises BuildError if the sound firmware does not compile, or does not pass.
    """
    with tempfile.TemporaryDirectory(prefix="headway-mutate-") as name:
        folder = Path(name).resolve()
        kept = [Path(shutil.copy(path, folder)) for path in vectors]  # the checkout may change
        first = Judge(
            Build(root, folder / "0" / "plain", PLAIN),
            Build(root, folder / "0" / "sanitized", SANITIZE, cpu_s=20),
            Build(root, folder / "0" / "optimized", OPTIMIZED),
        )
        for build in (first.plain, first.sanitized):
            if by := build.judge(build.link(), kept):
                raise BuildError(f"the firmware as it is disagrees with its vectors:\n{by}")
        judges: Queue[Judge] = Queue()
        judges.put(first)
        for i in range(1, workers):
            judges.put(first.copy(folder / str(i)))
        done = 0

        def one(case: Case) -> Result:
            nonlocal done
            if case.key in known:
                done += 1
                return known[case.key]
            judge = judges.get()
            try:
                result = judge.try_out(case, kept)
            finally:
                judges.put(judge)
            done += 1
            progress(done, result)
            return result

        with ThreadPoolExecutor(workers) as pool:
            return list(pool.map(one, chosen))
