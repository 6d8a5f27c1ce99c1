"""The sections with a plot for each axis: how well it followed, and what it took."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from headway.cli.page.plot import Array, Curve, Level, Plot
from headway.cli.page.section import Section, levels
from headway.cli.page.shown import Shown
from headway.devices.axis import AxisUnits, whole_turns

SIGMAS = 2.0
INSIDE = 0.954  # of a normal distribution, within that


def tracking(shown: Sequence[Shown]) -> Section:
    """True position minus reference, and what the controller took it to be."""
    section = Section(
        "tracking",
        "Tracking",
        [
            "True position minus reference. The band is where the controller saw it: its estimate "
            "at each tick, two standard deviations to either side.",
            "Figures are from the end of the entry to the end of the task.",
        ],
    )
    for i, axis in enumerate(shown[0].config.machine.axes):
        plot = Plot(axis.joint, f"error [m{axis.unit}]", judged=True)
        for run in shown:
            truth_s, now_s = run.arrays["truth_s"], run.arrays["now_s"]
            reference = run.arrays["truth_reference"][:, i]
            seen = run.arrays["now_estimate"][:, i] - np.interp(now_s, truth_s, reference)
            seen -= whole_turns([axis], seen[:, None])[:, 0]
            task = truth_s <= run.end_s
            time_s = truth_s[task]
            way = (run.arrays["truth_position"][:, i] - reference)[task]
            error = 1e3 * (way - whole_turns([axis], way[:, None])[:, 0])
            band = 1e3 * (seen[:, None] + _band(run, i))
            name = run.label(f"estimated, ± {SIGMAS:g} sigma")
            plot.add(now_s, [Curve(name, band, run.colour, "band")], run.points)
            plot.add(time_s, [Curve(run.label("true"), error, run.colour)], run.points)
            judged = error[(time_s >= run.span_s[0]) & (time_s <= run.span_s[1])]
            if len(judged):
                rms, most = np.sqrt(np.mean(judged**2)), np.abs(judged).max()
                plot.figures.append(run.label(f"rms {rms:.3g}, max {most:.3g} m{axis.unit}"))
        section.plots.append(plot)
    return section


def estimate(shown: Sequence[Shown]) -> Section:
    """What the estimator was wrong by, against what it thought possible."""
    section = Section(
        "estimate",
        "Estimate",
        [
            "Estimated minus true position at each tick's now, and the band that the filter gives "
            f"itself. An honest filter has {100 * INSIDE:.0f} % of the errors inside."
        ],
    )
    for i, axis in enumerate(shown[0].config.machine.axes):
        plot = Plot(axis.joint, f"error [m{axis.unit}]", judged=True)
        for run in shown:
            truth_s, now_s = run.arrays["truth_s"], run.arrays["now_s"]
            known = (now_s >= truth_s[0]) & (now_s <= truth_s[-1])
            time_s, band = now_s[known], _band(run, i)[known]
            error = run.arrays["now_estimate"][known, i] - _truth(run, i, time_s)
            error -= whole_turns([axis], error[:, None])[:, 0]
            curves = [
                Curve(run.label(f"± {SIGMAS:g} sigma"), 1e3 * band, run.colour, "band"),
                Curve(run.label("estimated - true"), 1e3 * error, run.colour),
            ]
            plot.add(time_s, curves, run.points)
            judged = (time_s >= run.span_s[0]) & (time_s <= run.span_s[1])
            if judged.any():
                inside = np.mean(np.abs(error[judged]) <= band[judged, 1])
                plot.figures.append(run.label(f"{100 * inside:.0f} % inside"))
        section.plots.append(plot)
    return section


def _truth(run: Shown, axis: int, time_s: Array) -> Array:
    """True position between the recorded milliseconds [rad or m]."""
    knots_s, position, velocity = (
        run.arrays[f"truth_{name}"] for name in ("s", "position", "velocity")
    )
    value: Array = CubicHermiteSpline(knots_s, position[:, axis], velocity[:, axis])(time_s)
    return value


def _band(run: Shown, axis: int) -> Array:
    """Minus and plus the estimated position's deviations, (ticks, 2) [rad or m]."""
    size = run.arrays["now_estimate"].shape[1]
    variance = run.arrays["now_covariance"][:, axis * (size + 1)]
    deviation: Array = SIGMAS * np.sqrt(np.maximum(variance, 0))[:, None]
    return deviation * [-1, 1]


def position(shown: Sequence[Shown]) -> Section:
    """Where the machine was and where it should have been."""
    section = Section(
        "position", "Position", ["True position, and the reference up to the task's end."]
    )
    shared = all(run.config.task == shown[0].config.task for run in shown)
    for i, axis in enumerate(shown[0].config.machine.axes):
        bounds = ((axis.lowest, "least"), (axis.highest, "greatest"))
        ends = [Level(value, name, reached=False) for value, name in bounds if np.isfinite(value)]
        plot = Plot(axis.joint, f"position [{axis.unit}]", levels=ends)
        for run in shown:
            time_s = run.arrays["truth_s"]
            true = Curve(run.label("true"), run.arrays["truth_position"][:, i], run.colour)
            plot.add(time_s, [true], run.points)
            if run is shown[0] or not shared:
                task = time_s <= run.end_s
                reference = run.arrays["truth_reference"][task, i]
                name = "reference" if shared else run.label("reference")
                curve = Curve(name, reference, "reference", "dashed")
                plot.add(time_s[task], [curve], run.points)
        section.plots.append(plot)
    return section


def effort(shown: Sequence[Shown]) -> Section:
    """What the motors were asked for, against what they may give."""
    axes = shown[0].config.machine.driven
    words = dict.fromkeys("torque" if axis.unit == "rad" else "force" for axis in axes.values())
    word = " and ".join(words)
    section = Section(
        "torque",
        word.capitalize(),
        [
            f"What each device asked of its motor, every millisecond. Dots: the {word} that it "
            "would have asked for without the limit.",
        ],
    )
    for i, axis in axes.items():
        unit = axis.effort_unit
        plot = Plot(axis.joint, f"{'torque' if axis.unit == 'rad' else 'force'} [{unit}]")
        plot.levels += _limits(shown, i)
        for run in shown:
            tq = AxisUnits.of(run.config.machine.axes[i], run.config.loop).tq_per_effort
            asked = run.arrays["servo_unclipped_tq"][:, i] / tq
            applied = run.arrays["servo_torque_tq"][:, i] / tq
            clipped = asked != applied
            curves = [
                Curve(run.label("applied"), applied, run.colour),
                Curve(run.label("unclipped"), np.where(clipped, asked, np.nan), "bad", "dots"),
            ]
            plot.add(run.arrays["servo_s"], curves, run.points)
            most, share = np.abs(applied).max(), 100 * np.mean(clipped)
            plot.figures.append(run.label(f"max {most:.3g} {unit}, {share:.2g} % clipped"))
        section.plots.append(plot)
    return section


def _limits(shown: Sequence[Shown], axis: int) -> list[Level]:
    def limit(run: Shown) -> float:
        return run.config.machine.axes[axis].effort_limit

    return [*levels(shown, "limit", limit), *levels(shown, "", lambda run: -limit(run))]
