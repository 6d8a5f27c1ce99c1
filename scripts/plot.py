"""A run as a picture. Use: python scripts/plot.py RUN SVG, where RUN is a folder of `headway run`.

Three panels over the first seconds of the task: position and reference, error, torque and limits.
The same record gives the same file, byte for byte.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from headway.controller.record.reader import read_run
from headway.controller.reference import ENTRY_S
from headway.devices.axis import AxisUnits

Array = NDArray[np.float64]

BUCKETS = 250  # or a few more, across the picture; noise is drawn as the range in each
COLOURS = ("#1f5fa8", "#d97a0f", "#3a8f4d", "#a03a8f", "#7a5230", "#5a6b78")
STYLE = {
    "svg.hashsalt": "headway",  # identifiers inside the file, else random
    "svg.fonttype": "path",  # looks the same everywhere
    "path.simplify": False,
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
}


def buckets(values: Array) -> Array:
    """Rows (m, n) cut into pieces of equal size: (pieces, size, n); the rest is dropped."""
    size = max(1, len(values) // BUCKETS)
    return values[: len(values) // size * size].reshape(-1, size, values.shape[1])


def draw_position(panel: Axes, time_s: Array, truth: Array, reference: Array) -> None:
    for i, name in enumerate(NAMES):
        panel.plot(time_s, truth[:, i], color=COLOURS[i], linewidth=2.2, label=name)
    panel.plot(time_s, reference, color="black", linewidth=0.7, linestyle=(0, (4, 3)))
    panel.plot([], [], color="black", linewidth=0.7, linestyle=(0, (4, 3)), label="reference")
    panel.set_ylabel("position [rad]")


def draw_error(panel: Axes, time_s: Array, error: Array, rms: Array) -> None:
    low, high = buckets(error).min(axis=1), buckets(error).max(axis=1)
    for i, name in enumerate(NAMES):
        label = f"{name}: rms {rms[i]:.2f} mrad"
        panel.fill_between(
            time_s, low[:, i], high[:, i], color=COLOURS[i], alpha=0.75, linewidth=0.6, label=label
        )
    judged = time_s > ENTRY_S
    most = 1.15 * max(-low[judged].min(), high[judged].max())
    panel.set_ylim(-most, most)
    panel.axvspan(0, ENTRY_S, color="#eeeeee", zorder=0.5)
    panel.text(ENTRY_S / 2, -0.9 * most, "entry", ha="center", color="#777777")
    panel.set_ylabel("error [mrad]")


def draw_torque(panel: Axes, time_s: Array, torque: Array, limits: list[float]) -> None:
    low, high = buckets(torque).min(axis=1), buckets(torque).max(axis=1)
    for i, name in enumerate(NAMES):
        panel.fill_between(
            time_s, low[:, i], high[:, i], color=COLOURS[i], alpha=0.75, linewidth=0.6, label=name
        )
        for sign in (-1, 1):
            panel.axhline(sign * limits[i], color=COLOURS[i], linewidth=1, linestyle=(0, (6, 3)))
    panel.plot([], [], color="#555555", linewidth=1, linestyle=(0, (6, 3)), label="limits")
    panel.set_ylabel("torque [Nm]")
    panel.set_xlabel("time of the task [s]")


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("run", type=Path, help="folder of a run, or its run.mcap")
parser.add_argument("svg", type=Path, help="the file to write")
parser.add_argument("--seconds", type=float, default=5.0, help="of the task to show")
options = parser.parse_args()

run = read_run(options.run)
config, record = run.config(), run.arrays
NAMES = [axis.joint for axis in config.machine.axes]
tq_per_effort = [AxisUnits.of(axis, config.loop).tq_per_effort for axis in config.machine.axes]

time_s = record["truth_s"]
error = 1e3 * (record["truth_position"] - record["truth_reference"])
judged = (time_s >= ENTRY_S) & (time_s <= record["tick_s"][-1])  # as the run's summary has it
rms = np.sqrt(np.mean(error[judged] ** 2, axis=0))
shown = (time_s >= 0) & (time_s <= options.seconds)
middle_s = buckets(time_s[shown][:, None]).mean(axis=(1, 2))

matplotlib.rcParams.update(STYLE)
figure = Figure(figsize=(8.6, 6.6), facecolor="white", layout="constrained")
panels = figure.subplots(3, 1, sharex=True)
draw_position(
    panels[0],
    middle_s,
    buckets(record["truth_position"][shown]).mean(axis=1),
    buckets(record["truth_reference"][shown]).mean(axis=1),
)
draw_error(panels[1], middle_s, error[shown], rms)
torque = record["servo_torque_tq"][shown] / tq_per_effort
draw_torque(panels[2], middle_s, torque, [axis.effort_limit for axis in config.machine.axes])
for panel in panels:
    panel.set_xlim(0, options.seconds)
    panel.legend(loc="lower right", bbox_to_anchor=(1, 0.98), ncols=3, frameon=False)
options.svg.parent.mkdir(parents=True, exist_ok=True)
figure.savefig(options.svg, metadata={"Date": None, "Creator": "scripts/plot.py"})
