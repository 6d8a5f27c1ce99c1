"""Ctrl-C and SIGTERM as a wish to stop, for what has to come to rest first."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Stoppable(Protocol):
    """What goes on until it is told to stop."""

    stopping: bool


@contextmanager
def signals_stop(what: Stoppable) -> Iterator[None]:
    """The first Ctrl-C or SIGTERM asks for a stop; the next Ctrl-C is a KeyboardInterrupt."""

    def stop(*_: object) -> None:
        what.stopping = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
