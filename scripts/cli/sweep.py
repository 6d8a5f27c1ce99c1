"""`headway sweep`: the same task with other values and other seeds, run side by side."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter, validators

from headway.cli.changes import Changes
from headway.cli.failure import ExitCode, Failure
from headway.cli.folder import RUNS, check_free, run_folder, stamp

if TYPE_CHECKING:
    from headway.cli.vary import Combination
    from headway.configs.schema import Config

AT_LEAST_ONE = Parameter(validator=validators.Number(gte=1))

Row = dict[str, Any]


def sweep(
    config: Path,
    /,
    *,
    vary: Annotated[
        list[str] | None, Parameter(metavar="KEY.PATH=VALUE,VALUE", negative_iterable=())
    ] = None,
    seeds: Annotated[int, AT_LEAST_ONE] = 3,
    jobs: Annotated[int | None, AT_LEAST_ONE] = None,
    duration: float | None = None,
    overrides: Changes = None,
    out: Path | None = None,
    to_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> int:
    """Runs a config's task with every combination of values, over several seeds, in simulation.

    Prints a row for each combination, and the command that repeats its worst seed. Leaves a folder
    with sweep.parquet (a row for each run, with all of its summary) and sweep.json (what is
    printed). All values are checked before the first run. A run that fails is a row with its error.
    Ctrl-C keeps the runs that are done. The exit code is 4 if a run failed, else 3 if a limit was
    violated in one, else 0.

    Example: what loss costs, at two distances ahead.

        headway sweep configs/arm2.yaml --vary loop.margin_us=12288,24576
        --vary sim.to_device.loss=0,0.1 --duration 4

    Parameters
    ----------
    config
        The YAML file of a machine and its task.
    vary
        A key of the config and its values; may be repeated. Commas within brackets, braces or
        quotes do not part values, as in --vary sim.start_rad_or_m=[0,0],[0.5,0.5].
    seeds
        How many seeds each combination gets: 0, 1, 2 and so on.
    jobs
        How many runs at a time; by default one for each processor. More make the measured
        computing times longer and change nothing else.
    duration
        Seconds of the task, instead of the config's duration_s.
    overrides
        Changes one key of the config in all runs; may be repeated.
    out
        The folder to leave; it must not exist yet, or be empty. Default: runs/NAME-sweep-STAMP.
    to_json
        Prints sweep.json, and nothing else, on standard output.
    """
    if importlib.util.find_spec("pyarrow") is None:
        reason = "sweep needs pyarrow, which is not installed: pip install pyarrow"
        raise Failure(ExitCode.USAGE, reason)
    changes = list(overrides or [])
    if duration is not None:
        changes.append(f"duration_s={duration}")
    combinations = _combinations(config, changes, vary or [])
    runs = [(combination, seed) for combination in combinations for seed in range(seeds)]
    folder = out or RUNS / f"{combinations[0].config.name}-sweep-{stamp()}"
    check_free(folder)
    with run_folder(folder) as made:
        _compile(config, combinations)
        rows = _run_all(config, runs, jobs or len(os.sched_getaffinity(0)))
        if not rows:
            raise KeyboardInterrupt
        made.keep = True
        _write(folder, combinations, rows, to_json)
    if len(rows) < len(runs):
        print(f"interrupted: {len(rows)} of {len(runs)} runs are in {folder}", file=sys.stderr)
        return ExitCode.INTERRUPTED
    return _verdict(rows)


def _combinations(path: Path, changes: list[str], vary: list[str]) -> list[Combination]:
    """Raises Failure with everything that is wrong with the config or a value."""
    from headway.cli.vary import combinations, parse_varied
    from headway.configs.load import ConfigError

    try:
        return combinations(path, changes, parse_varied(vary, changes))
    except (ConfigError, ValueError) as error:
        raise Failure(ExitCode.USAGE, str(error)) from error


def _compile(path: Path, combinations: list[Combination]) -> None:
    """Makes the models' C, once, before several processes want it at the same time.

    Raises Failure where config and model do not fit together.
    """
    from headway.cli.progress import compiling
    from headway.sim.lockstep import Lockstep

    different: dict[Any, Config] = {}
    for config in (combination.config for combination in combinations):
        shape = config.machine.model, config.loop.knot_us, config.mpc.horizon_us
        different.setdefault((*shape, config.mpc.intervals), config)
    for config in different.values():
        try:
            with compiling(config):
                Lockstep(config, path.parent)
        except ValueError as error:
            raise Failure(ExitCode.USAGE, f"{path}: {' '.join(str(error).split())}") from error


def _run_all(path: Path, runs: list[tuple[Combination, int]], jobs: int) -> list[Row]:
    """A row for each run, in their order; on Ctrl-C of those that are done."""
    from headway.cli.pool import each, processes
    from headway.cli.progress import COUNT, Bar
    from headway.cli.simulation import replay_command

    rows: dict[int, Row] = {}
    jobs = min(jobs, len(runs))
    print(f"{len(runs)} runs, {jobs} at a time", file=sys.stderr)
    folder = path.parent.absolute()
    arguments = [(c.config.model_copy(update={"seed": seed}), folder) for c, seed in runs]
    try:
        with Bar("sweep", len(runs), COUNT) as bar, processes(jobs) as executor:
            bar.update(0)
            for i, done in each(executor, simulate, arguments):
                combination, seed = runs[i]
                varied = {f"vary.{key}": combination.typed(key) for key in combination.values}
                replay = replay_command(path, combination.changes, seed)
                error = done.exception()
                came = {"error": f"internal error: {error!r}"} if error else done.result()
                rows[i] = {**varied, "seed": seed, "error": "", "replay": replay, **came}
                bar.update(len(rows))
    except KeyboardInterrupt:
        pass  # what is done is kept
    return [rows[i] for i in sorted(rows)]


def simulate(argument: tuple[Config, Path]) -> Row:
    """Runs a config whose paths start at a folder; gives its summary in columns, or its error."""
    from headway.cli.flat import flatten
    from headway.cli.simulation import Simulation
    from headway.controller.tick import DeviceError
    from headway.sim.plant import UnstableError

    try:
        return flatten(Simulation(*argument).run())
    except (DeviceError, UnstableError, ValueError) as error:
        return {"error": " ".join(str(error).split())}


def _write(folder: Path, combinations: list[Combination], rows: list[Row], to_json: bool) -> None:
    """The two files, and the one or the other on standard output. Raises OSError."""
    from headway.cli.sweep_report import print_sweep, sweep_report, write_parquet

    axes = [axis.joint for axis in combinations[0].config.machine.axes]
    report = sweep_report(axes, list(combinations[0].values), rows)
    text = json.dumps(report, indent=2, allow_nan=False) + "\n"
    (folder / "sweep.json").write_text(text, encoding="utf-8")
    write_parquet(rows, folder / "sweep.parquet")
    if to_json:
        print(text, end="")
    else:
        print_sweep(report)
        print(f"written to {folder}")


def _verdict(rows: list[Row]) -> ExitCode:
    if any(row["error"].startswith("internal") for row in rows):
        return ExitCode.INTERNAL
    if any(row["error"] for row in rows):
        return ExitCode.DEVICE
    return ExitCode.LIMIT if any(row["limits_violated"] for row in rows) else ExitCode.DONE
