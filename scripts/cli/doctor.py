"""`headway doctor`: what this computer and these links can hold, and the margin that follows."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from headway.cli.changes import Changes, changed_config
from headway.cli.failure import ExitCode, Failure
from headway.cli.linked import Factor, Kind, Linked
from headway.cli.wall import WallClock

if TYPE_CHECKING:
    from headway.cli.measure import Measured
    from headway.configs.schema import Config

LISTEN_S = 5.0  # to devices that nothing is armed of
POLL_US = 250  # a board looks into its inbox at least so often
SEND_US = 500  # from a plan's stamp until its last frame is written, on a slow computer
RARE = 99.9  # percent


def doctor(
    config: Path,
    /,
    *,
    link: Kind = "serial",
    spawn: Annotated[bool, Parameter(negative=())] = False,
    duration: float = 10.0,
    write: Annotated[bool, Parameter(negative=())] = False,
    realtime_factor: Factor = 1.0,
    keys: Path | None = None,
    ports: Path | None = None,
    overrides: Changes = None,
) -> int:
    """Measures what this computer can hold, and from it the smallest safe margin.

    Runs the config's task in real time against a plant that it starts itself, and so finds how late
    the loop wakes up and how long a tick computes. The round trip is that of the machine's own
    devices, which get stamps and nothing else: nothing is armed, nothing moves. With --spawn it is
    that of the plant. Let the computer do what it will do in operation, and nothing else.

    The margin has to last from a knot until the plan is with the slowest device: 99.9 % of wake-up
    and computing, of the round trip less the way back, what a clock may be off by, a board's look
    into its inbox; rounded up to knots.

    Example: can this computer control the arm, and how far ahead does it have to plan?

        headway doctor configs/arm2.yaml --spawn --set sync.limit_us=1000

    Parameters
    ----------
    config
        The YAML file of a machine and its task.
    link
        How the devices are reached: serial or udp.
    spawn
        Measures the round trip to the plant as well, not to the machine's devices.
    duration
        Seconds of the task. A tick in a thousand needs some thousand ticks to be seen.
    write
        Writes the margin into the config, as loop.margin_us.
    realtime_factor
        As of `headway plant`; what is measured is in its time.
    keys
        The folder of the machine's keys. Default: ~/.config/headway/keys/NAME.
    ports
        The folder where plants leave their ports' names. Default: headway/ in $XDG_RUNTIME_DIR.
    overrides
        Changes one key of the config; may be repeated.
    """
    own = Linked(link, realtime_factor, True)
    own.check()
    devices = Linked(link, realtime_factor, spawn, keys, ports)
    devices.check()
    changes = [*(overrides or []), f"duration_s={duration}"]
    checked = changed_config(config, changes)
    from headway.cli.measure import measure

    trip = None if spawn else _round_trips(devices, config, checked, list(overrides or []))
    measured = measure(own, config, checked, changes)
    if trip is not None:
        measured = replace(measured, round_trip_us=trip[0], clock_us=trip[1])
    if not all(len(each) for each in measured.round_trip_us):
        raise Failure(ExitCode.DEVICE, "not every device has answered: there is no round trip")
    margin_us = safe_margin_us(checked, measured)
    _show(checked, measured, margin_us)
    if measured.failure:
        print(f"the task broke off: {measured.failure}", file=sys.stderr)
    _require_possible(config, changes, margin_us)
    if write:
        _write(config, margin_us)
        print(f"written to {config}: loop.margin_us is {margin_us}")
    return ExitCode.DONE


def safe_margin_us(config: Config, measured: Measured) -> int:
    """The smallest margin, in whole knots, within which a plan reaches every device [us]."""
    import numpy as np

    ready = float(np.percentile(measured.ready_us, RARE))
    trips = max(float(np.percentile(each, RARE)) for each in measured.round_trip_us)
    way = trips - config.sync.to_host_least_us
    needed = ready + SEND_US + way + measured.clock_us + POLL_US
    return int(-(-needed // config.loop.knot_us)) * config.loop.knot_us


def _round_trips(
    linked: Linked, path: Path, config: Config, changes: list[str]
) -> tuple[list[Any], float]:
    """Of the machine's own devices [us], and what their clocks may be off by."""
    from headway.cli.measure import clock_error, round_trips
    from headway.controller.settling import Settling

    arrived: list[tuple[int, int, bytes]] = []
    with linked.machine(path, config, changes) as reached:
        remotes, clock = reached.remotes(), WallClock(linked.factor)
        with reached.link(clock) as link:

            class Tapped:
                """The link, with a copy of what arrives."""

                def receive(self, now_us: int) -> list[tuple[int, int, bytes]]:
                    packets = link.receive(now_us)
                    arrived.extend(packets)
                    return packets

                def send(self, device: int, packet: bytes, now_us: int) -> None:
                    link.send(device, packet, now_us)

            names, knot_us = list(reached.keys.devices), config.loop.knot_us
            Settling(names, knot_us, remotes, Tapped(), clock).run(LISTEN_S)
    trips = round_trips(arrived, len(config.machine.boards))
    return trips, clock_error(packet for _, _, packet in arrived)


def _show(config: Config, measured: Measured, margin_us: int) -> None:
    import numpy as np

    table = Table("[us]", "median", "99 %", "99.9 %", "largest")
    rows = [("wake-up", measured.wake_us), ("compute", measured.compute_us)]
    rows += [("both, until a plan is sent", measured.ready_us)]
    rows += [
        (f"round trip, {axis.joint}", each)
        for axis, each in zip(config.machine.boards, measured.round_trip_us, strict=True)
    ]
    for name, values in rows:
        figures = [np.percentile(values, percent) for percent in (50, 99, RARE, 100)]
        table.add_row(name, *(f"{figure:.0f}" for figure in figures))
    console = Console()
    console.print(table)
    console.print(
        f"{measured.knots} knots: {measured.missed} without a plan in time, "
        f"{measured.late_points} plans too late at a device; a clock is off by "
        f"{measured.clock_us:.0f} us at most"
    )
    now_us = config.loop.margin_us
    console.print(f"smallest safe margin: {margin_us} us; loop.margin_us is {now_us}")


def _require_possible(path: Path, changes: list[str], margin_us: int) -> None:
    """Raises Failure for a margin that the config may not have, before anything is written."""
    try:
        changed_config(path, [*changes, f"loop.margin_us={margin_us}"])
    except Failure as error:
        what = f"this computer and these links are too slow: {margin_us} us would be needed"
        raise Failure(ExitCode.LIMIT, f"{what}, and that is refused:\n{error}") from error


def _write(path: Path, margin_us: int) -> None:
    """Puts the margin into the file, and leaves everything else as it is. Raises Failure."""
    from headway.configs.edit import edit_number
    from headway.configs.mistakes.mistake import ConfigError

    try:
        edit_number(path, ("loop", "margin_us"), margin_us)
    except ConfigError as error:
        raise Failure(ExitCode.USAGE, str(error)) from error
    except OSError as error:
        raise Failure(ExitCode.USAGE, f"{path}: cannot be written: {error.strerror}") from error
