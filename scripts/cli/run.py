"""`headway run`: one task in closed loop against the simulated plant."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console

from headway.cli.failure import ExitCode, Failure
from headway.cli.folder import RUNS, check_free, stamp, written_whole
from headway.cli.progress import Bar
from headway.cli.table import summary_table
from headway.configs.load import ConfigError, load_config
from headway.configs.save import save_config
from headway.configs.schema import Config

if TYPE_CHECKING:
    from headway.sim.lockstep import Lockstep


def run(
    config: Path,
    /,
    *,
    duration: float | None = None,
    out: Path | None = None,
    seed: int | None = None,
    overrides: Annotated[
        list[str] | None,
        Parameter(name="--set", metavar="KEY.PATH=VALUE", negative_iterable=()),
    ] = None,
    to_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> int:
    """Runs a config's task in closed loop, in simulation, and measures how well it went.

    Leaves a folder with summary.json, record.npz (every tick, and the plant's truth at 1 kHz) and
    config.yaml (the config as used, which can be run again). Ctrl-C brings the machine to rest
    first and keeps what there is; a second one gives up.

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
    """
    changes = list(overrides or [])
    if duration is not None:
        changes.append(f"duration_s={duration}")
    if seed is not None:
        changes.append(f"seed={seed}")
    try:
        checked = load_config(config, changes)
    except ConfigError as error:
        raise Failure(ExitCode.USAGE, str(error)) from error
    folder = out or RUNS / f"{checked.name}-{stamp()}"
    check_free(folder)
    lockstep = _set_up(config, checked)
    with written_whole(folder) as unfinished:
        summary = _simulate(lockstep)
        _write(unfinished, summary, lockstep, config.parent)
    if to_json:
        print(json.dumps(summary, indent=2, allow_nan=False))
    else:
        Console().print(summary_table(summary))
        print(f"written to {folder}")
    return _verdict(summary, lockstep.stopping)


def _set_up(path: Path, config: Config) -> Lockstep:
    """The simulation at power-up. Raises Failure where config and model do not fit together."""
    from headway.sim.lockstep import Lockstep  # here, since it takes a second, and help should not

    try:
        return Lockstep(config, path.parent)
    except ValueError as error:
        raise Failure(ExitCode.USAGE, f"{path}: {' '.join(str(error).split())}") from error


def _simulate(lockstep: Lockstep) -> dict[str, Any]:
    """Runs to the end, or until Ctrl-C; returns the summary. Raises Failure if a device fails."""
    from headway.cli.summary import summarize
    from headway.controller.loop import DeviceError
    from headway.sim.plant import UnstableError

    config = lockstep.config
    try:
        with (
            Bar(config.name, config.duration_s) as bar,
            _ctrl_c_stops(lockstep),
            redirect_stdout(sys.stderr),  # standard output is for the summary alone
        ):
            lockstep.run(bar.update)
    except DeviceError as error:
        raise Failure(ExitCode.DEVICE, str(error)) from error
    except UnstableError as error:
        raise Failure(ExitCode.USAGE, str(error)) from error
    if lockstep.ticks == 0:
        raise KeyboardInterrupt  # before the task began: there is nothing to tell
    return summarize(config, lockstep, lockstep.record.arrays())


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


def _write(folder: Path, summary: dict[str, Any], lockstep: Lockstep, base: Path) -> None:
    """`base` is where the config's relative paths start."""
    text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
    (folder / "summary.json").write_text(text, encoding="utf-8")
    lockstep.record.save(folder / "record.npz")
    save_config(lockstep.config, base, folder / "config.yaml")


def _verdict(summary: dict[str, Any], interrupted: bool) -> ExitCode:
    for violation in summary["limits_violated"]:
        print(f"limit violated: {violation}", file=sys.stderr)
    if interrupted:
        rest = "was brought to rest" if summary["at_rest_after_end"] else "did NOT come to rest"
        print(f"interrupted; the machine {rest}", file=sys.stderr)
        return ExitCode.INTERRUPTED
    return ExitCode.LIMIT if summary["limits_violated"] else ExitCode.DONE
