"""What benchmarks of many runs share: two processes, progress, and a run that may break off."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TypeVar

from headway.cli.simulation import MemoryRecord
from headway.configs.schema import Config
from headway.controller.record.columns import Arrays
from headway.controller.tick import DeviceError
from headway.sim.lockstep import Lockstep

Job = TypeVar("Job")
Result = TypeVar("Result")


def each(run: Callable[[Job], Result], jobs: Sequence[Job], what: str = "runs") -> list[Result]:
    """Results in the order of the jobs."""
    results: list[Result] = []
    with ProcessPoolExecutor(2) as pool:
        for done, result in enumerate(pool.map(run, jobs), 1):
            results.append(result)
            print(f"\r{done} of {len(jobs)} {what}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return results


def run_through(config: Config, folder: Path) -> tuple[Lockstep, Arrays, str]:
    """A run to its end, its record, and what the host said if it broke off."""
    record, said = MemoryRecord(), ""
    lockstep = Lockstep(config, folder, record)
    try:
        lockstep.run()
    except DeviceError as error:
        said = str(error)
    return lockstep, record.arrays(), said
