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
        gradient: Array,
        constraints: Array,
        constraints_indices: Indices,
        constraints_indptr: Indices,
        lower: Array,
        upper: Array,
        max_iterations: int,
        tolerance: float,
    ) -> None: ...

class Hpipm(Solver):
    def __init__(
        self,
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
        approach_s: Array,
        soft: Array,
        max_iterations: int,
        tolerance: float,
    ) -> None: ...

class Feedback:
    status: int
    iterations: int
    residual: float
    accepted: bool
    rounds: int
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
    def run(self) -> int: ...

class Tick:
    def __init__(
        self,
        before: list[Bound],
        solver: Solver,
        vectors: Bound,
        z: Array,
        judge: Bound,
        residual: Array,
        encoding: Encoding,
    ) -> None: ...
    def prepare(self) -> None: ...
    def feedback(self) -> Feedback: ...
