"""What a tick computes: generated functions and a QP solver, in one call (module.cpp)."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

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

def steps(times_us: list[int], longest_us: int) -> Indices:
    """Start, middle and end (m, 3) of steps from time to time, as many between two as keep them
    short."""

class Rows:
    """Samples in the order of their stamps and the filter after each, a row a sample: z (m, 3n),
    covariance (m, 3n, 3n), normalized innovation squared, outliers in a row by axis (m, n)."""

    def __init__(
        self,
        time_us: Indices,
        axis: Indices,
        position: Array,
        z: Array,
        covariance: Array,
        nis: Array,
        rejected: Indices,
    ) -> None: ...

class Filter:
    """An extended Kalman filter over z = [q, v, d]."""

    def __init__(
        self,
        step: Bound,
        acceleration: Array,
        walk: Array,
        reading: Array,
        start: Array,
        nis_max: float,
        in_a_row: int,
    ) -> None: ...
    def run(
        self,
        z: Array,
        covariance: Array,
        times_us: Indices,
        tracks: Array,
        rows: Rows,
        first: int,
        last: int,
    ) -> None:
        """Carries z and its covariance, in place, through steps whose start, middle and end are
        `times_us` (m, 3), along `tracks` (3m, 5n) at those. Rows first .. last - 1 are taken in,
        and filled in, where a step ends at their time. Raises ValueError for other sizes."""
