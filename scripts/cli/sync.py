"""`headway sync`: whether the boards' clocks have settled, and how far each may be off."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.live import Live
from rich.table import Table

from headway.cli.changes import Changes, changed_config
from headway.cli.failure import ExitCode, Failure
from headway.cli.linked import SIMULATED, Link, Linked
from headway.cli.wall import WallClock

if TYPE_CHECKING:
    from headway.configs.schema import Config
    from headway.controller.settling import Settling
    from headway.devices.clock import ClockState

SHOWN_S = 0.1  # between two states of the table, and two points of the plot


def sync(
    config: Path,
    /,
    *,
    settled: float = 2.0,
    timeout: float = 30.0,
    seed: int | None = None,
    overrides: Changes = None,
    to_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
    plot: Path | None = None,
    over: Link = SIMULATED,
) -> int:
    """Watches the clocks of a machine's boards until all have settled.

    In simulation; with --link those of boards, or of a plant in another process.

    Says for each board its offset as the host measures it, the interval in which the board itself
    says that its error lies, the skew of its oscillator, and the shortest round trip. Nothing is
    armed, nothing moves. Ends with 0 when all clocks have stayed settled for a while, with 4 and
    the names of those that have not when the time is over.

    Example: how well do they agree over a serial port, if nothing is known of its delays?

        headway sync configs/arm2.yaml --set sim.network=usb --set sync.to_device_least_us=0

    Parameters
    ----------
    config
        The YAML file of a machine.
    settled
        Seconds for which all clocks have to stay settled.
    timeout
        Seconds until it gives up.
    seed
        Of everything random, instead of the config's seed.
    overrides
        Changes one key of the config; may be repeated.
    to_json
        Prints the end's figures as JSON, and nothing else, on standard output.
    plot
        Draws offsets and intervals over time into this file, as SVG, PNG or PDF by its name. Needs
        matplotlib.
    """
    linked = over.linked()
    changes = list(overrides or []) + ([] if seed is None else [f"seed={seed}"])
    checked = changed_config(config, changes)
    for name, value in (("--settled", settled), ("--timeout", timeout)):
        if not 0 < value <= 3600:
            raise Failure(ExitCode.USAGE, f"{name} {value:g}: give seconds, up to 3600")
    if plot is not None:
        _check_plot(plot)
    with _machine(config, checked, changes, linked) as settling:
        joints = [axis.joint for axis in checked.machine.axes]
        console = Console(stderr=to_json)
        history: list[tuple[float, list[ClockState]]] = []
        with Live(console=console, auto_refresh=False, transient=to_json) as live:
            while settling.settled_s < settled and settling.time_s < timeout:
                states = settling.run(SHOWN_S)
                history.append((settling.time_s, states))
                shown = _table(joints, states, settling.time_s, settling.settled_s)
                live.update(shown, refresh=True)
    done = settling.settled_s >= settled
    if plot is not None:
        _draw(plot, joints, history)
    if to_json:
        print(json.dumps(_figures(joints, history[-1][1], settling.time_s, done), indent=2))
    if not done:
        late = "; ".join(settling.unsettled()) or "all clocks: not for long enough"
        print(f"not settled within {timeout:g} s: {late}", file=sys.stderr)
    return ExitCode.DONE if done else ExitCode.DEVICE


@contextmanager
def _machine(
    path: Path, config: Config, changes: list[str], linked: Linked | None
) -> Iterator[Settling]:
    """The devices, simulated or at their ports. Raises Failure."""
    from headway.controller.settling import Settling

    if linked is not None:
        with linked.machine(path, config, changes) as reached:
            remotes, clock = reached.remotes(), WallClock(linked.factor)
            with reached.link(clock) as link:
                yield Settling(config, remotes, link, clock)
        return
    from headway.sim.plant_clock import PlantClock
    from headway.sim.world import World

    try:
        world = World(config, path.parent)
    except ValueError as error:
        raise Failure(ExitCode.USAGE, f"{path}: {' '.join(str(error).split())}") from error
    yield Settling(config, world.remotes, world.link, PlantClock(world))


def _table(joints: list[str], states: list[ClockState], time_s: float, settled_s: float) -> Table:
    title = f"{time_s:.1f} s, " + (
        f"settled for {settled_s:.1f} s" if settled_s >= 0 else "not settled"
    )
    heads = ("", "offset [us]", "error within [us]", "skew [ppm]", "round trip [us]", "excluded")
    table = Table(*heads, "", title=title, title_justify="left")
    for joint, state in zip(joints, states, strict=True):
        within = "-"
        if state.least_us is not None and state.most_us is not None:
            within = f"{state.least_us:.1f} .. {state.most_us:.1f}"
        table.add_row(
            joint,
            "-" if state.offset_us is None else f"{state.offset_us:.1f}",
            within,
            f"{state.skew_ppm:.2f}",
            "-" if state.round_trip_us is None else str(state.round_trip_us),
            str(state.excluded),
            "settled" if state.settled else "...",
        )
    return table


def _figures(
    joints: list[str], states: list[ClockState], time_s: float, done: bool
) -> dict[str, Any]:
    devices = [
        {"joint": joint, **asdict(state), "interval_us": state.interval_us}
        for joint, state in zip(joints, states, strict=True)
    ]
    for device in devices:
        for key, value in device.items():
            if isinstance(value, float):
                device[key] = round(value, 3)
    return {"settled": done, "time_s": round(time_s, 3), "devices": devices}


def _check_plot(path: Path) -> None:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise Failure(ExitCode.USAGE, "--plot needs matplotlib: pip install matplotlib") from error
    kinds = Figure().canvas.get_supported_filetypes()
    if path.suffix[1:] not in kinds:
        raise Failure(ExitCode.USAGE, f"--plot {path}: end the name with .{', .'.join(kinds)}")


def _draw(path: Path, joints: list[str], history: list[tuple[float, list[ClockState]]]) -> None:
    """Raises Failure for a file that cannot be written."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    for i, joint in enumerate(joints):
        known = [(t, s[i]) for t, s in history if s[i].least_us is not None]
        if not known:
            continue
        times = [t for t, _ in known]
        color = f"C{i}"
        least, most = [s.least_us or 0.0 for _, s in known], [s.most_us or 0.0 for _, s in known]
        axes.fill_between(times, least, most, color=color, alpha=0.2, label=f"{joint}, as told")
        offsets = [s.offset_us or 0.0 for _, s in known]
        axes.plot(times, offsets, color=color, label=f"{joint}, measured")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("clock minus the host's [us]")
    axes.legend()
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise Failure(ExitCode.USAGE, f"--plot {path}: {error}") from error
