"""How the command ends when it cannot do what it was asked, or should not call it done."""

from __future__ import annotations

import enum


class ExitCode(enum.IntEnum):
    """What the shell gets to see."""

    DONE = 0
    INTERNAL = 1  # a mistake of ours
    USAGE = 2  # a mistake in the command line or in the config
    LIMIT = 3  # the run is complete, but a limit was violated in it, or no plan passed
    DEVICE = 4  # a device or the link to it failed
    RECORD = 5  # the run is over, but its record misses something: do not trust the figures
    INTERRUPTED = 130  # Ctrl-C


class Failure(Exception):
    """Ends the command with one message for the user and an exit code."""

    def __init__(self, code: ExitCode, message: str) -> None:
        super().__init__(message)
        self.code = code
