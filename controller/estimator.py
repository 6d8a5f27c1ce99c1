"""State estimation at the synchronized now from stamped, delayed, unordered encoder samples.

An extended Kalman filter over z = [q, v, d] (d: disturbance torque, a random walk) whose process is
the machine with its servo loops. Samples are kept in order of their stamps, with the filter's state
after each; one that comes late is put in its place and the later ones are replayed, so the estimate
does not depend on the order of arrival. Filter algebra: filterpy (Labbe); process noise: white
acceleration (Bar-Shalom, Li, Kirubarajan, Estimation with Applications, 2001, section 6.2).
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray

from headway.configs.schema import Estimator as EstimatorConfig
from headway.configs.section import by_axis
from headway.controller.equations import TRACK_ROWS
from headway.controller.prediction import Prediction

Array = NDArray[np.float64]

STEP_MAX_US = 5_000  # of the prediction: a stiff servo loop diverges in longer Runge-Kutta steps
HISTORY_US = 250_000  # samples older than this are forgotten
REJECTED_IN_A_ROW = 20  # then the filter is wrong, not the samples: its covariance is widened
START_SIGMA = (2e-3, 0.05)  # of q and v at a reset [rad or m, and per second]
START_WALK_S = 0.2  # of the disturbance's random walk: what is known of it at a reset


class Tracks(Protocol):
    """What the devices execute, as far as the host knows."""

    def at(self, times_us: NDArray[np.int64], near: Array) -> Array:
        """[r, r', f, Kp, Kd + c] at system times (m,), close together: (m, 5n) in rad, Nm and
        seconds. `near` (n,): where the axes are at the first of them, give or take some turns."""


@dataclass(frozen=True)
class Sample:
    """One encoder reading; ordered by stamp, then axis."""

    time_us: int
    axis: int
    position: float


@dataclass(frozen=True)
class Estimate:
    """State z = [q, v, d] and its covariance at one time."""

    time_us: int
    z: Array
    covariance: Array

    def state(self, n: int) -> Array:
        """x = [q, v]."""
        return self.z[: 2 * n]


@dataclass
class _Checkpoint:
    """A sample and the filter after it."""

    time_us: int
    axis: int
    position: float
    z: Array
    covariance: Array
    nis: float  # normalized innovation squared
    rejected: tuple[int, ...]  # outliers in a row, by axis


class _Filter(ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's filter with our process: the state is predicted by the compiled model."""

    def __init__(self, prediction: Prediction) -> None:
        self._n = n = prediction.n
        super().__init__(dim_x=3 * n, dim_z=1)
        self.x = np.zeros(
            3 * n
        )  # not (n, 1), which a 1-D measurement would silently grow to a matrix
        self.F = np.eye(3 * n)
        self._step = prediction.step
        self.tracks = np.zeros((3, TRACK_ROWS * n))
        self.dt_s = 0.0

    def predict_x(self, u: object = 0) -> None:
        n = self._n
        x, d, start, middle, end, dt = self._step.inputs
        x[:, 0], d[:, 0], dt[0, 0] = self.x[: 2 * n], self.x[2 * n :], self.dt_s
        start[:, 0], middle[:, 0], end[:, 0] = self.tracks
        after, jacobian = self._step.run()
        self.x = np.concatenate((after[:, 0], self.x[2 * n :]))
        self.F[: 2 * n] = jacobian


class Estimator:
    """Keeps the samples of the last quarter second and the filter after each of them."""

    def __init__(
        self, prediction: Prediction, config: EstimatorConfig, unit_per_count: Array
    ) -> None:
        n = self._n = prediction.n
        self._filter = _Filter(prediction)
        self._gate = config.gate_sigma**2
        self._noise = (config.measurement_noise_counts * unit_per_count) ** 2
        self._acceleration = np.array(by_axis(config.acceleration_noise_rad_or_m_per_s15, n)) ** 2
        walk = np.array(by_axis(config.disturbance_noise_Nm_or_N_per_s05, n))
        self._walk = config.disturbance * walk**2
        start = np.concatenate((np.repeat(START_SIGMA, n) ** 2, START_WALK_S * self._walk))
        self._start_covariance = np.diag(start)
        self._observe = np.eye(3 * n)[:n]
        self._checkpoints: list[_Checkpoint] = []
        self._keys: list[tuple[int, int]] = []
        self.nis_sum, self.accepted, self.outliers, self.replayed = 0.0, 0, 0, 0

    def reset(self, time_us: int, position: Array) -> None:
        """Starts at rest at a known position; all history is forgotten."""
        z = np.concatenate((position, np.zeros(2 * self._n)))
        start = _Checkpoint(time_us, -1, 0.0, z, self._start_covariance, 0.0, (0,) * self._n)
        self._checkpoints, self._keys = [start], [(time_us, -1)]

    def update(self, samples: list[Sample], now_us: int, tracks: Tracks) -> Estimate:
        """The state at `now_us` given all samples so far, these included."""
        first = len(self._keys)
        for sample in samples:
            key = (sample.time_us, sample.axis)
            at = bisect_left(self._keys, key)
            known = at < len(self._keys) and self._keys[at] == key
            if known or at == 0:  # a duplicate, or older than all that is remembered
                continue
            self._keys.insert(at, key)
            self._checkpoints.insert(at, self._blank(sample))
            first = min(first, at)
        self._replay(first, tracks)
        self._forget(now_us)
        last = self._checkpoints[-1]
        self._load(last.z, last.covariance)
        self._propagate(last.time_us, [now_us], tracks)
        return Estimate(now_us, self._filter.x, self._filter.P)

    def predict(self, estimate: Estimate, times_us: list[int], tracks: Tracks) -> Estimate:
        """The estimate carried along the tracks through `times_us` to the last of them."""
        self._load(estimate.z, estimate.covariance)
        self._propagate(estimate.time_us, times_us, tracks)
        return Estimate(times_us[-1], self._filter.x, self._filter.P)

    def _blank(self, sample: Sample) -> _Checkpoint:
        """A checkpoint whose state the replay will fill in."""
        empty = np.empty(0)
        return _Checkpoint(
            sample.time_us, sample.axis, sample.position, empty, empty, 0.0, (0,) * self._n
        )

    def _load(self, z: Array, covariance: Array) -> None:
        self._filter.x, self._filter.P = z, covariance

    def _forget(self, now_us: int) -> None:
        cut = bisect_right(self._keys, (now_us - HISTORY_US, -1)) - 1
        if cut > 0:
            for checkpoint in self._checkpoints[:cut]:
                self._count(checkpoint)
            del self._checkpoints[:cut], self._keys[:cut]

    def _count(self, checkpoint: _Checkpoint) -> None:
        """Each sample enters the statistics once: as it was last processed."""
        if checkpoint.axis < 0:
            return
        if checkpoint.rejected[checkpoint.axis]:
            self.outliers += 1
            return
        self.accepted += 1
        self.nis_sum += checkpoint.nis

    def _replay(self, first: int, tracks: Tracks) -> None:
        if first == len(self._checkpoints):
            return
        before = self._checkpoints[first - 1]
        self._load(before.z, before.covariance)
        self.replayed += len(self._checkpoints) - first
        times = [c.time_us for c in self._checkpoints[first:]]
        rejected = before.rejected
        steps = self._steps(before.time_us, times, tracks)
        for checkpoint, _ in zip(self._checkpoints[first:], steps, strict=True):
            rejected = self._correct(checkpoint, rejected)

    def _steps(self, start_us: int, times_us: list[int], tracks: Tracks) -> Iterator[None]:
        """Predicts from time to time, yielding at each."""
        stops, asked_for = _stops(start_us, times_us)
        ends = np.array(stops, dtype=np.int64)
        starts = np.concatenate(([start_us], ends[:-1]))
        grid = np.stack((starts, (starts + ends) // 2, ends), axis=1)
        near = self._filter.x[: self._n]
        values = tracks.at(grid.ravel(), near).reshape(len(ends), 3, -1)
        for dt_us, value, here in zip((ends - starts).tolist(), values, asked_for, strict=True):
            if dt_us > 0:
                self._filter.dt_s, self._filter.tracks = dt_us * 1e-6, value
                self._filter.Q = self._process_noise(dt_us * 1e-6)
                self._filter.predict()
            if here:
                yield

    def _propagate(self, start_us: int, times_us: list[int], tracks: Tracks) -> None:
        for _ in self._steps(start_us, times_us, tracks):
            pass

    def _process_noise(self, dt: float) -> Array:
        n = self._n
        noise = np.zeros((3 * n, 3 * n))
        for i in range(n):
            noise[i, i] = self._acceleration[i] * dt**3 / 3
            noise[i, n + i] = noise[n + i, i] = self._acceleration[i] * dt**2 / 2
            noise[n + i, n + i] = self._acceleration[i] * dt
            noise[2 * n + i, 2 * n + i] = self._walk[i] * dt
        return noise

    def _correct(self, checkpoint: _Checkpoint, rejected: tuple[int, ...]) -> tuple[int, ...]:
        """Takes one sample in, unless it is an outlier; returns the outliers in a row by axis."""
        f, axis = self._filter, checkpoint.axis
        innovation = checkpoint.position - f.x[axis]
        checkpoint.nis = float(innovation**2 / (f.P[axis, axis] + self._noise[axis]))
        run = rejected[axis] + 1 if checkpoint.nis > self._gate else 0
        if run == 0:
            row = self._observe[axis : axis + 1]
            z = np.array([checkpoint.position])
            f.update(z, lambda _: row, lambda x: x[axis : axis + 1], R=self._noise[axis])
        elif run % REJECTED_IN_A_ROW == 0:
            f.P = f.P + self._start_covariance
        checkpoint.rejected = (*rejected[:axis], run, *rejected[axis + 1 :])
        checkpoint.z, checkpoint.covariance = f.x, f.P
        return checkpoint.rejected


def _stops(start_us: int, times_us: list[int]) -> tuple[list[int], list[bool]]:
    """The times, and between them as few more as keep steps short; which of them were asked for."""
    stops: list[int] = []
    asked_for: list[bool] = []
    for time_us in times_us:
        gap_us = time_us - start_us
        count = max(1, -(-gap_us // STEP_MAX_US))
        stops += [start_us + gap_us * i // count for i in range(1, count + 1)]
        asked_for += [i == count for i in range(1, count + 1)]
        start_us = time_us
    return stops, asked_for
