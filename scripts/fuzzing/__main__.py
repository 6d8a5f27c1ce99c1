"""scripts/fuzz SECONDS [TARGET ...]: fuzzes the firmware, each target for so long.

Targets are the programs of tests/fuzz. What they find interesting is kept in build/fuzz and is
where the next run begins. Exits 1 at a crash, with the command that replays it, or where too little
was reached; 2 if something is missing. At the end: how many branches of codec, gate and logic
the inputs reach.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from seeds import of_vectors, write

from build import ROOT, BuildError, coverage, fail, fuzzer, missing

FOLDER = ROOT / "build" / "fuzz"
# What the targets are about; together they have to reach 95 % of its branches.
REACHED = {
    "bytes": ("cobs.c", "wire.h", "plan.c", "status.c", "command.c", "fields.h", "frame.c"),
    "plans": ("gate.c", "gap.c", "track.c"),
    "graphs": (
        *("graph.c", "logic.c", "piece.c", "batch.c", "reading.c", "report.c", "signals.c"),
        "feed.c",
    ),
}
GOAL = 0.95
MAX_BYTES = 2000


def fuzz(target: str, seconds: int, folder: Path) -> bool:
    """Whether it lived. Raises BuildError."""
    folder.mkdir(parents=True, exist_ok=True)
    corpus, program = folder / f"{target}-corpus", fuzzer(target, folder / target)
    if target == "bytes":
        write(corpus, of_vectors(ROOT / "tests" / "vectors"))
    corpus.mkdir(exist_ok=True)
    options = [f"-max_total_time={seconds}", f"-max_len={MAX_BYTES}", "-timeout=10"]
    options += [f"-artifact_prefix={folder / target}-", "-print_final_stats=1"]
    done = subprocess.run([program, *options, corpus], capture_output=True, text=True)
    stats = dict(
        line.removeprefix("stat::").split(":", 1)
        for line in done.stderr.splitlines()
        if line.startswith("stat::")
    )
    ran = stats.get("number_of_executed_units", "?").strip()
    print(f"{target}: {ran} inputs in {seconds} s, {'no' if done.returncode == 0 else 'a'} crash")
    if done.returncode != 0:
        print(done.stderr[-4000:])
        kinds = ("crash", "timeout", "oom", "leak")
        inputs = [file for kind in kinds for file in folder.glob(f"{target}-{kind}-*")]
        for file in sorted(inputs, key=lambda file: file.stat().st_mtime)[-1:]:
            print(f"to see it again: {program} {file}")
    return done.returncode == 0


def show_coverage(target: str, folder: Path) -> bool:
    """Whether enough was reached."""
    inputs = sorted((folder / f"{target}-corpus").iterdir())
    found = coverage(target, inputs, REACHED[target])
    for file in found:
        print(f"  {file.file}: branches {file.ran}/{file.all}")
    share = sum(file.ran for file in found) / sum(file.all for file in found)
    print(f"  {target}: {share:.1%} of {GOAL:.0%}, with {len(inputs)} inputs")
    return share >= GOAL


def main(words: list[str]) -> int:
    seconds, targets = words[0] if words else "", words[1:] or list(REACHED)
    if not seconds.isdigit() or seconds == "0":
        fail("usage: scripts/fuzz SECONDS [TARGET ...], such as: scripts/fuzz 60")
    for target in targets:
        if target not in REACHED:
            fail(f"no target called {target}; there are: {', '.join(REACHED)}")
    if command := missing():
        fail(command)
    try:
        lived = [fuzz(target, int(seconds), FOLDER) for target in targets]
        reached = [show_coverage(target, FOLDER) for target in targets] if all(lived) else []
    except BuildError as error:
        fail(f"the targets do not compile:\n{error}")
    return 0 if all(lived) and all(reached) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
