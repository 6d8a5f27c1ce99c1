"""The sections with a value for each tick: what it cost to compute, what the solver did."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from headway.cli.page.plot import Array, Curve, Plot
from headway.cli.page.section import Rows, Section, Trace, levels, side_by_side
from headway.cli.page.shown import Shown

# Fields of the channel `timing`, in the order in which they happen.
STEPS = {
    "estimate": "estimate",
    "prepare": "prepare",
    "solve": "solve",
    "encode": "encode",
    "compute": "whole tick",
}
PERCENTS = {"median": 50, "p99": 99, "p99.9": 99.9, "max": 100}
BINS = 80
USUAL = 99.9  # percent of the ticks that the histogram shows in full width
STAGES = {0: "solved", 1: "stopped at the cap"}
STATUSES = {  # by backend
    "osqp": {1: "solved", 2: "solved inaccurately", 7: "stopped at the cap"},
    "hpipm": STAGES,
    "riccati": STAGES,
}


def compute(shown: Sequence[Shown]) -> Section:
    """Computing times by the wall clock, against the knot."""
    section = Section(
        "compute",
        "Computing time",
        [
            "By the wall clock of the computer that ran it; nothing in the run depends on it. In "
            "simulation a tick counts as what the config says."
        ],
        table=_percentiles(shown),
    )

    def knot_ms(run: Shown) -> float:
        return run.config.loop.knot_us * 1e-3

    lines = [
        *levels(shown, "knot", knot_ms),
        *levels(shown, "counted as", lambda run: run.config.sim.compute_us * 1e-3),
    ]
    over_time = Plot("Over time", "time [ms]", levels=lines)
    section.plots += side_by_side(shown, over_time, _steps)
    histogram = Plot("Whole tick", "ticks", x="time [ms]", log=True, upright=True, levels=lines)
    edges = _edges(shown, max(knot_ms(run) for run in shown))
    for run in shown:
        whole = np.minimum(run.arrays["timing_compute_us"] * 1e-3, edges[-1])
        counts = np.histogram(whole, edges)[0]
        curve = Curve(run.label("ticks"), counts, run.colour, "bars")
        histogram.add((edges[:-1] + edges[1:]) / 2, [curve], BINS)
    histogram.figures.append("the last bar has all that took longer")
    section.plots.append(histogram)
    return section


def _steps(run: Shown) -> list[Trace]:
    times_ms = {name: run.arrays[f"timing_{key}_us"] * 1e-3 for key, name in STEPS.items()}
    return [
        Trace(name, run.arrays["timing_s"], time_ms) for name, time_ms in reversed(times_ms.items())
    ]


def _edges(shown: Sequence[Shown], knot_ms: float) -> Array:
    """Of the histogram's bins, the same for all runs [ms]."""
    usual = max(np.percentile(run.arrays["timing_compute_us"], USUAL) for run in shown) * 1e-3
    return np.linspace(0, 1.1 * max(usual, knot_ms), BINS + 1)


def _percentiles(shown: Sequence[Shown]) -> Rows:
    rows = []
    for key, name in STEPS.items():
        for run in shown:
            times_ms = run.arrays[f"timing_{key}_us"] * 1e-3
            known = times_ms[np.isfinite(times_ms)]
            cells = [f"{np.percentile(known, p):.3g}" for p in PERCENTS.values() if len(known)]
            head = [run.name] if run.name else []
            rows.append([*head, name, *(cells or ["-"] * len(PERCENTS))])
    names = ["run", "[ms]"] if shown[0].name else ["[ms]"]
    return Rows([*names, *PERCENTS], rows, numbers=len(PERCENTS))


def solver(shown: Sequence[Shown]) -> Section:
    """Iterations and residual of each tick, and the plans that were not used."""
    section = Section("solver", "Solver", [run.label(_told(run)) for run in shown])
    iterations = Plot("Iterations", "iterations of the solver")
    residual = Plot(
        "Residual",
        "residual / allowed",
        log=True,
        levels=levels(shown, "allowed", lambda run: 1.0),
    )
    for run in shown:
        arrays = run.arrays
        time_s = arrays["solver_s"]
        curve = Curve(run.label("iterations"), arrays["solver_iterations"], run.colour)
        iterations.add(time_s, [curve], run.points)
        rejected_s = arrays["tick_s"][~arrays["tick_accepted"]]
        place = np.interp(rejected_s, time_s, arrays["solver_iterations"]) if len(time_s) else 0.0
        dots = np.broadcast_to(place, rejected_s.shape)
        curve = Curve(run.label("plan rejected"), dots, "bad", "dots")
        iterations.add(rejected_s, [curve], run.points)
        known = np.where(arrays["solver_residual"] > 0, arrays["solver_residual"], np.nan)
        curve = Curve(run.label("residual"), known, run.colour)
        residual.add(time_s, [curve], run.points)
    section.plots += [iterations, residual]
    return section


def _told(run: Shown) -> str:
    """What became of the ticks, in a sentence."""
    ticks, accepted = len(run.arrays["tick_s"]), int(np.sum(run.arrays["tick_accepted"]))
    told = f"{ticks} ticks, {ticks - accepted} plans rejected"
    if part_way := np.count_nonzero(run.arrays["refused_share"]):
        told += f", of {part_way} that the gate refused a part of the way was sent"
    statuses, counts = np.unique(run.arrays["solver_status"], return_counts=True)
    if not len(statuses):
        return f"{told}. MPC was off: the reference itself was sent."
    words = STATUSES[run.config.mpc.backend]
    solved = (
        f"{count} {words.get(int(status), f'ended with status {status}')}"
        for status, count in zip(statuses, counts, strict=True)
    )
    return f"{told}. The solver: {', '.join(solved)}."
