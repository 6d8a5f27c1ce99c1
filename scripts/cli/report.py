"""`headway report`: a run, or two beside each other, as a page for any browser."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headway.cli.failure import ExitCode, Failure
from headway.cli.live import PLANT_NAME
from headway.cli.progress import Bar
from headway.configs.replace import replace_text

if TYPE_CHECKING:
    from headway.cli.page.animation import Animation
    from headway.cli.page.shown import Shown
    from headway.controller.record.reader import Run

SUMMARY = "summary.json"


def report(run: Path, other: Path | None = None, /, *, out: Path | None = None) -> int:
    """Makes a page of a run: the machine as it moves, and plots of all that matters.

    The page is one HTML file that needs no network and no other file. It has the machine, drawn by
    MuJoCo as it moved; how well it followed, and what the controller saw of it; torques and their
    limits; computing times; how much plan each device still held; what was lost; the solver. With a
    second run both are in the same plots, and the summary has their ratio.

    A page that is already there is replaced: it can be made again from the record.

    Example: a run, and how another seed differs from it.

        headway report runs/mine
        headway report runs/mine runs/other

    Parameters
    ----------
    run
        A run's folder, or its run.mcap.
    other
        A second run, of a machine with the same axes, to be compared.
    out
        The file to write. Default: report.html in the run's folder; with a second run
        report-vs-NAME.html, where NAME is the other's folder.
    """
    paths = [run] if other is None else [run, other]
    shown = _shown(paths)
    target = out or _default(shown)
    if target.is_dir():
        raise Failure(ExitCode.USAGE, f"--out {target}: is a folder; name a file in it")
    from headway.cli.page.document import document

    film, no_film = _film(shown)
    _replace(target, document(shown, film, no_film))
    if no_film:
        print(f"no animation: {no_film}", file=sys.stderr)
    print(f"written to {target}")
    return ExitCode.DONE


def _shown(paths: list[Path]) -> list[Shown]:
    """The runs as they are to be shown. Raises Failure."""
    from headway.cli.page.shown import Shown

    runs = [_read(path) for path in paths]
    names = [""]
    if len(runs) == 2:
        names = [run.path.parent.resolve().name for run in runs]
        if names[0] == names[1]:
            names = [str(path) for path in paths]
    summaries = [_summary(run) for run in runs]
    shown = [
        Shown(name, colour, run, summary)
        for name, colour, run, summary in zip(names, "ab", runs, summaries, strict=False)
    ]
    axes = [run.joints for run in shown]
    if axes[0] != axes[-1]:
        raise Failure(
            ExitCode.USAGE,
            f"{paths[0]} has the axes {', '.join(axes[0])}, {paths[1]} has "
            f"{', '.join(axes[1])}: only runs of machines with the same axes can be compared",
        )
    return shown


def _read(path: Path) -> Run:
    """A record with something to show. Raises Failure."""
    from pydantic import ValidationError

    from headway.cli.truth import has_truth, with_truth
    from headway.controller.record.reader import RecordError, read_run
    from headway.controller.reference import task_reference

    try:
        run = read_run(path)
        config = run.config()
        plant = run.path.with_name(PLANT_NAME)
        if run.messages["tick"] and plant.exists():
            task = task_reference(config, run.path.parent)
            run.arrays = with_truth(run.arrays, read_run(plant).arrays, task)
    except RecordError as error:
        raise Failure(ExitCode.USAGE, str(error)) from error
    except ValidationError as error:
        raise Failure(
            ExitCode.USAGE,
            f"{path}: its config is of another version of headway: use the one that wrote it, "
            f"{run.versions.get('headway')}",
        ) from error
    except ValueError as error:
        raise Failure(ExitCode.USAGE, f"{path}: {error}") from error
    if run.messages["tick"] and not has_truth(run.arrays):
        raise Failure(
            ExitCode.USAGE,
            f"{run.path}: nobody has recorded how the machine truly moved: a page needs the record "
            f"of its plant beside it, as {PLANT_NAME} (`headway plant --record`)",
        )
    if not (run.messages["tick"] and has_truth(run.arrays)):
        raise Failure(
            ExitCode.USAGE, f"{run.path}: ends before its task begins: there is nothing to show"
        )
    return run


def _summary(run: Run) -> dict[str, Any] | None:
    """What `headway run` left beside the record; None if it was killed. Raises Failure."""
    path = run.path.with_name(SUMMARY)
    try:
        summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        same = summary["log_sha256"] == run.log_sha256
    except FileNotFoundError:
        return None
    except (OSError, ValueError, LookupError, TypeError) as error:
        what = " ".join(str(error).split())
        raise Failure(ExitCode.USAGE, f"{path}: cannot be read: {what}; remove it") from error
    if run.complete and not same:
        raise Failure(ExitCode.USAGE, f"{path}: is the summary of another run; remove it")
    return summary


def _default(shown: list[Shown]) -> Path:
    folder = shown[0].run.path.parent
    if len(shown) == 1:
        return folder / "report.html"
    return folder / f"report-vs-{shown[1].run.path.parent.resolve().name}.html"


def _film(shown: list[Shown]) -> tuple[Animation | None, str]:
    """The animation, or why there is none."""
    from headway.cli.page.animation import animate, picture_times
    from headway.cli.page.scene import NoPicture

    times_s = shown[0].arrays["truth_s"]
    pictured_s, _ = picture_times(float(times_s[0]), float(times_s[-1]))
    try:
        with Bar("drawing", float(pictured_s[-1] - pictured_s[0])) as bar:
            return animate(shown[0].run, shown[1].run if shown[1:] else None, bar.update), ""
    except NoPicture as error:
        return None, str(error)


def _replace(path: Path, text: str) -> None:
    """Writes a file as a whole, in place of what is there. Raises Failure."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_text(path, text)
    except OSError as error:
        raise Failure(ExitCode.USAGE, f"{path}: cannot be written: {error.strerror}") from error
