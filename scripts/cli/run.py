"""`headway run`: one task in closed loop, against the simulated plant or over real links."""

from __future__ import annotations

import json
import shlex
import sys
from contextlib import nullcontext, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console

from headway.cli.changes import Changes, changed_config
from headway.cli.failure import ExitCode, Failure
from headway.cli.folder import RUNS, Made, check_free, run_folder, stamp
from headway.cli.linked import SIMULATED, Link, Linked
from headway.cli.live import PLANT_NAME, live
from headway.cli.progress import Bar, compiling
from headway.cli.stopping import signals_stop
from headway.cli.table import summary_table
from headway.cli.versions import versions
from headway.cli.view import View, check_display

if TYPE_CHECKING:
    from headway.cli.summary import Driver
    from headway.configs.schema import Config
    from headway.controller.live import Live
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
    over: Link = SIMULATED,
) -> int:
    """Runs a config's task in closed loop, in simulation, and measures how well it went.

    With --link it runs on the wall clock instead, against devices at serial ports or UDP addresses:
    boards, or a plant in another process (`headway plant`).

    Leaves a folder with config.yaml (the config as used, which can be run again), run.mcap (every
    packet and every tick, and the plant's truth at 1 kHz) and summary.json; with --spawn the truth
    is in plant.mcap. Ctrl-C brings the
    machine to rest first and keeps what there is; a second one gives up. A run that is killed
    leaves the record up to then.

    Example: ten times the usual loss of packets, another seed, and the summary for a script.

        headway run configs/arm2.yaml --duration 2 --seed 7 --set sim.to_device.loss=0.1 --json

    Example: in real time, against a plant that it starts itself, behind ptys.

        headway run configs/arm2.yaml --link serial --spawn --set sync.limit_us=1000

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
    linked = over.linked()
    if view:
        if linked is not None:
            raise Failure(ExitCode.USAGE, "--view shows a simulated run: leave --link out")
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
            driver: Driver
            counted = dict[str, int]()
            if linked is not None:
                driver, counted = _run_live(linked, config, checked, changes, recording, made)
            else:
                driver = _run_simulated(config, checked, recording, view, made)
        made.keep = True
        summary = _summary(driver, recording, folder / PLANT_NAME)
        if counted:
            summary["link"] = counted
        text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
        (folder / "summary.json").write_text(text, encoding="utf-8")
    if to_json:
        print(text, end="")
    else:
        Console().print(summary_table(summary))
        print(f"written to {folder}")
        if summary["tracking"]["by"] == "encoders":
            print("tracking is by what the encoders told: nobody has seen the machine from outside")
        else:
            print(f"to look at it: headway report {shlex.quote(str(folder))}")
    return _verdict(summary, driver.stopping, recording.failure)


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
        with compiling(config):
            return Lockstep(config, path.parent, recording)
    except ValueError as error:
        raise Failure(ExitCode.USAGE, f"{path}: {' '.join(str(error).split())}") from error


def _run_simulated(
    path: Path, config: Config, recording: Recording, view: bool, made: Made
) -> Lockstep:
    """In virtual time."""
    lockstep = _set_up(path, config, recording)
    with View(lockstep.plant) if view else nullcontext() as window:
        _drive(lockstep, made, Bar(config.name, config.duration_s), window)
    return lockstep


def _run_live(
    linked: Linked, path: Path, config: Config, changes: list[str], recording: Recording, made: Made
) -> tuple[Live, dict[str, int]]:
    """On the wall clock. Also what the link has counted. Says before how long it takes, and nothing
    while it runs: a terminal may stand still, and what draws there takes the interpreter's time."""
    with live(linked, path, config, changes, made.path, recording) as (driver, link):
        seconds = config.duration_s / linked.factor
        print(
            f"{config.name}: {seconds:g} s once the clocks agree; Ctrl-C brings it to rest",
            file=sys.stderr,
        )
        _drive(driver, made, None, None)
    return driver, link.counts() | {"frames_bad": driver.frames_bad()}


def _drive(driver: Driver, made: Made, bar: Bar | None, window: View | None) -> None:
    """Runs to the end, or until Ctrl-C. Raises Failure if a device fails."""
    from headway.controller.tick import DeviceError
    from headway.sim.plant import UnstableError

    try:
        with (
            bar or nullcontext(),
            signals_stop(driver),
            redirect_stdout(sys.stderr),  # standard output is for the summary alone
        ):

            def progress(done_s: float) -> None:
                if bar:
                    bar.update(done_s)
                if window:
                    window.show(done_s)

            driver.run(progress)
    except UnstableError as error:
        raise Failure(ExitCode.USAGE, str(error)) from error
    except Exception as error:
        made.keep = driver.ticks > 0
        if made.keep:
            print(f"the record up to then is in {made.path}", file=sys.stderr)
        if isinstance(error, DeviceError):
            raise Failure(ExitCode.DEVICE, str(error)) from error
        raise
    if driver.ticks == 0:
        raise KeyboardInterrupt  # before the task began: there is nothing to tell


def _summary(driver: Driver, recording: Recording, plant: Path) -> dict[str, Any]:
    """The summary, from what has been recorded, here and by a spawned plant. Raises Failure if that
    is nothing."""
    from headway.cli.summary import summarize
    from headway.cli.truth import with_truth
    from headway.controller.record.reader import RecordError, read_run

    try:
        run = recording.run()
        arrays = run.arrays
        if plant.exists():
            arrays = with_truth(arrays, read_run(plant).arrays, driver.loop.task)
    except RecordError as error:
        raise Failure(ExitCode.RECORD, f"{error} ({recording.failure})") from error
    if not run.messages["tick"]:
        reason = f"{run.path}: nothing of the task was recorded: {recording.failure}"
        raise Failure(ExitCode.RECORD, reason)
    kept = {
        "complete": run.complete,
        "batches_dropped": run.batches_dropped,
        "messages": run.messages,
    }
    return {**summarize(driver.config, driver, arrays), "record": kept}


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
