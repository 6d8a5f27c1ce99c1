"""`headway run`: one task in closed loop against the simulated plant."""

from __future__ import annotations

import json
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console

from headway.cli.changes import Changes, changed_config
from headway.cli.failure import ExitCode, Failure
from headway.cli.folder import RUNS, check_free, run_folder, stamp
from headway.cli.progress import Bar
from headway.cli.table import summary_table
from headway.cli.versions import versions
from headway.cli.view import View, check_display

if TYPE_CHECKING:
    from headway.configs.schema import Config
    from headway.controller.record.recording import Recording
    from headway.sim.lockstep import Lockstep


def run(
    config: Path,
    /,
    *,
    duration: float | None = None,
    out: Path | None = None,
    seed: int | None = None,
    overrides: Changes = None,
    to_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
    view: Annotated[bool, Parameter(negative=())] = False,
) -> int:
    """Runs a config's task in closed loop, in simulation, and measures how well it went.

    Leaves a folder with config.yaml (the config as used, which can be run again), run.mcap (every
    packet and every tick, and the plant's truth at 1 kHz) and summary.json. Ctrl-C brings the
    machine to rest first and keeps what there is; a second one gives up. A run that is killed
    leaves the record up to then.

    Example: ten times the usual loss of packets, another seed, and the summary for a script.

        headway run configs/arm2.yaml --duration 2 --seed 7 --set sim.to_device.loss=0.1 --json

    Parameters
    ----------
    config
        The YAML file of a machine and its task.
    duration
        Seconds of the task, instead of the config's duration_s.
    out
        The folder to leave; it must not exist yet, or be empty. Default: runs/NAME-STAMP.
    seed
        Of everything random, instead of the config's seed. The same seed repeats the same run.
    overrides
        Changes one key of the config; may be repeated. Lists count from 0, as in
        --set machine.axes.0.servo.kp_Nm_per_rad=90.
    to_json
        Prints the summary as JSON, and nothing else, on standard output.
    view
        Shows the machine in MuJoCo's own viewer while it runs, at most at real time. Needs a
        display. The run is the same.
    """
    if view:
        check_display()
    from headway.configs.save import save_config

    changes = list(overrides or [])
    if duration is not None:
        changes.append(f"duration_s={duration}")
    if seed is not None:
        changes.append(f"seed={seed}")
    checked = changed_config(config, changes)
    folder = out or RUNS / f"{checked.name}-{stamp()}"
    check_free(folder)
    with run_folder(folder) as made:
        save_config(checked, config.parent, folder / "config.yaml")
        with _recording(folder, checked) as recording:
            lockstep = _set_up(config, checked, recording)
            try:
                _simulate(lockstep, view)
            except Exception as error:
                mistake = isinstance(error, Failure) and error.code is ExitCode.USAGE
                made.keep = lockstep.ticks > 0 and not mistake
                if made.keep:
                    print(f"the record up to then is in {folder}", file=sys.stderr)
                raise
        made.keep = True
        summary = _summary(lockstep, recording)
        text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
        (folder / "summary.json").write_text(text, encoding="utf-8")
    if to_json:
        print(text, end="")
    else:
        Console().print(summary_table(summary))
        print(f"written to {folder}")
        print(f"to look at it: headway report {shlex.quote(str(folder))}")
    return _verdict(summary, lockstep.stopping, recording.failure)


def _recording(folder: Path, config: Config) -> Recording:
    """Starts the run's record. Raises OSError."""
    from headway.controller.record.reader import NAME
    from headway.controller.record.recording import Recording
    from headway.controller.record.target import About

    text = (folder / "config.yaml").read_text(encoding="utf-8")
    return Recording(folder / NAME, About(text, config.seed, versions()))


def _set_up(path: Path, config: Config, recording: Recording) -> Lockstep:
    """The simulation at power-up. Raises Failure where config and model do not fit together."""
    from headway.sim.lockstep import Lockstep  # here, since it takes a second, and help should not

    try:
        return Lockstep(config, path.parent, recording)
    except ValueError as error:
        raise Failure(ExitCode.USAGE, f"{path}: {' '.join(str(error).split())}") from error


def _simulate(lockstep: Lockstep, view: bool) -> None:
    """Runs to the end, or until Ctrl-C. Raises Failure if a device fails."""
    from headway.controller.tick import DeviceError
    from headway.sim.plant import UnstableError

    config = lockstep.config
    try:
        with (
            Bar(config.name, config.duration_s) as bar,
            _ctrl_c_stops(lockstep),
            redirect_stdout(sys.stderr),  # standard output is for the summary alone
            View(lockstep.plant) if view else nullcontext() as window,
        ):

            def progress(done_s: float) -> None:
                bar.update(done_s)
                if window:
                    window.show(done_s)

            lockstep.run(progress)
    except DeviceError as error:
        raise Failure(ExitCode.DEVICE, str(error)) from error
    except UnstableError as error:
        raise Failure(ExitCode.USAGE, str(error)) from error
    if lockstep.ticks == 0:
        raise KeyboardInterrupt  # before the task began: there is nothing to tell


def _summary(lockstep: Lockstep, recording: Recording) -> dict[str, Any]:
    """The summary, from what has been recorded. Raises Failure if that is nothing."""
    from headway.cli.summary import summarize
    from headway.controller.record.reader import RecordError

    try:
        run = recording.run()
    except RecordError as error:
        raise Failure(ExitCode.RECORD, f"{error} ({recording.failure})") from error
    if not run.messages["tick"] or not run.messages["truth"]:
        reason = f"{run.path}: nothing of the task was recorded: {recording.failure}"
        raise Failure(ExitCode.RECORD, reason)
    kept = {
        "complete": run.complete,
        "batches_dropped": run.batches_dropped,
        "messages": run.messages,
    }
    return {**summarize(lockstep.config, lockstep, run.arrays), "record": kept}


@contextmanager
def _ctrl_c_stops(lockstep: Lockstep) -> Iterator[None]:
    """The first Ctrl-C asks the machine to come to rest; the next one is a KeyboardInterrupt."""

    def stop(*_: object) -> None:
        lockstep.stopping = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _verdict(summary: dict[str, Any], interrupted: bool, record_failure: str) -> ExitCode:
    for violation in summary["limits_violated"]:
        print(f"limit violated: {violation}", file=sys.stderr)
    if not summary["record"]["complete"]:
        print(f"the record is incomplete, and so is the summary: {record_failure}", file=sys.stderr)
    if not summary["solver"]["accepted"]:
        print("no plan passed its checks: see what `headway check` says", file=sys.stderr)
    if interrupted:
        rest = "was brought to rest" if summary["at_rest_after_end"] else "did NOT come to rest"
        print(f"interrupted; the machine {rest}", file=sys.stderr)
        return ExitCode.INTERRUPTED
    if not summary["record"]["complete"]:
        return ExitCode.RECORD
    good = summary["solver"]["accepted"] and not summary["limits_violated"]
    return ExitCode.DONE if good else ExitCode.LIMIT
