"""Ctrl-C (SIGINT) for the main thread alone.

The kernel gives a signal to any thread that does not hold it back. One that another thread took
while OSQP solves in the main one would run OSQP's handler, which prints into our output.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def held_back() -> Iterator[None]:
    """Threads and processes that are started in this context never get a Ctrl-C."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
