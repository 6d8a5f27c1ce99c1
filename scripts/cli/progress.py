"""The progress bar, on standard error."""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from headway.devices import interrupts

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
