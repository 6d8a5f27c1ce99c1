"""What a process asks of the operating system to be on time; and what it was refused."""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager

PLANT, LOOP = 40, 50  # SCHED_FIFO's priorities
MCL_CURRENT, MCL_FUTURE = 1, 2


@contextmanager
def claimed(priority: int) -> Iterator[list[str]]:
    """Real-time priority for this thread and those it starts, memory that stays, no collector.

    Yields in words what was refused; nothing that was is needed for a correct run.
    """
    refused = []
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        refused.append(
            f"no real-time priority ({error.strerror}): ticks may be late whenever the computer "
            "is busy; an rtprio line in /etc/security/limits.conf allows it"
        )
    library = ctypes.CDLL(None, use_errno=True)
    if library.mlockall(MCL_CURRENT | MCL_FUTURE):
        refused.append(
            f"memory is not locked ({os.strerror(ctypes.get_errno())}): a tick may wait for a "
            "page; a memlock line in /etc/security/limits.conf allows it"
        )
    collected = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()  # a tick leaves no cycles behind, and a collection would come when it likes
    try:
        yield refused
    finally:
        if collected:
            gc.enable()
        gc.unfreeze()
        library.munlockall()
        os.sched_setscheduler(0, policy, parameters)
