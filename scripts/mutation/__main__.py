"""scripts/mutate: changes the firmware, one place at a time, and has the judge notice.

docs/mutation.md describes it.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import gcov
from accepted import SHARE_MAX, Judged, Key, MistakeError, load
from builder import BuildError
from campaign import BROKEN, EQUIVALENT, KILLED, SURVIVED, Case, Result, cases, digest, run


def say(text: str) -> None:
    """Progress."""
    print(f"mutate: {text}", file=sys.stderr, flush=True)


def arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/mutate", description=__doc__)
    parser.add_argument("files", nargs="*", metavar="FILE", help="as firmware/gate.c; else all")
    parser.add_argument("--shard", default="0/1", metavar="I/N", help="every N-th mutant from I on")
    parser.add_argument("--list", action="store_true", help="print the mutants and try none")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="every result, a line each as it comes"
    )
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="threads; else 2")
    parser.add_argument("--coverage", action="store_true", help="lines and branches instead")
    parser.add_argument(
        "--root", type=Path, default=Path(__file__).resolve().parents[2], help=argparse.SUPPRESS
    )
    return parser.parse_args(words)


def shard(text: str) -> tuple[int, int]:
    """I and N. Raises MistakeError."""
    first, _, count = text.partition("/")
    if not (first.isdigit() and count.isdigit() and int(first) < int(count)):
        raise MistakeError(f"--shard {text}: give it as I/N with 0 <= I < N, 0/8 for instance")
    return int(first), int(count)


def chosen_files(judged: Judged, words: Sequence[str]) -> list[str]:
    """Those asked for. Raises MistakeError for one that is not judged."""
    for word in words:
        if word not in judged.files:
            raise MistakeError(f"{word} is not judged; tests/mutants.toml has: {judged.files}")
    return list(words or judged.files)


def unmutated(root: Path, vectors: Sequence[Path], every: dict[str, list[Case]]) -> list[str]:
    """Executable lines that no mutant changes."""
    covered = gcov.measure(root, list(every), vectors)
    missing = []
    for file, found in every.items():
        touched = {n for c in found for n in range(c.mutant.lines[0], c.mutant.lines[1] + 1)}
        lines = covered[file]
        missing += [f"{file}:{n}: no mutant" for n in sorted(set(lines) - touched)]
        say(f"{file}: {len(lines)} executable lines, {len(set(lines) - touched)} without a mutant")
    return missing


def mistakes(judged: Judged, every: dict[str, list[Case]], results: Sequence[Result]) -> list[str]:
    """What is wrong with the list of accepted survivors."""
    known = {case.key for found in every.values() for case in found}
    outcomes = {result.case.key: result.outcome for result in results}
    found = []
    for key in judged.survivors:
        if key.file not in judged.files or (key.file in every and key not in known):
            found.append(f"listed, but there is no such mutant: {key}")
        elif outcomes.get(key, SURVIVED) != SURVIVED:
            found.append(f"listed, but it is {outcomes[key]}: {key}")
    tried = sum(result.outcome in (KILLED, SURVIVED) for result in results)
    listed = sum(result.case.key in judged.survivors for result in results)
    whole = len(results) == len(known) and set(every) == set(judged.files)
    if whole and listed > SHARE_MAX * tried:
        found.append(f"{listed} of {tried} mutants are listed: more than {SHARE_MAX:.0%}")
    return found


def print_table(results: Sequence[Result], judged: Judged) -> None:
    """A row for each file, and their sum."""
    head = ("file", "mutants", "killed", "listed", "survived", "equivalent", "not compiling")
    rows: list[Sequence[str]] = [head]
    files = list(dict.fromkeys(result.case.key.file for result in results))
    for file in [*files, "all"]:
        of = [r for r in results if file in (r.case.key.file, "all")]
        counts = Counter(result.outcome for result in of)
        listed = sum(r.outcome == SURVIVED and r.case.key in judged.survivors for r in of)
        numbers = (len(of), counts[KILLED], listed, counts[SURVIVED] - listed)
        rows.append((file, *map(str, (*numbers, counts[EQUIVALENT], counts[BROKEN]))))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        print("  ".join(cells))


def print_survivor(case: Case) -> None:
    """Where it is, what it is, and the entry that would accept it."""
    print(f"{case.key.file}:{case.line}: survived: {case.key.mutation}")
    print(f"  - {case.key.line}\n  + {case.shown}")


def as_json(result: Result, of: str) -> dict[str, object]:
    """A row of --json; `of` is the digest of what was judged, and by what."""
    key = result.case.key
    return {
        "file": key.file,
        "line_number": result.case.line,
        "function": key.function,
        "line": key.line,
        "mutation": key.mutation,
        "kind": result.case.mutant.kind,
        "outcome": result.outcome,
        "by": result.by[:300],
        "of": of,
    }


def resumed(path: Path, of: str, chosen: Sequence[Case]) -> dict[Key, Result]:
    """What an aborted campaign on the same firmware and vectors has left in `path`.

    Raises MistakeError for a file of others, or of something else.
    """
    by_key = {case.key: case for case in chosen}
    known = {}
    # an abort may have cut the last line off
    for line in path.read_text().split("\n")[:-1] if path.exists() else ():
        try:
            row = json.loads(line)
            key = Key(row["file"], row["function"], row["line"], row["mutation"])
            if row["of"] != of:
                raise MistakeError(f"{path} has results of other firmware or vectors: remove it")
            if key in by_key:
                known[key] = Result(by_key[key], row["outcome"], row["by"])
        except (ValueError, KeyError, TypeError) as error:
            raise MistakeError(f"{path} has a line that is no result: remove it") from error
    return known


def whole_lines(path: Path) -> None:
    """Cuts off the part of a line that an abort has left at the end."""
    if path.exists():
        text = path.read_bytes()
        os.truncate(path, text.rfind(b"\n") + 1)


def print_coverage(root: Path, judged: Judged, files: list[str], vectors: list[Path]) -> int:
    """Exit code."""
    good = True
    seen = set()
    for file, lines in gcov.measure(root, files, vectors).items():
        rows = (root / file).read_text().splitlines()
        branches = [count for line in lines.values() for count in line.branches]
        ran = sum(line.count > 0 for line in lines.values())
        taken = sum(count > 0 for count in branches)
        print(f"{file}: lines {ran}/{len(lines)}, branches {taken}/{len(branches)}")
        for number, line in sorted(lines.items()):
            if line.count > 0 and all(line.branches):
                continue
            code = rows[number - 1].strip()
            if (file, code) in judged.uncovered:
                seen.add((file, code))
                continue
            print(f"{file}:{number}: ran {line.count} times, branches {line.branches}: {code}")
            good = False
    for file, code in sorted(set(judged.uncovered) - seen):
        if file in files:
            print(f"listed as uncovered, but it is not: {file}: {code}")
            good = False
    return 0 if good else 1


def hunt(options: argparse.Namespace, judged: Judged, files: list[str], vectors: list[Path]) -> int:
    """Exit code."""
    root = options.root
    every = {file: cases(root, file) for file in files}
    first, count = shard(options.shard)
    chosen = [case for found in every.values() for case in found][first::count]
    if options.list:
        for case in chosen:
            print(f"{case.key.file}:{case.line}: {case.mutant.kind}: {case.key.mutation}")
        return 0
    wrong = unmutated(root, vectors, every)
    alive = 0
    of = digest(root, vectors)
    known = resumed(options.json, of, chosen) if options.json else {}
    if known:
        whole_lines(options.json)
        say(f"{len(known)} of {len(chosen)} are known from {options.json}")
    kept = options.json.open("a", buffering=1) if options.json else nullcontext()

    def progress(done: int, result: Result) -> None:
        nonlocal alive
        if out is not None:
            out.write(json.dumps(as_json(result, of)) + "\n")
        if result.outcome == SURVIVED and result.case.key not in judged.survivors:
            alive += 1
            say(f"survived: line {result.case.line}: {result.case.key}")
        if done % 50 == 0 or done == len(chosen):
            say(f"{done}/{len(chosen)}, {alive} survived")

    with kept as out:
        results = run(root, chosen, vectors, options.workers, known, progress)
    for result in results:
        if result.outcome == SURVIVED and result.case.key not in judged.survivors:
            print_survivor(result.case)
            wrong.append("a survivor")
    for text in (listed := mistakes(judged, every, results)) + [w for w in wrong if ":" in w]:
        print(text)
    print_table(results, judged)
    return 1 if wrong or listed else 0


def main(words: Sequence[str] | None = None) -> int:
    """Exit code: 0 if every mutant is killed or listed, 1 if not, 2 if it cannot be told."""
    options = arguments(words)
    try:
        judged = load(options.root / "tests" / "mutants.toml")
        files = chosen_files(judged, options.files)
        vectors = sorted((options.root / "tests" / "vectors").glob("*.txt"))
        if options.coverage:
            return print_coverage(options.root, judged, files, vectors)
        return hunt(options, judged, files, vectors)
    except (MistakeError, BuildError) as error:
        print(f"scripts/mutate: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
