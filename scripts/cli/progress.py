"""The progress bar, on standard error."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from headway.devices import interrupts

if TYPE_CHECKING:
    from headway.configs.schema import Config

PATIENCE_S = 2.0  # whatever is over sooner needs no bar
SECONDS = "{task.completed:.1f} of {task.total:.1f} s,"
COUNT = "{task.completed:.0f} of {task.total:.0f} runs,"


class Bar:
    """How much is done, with the time left; appears when it takes its time."""

    def __init__(self, name: str, total: float, text: str = SECONDS) -> None:
        """total: seconds of the task, which is not the time it takes; or, with `text`, of what it
        counts."""
        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn(text),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=console,
            redirect_stdout=False,  # it would put back what was there at its start, not at its end
            transient=console.is_terminal,  # a log keeps its last state
        )
        self._task = self._progress.add_task(name, total=total)
        self._began_s = time.monotonic()
        self._shown = False

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            self._progress.stop()

    def update(self, done: float) -> None:
        """Tells how much is done, of the total."""
        if not self._shown and time.monotonic() - self._began_s > PATIENCE_S:
            with interrupts.held_back():
                self._progress.start()
            self._shown = True
        self._progress.update(self._task, completed=max(0.0, done))


@contextmanager
def compiling(config: Config) -> Iterator[None]:
    """Of the libraries that a config's loop asks for how many are there, from the first on that has
    to be compiled. Not on a terminal there are lines instead, see codegen.py."""
    from headway.models.codegen import telling

    console = Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
        redirect_stdout=False,
        transient=True,
    )
    task = bar.add_task("compiling", total=libraries(config))
    asked, shown = 0, False

    def told(name: str, new: bool) -> None:
        nonlocal asked, shown
        bar.update(task, description=f"compiling {name}, once", completed=asked)
        asked += 1
        if new and not shown:
            with interrupts.held_back():
                bar.start()
            shown = True

    try:
        with telling(told):
            yield
        bar.update(task, completed=asked)
    finally:
        if shown:
            bar.stop()


def libraries(config: Config) -> int:
    """How many a loop asks for: machine, linearization and tracks, and with MPC the problem and, if
    it is compiled, the solver."""
    mpc = config.mpc
    return 3 + mpc.enabled + (mpc.enabled and mpc.backend == "riccati")
