"""A default task for a machine that nobody has seen: sines that are gentle by its own dynamics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from headway.cli.rules.subject import Array, Subject

# Shares of the limits that the task stays below.
RANGE_SHARE, SPEED_SHARE, ACCELERATION_SHARE, EFFORT_SHARE = 0.15, 0.25, 0.25, 0.5
AMPLITUDE_MAX = {"rad": 0.4, "m": 0.1}
FREQUENCY_MAX_HZ, FREQUENCY_MIN_HZ = 0.5, 0.05
CENTRES = 64  # tried where the middle of the range will not do
PHASES = 64  # of the period, at which it is judged


@dataclass(frozen=True)
class Gentle:
    """Sines of one frequency: by axis, rad or m."""

    frequency_Hz: float
    centre: Array
    amplitude: Array
    phase_rad: Array


def gentle_task(subject: Subject) -> Gentle | None:
    """The first that holds: around the middle of the range if possible, as large as may be, without
    two bodies that touch. None if there is no pose to hold with half of the efforts."""
    n = len(subject.axes)
    span = np.diff([axis.poses for axis in subject.axes])[:, 0]
    most = np.array([AMPLITUDE_MAX[axis.unit] for axis in subject.axes])
    speed = np.array([axis.velocity_limit for axis in subject.axes])
    phase = np.round(2 * np.pi * np.arange(n) / n, 3)  # not all axes turn back at once
    for centre in _centres(subject):
        for scale in (1.0, 0.5, 0.25):
            amplitude = scale * np.minimum(RANGE_SHARE * span, most)
            frequency = min(FREQUENCY_MAX_HZ, SPEED_SHARE * (speed / amplitude).min() / 2 / np.pi)
            while frequency >= FREQUENCY_MIN_HZ:
                found = Gentle(_two(frequency), _four(centre), _four(amplitude), phase)
                if _holds(subject, found):
                    return found
                frequency /= 1.4
    return None


def _centres(subject: Subject) -> Iterator[Array]:
    """The middle of the range, then others around it by how little they load the drives."""
    low, high = np.array([axis.poses for axis in subject.axes]).T
    yield (low + high) / 2
    shares = qmc.Sobol(len(low), rng=np.random.default_rng(0)).random(CENTRES)
    centres = low + (0.25 + 0.5 * shares) * (high - low)
    still = np.zeros_like(centres)
    load = np.abs(subject.effort(centres, still, still)) / subject.effort_limit
    yield from centres[np.argsort(load.max(axis=1))]


def _holds(subject: Subject, task: Gentle) -> bool:
    rate = 2 * np.pi * task.frequency_Hz
    angle = 2 * np.pi * np.arange(PHASES)[:, None] / PHASES + task.phase_rad
    q = task.centre + task.amplitude * np.sin(angle)
    v, a = rate * task.amplitude * np.cos(angle), -(rate**2) * task.amplitude * np.sin(angle)
    effort = np.abs(subject.effort(q, v, a))
    acceleration = np.array([axis.acceleration_limit for axis in subject.driven.values()])
    if np.any(effort > EFFORT_SHARE * subject.effort_limit):
        return False
    return bool(np.all(np.abs(a) <= ACCELERATION_SHARE * acceleration)) and not subject.touching(q)


def _two(number: float) -> float:
    return float(f"{number:.2g}")


def _four(numbers: Array) -> Array:
    return np.array([float(f"{number:.4g}") for number in numbers])
