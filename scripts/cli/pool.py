"""Processes that work side by side, for commands that run much at once."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Any, TypeVar

from headway.devices import interrupts

T = TypeVar("T")


@contextmanager
def processes(count: int) -> Iterator[Executor]:
    """An executor of `count` new processes. What is raised meanwhile ends them at once; Ctrl-C is
    for this process alone."""
    before = multiprocessing.active_children()
    # Its threads write to processes that may just have ended: that is an error of theirs, and not,
    # as on standard output, the end of all.
    pipe = signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _begin)
    try:
        yield pool
    except BaseException:
        for child in multiprocessing.active_children():
            if child not in before:
                child.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        signal.signal(signal.SIGPIPE, pipe)


def _begin() -> None:
    """Standard output is the parent's alone; and whoever kills the parent kills its children."""
    os.dup2(2, 1)
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_die_with, args=(parent.sentinel,), daemon=True).start()


def _die_with(sentinel: int) -> None:
    multiprocessing.connection.wait([sentinel])
    os._exit(1)


def each(
    executor: Executor, function: Callable[[T], Any], arguments: Sequence[T]
) -> Iterator[tuple[int, Future[Any]]]:
    """Calls `function` with each argument; gives the argument's index and what came of it, in the
    order in which they are done."""
    with interrupts.held_back():
        futures = {executor.submit(function, argument): i for i, argument in enumerate(arguments)}
    for future in as_completed(futures):
        yield futures[future], future
