"""What a run comes to, in numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from headway.cli.truth import has_truth, told_positions
from headway.cli.versions import versions
from headway.configs.schema import Config
from headway.controller.loop import Loop
from headway.controller.record.recorder import Recorder
from headway.controller.reference import ENTRY_S, Reference
from headway.devices import core
from headway.devices.axis import AxisUnits, whole_turns

Array = NDArray[np.float64]
Arrays = dict[str, Array]

TRACKS = "position", "torque", "Kp", "Ki", "Kd"
REST_WINDOW_S = 0.05  # at the very end
# Mean speed over the window [rad/s, m/s]: a held axis trembles by an encoder count.
REST_SPEED = {"rad": 5e-3, "m": 1e-3}
REST_MOVE = {"rad": 1e-3, "m": 2e-4}  # within the window [rad, m]


class Driver(Protocol):
    """What has run the loop: in virtual time, or on the wall clock."""

    config: Config
    loop: Loop
    record: Recorder
    ticks: int  # of the task
    deadline_misses: int  # ticks skipped, or too late for their plan
    stopping: bool

    def run(self, progress: Callable[[float], None] | None = None) -> None:
        """See Lockstep.run and Live.run."""

    def frames(self, arrays: Arrays) -> dict[str, int | None]:
        """Sent while the task ran, lost (None: nobody knows), late_points and gate_refused."""

    def device_states(self) -> list[str]:
        """By name, at the end."""


def summarize(config: Config, driver: Driver, arrays: Arrays) -> dict[str, Any]:
    """The summary of a run with at least one tick, ready for JSON.

    What cannot be known (of a solver that is off, of a run too short, of a machine that nobody
    sees from outside) is None. Lists by axis are
    in the config's order; lists by state are [q..., v...] in rad and rad/s, on linear axes in m and
    m/s. "torque" is force there, in N.
    """
    return {
        "config": config.name,
        "seed": config.seed,
        "duration_s": config.duration_s,
        "rate_hz": 1e6 / config.loop.knot_us,
        "margin_us": config.loop.margin_us,
        "axes": [axis.joint for axis in config.machine.axes],
        "tracking": _tracking(config, driver.loop.task, arrays),
        "estimate": _estimate(driver, arrays),
        "torque": _torque(config, arrays),
        "compute_us": _percentiles(arrays["timing_compute_us"], p50=50, p99=99, p999=99.9, max=100),
        "compute_split_us": {
            step: _percentiles(arrays[f"timing_{step}_us"], p50=50, p99=99)
            for step in ("estimate", "prepare", "solve", "encode")
        },
        "solver": _solver(driver, arrays),
        "frames": driver.frames(arrays),
        "deadline_misses": driver.deadline_misses,
        "at_rest_after_end": _at_rest(driver, arrays),
        "limits_violated": _violations(config, arrays),
        "log_sha256": driver.record.sha256(),
        "versions": versions(),
    }


def _number(value: float) -> float | None:
    """JSON has no NaN and no infinity."""
    return float(value) if np.isfinite(value) else None


def _numbers(values: Array) -> list[float | None]:
    return [_number(value) for value in values]


def _rms(rows: Array) -> list[float | None]:
    """Root mean square of each column; None of no rows."""
    if not len(rows):
        return [None] * rows.shape[1]
    return _numbers(np.sqrt(np.mean(rows**2, axis=0)))


def _max(rows: Array) -> list[float | None]:
    """Largest magnitude in each column; None of no rows."""
    if not len(rows):
        return [None] * rows.shape[1]
    return _numbers(np.max(np.abs(rows), axis=0))


def _percentiles(values: Array, **percents: float) -> dict[str, float | None]:
    known = values[np.isfinite(values)]
    if not len(known):
        return dict.fromkeys(percents)
    return {name: _number(np.percentile(known, percent)) for name, percent in percents.items()}


def judged(time_s: Array, arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Which of these times lie in the task, after the entry and before the coasting to rest."""
    end_s = float(arrays["tick_s"][-1])
    return np.logical_and(time_s >= ENTRY_S, time_s <= end_s)


def _tracking(config: Config, task: Reference, arrays: Arrays) -> dict[str, Any]:
    """The plant's true position against the task's reference, without whole turns between them
    where an axis is continuous; where nobody knows the truth, what the encoders told."""
    units = [f"m{axis.unit}" for axis in config.machine.axes]
    if not has_truth(arrays):
        return _followed(config, task, arrays) | {"unit": units, "by": "encoders"}
    in_task = judged(arrays["truth_s"], arrays)
    way = (arrays["truth_position"] - arrays["truth_reference"])[in_task]
    error = 1e3 * (way - whole_turns(config.machine.axes, way))
    return {"rms": _rms(error), "max": _max(error), "unit": units, "by": "truth"}


def _followed(config: Config, task: Reference, arrays: Arrays) -> dict[str, Any]:
    errors = [np.empty((0, 1))] * len(config.machine.axes)  # nobody sees one without an encoder
    for i, (time_s, position) in enumerate(told_positions(config, arrays)):
        way = (position - task.at(time_s)[0][:, i])[judged(time_s, arrays)]
        axis = config.machine.axes[i : i + 1]
        errors[i] = 1e3 * (way[:, None] - whole_turns(axis, way[:, None]))
    return {"rms": [_rms(e)[0] for e in errors], "max": [_max(e)[0] for e in errors]}


def _estimate(driver: Driver, arrays: Arrays) -> dict[str, Any]:
    """Estimated states against the truth, at now and at the commit knot.

    Between its milliseconds the truth is a cubic Hermite spline, on the arm right to 0.5 urad and
    3 mrad/s (rms: the servos' steps).
    """
    if not has_truth(arrays):
        unknown = [None] * (2 * len(driver.config.machine.axes))
        return {"rms_now": unknown, "rms_commit": unknown, "nis_mean": _nis(driver)}
    truth = CubicHermiteSpline(
        arrays["truth_s"], arrays["truth_position"], arrays["truth_velocity"]
    )
    axes = driver.config.machine.axes
    rate, n = truth.derivative(), len(axes)
    rms: dict[str, Any] = {}
    for which in ("now", "commit"):
        time_s = arrays[f"{which}_s"]
        true_state = np.hstack((truth(time_s), rate(time_s)))
        error = arrays[f"{which}_estimate"][:, : 2 * n] - true_state
        error[:, :n] -= whole_turns(axes, error[:, :n])
        ticks_s = arrays["now_s"][: len(error)]  # a writer that was killed may lack the last one's
        rms[f"rms_{which}"] = _rms(error[: len(ticks_s)][judged(ticks_s, arrays)])
    return {**rms, "nis_mean": _nis(driver)}


def _nis(driver: Driver) -> float | None:
    estimator = driver.loop.estimator
    return estimator.nis_sum / estimator.accepted if estimator.accepted else None


def _torque(config: Config, arrays: Arrays) -> dict[str, Any]:
    """Torque that the devices ask of their motors [Nm or N], at 1 kHz, before friction and brakes.

    noise_rms is the part that is faster than the motion: the rms of the second difference divided
    by sqrt(6), which for white noise is its standard deviation (1 + 4 + 1 = 6) while a motion of a
    few Hz leaves next to nothing. clipped_share is how often the limit cut the demand.
    """
    limits = {
        "limit": [axis.effort_limit for axis in config.machine.axes],
        "unit": [axis.effort_unit for axis in config.machine.axes],
    }
    if not has_truth(arrays):
        unknown = [None] * len(config.machine.axes)
        return (
            dict.fromkeys(("max_abs", "max_unclipped", "clipped_share", "noise_rms"), unknown)
            | limits
        )
    tq_per_effort = _tq_per_effort(config)
    applied = arrays["servo_torque_tq"] / tq_per_effort
    unclipped = arrays["servo_unclipped_tq"] / tq_per_effort
    in_task = applied[judged(arrays["servo_s"], arrays)]
    return {
        "max_abs": _max(applied),
        "max_unclipped": _max(unclipped),
        "clipped_share": _numbers(np.mean(applied != unclipped, axis=0)),
        "noise_rms": _rms(np.diff(in_task, n=2, axis=0) / np.sqrt(6)),
        **limits,
    }


def _tq_per_effort(config: Config) -> Array:
    return np.array([AxisUnits.of(axis, config.loop).tq_per_effort for axis in config.machine.axes])


def _refused(config: Config, arrays: Arrays) -> dict[str, int]:
    """How many plans the host's own gate refused, by axis, track and the check that failed."""
    axes, rows = config.machine.axes, ("axis", "sink", "result")
    refusals = zip(*(arrays[f"refused_{row}"].tolist() for row in rows), strict=True)
    counts = Counter(
        f"{axes[axis].joint}: {TRACKS[sink]}, {core.GATE_RESULTS[result]}"
        for axis, sink, result in refusals
    )
    return dict(counts.most_common())


def _solver(driver: Driver, arrays: Arrays) -> dict[str, Any]:
    """Plans by what became of them; without MPC the reference's plans are counted. Those that the
    gate refused count as accepted if a part of the way to them passed."""
    accepted = int(np.sum(arrays["tick_accepted"]))
    return {
        "ticks": driver.ticks,
        "accepted": accepted,
        "rejected": driver.ticks - accepted,
        "refused_by_gate": _refused(driver.config, arrays),
        "part_way": int(np.count_nonzero(arrays["refused_share"])),
        "iterations_p50": _percentiles(arrays["solver_iterations"], p50=50)["p50"],
    }


def _at_rest(driver: Driver, arrays: Arrays) -> bool:
    """Whether every motor's device holds and the plant, if anybody sees it, stands still at the
    end. What has no motor may swing, and sways the others: then what their devices say counts."""
    driven, states = driver.config.machine.driven, driver.device_states()
    holding = all(states[i] == "HOLD" for i in driven)
    if not has_truth(arrays) or len(driven) < len(driver.config.machine.axes):
        return holding
    time_s = arrays["truth_s"]
    window = time_s >= time_s[-1] - REST_WINDOW_S
    mean_velocity = np.mean(arrays["truth_velocity"][window], axis=0)
    moved = np.ptp(arrays["truth_position"][window], axis=0)
    axes = driver.config.machine.axes
    still = np.abs(mean_velocity) < [REST_SPEED[axis.unit] for axis in axes]
    there = moved < [REST_MOVE[axis.unit] for axis in axes]
    return bool(holding and np.all(still) and np.all(there))


def _violations(config: Config, arrays: Arrays) -> list[str]:
    """The limits that the plant or a device went beyond at any time, by axis, in words; where
    nobody knows the truth, by what the encoders told."""
    violations = []
    told = [] if has_truth(arrays) else told_positions(config, arrays)
    for axis, (_, position) in zip(config.machine.axes, told, strict=False):
        outside = position[(position < axis.lowest) | (position > axis.highest)]
        if len(outside):
            worst = max(outside.tolist(), key=abs)
            violations.append(
                f"{axis.joint}: position {worst:.6g} {axis.unit} outside of its range"
            )
    if told:
        return violations
    for i, (axis, tq_per_effort) in enumerate(
        zip(config.machine.axes, _tq_per_effort(config), strict=True)
    ):
        position, unit = arrays["truth_position"][:, i], axis.unit
        low, high = np.min(position), np.max(position)
        speed = np.max(np.abs(arrays["truth_velocity"][:, i]))
        torque_tq = np.max(np.abs(arrays["servo_torque_tq"][:, i]))
        beyond = []
        if low < axis.lowest:
            beyond.append(f"position {low:.6g} {unit} below {axis.lowest:g}")
        if high > axis.highest:
            beyond.append(f"position {high:.6g} {unit} above {axis.highest:g}")
        if speed > axis.velocity_limit:
            beyond.append(f"velocity {speed:.6g} {unit}/s above {axis.velocity_limit:g}")
        if torque_tq > round(axis.effort_limit * tq_per_effort):  # as the device has it
            what = "torque" if unit == "rad" else "force"
            beyond.append(
                f"{what} {torque_tq / tq_per_effort:.6g} {axis.effort_unit} above "
                f"{axis.effort_limit:g}"
            )
        violations += [f"{axis.joint}: {text}" for text in beyond]
    return violations
