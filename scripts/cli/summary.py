"""What a run comes to, in numbers."""

from __future__ import annotations

import importlib.metadata
import platform
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from headway.configs.schema import Config
from headway.devices.axis import AxisUnits
from headway.sim.lockstep import Lockstep

Array = NDArray[np.float64]
Arrays = dict[str, Array]

ENTRY_S = 0.5  # from rest onto the reference: not judged
REST_WINDOW_S = 0.05  # at the very end
REST_SPEED_RAD_PER_S = 5e-3  # mean over the window: a held axis trembles by an encoder count
REST_MOVE_RAD = 1e-3  # within the window
PACKAGES = ("headway", "mujoco", "casadi", "osqp", "numpy", "pin")


def summarize(config: Config, lockstep: Lockstep, arrays: Arrays) -> dict[str, Any]:
    """The summary of a run with at least one tick, ready for JSON.

    What cannot be known (of a solver that is off, of a run too short) is None. Lists by axis are
    in the config's order; lists by state are [q..., v...] in rad and rad/s.
    """
    return {
        "config": config.name,
        "seed": config.seed,
        "duration_s": config.duration_s,
        "rate_hz": 1e6 / config.loop.knot_us,
        "margin_us": config.loop.margin_us,
        "axes": [axis.joint for axis in config.machine.axes],
        "tracking": _tracking(arrays),
        "estimate": _estimate(lockstep, arrays),
        "torque": _torque(config, arrays),
        "compute_us": _percentiles(arrays["compute_us"], p50=50, p99=99, p999=99.9, max=100),
        "compute_split_us": {
            step: _percentiles(arrays[f"{step}_us"], p50=50, p99=99)
            for step in ("estimate", "linearize", "solve", "encode")
        },
        "solver": _solver(lockstep, arrays),
        "frames": _frames(lockstep),
        "deadline_misses": lockstep.deadline_misses,
        "at_rest_after_end": _at_rest(lockstep, arrays),
        "limits_violated": _violations(config, arrays),
        "log_sha256": lockstep.record.sha256(),
        "versions": {"python": platform.python_version()}
        | {name: importlib.metadata.version(name) for name in PACKAGES},
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


def _judged(time_s: Array, arrays: Arrays) -> NDArray[np.bool_]:
    """Which of these times lie in the task, after the entry and before the coasting to rest."""
    end_s = float(arrays["tick_s"][-1])
    return np.logical_and(time_s >= ENTRY_S, time_s <= end_s)


def _tracking(arrays: Arrays) -> dict[str, Any]:
    """The plant's true position against the task's reference."""
    judged = _judged(arrays["truth_s"], arrays)
    error = 1e3 * (arrays["truth_position"] - arrays["truth_reference"])[judged]
    return {"rms": _rms(error), "max": _max(error), "unit": ["mrad"] * error.shape[1]}


def _estimate(lockstep: Lockstep, arrays: Arrays) -> dict[str, Any]:
    """Estimated states against the truth, at now and at the commit knot.

    Between its milliseconds the truth is a cubic Hermite spline, on the arm right to 0.5 urad and
    3 mrad/s (rms: the servos' steps).
    """
    truth = CubicHermiteSpline(
        arrays["truth_s"], arrays["truth_position"], arrays["truth_velocity"]
    )
    rate, states = truth.derivative(), 2 * len(lockstep.config.machine.axes)
    rms: dict[str, Any] = {}
    for which in ("now", "commit"):
        time_s = arrays[f"{which}_s"]
        true_state = np.hstack((truth(time_s), rate(time_s)))
        error = arrays[f"{which}_estimate"][:, :states] - true_state
        rms[f"rms_{which}"] = _rms(error[_judged(arrays["now_s"], arrays)])
    estimator = lockstep.loop.estimator
    nis = estimator.nis_sum / estimator.accepted if estimator.accepted else None
    return {**rms, "nis_mean": nis}


def _torque(config: Config, arrays: Arrays) -> dict[str, Any]:
    """Torque that the devices ask of their motors [Nm], at 1 kHz, before friction and brakes.

    noise_rms is the part that is faster than the motion: the rms of the second difference divided
    by sqrt(6), which for white noise is its standard deviation (1 + 4 + 1 = 6) while a motion of a
    few Hz leaves next to nothing. clipped_share is how often the limit cut the demand.
    """
    tq_per_Nm = _tq_per_Nm(config)
    applied = arrays["servo_torque_tq"] / tq_per_Nm
    unclipped = arrays["servo_unclipped_tq"] / tq_per_Nm
    judged = applied[_judged(arrays["truth_s"], arrays)]
    return {
        "max_abs": _max(applied),
        "max_unclipped": _max(unclipped),
        "clipped_share": _numbers(np.mean(applied != unclipped, axis=0)),
        "limit": [axis.torque_limit_Nm for axis in config.machine.axes],
        "noise_rms": _rms(np.diff(judged, n=2, axis=0) / np.sqrt(6)),
    }


def _tq_per_Nm(config: Config) -> Array:
    return np.array([AxisUnits.of(axis, config.loop).tq_per_Nm for axis in config.machine.axes])


def _solver(lockstep: Lockstep, arrays: Arrays) -> dict[str, Any]:
    """Plans by what became of them; without MPC the reference's plans are counted."""
    accepted = int(np.sum(arrays["accepted"]))
    return {
        "ticks": lockstep.ticks,
        "accepted": accepted,
        "rejected": lockstep.ticks - accepted,
        "iterations_p50": _percentiles(arrays["iterations"], p50=50)["p50"],
    }


def _frames(lockstep: Lockstep) -> dict[str, int]:
    """Frames from the host to the devices while the task ran, and what the devices refused."""
    statuses = [node.status for node in lockstep.plant.nodes]
    return {
        "sent": sum(wire.sent for wire in lockstep.link.to_device),
        "lost": sum(wire.lost for wire in lockstep.link.to_device),
        "late_points": sum(status.plans_late for status in statuses),
        "gate_refused": sum(status.plans_refused for status in statuses),
    }


def _at_rest(lockstep: Lockstep, arrays: Arrays) -> bool:
    """Whether every device holds and the plant stands still at the record's end."""
    time_s = arrays["truth_s"]
    window = time_s >= time_s[-1] - REST_WINDOW_S
    mean_velocity = np.mean(arrays["truth_velocity"][window], axis=0)
    moved = np.ptp(arrays["truth_position"][window], axis=0)
    still = np.abs(mean_velocity) < REST_SPEED_RAD_PER_S
    holding = all(state == "HOLD" for state in lockstep.device_states())
    return bool(holding and np.all(still) and np.all(moved < REST_MOVE_RAD))


def _violations(config: Config, arrays: Arrays) -> list[str]:
    """The limits that the plant or a device went beyond at any time, by axis, in words."""
    violations = []
    for i, (axis, tq_per_Nm) in enumerate(
        zip(config.machine.axes, _tq_per_Nm(config), strict=True)
    ):
        position = arrays["truth_position"][:, i]
        speed = np.max(np.abs(arrays["truth_velocity"][:, i]))
        torque_tq = np.max(np.abs(arrays["servo_torque_tq"][:, i]))
        low, high = axis.position_min_rad, axis.position_max_rad
        if np.min(position) < low:
            violations.append(f"{axis.joint}: position {np.min(position):.6g} rad below {low:g}")
        if np.max(position) > high:
            violations.append(f"{axis.joint}: position {np.max(position):.6g} rad above {high:g}")
        if speed > axis.velocity_limit_rad_per_s:
            limit = axis.velocity_limit_rad_per_s
            violations.append(f"{axis.joint}: velocity {speed:.6g} rad/s above {limit:g}")
        if torque_tq > round(axis.torque_limit_Nm * tq_per_Nm):  # as the device has it
            limit = axis.torque_limit_Nm
            violations.append(
                f"{axis.joint}: torque {torque_tq / tq_per_Nm:.6g} Nm above {limit:g}"
            )
    return violations
