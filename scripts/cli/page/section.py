"""A part of the page: a heading, what is to be seen, a table perhaps, and plots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle

from headway.cli.page.plot import Array, Curve, Level, Plot, Style
from headway.cli.page.shown import Shown

PALETTE = [f"c{i}" for i in range(8)]  # variables of page.css


@dataclass
class Rows:
    """A table: cells as text, in the last `numbers` columns numbers."""

    head: list[str]
    body: list[list[str]]
    numbers: int


@dataclass
class Section:
    """`key` is its address within the page."""

    key: str
    title: str
    about: list[str]  # sentences
    plots: list[Plot] = field(default_factory=list)
    table: Rows | None = None


@dataclass(frozen=True)
class Trace:
    """One line of a run, with its x."""

    label: str
    x: Array
    values: Array
    style: Style = "line"


def side_by_side(
    shown: Sequence[Shown], like: Plot, traces: Callable[[Shown], list[Trace]]
) -> list[Plot]:
    """Traces of one run in one plot, each in a colour of its own; of two runs in a plot for each
    trace, with both runs in it. `like` has the title, the axes and the levels.

    Every run has traces of the same labels, in the same order.
    """
    if len(shown) == 1:
        for colour, trace in zip(cycle(PALETTE), traces(shown[0]), strict=False):
            curve = Curve(trace.label, trace.values, colour, trace.style)
            like.add(trace.x, [curve], shown[0].points)
        return [like]
    plots = []
    for pair in zip(*map(traces, shown), strict=True):
        plot = replace(like, title=f"{like.title}: {pair[0].label}")
        for run, trace in zip(shown, pair, strict=True):
            curve = Curve(run.name, trace.values, run.colour, trace.style)
            plot.add(trace.x, [curve], run.points)
        plots.append(plot)
    return plots


def levels(
    shown: Sequence[Shown], label: str, value: Callable[[Shown], float], reached: bool = True
) -> list[Level]:
    """A level of each run; one for all if they have the same. `reached`: see Level."""
    values = {run: value(run) for run in shown}
    if len(set(values.values())) == 1:
        return [Level(values[shown[0]], label, reached)]
    return [Level(of_run, run.label(label), reached) for run, of_run in values.items()]
