"""The progress bar of a run, on standard error."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

PATIENCE_S = 2.0  # whatever is over sooner needs no bar


class Bar:
    """Seconds of the task done, with the time left; appears when a run takes its time."""

    def __init__(self, name: str, duration_s: float) -> None:
        """duration_s: of the task [s], which is not the time it takes."""
        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:.1f} of {task.total:.1f} s,"),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=console,
            transient=console.is_terminal,  # a log keeps its last state
        )
        self._task = self._progress.add_task(name, total=duration_s)
        self._began_s = time.monotonic()
        self._shown = False

    def __enter__(self) -> Bar:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._shown:
            self._progress.stop()

    def update(self, done_s: float) -> None:
        """Tells how much of the task is done [s]."""
        if not self._shown and time.monotonic() - self._began_s > PATIENCE_S:
            self._progress.start()
            self._shown = True
        self._progress.update(self._task, completed=max(0.0, done_s))
