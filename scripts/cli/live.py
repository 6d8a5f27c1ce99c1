"""`headway run --link`: the loop against devices at real ports."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from headway.cli.failure import ExitCode, Failure
from headway.cli.linked import Linked
from headway.cli.progress import compiling
from headway.cli.wall import WallClock

if TYPE_CHECKING:
    from headway.configs.schema import Config
    from headway.controller.live import Live
    from headway.controller.record.recorder import Recorder
    from headway.devices.port_link import PortLink

PLANT_NAME = "plant.mcap"  # what a spawned plant leaves in the run's folder


@contextmanager
def live(
    linked: Linked, path: Path, config: Config, changes: list[str], folder: Path, record: Recorder
) -> Iterator[tuple[Live, PortLink]]:
    """The loop with its devices found, ready to run, and its link; afterwards all is closed.

    Raises Failure where something cannot be found or does not fit.
    """
    from headway.controller.live import Live
    from headway.controller.loop import Loop
    from headway.controller.reference import task_reference
    from headway.models.machine import load_machine

    with linked.machine(path, config, changes, folder / PLANT_NAME) as reached:
        remotes = reached.remotes()
        try:
            machine = load_machine(
                (path.parent / config.machine.model).resolve(), config.machine.coupling
            )
            task = task_reference(config, path.parent)
            with compiling(config):
                loop = Loop(config, machine, remotes, task, record)
        except ValueError as error:
            raise Failure(ExitCode.USAGE, f"{path}: {' '.join(str(error).split())}") from error
        clock = WallClock(linked.factor)
        with reached.link(clock) as link:
            try:
                yield Live(config, loop, remotes, link, record, clock), link
            except Failure as failure:
                if not link.gone:
                    raise
                said = "\n".join([*link.gone.values(), str(failure)])
                raise Failure(failure.code, said) from failure
