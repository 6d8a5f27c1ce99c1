"""Entry point of the `headway` command: arguments in, exit code out, never a traceback."""

from __future__ import annotations

import importlib.metadata
import os
import signal
import sys
import tempfile
import traceback
from pathlib import Path

from cyclopts import App, CycloptsError

import headway.cli.operate  # noqa: F401 - adds to the commands of `devices`
from headway.cli.chaos import chaos
from headway.cli.check import check
from headway.cli.completion import completion
from headway.cli.devices import devices
from headway.cli.doctor import doctor
from headway.cli.export import export
from headway.cli.failure import ExitCode, Failure
from headway.cli.folder import RUNS, stamp
from headway.cli.init import init
from headway.cli.keys import keys
from headway.cli.plant import plant
from headway.cli.play import play
from headway.cli.qp import qp
from headway.cli.report import report
from headway.cli.run import run
from headway.cli.sweep import sweep
from headway.cli.sync import sync
from headway.models.uncompiled import UncompiledError

HELP = """Receding-horizon control for machines at the far end of slow, jittery, lossy wires.

Example: simulate two seconds of the two-link arm and see how well it followed.

    headway run configs/arm2.yaml --duration 2
"""

EXIT_CODES = """Exit codes: 0 done, 1 internal error, 2 mistake in the command line or the config,
3 a limit was violated or no plan passed its checks, 4 a device or the link failed, 5 the record
misses something, 130 interrupted."""


def make_app() -> App:
    """The command line: all commands, their options and their help."""
    app = App(
        name="headway",
        help=HELP,
        help_epilogue=EXIT_CODES,
        help_format="markdown",
        version=importlib.metadata.version("headway"),
        suppress_keyboard_interrupt=False,
        result_action="return_value",
    )
    for command in (
        init,
        check,
        keys,
        doctor,
        sync,
        run,
        plant,
        play,
        chaos,
        report,
        sweep,
        export,
        completion,
    ):
        app.command(command)
    app.command(devices)
    app.command(qp)
    return app


def main(arguments: list[str] | None = None) -> int:
    """Runs the command with `arguments` (default: those of the process); returns its exit code."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    # Our matrices are small; and a thread of its own would take a Ctrl-C from the main one.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `headway run ... | head` just ends
    try:
        return int(make_app()(arguments, exit_on_error=False) or ExitCode.DONE)
    except CycloptsError:
        return ExitCode.USAGE  # cyclopts has told what is wrong
    except Failure as failure:
        print(failure, file=sys.stderr)
        return failure.code
    except UncompiledError as error:
        print(error, file=sys.stderr)
        return ExitCode.USAGE
    except KeyboardInterrupt:
        print("interrupted; nothing was written", file=sys.stderr)
        return ExitCode.INTERRUPTED
    except Exception as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())
        print(f"internal error: {what[:300]} (traceback: {_write_crash()})", file=sys.stderr)
        return ExitCode.INTERNAL


def _write_crash() -> Path:
    """Writes the current exception's traceback below runs/, or where there is room for it."""
    text = f"{' '.join(sys.argv)}\n\n{traceback.format_exc()}"
    for folder in (RUNS, Path(tempfile.gettempdir())):
        path = folder / f"crash-{stamp()}.txt"
        try:
            folder.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
            return path
        except OSError:
            continue
    return Path("nowhere to write it")
