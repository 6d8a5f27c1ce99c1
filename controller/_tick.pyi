"""What a tick computes: generated functions and a QP solver, in one call (module.cpp)."""

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from headway.controller.estimator import Tracks
from headway.devices._tracks import Sample, Samples
from headway.models._generated import Bound

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

class Answer:
    def __init__(self, status: int, iterations: int, good: bool) -> None: ...

class Solver:
    def update(self) -> bool: ...
    def solve(self, z: Array) -> Answer: ...

class Stranger(Solver):
    def __init__(self, size: int, answer: Callable[[], tuple[Array, Answer]]) -> None: ...

class Osqp(Solver):
    def __init__(
        self,
        hessian: Array,
        hessian_indices: Indices,
        hessian_indptr: Indices,
        hessian_changes: bool,
        gradient: Array,
        constraints: Array,
        constraints_indices: Indices,
        constraints_indptr: Indices,
        lower: Array,
        upper: Array,
        scale: Array,
        max_iterations: int,
        tolerance: float,
    ) -> None: ...

class Stages:
    def __init__(
        self,
        cubic: list[tuple[float, float, float]],
        driven: list[int],
        bounded: list[int],
        a: Array,
        b0: Array,
        b1: Array,
        gradient: Array,
        lower: Array,
        upper: Array,
        column_scale: Array,
        row_scale: Array,
        state: Array,
        torque: Array,
        step: Array,
        curvature: Array,
        kept: Array,
        kept_slope: Array,
        approach_s: Array,
        soft: Array,
    ) -> None: ...

class Hpipm(Solver):
    def __init__(self, stages: Stages, max_iterations: int, tolerance: float) -> None: ...

class Riccati(Solver):
    def __init__(
        self, library: str, stages: Stages, max_iterations: int, tolerance: float
    ) -> None: ...

class Feedback:
    status: int
    iterations: int
    stationarity: float
    complementarity: float
    residual: float
    accepted: bool
    solve_us: float

class Encoding:
    def __init__(
        self,
        encode: Bound,
        rollout: Bound,
        relieve: Bound,
        relief: Array,
        next: Array,
        over: Array,
    ) -> None: ...
    def run(self) -> None: ...

class Tick:
    def __init__(
        self,
        before: list[Bound],
        solver: Solver,
        vectors: Bound,
        z: Array,
        judge: Bound,
        residual: Array,
        encoding: Encoding | None,
        sqp_iterations: int,
        driven: list[int],
        scale: Array,
        x: Array,
        u: Array,
        assumed: Array,
        around: Array,
        d: Array,
    ) -> None: ...
    def prepare(self) -> None: ...
    def feedback(self) -> Feedback: ...

def finite(rows: Array) -> bool:
    """Whether all of them (m, n) are: numpy takes six times as long."""

class Filter:
    """An extended Kalman filter over z = [q, v, d], with the samples that it has taken in."""

    taken: int
    accepted: int
    outliers: int
    nis_sum: float

    def __init__(
        self,
        rate: Bound,
        slope: Bound,
        acceleration: Array,
        walk: Array,
        reading: Array,
        start: Array,
        nis_max: float,
        in_a_row: int,
        rows: int,
        bundle_us: int,
        step_us: int,
    ) -> None:
        """`rows`: room for so many samples at first; `bundle_us`, `step_us`: the longest bundle and
        step. Raises ValueError for arrays of other sizes than the slope's, and for a rate that
        does not share them."""

    def reset(self, time_us: int, z: Array, covariance: Array) -> None:
        """Forgets all samples."""

    def update(
        self, samples: Samples | Iterable[Sample], now_us: int, tracks: Tracks
    ) -> tuple[Array, Array, Array]:
        """Takes the samples up to now in, but for known ones and those older than all that is
        remembered, with those that were taken in before and are later than a new one; and out of
        the list. Returns z and its covariance then, and the tracks there. Raises ValueError for
        tracks of another size and samples of no axis."""

    def predict(
        self, z: Array, covariance: Array, times_us: list[int], tracks: Tracks
    ) -> tuple[Array, Array, Array]:
        """The two carried through times, and the tracks there. Raises ValueError for other
        sizes."""

    def step(self, z: Array, tracks: Array, dt_s: float) -> tuple[Array, Array]:
        """One step by itself, through tracks (3, 5n) at its start, middle and end: x after it (2n,)
        and its Jacobian in z (2n, 3n). Raises ValueError for other sizes."""

    def forget(self, before_us: int) -> None:
        """Forgets the samples before the last one that is older than a time: they enter the
        statistics."""
