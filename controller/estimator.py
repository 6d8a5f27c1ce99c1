"""State estimation at the synchronized now from stamped, delayed, unordered encoder samples.

An extended Kalman filter over z = [q, v, d] (d: disturbance torque, a random walk) whose process is
the machine with its servo loops. Samples are kept in order of their stamps, with the filter's state
after each (history.cpp); one that comes late is put in its place and the later ones are replayed,
so the estimate does not depend on the order of arrival. The filter steps to the first instant of a
fixed grid's cell and reads all samples of the cell from there, along the velocity then. An axis
without an encoder has no samples: it is estimated by what it does to the others (observable.py).
The filter (filter.cpp) is compiled and does a whole update in one call; process noise: white
acceleration (Bar-Shalom, Li, Kirubarajan, Estimation with Applications, 2001, section 6.2).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Estimator as EstimatorConfig
from headway.configs.section import by_axis
from headway.controller._tick import Filter
from headway.controller.prediction import Prediction
from headway.devices._tracks import Sample, Samples

Array = NDArray[np.float64]
Times = NDArray[np.int64]

# Samples are stepped to together if the same multiple of this comes before them: boards that sample
# at the same time, but each in a servo period of its own, would cost a step each.
BUNDLE_US = 256
STEP_MAX_US = 5_000  # of the prediction: a stiff servo loop diverges in longer Runge-Kutta steps
HISTORY_US = 250_000  # samples older than this are forgotten
REJECTED_IN_A_ROW = 20  # then the filter is wrong, not the samples: its covariance is widened
START_SIGMA = (2e-3, 0.05)  # of q and v at a reset [rad or m, and per second]
ROWS = 1024  # samples that there is room for at first
START_WALK_S = 0.2  # of the disturbance's random walk: what is known of it at a reset


class Tracks(Protocol):
    """What the devices execute, as far as the host knows. A compiled `Along` is asked without a
    detour through Python."""

    def at(self, times_us: Times, near: Array) -> Array:
        """[r, r', f, Kp, Kd + c] at system times (m,), close together: (m, 5n) in rad, Nm and
        seconds. `near` (n,): where the axes are at the first of them, give or take some turns."""


class Estimate(NamedTuple):
    """State z = [q, v, d] and its covariance at one time."""

    time_us: int
    z: Array
    covariance: Array
    tracks: Array  # what the devices then execute, see Tracks (5n,)

    def state(self, n: int) -> Array:
        """x = [q, v]."""
        return self.z[: 2 * n]


class Estimator:
    """Keeps the samples of the last quarter second and the filter after each of them."""

    def __init__(
        self,
        prediction: Prediction,
        config: EstimatorConfig,
        unit_per_count: Array,
        bare: Mapping[int, float] | None = None,
    ) -> None:
        """`bare`: of the axes without an encoder, of which no sample ever comes, how well it is
        known where they rest at a reset, as a standard deviation [rad or m]. No disturbance is
        estimated there: a constant one would look like another position."""
        n = self._n = prediction.n
        acceleration = np.array(by_axis(config.acceleration_noise_rad_or_m_per_s15, n)) ** 2
        walk = np.array(by_axis(config.disturbance_noise_Nm_or_N_per_s05, n))
        walk = config.disturbance * walk**2
        reading = (config.measurement_noise_counts * unit_per_count) ** 2
        sigma = np.repeat(START_SIGMA, n)
        for axis, rest_sigma in (bare or {}).items():
            sigma[axis], walk[axis] = rest_sigma, 0.0
        start = np.concatenate((sigma**2, START_WALK_S * walk))
        self._start_covariance = np.diag(start)
        pool = dict[str, Array]()  # the arrays that both work on
        rate, slope = (prediction.call(name, pool).bound for name in ("servoed", "slope"))
        outlier = config.gate_sigma**2, REJECTED_IN_A_ROW
        spans = ROWS, BUNDLE_US, STEP_MAX_US
        self._filter = Filter(rate, slope, acceleration, walk, reading, start, *outlier, *spans)

    def reset(self, time_us: int, position: Array) -> None:
        """Starts at rest at a known position; all history is forgotten."""
        z = np.concatenate((position, np.zeros(2 * self._n)))
        self._filter.reset(time_us, z, self._start_covariance)

    def update(self, samples: Samples | Iterable[Sample], now_us: int, tracks: Tracks) -> Estimate:
        """The state at `now_us` given all samples so far, these included: they are taken out of a
        list of the compiled kind, but for those that are later."""
        estimate = Estimate(now_us, *self._filter.update(samples, now_us, tracks))
        self._filter.forget(now_us - HISTORY_US)
        return estimate

    def predict(self, estimate: Estimate, times_us: list[int], tracks: Tracks) -> Estimate:
        """The estimate carried along the tracks through `times_us` to the last of them."""
        through_us = [estimate.time_us, *times_us]
        ahead = self._filter.predict(estimate.z, estimate.covariance, through_us, tracks)
        return Estimate(times_us[-1], *ahead)

    @property
    def replayed(self) -> int:
        """Samples taken in, with those that were taken in anew after a late one."""
        return self._filter.taken

    @property
    def accepted(self) -> int:
        """Samples that were no outliers. Each is counted once: when it is forgotten."""
        return self._filter.accepted

    @property
    def outliers(self) -> int:
        """Samples that were."""
        return self._filter.outliers

    @property
    def nis_sum(self) -> float:
        """Normalized innovations squared of those that were none."""
        return self._filter.nis_sum
