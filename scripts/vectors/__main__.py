"""Writes tests/vectors anew: inputs from a seeded generator, answers from the firmware as it is.

.venv/bin/python scripts/vectors [NAME ...]: all files, or those named. A change of an answer is a
change of what the firmware does; look at it with git before it is committed.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

import clock
import codec
import device
import gate
import group
import guard
import handshake
import history
import neighbours
import payload
import peer
import servo
import settings
import signals
import stepper
import stop
import track
import watch
from judge import ROOT, compile_judge

VECTORS = ROOT / "tests" / "vectors"
KINDS: dict[str, Callable[[Random], Iterator[str]]] = {
    "cobs": codec.cobs,
    "siphash": codec.siphash,
    "frames": codec.frames,
    "handshakes": handshake.handshakes,
    "varints": payload.varints,
    "syncs": payload.syncs,
    "plans": payload.plans,
    "statuses": payload.statuses,
    "fixed": track.fixed,
    "tracks": track.tracks,
    "gates": gate.gates,
    "states": stop.states,
    "commands": stop.commands,
    "faults": stop.faults,
    "ramps": stop.ramps,
    "gaps": stop.gaps,
    "homing": stop.homing,
    "monitors": watch.monitors,
    "guards": guard.guards,
    "groups": group.groups,
    "histories": history.histories,
    "servos": servo.servos,
    "steppers": stepper.steppers,
    "settings": settings.settings,
    "stores": settings.stores,
    "clocks": clock.clocks,
    "bounds": clock.bounds,
    "steering": clock.steering,
    "averages": clock.averages,
    "peers": peer.peers,
    "neighbours": neighbours.neighbours,
    "lineages": peer.lineages,
    "marks": peer.marks,
    "pieces": signals.pieces,
    "graphs": signals.graphs,
    "readings": signals.readings,
    "batches": signals.batches,
    "logics": signals.logics,
    "reports": signals.reports,
}
# Those whose lines follow from answers before them.
DIALOGUES: dict[str, Callable[[Path], Iterator[str]]] = {"devices": device.devices}


def questions(judge: Path, name: str) -> str:
    """A file without its answers."""
    head = f"# {name}: made by scripts/vectors; README.md describes the format.\n"
    lines = DIALOGUES[name](judge) if name in DIALOGUES else KINDS[name](Random(name))
    return head + "".join(f"{line}\n" for line in lines)


def answered(judge: Path, name: str) -> str:
    """A file with this firmware's answers."""
    asked = questions(judge, name)
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write(asked)
        file.flush()
        done = subprocess.run([judge, "--answer", file.name], capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"the judge ended with {done.returncode}:\n{done.stderr}")
    return done.stdout


def main(names: list[str]) -> None:
    """Writes the files."""
    VECTORS.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        judge = compile_judge(Path(folder) / "judge")
        known = [*KINDS, *DIALOGUES]
        for name in names or known:
            if name not in known:
                sys.exit(f"no vectors called {name}; there are: {', '.join(known)}")
            (VECTORS / f"{name}.txt").write_text(answered(judge, name))


if __name__ == "__main__":
    main(sys.argv[1:])
