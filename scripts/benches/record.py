"""What recording costs the loop's thread at each tick, and what it leaves on the disk."""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from _report import arguments, finish, goal, table

from headway.configs.load import load_config
from headway.controller.record.note import Note, note_tick
from headway.controller.record.recorder import Memory, Recorder
from headway.controller.record.recording import Recording
from headway.controller.record.target import About, Target
from headway.controller.tick import Tick
from headway.sim import lockstep

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
ABOUT = About("bench", 0, {"headway": "bench"})
PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}
BLOCK = 64  # ticks with recording, then as many without


class Nothing(Memory):
    """Records nothing: what is measured with it is the measuring."""

    def add(self, note: Note) -> None:
        pass

    def publish(self) -> None:
        pass


class Measured(Memory):
    """A run's record. At each tick, where the loop's thread would do it, it also notes the same for
    a file or for nothing, block by block, and measures that by the wall clock."""

    def __init__(self, recording: Recording) -> None:
        super().__init__()
        self._targets: tuple[Recorder, Recorder] = recording, Nothing()
        self.noting_us: tuple[list[float], list[float]] = [], []
        self.compute_us: tuple[list[float], list[float]] = [], []
        self._ticks = 0

    def note_tick(self, _: Recorder, tick: Tick, sent_us: int, in_time: bool) -> None:
        """Takes the place of the function of that name."""
        packets = [note for note in self._notes if note[0] in ("received", "sent")]
        which = self._ticks // BLOCK % 2
        target = self._targets[which]
        began_ns = time.perf_counter_ns()
        for note in packets:
            target.add(note)
        note_tick(target, tick, sent_us, in_time)
        ended_ns = time.perf_counter_ns()
        if tick.now is not None:
            self._ticks += 1
            self.noting_us[which].append((ended_ns - began_ns) * 1e-3)
            self.compute_us[which].append(tick.total_us)
        note_tick(self, tick, sent_us, in_time)

    def rows(self) -> list[dict[str, Any]]:
        """Noting a tick, and the tick itself, with recording and without."""
        return [
            {"time of the loop's thread [us]": f"{what}, {how}", "ticks": len(times_us)}
            | {name: float(np.percentile(times_us, p)) for name, p in PERCENTILES.items()}
            for what, both in (("noting", self.noting_us), ("the tick", self.compute_us))
            for how, times_us in zip(("recording", "without"), both, strict=True)
        ]

    def write(self, path: Path) -> float:
        """Writes the record into a file as the writer does; returns the seconds it took."""
        began_s = time.process_time()
        with path.open("wb") as file:
            target = Target(file, ABOUT)
            for batch in self._batches:
                target.write(batch)
            target.finish(complete=True, dropped=0)
        return time.process_time() - began_s


def main() -> None:
    options = arguments(__doc__ or "")
    duration_s = 120 if options.long else 20
    config = load_config(CONFIGS / "arm2.yaml", [f"duration_s={duration_s}"])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Recording(folder / "ticks.mcap", ABOUT) as recording:
            record = Measured(recording)
            lockstep.note_tick = record.note_tick
            lockstep.Lockstep(config, CONFIGS, record).run()
        took_s = record.write(folder / "run.mcap")
        megabytes = (folder / "run.mcap").stat().st_size / 1e6
    if recording.failure:
        sys.exit(recording.failure)
    arrays = record.arrays()
    recorded_s = (arrays["end_us"][-1] - arrays["sent_us"][0]) * 1e-6
    rows = record.rows()
    table(f"arm2, {duration_s} s", rows)
    goals = [
        goal("recording a tick, p99 [us]", rows[0]["p99"], "<=", 15),
        goal("run.mcap, MB a minute", megabytes / recorded_s * 60, "<=", 60),
        goal("the writer's speed, times real time", recorded_s / took_s, ">=", 5),
    ]
    finish(rows, goals, options.json)


if __name__ == "__main__":
    main()
