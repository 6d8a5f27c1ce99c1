"""`headway play`: devices that fire, compute and sample in one time, in simulation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from headway.cli.failure import ExitCode, Failure

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from headway.configs.stage import Feed, Player
    from headway.sim.stage import Play


def play(
    stage: Path,
    /,
    *,
    to_json: Annotated[bool, Parameter(name="--json", negative=())] = False,
) -> int:
    """Plays a stage: event streams and ramps on devices, with logic, outputs, readings and feeds.

    Says when outputs went on, against what was asked and against each other's, and what was read.

    Example: a strobe and a shutter at the same microsecond, a sensor on their edges, and a wave
    beyond its bandwidth.

        headway play configs/strobe.yaml

    Another: an electronic gear, from one board to the other.

        headway play configs/gear.yaml

    Parameters
    ----------
    stage
        The YAML file of a stage.
    to_json
        Prints the figures as JSON, and nothing else, on standard output.
    """
    from headway.configs.mistakes.mistake import ConfigError
    from headway.configs.stage import load_stage
    from headway.sim.stage import Play

    try:
        played = Play(load_stage(stage))
        played.run()
    except ConfigError as error:
        raise Failure(ExitCode.USAGE, str(error)) from error
    except ValueError as error:
        raise Failure(ExitCode.DEVICE, f"{stage}: {error}") from error
    figures = _figures(played)
    if to_json:
        print(json.dumps(figures, indent=2))
    else:
        _show(figures)
    if trouble := _trouble(figures["devices"]):
        raise Failure(ExitCode.DEVICE, f"{stage}: {trouble}")
    return ExitCode.DONE


def _trouble(devices: list[dict[str, Any]]) -> str:
    """Which devices did not do what they were asked for; empty if all did."""
    found = []
    for row in devices:
        name = row["device"]
        if row["logic"] != "good":
            found.append(f"{name} has refused its logic: {row['logic']}")
        if row["refused"] or not row["settled"]:
            found.append(f"{name} has not taken all of its tracks")
        if row["late"]:
            text = f"{row['late']} pieces came to {name} after their start"
            help_ = "change its tracks less often, feed them later (after_us)"
            found.append(f"{text}: {help_}, or have a better wire")
        if row["gaps"]:
            text = f"{row['gaps']} gaps were in what other boards fed {name}"
            found.append(f"{text}: feed it less often (every), or have a better mesh")
    return "; ".join(found)


def _figures(played: Play) -> dict[str, Any]:
    import numpy as np

    from headway.sim.stage import reconstruct

    outputs, readings, devices = [], [], []
    seen: dict[str, list[int]] = {}
    for i, (name, device) in enumerate(played.stage.devices.items()):
        signals = played.signals(i)
        row: dict[str, Any] = {"device": name, "logic": signals.refusal or "good"}
        row |= {"settled": signals.settled, "refused": signals.refused, "late": signals.late}
        devices.append(row | {"gaps": signals.gaps, "readings_lost": signals.lost})
        for output, track in enumerate(device.digital):
            fired = played.fired[i].get(output, [])
            row = {"device": name, "output": output, "follows": track}
            row["times"] = len(fired)
            stream = played.stage.tracks[track].stream if track in played.stage.tracks else None
            if stream is not None:
                asked = stream.start_us + stream.every_us * np.arange(stream.times)
                off = np.array([t - asked[np.abs(asked - t).argmin()] for t in fired])
                row["off_us"] = int(np.abs(off).max()) if len(off) else None
            if track in played.stage.feeds:
                row["off_us"] = _fed_off_us(played, track, fired)
            if track in seen and len(seen[track]) == len(fired):
                row["apart_us"] = int(np.abs(np.array(fired) - seen[track]).max())
            seen.setdefault(track, fired)
            outputs.append(row)
        for trigger, reading in enumerate(device.readings):
            told = played.readings(i, trigger)
            row = {"device": name, "reads": reading.read, "kind": reading.kind}
            row["times"] = len(told)
            if reading.fold_us is not None and len(told) > 20:
                left, amplitudes = reconstruct(told, reading.fold_us)
                row["left_over"] = None if np.isnan(left) else round(left, 4)
                row["amplitudes"] = [round(float(a), 1) for a in amplitudes]
            if reading.read in played.stage.feeds:
                row["apart"] = _fed_apart(played, reading.read, told)
            readings.append(row)
    return {
        "name": played.stage.name,
        "clocks_within_us": round(played.widest_us, 1),
        "outputs": outputs,
        "readings": readings,
        "devices": devices,
    }


def _fed(played: Play, name: str) -> tuple[int, Player, Feed]:
    """Which device feeds it, and how."""
    owner = played.stage.feeds[name]
    device = played.stage.devices[owner]
    return played.names.index(owner), device, device.feeds[name]


def _fed_off_us(played: Play, name: str, fired: list[int]) -> int | None:
    """How far an output that follows a feed was from one that follows its source, `after_us`
    before; None where there is no such output."""
    import numpy as np

    index, device, feed = _fed(played, name)
    if feed.of not in device.digital or not fired:
        return None
    first = np.array(played.fired[index].get(device.digital.index(feed.of), []))
    if not len(first):
        return None
    off = [np.abs(first + feed.after_us - t).min() for t in fired if t >= first[0]]
    return int(max(off)) if off else None


def _fed_apart(played: Play, name: str, told: NDArray[np.int64]) -> float | None:
    """How far what was read of a feed was from what its device read of the source, `after_us`
    before, from the begin of the play on; None where it reads nothing of it at intervals."""
    import numpy as np

    index, device, feed = _fed(played, name)
    for trigger, reading in enumerate(device.readings):
        if reading.kind != "interval" or reading.read != feed.of:
            continue
        first = played.readings(index, trigger)
        times = told[:, 0] - feed.after_us
        inside = (told[:, 0] >= 0) & (times >= first[0, 0]) & (times <= first[-1, 0])
        apart = told[inside, 1] - np.interp(times[inside], first[:, 0], first[:, 1])
        return round(float(np.abs(apart).max()), 1) if len(apart) else None
    return None


def _show(figures: dict[str, Any]) -> None:
    console = Console()
    for title in ("outputs", "readings", "devices"):
        rows = figures[title]
        if not rows:
            continue
        heads = list(dict.fromkeys(key for row in rows for key in row))
        table = Table(*heads, title=title, title_justify="left")
        for row in rows:
            cells = (row.get(key) for key in heads)
            table.add_row(*("" if cell is None else str(cell) for cell in cells))
        console.print(table)
    console.print(f"{figures['name']}: clocks were within {figures['clocks_within_us']} us")
