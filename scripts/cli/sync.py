"""`headway sync`: whether the boards' clocks have settled, and how far each may be off."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
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
from headway.cli.linked import SIMULATED, Link, Linked, Over, check_factor
from headway.cli.wall import WallClock

if TYPE_CHECKING:
    from headway.controller.settling import Settling
    from headway.devices.clock import ClockState

CONFIGS = (".yaml", ".yml")
SHOWN_S = 0.1  # between two states of the table, and two points of the plot


def sync(
    *where: str,
    settled: float = 2.0,
    timeout: float = 30.0,
    seed: int | None = None,
    overrides: Changes = None,
    to_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
    plot: Path | None = None,
    over: Link = SIMULATED,
) -> int:
    """Watches the clocks of a machine's boards until all have settled.

    Of a config's machine in simulation, or with --link of boards, or of a plant in another process.
    Without a config, of whatever devices are at the ports that are named: paths, or addresses as
    HOST:PORT. A device tells its time to who has its key and to nobody else, so each is found by
    the keys that are here, of all machines unless --keys names one's; it has to be at rest, and no
    other host's.

    Says for each board its offset as the host measures it, the interval in which the board itself
    says that its error lies, the skew of its oscillator, and the shortest round trip. Nothing is
    armed, nothing moves. Ends with 0 when all clocks have stayed settled for a while, with 4 and
    the names of those that have not when the time is over.

    Example: how well do they agree over a serial port, if nothing is known of its delays?

        headway sync configs/arm2.yaml --set sim.network=usb --set sync.to_device_least_us=0

    And what is at these two ports?

        headway sync /dev/ttyACM0 192.168.1.20:47001 --settled 10

    Parameters
    ----------
    where
        The YAML file of a machine, or ports.
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
    changes = list(overrides or []) + ([] if seed is None else [f"seed={seed}"])
    for name, value in (("--settled", settled), ("--timeout", timeout)):
        if not 0 < value <= 3600:
            raise Failure(ExitCode.USAGE, f"{name} {value:g}: give seconds, up to 3600")
    if plot is not None:
        _check_plot(plot)
    with _watched(where, changes, over) as (settling, names):
        console = Console(stderr=to_json)
        history: list[tuple[float, list[ClockState]]] = []
        with Live(console=console, auto_refresh=False, transient=to_json) as live:
            while settling.settled_s < settled and settling.time_s < timeout:
                states = settling.run(SHOWN_S)
                history.append((settling.time_s, states))
                shown = _table(names, states, settling.time_s, settling.settled_s)
                live.update(shown, refresh=True)
    done = settling.settled_s >= settled
    if plot is not None:
        _draw(plot, names, history)
    if to_json:
        print(json.dumps(_figures(names, history[-1][1], settling.time_s, done), indent=2))
    if not done:
        late = "; ".join(settling.unsettled()) or "all clocks: not for long enough"
        print(f"not settled within {timeout:g} s: {late}", file=sys.stderr)
    return ExitCode.DONE if done else ExitCode.DEVICE


@contextmanager
def _watched(
    where: Sequence[str], changes: list[str], over: Over
) -> Iterator[tuple[Settling, list[str]]]:
    """The devices of a config or at ports, and their names. Raises Failure."""
    if not where:
        raise Failure(ExitCode.USAGE, "headway sync: name a config, or ports")
    if any(Path(each).suffix in CONFIGS for each in where):
        if len(where) > 1:
            raise Failure(ExitCode.USAGE, f"{' '.join(where)}: name one config, or ports alone")
        with _machine(Path(where[0]), changes, over.linked()) as watched:
            yield watched
        return
    if over.link or over.spawn or over.ports or changes:
        raise Failure(
            ExitCode.USAGE,
            "--link, --spawn, --ports, --set and --seed are for a config: leave them out, as the "
            f"ports are named: {' '.join(where)}",
        )
    check_factor(over.realtime_factor)
    with _at_ports(where, over) as watched:
        yield watched


@contextmanager
def _at_ports(where: Sequence[str], over: Over) -> Iterator[tuple[Settling, list[str]]]:
    from headway.cli.at_ports import KNOT_US, at_ports
    from headway.controller.settling import Settling

    clock = WallClock(over.realtime_factor)
    with at_ports(where, over.keys, clock) as found:
        names = [f"{name} at {port}" for name, port in zip(found.names, found.ports, strict=True)]
        yield Settling(names, KNOT_US, found.remotes, found.link, clock), names


@contextmanager
def _machine(
    path: Path, changes: list[str], linked: Linked | None
) -> Iterator[tuple[Settling, list[str]]]:
    """Simulated, or over a link."""
    from headway.controller.settling import Settling

    config = changed_config(path, changes)
    names, knot_us = [axis.joint for axis in config.machine.boards], config.loop.knot_us
    if linked is not None:
        with linked.machine(path, config, changes) as reached:
            remotes, clock = reached.remotes(), WallClock(linked.factor)
            with reached.link(clock) as link:
                yield Settling(names, knot_us, remotes, link, clock), names
        return
    from headway.sim.plant_clock import PlantClock
    from headway.sim.world import World

    try:
        world = World(config, path.parent)
    except ValueError as error:
        raise Failure(ExitCode.USAGE, f"{path}: {' '.join(str(error).split())}") from error
    yield Settling(names, knot_us, world.remotes, world.link, PlantClock(world)), names


def _table(names: list[str], states: list[ClockState], time_s: float, settled_s: float) -> Table:
    title = f"{time_s:.1f} s, " + (
        f"settled for {settled_s:.1f} s" if settled_s >= 0 else "not settled"
    )
    heads = ("", "offset [us]", "error within [us]", "skew [ppm]", "round trip [us]", "excluded")
    table = Table(*heads, "", title=title, title_justify="left")
    for name, state in zip(names, states, strict=True):
        within = "-"
        if state.least_us is not None and state.most_us is not None:
            within = f"{state.least_us:.1f} .. {state.most_us:.1f}"
        table.add_row(
            name,
            "-" if state.offset_us is None else f"{state.offset_us:.1f}",
            within,
            f"{state.skew_ppm:.2f}",
            "-" if state.round_trip_us is None else str(state.round_trip_us),
            str(state.excluded),
            "settled" if state.settled else "...",
        )
    return table


def _figures(
    names: list[str], states: list[ClockState], time_s: float, done: bool
) -> dict[str, Any]:
    devices = [
        {"joint": name, **asdict(state), "interval_us": state.interval_us}
        for name, state in zip(names, states, strict=True)
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


def _draw(path: Path, names: list[str], history: list[tuple[float, list[ClockState]]]) -> None:
    """Raises Failure for a file that cannot be written."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    for i, name in enumerate(names):
        known = [(t, s[i]) for t, s in history if s[i].least_us is not None]
        if not known:
            continue
        times = [t for t, _ in known]
        color = f"C{i}"
        least, most = [s.least_us or 0.0 for _, s in known], [s.most_us or 0.0 for _, s in known]
        axes.fill_between(times, least, most, color=color, alpha=0.2, label=f"{name}, as told")
        offsets = [s.offset_us or 0.0 for _, s in known]
        axes.plot(times, offsets, color=color, label=f"{name}, measured")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("clock minus the host's [us]")
    axes.legend()
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise Failure(ExitCode.USAGE, f"--plot {path}: {error}") from error
