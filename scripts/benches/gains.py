"""arm2: bandwidth over the workspace with fixed and scheduled gains; tracking with both.

The bandwidth is measured: around a posture, one joint's position track swings by a millirad in many
sines at once while the others' stand still; MuJoCo and the firmware are the plant, and the torque
track only holds the posture. As all of the servo acts on the following error e, the loop's gain is
q / e. Its crossover is what is called bandwidth: it says how fast the servo rejects what nobody
foresaw and what margin is left for delays. The -3 dB frequency of q over the setpoint r beside it
moves more: where the gains are low the other joint's loop bends that curve near 3 dB.
"""

from __future__ import annotations

import itertools
import sys
from concurrent.futures import Executor, ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from _report import arguments, finish, goal, table
from numpy.typing import NDArray

from headway.cli.simulation import Simulation
from headway.configs.load import load_config
from headway.configs.schema import Task
from headway.controller import gains as gain_tracks
from headway.controller import loop
from headway.controller.feedforward import Feedforward
from headway.controller.gains import Schedule
from headway.controller.motion import Motion
from headway.controller.record.columns import Arrays
from headway.controller.reference import Reference
from headway.sim import world

Array = NDArray[np.float64]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
MODES = ("off", "fixed", "scheduled")
ALONE = "scheduled by M_jj alone"
WINDOW_MS = 2048  # of truth at 1 kHz: whole periods of each sine
SETTLE_S = 1.2  # before it, with the entry
PERIODS = np.unique(np.rint(np.geomspace(3, 95, 28) * WINDOW_MS * 1e-3))  # in the window
RATES = 2 * np.pi * PERIODS / (WINDOW_MS * 1e-3)  # [rad/s]
SPEED = 0.04  # [rad/s] of each sine
QUIET = "{delay_us: 0, jitter_us: 0, loss: 0}"
EXPERIMENT = [
    *("mpc.enabled=false", "sim.compute_us=0", "task.frequency_Hz=1"),
    *(f"sim.to_device={QUIET}", f"sim.to_host={QUIET}"),
    *("sync.to_device_least_us=0", "sync.to_host_least_us=0"),
    f"duration_s={SETTLE_S + WINDOW_MS * 1e-3 + 0.1}",
]
PLANTS = {  # how the plant differs from its model; by dry friction a joint sticks at a milliradian
    "model": "sim.plant={}",
    "shipped, no friction": "sim.plant.coulomb_Nm_or_N=[0, 0]",
}


class Swing(Reference):
    """A posture, and small sines on one joint: the task's axis with an amplitude."""

    def __init__(self, task: Task) -> None:
        self._posture = np.array([axis.offset for axis in task.axes])
        self._joint = np.array([float(axis.amplitude > 0) for axis in task.axes])
        # Phases that keep the sum small: Schroeder, IEEE Trans. Inf. Theory 16, 1970.
        k = np.arange(len(RATES))
        self._phase = -np.pi * k**2 / len(RATES)

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        angle = np.outer(time_s, RATES) + self._phase
        parts = (
            (np.sin(angle) / RATES).sum(axis=1),
            np.cos(angle).sum(axis=1),
            (-np.sin(angle) * RATES).sum(axis=1),
        )
        q, v, a = (SPEED * np.outer(part, self._joint) for part in parts)
        return self._posture + q, v, a


class Held(Feedforward):
    """Streams the reference; the torque holds the posture and nothing more."""

    def plan(self, reference: Reference, time_s: Array) -> Motion:
        motion = super().plan(reference, time_s)
        middle = np.rint(motion.position.mean(axis=0) * 1e2) / 1e2
        torque = self._prediction.holding(middle, np.zeros_like(middle))
        return Motion.of(motion.position, motion.velocity, np.tile(torque, (len(time_s), 1)))


class Alone(Schedule):
    """Takes the other joints for locked."""

    def _inertia(self, mass: Array, share: Array, at: int) -> Array:
        own: Array = mass[:, self._order[at], self._order[at]]
        return own


Experiment = tuple[str, str, tuple[float, float], int]  # gains, plant, posture, joint


def bandwidth(experiment: Experiment) -> dict[str, float]:
    """Crossover, -3 dB frequency [rad/s] and phase margin [deg] of one joint at one posture."""
    gains, plant, posture, joint = experiment
    overrides = [f"loop.gains={gains.partition(' ')[0]}", PLANTS[plant], *EXPERIMENT]
    for axis, position in enumerate(posture):
        overrides.append(f"task.axes.{axis}.offset_rad={position}")
        overrides.append(f"task.axes.{axis}.amplitude_rad={1 if axis == joint else 0}")
    overrides.append(f"sim.start_rad_or_m=[{posture[0]}, {posture[1]}]")
    # These take the places of what has those names.
    world.task_reference = lambda config, _: Swing(config.task)  # type: ignore[attr-defined]
    loop.Feedforward = Held  # type: ignore[attr-defined]
    gain_tracks.Schedule = Alone if gains == ALONE else Schedule  # type: ignore[misc]
    simulation = Simulation(load_config(CONFIGS / "arm2.yaml", overrides), CONFIGS)
    simulation.run()
    record = simulation.record.arrays()
    assert record["tick_accepted"].all() and record["end_plans_refused"][0] == 0
    return response(record, joint)


def response(record: Arrays, joint: int) -> dict[str, float]:
    """From the last window of the task."""
    first = np.searchsorted(record["truth_s"], SETTLE_S)
    window = slice(first, first + WINDOW_MS)
    pitch = 2 * np.pi / 40_000
    q = np.fft.rfft(record["truth_position"][window, joint])
    r = np.fft.rfft(record["servo_setpoint_pq"][window, joint] / 1024 * pitch)
    tones = PERIODS.astype(int)
    q, r = q[tones], r[tones]
    gain = q / (r - q)
    crossover = falls_to(np.abs(gain), 1.0)
    phase = np.interp(np.log(crossover), np.log(RATES), np.unwrap(np.angle(gain)))
    return {
        "crossover": crossover,
        "bandwidth": falls_to(np.abs(q / r), 0.5**0.5),
        "margin": 180 + float(np.degrees(phase)),
    }


def falls_to(size: Array, level: float) -> float:
    """The highest frequency at which a response has this size, on logarithmic axes; the first or
    the last measured one where it lies beyond."""
    above = np.flatnonzero(size > level)
    if not len(above) or above[-1] == len(size) - 1:
        return float(RATES[above[-1] if len(above) else 0])
    i = above[-1]
    x, y = np.log(RATES[i : i + 2]), np.log(size[i : i + 2] / level)
    return float(np.exp(x[0] - y[0] * (x[1] - x[0]) / (y[1] - y[0])))


def spread(values: list[float]) -> float:
    """Half of the range over its middle, in percent."""
    return 100 * (max(values) - min(values)) / (max(values) + min(values))


def over_the_workspace(pool: Executor, plant: str, long: bool) -> list[dict[str, Any]]:
    """For each joint, with fixed and with scheduled gains."""
    first, second = ((-1.0, 0.8), 7) if long else ((0.8,), 5)
    postures = list(itertools.product(first, np.linspace(-2.4, 2.4, second).round(3).tolist()))
    rows = []
    for joint, gains in itertools.product((0, 1), ("fixed", ALONE, "scheduled")):
        print(f"bandwidth of q{joint + 1}, {plant}, {gains} ...", file=sys.stderr)
        experiments = [(gains, plant, posture, joint) for posture in postures]
        results = list(pool.map(bandwidth, experiments))
        row: dict[str, Any] = {"joint": f"q{joint + 1}", "plant": plant, "gains": gains}
        for name, key in (("crossover", "crossover"), ("-3 dB", "bandwidth")):
            values = [result[key] for result in results]
            row |= {f"{name} min": min(values), f"{name} max": max(values)}
            row[f"{name} +-%"] = spread(values)
        margins = [result["margin"] for result in results]
        rows.append(row | {"margin min": min(margins), "margin max": max(margins)})
    return rows


def tracking(job: tuple[str, int, float]) -> Array:
    """RMS error [mrad] and torque noise [Nm] of both joints: (4,)."""
    gains, seed, duration_s = job
    overrides = [f"loop.gains={gains}", f"seed={seed}", f"duration_s={duration_s}"]
    summary = Simulation(load_config(CONFIGS / "arm2.yaml", overrides), CONFIGS).run()
    return np.array([*summary["tracking"]["rms"], *summary["torque"]["noise_rms"]])


def main() -> None:
    options = arguments((__doc__ or "").splitlines()[0])
    seeds, duration_s = (10, 4.0) if options.long else (3, 4.0)
    plants = list(PLANTS) if options.long else ["model"]
    rows: list[dict[str, Any]] = []
    tracked: list[dict[str, Any]] = []
    with ProcessPoolExecutor(2) as pool:
        for plant in plants:
            rows += over_the_workspace(pool, plant, options.long and plant == "model")
    with ProcessPoolExecutor(2) as pool:  # new processes: these run the shipped loop
        for gains in MODES:
            print(f"tracking, {gains} ...", file=sys.stderr)
            jobs = [(gains, seed, duration_s) for seed in range(seeds)]
            median = np.median(list(pool.map(tracking, jobs)), axis=0)
            keys = ("rms q1 mrad", "rms q2 mrad", "noise q1 Nm", "noise q2 Nm")
            tracked.append({"gains": gains, **dict(zip(keys, median.tolist(), strict=True))})
    table("closed loop over the workspace, rad/s and degrees", rows)
    table(f"tracking as shipped, medians over {seeds} seeds of {duration_s:g} s", tracked)
    goals = [
        goal(f"crossover of {row['joint']}, scheduled, +- %", row["crossover +-%"], "<=", 10)
        for row in rows
        if (row["plant"], row["gains"]) == ("model", "scheduled")
    ]
    finish([*rows, *tracked], goals, options.json)


if __name__ == "__main__":
    main()
