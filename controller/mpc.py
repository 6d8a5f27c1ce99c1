"""One tick of model predictive control: from the estimate at the commit knot to a plan.

A tick is two calls of compiled code. `prepare` does all that can be done before the estimate is
known: the dynamics are linearized along the last plan, and the solver factorizes. `solve` takes the
estimate in, solves, judges the answer and encodes it (the two phases of the real-time iteration:
Diehl, Bock, Schloeder, SIAM J. Control Optim. 43, 2005).
"""

from __future__ import annotations

import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from headway.configs.schema import Config
from headway.controller._tick import Hpipm, Osqp, Solver, Tick
from headway.controller.motion import Motion
from headway.controller.objective import Costs
from headway.controller.ocp import Limits, Ocp
from headway.controller.prediction import Prediction
from headway.controller.tracks import Encoder
from headway.devices.remote import Points, Remote
from headway.models.codegen import Array, Call, compile_functions

OSQP_SIGINT = 10  # a Ctrl-C that OSQP has caught
OSQP_TOLERANCE = 3e-4  # in scaled units: of 3e-4 mrad, and in parts of what the problem moves by
HPIPM_TOLERANCE = 1e-4  # in scaled units
HPIPM_ITERATIONS = 30


@dataclass(frozen=True)
class Solution:
    """What the solver did."""

    status: int  # the solver's own
    iterations: int
    residual: float  # largest violation of a constraint, in parts of its tolerance
    # If its answer is to be used: points by axis, from the knot before the commit knot on, and what
    # the servos make of them.
    plan: tuple[list[Points], Motion] | None
    prepare_us: float  # wall clock, for the record only; before the tick
    solve_us: float


class Mpc:
    """Solves the optimal control problem once a tick, warm-started."""

    def __init__(
        self,
        config: Config,
        prediction: Prediction,
        encoder: Encoder,
        costs: Costs | None = None,
    ) -> None:
        """`costs`: of the task's own."""
        ocp, n = Ocp(config, Limits.of(config), costs), prediction.n
        knots = config.mpc.horizon_us // config.loop.knot_us
        self._stride = knots // config.mpc.intervals
        self._prediction, self.encoder = prediction, encoder
        library = compile_functions("mpc", ocp.functions(knots))
        # Arrays by name: what one function writes others read (ocp.py says what each is).
        x, u = (np.zeros((rows, ocp.intervals + 1), order="F") for rows in (2 * n, n))
        self._pool = pool = {"x": x, "u": u, "x0": x[:, :-1], "u0": u[:, :-1], "u1": u[:, 1:]}
        pool["time_s"] = np.zeros((1, ocp.intervals + 1), order="F")
        pool |= {name: encoder.pool[name] for name in ("position", "velocity", "torque")}
        pool["start"] = encoder.pool["x"]
        pool["parameters"] = ocp.parameters[:, None]
        linearize = prediction.call("linearize", pool)
        pool["dt"][...] = ocp.interval_s
        vectors, judge = (Call(library, name, pool) for name in ("vectors", "judge"))
        before = [linearize.bound]
        if costs is not None:
            before.append(Call(library, "weigh", pool).bound)
        if config.mpc.backend == "osqp":  # by stages it is not needed
            before.append(assembly(library, ocp, pool).bound)
            if costs is not None:
                before.append(squaring(library, ocp, pool).bound)
            solver = _osqp(config, ocp, pool)
        else:
            solver = _hpipm(ocp, pool)
        answer = judge.bound, pool["residual"], encoder.encoding
        self._tick = Tick(before, solver, vectors.bound, pool["z"], *answer)
        self._along = np.zeros((knots + 1, n))  # the positions of the guess
        self._gravity = np.zeros(n)
        self._prepare_us = 0.0

    def prepare(self, guess: Motion, disturbance: Array, node_s: Array) -> None:
        """Linearizes along a motion that begins at the next commit knot, and factorizes.

        disturbance: (n,), as far as it is known now; node_s: (N+1,) times of the task.
        """
        began = time.perf_counter()
        self._along = guess.position
        nodes, pool = slice(None, None, self._stride), self._pool
        n = len(disturbance)
        pool["x"][:n], pool["x"][n:] = guess.position[nodes].T, guess.velocity[nodes].T
        pool["u"][...], pool["assumed"][:, 0] = guess.torque[nodes].T, disturbance
        pool["time_s"][0] = node_s
        self._gravity = self._prediction.holding(guess.position[-1], np.zeros(n))
        self._tick.prepare()
        self._prepare_us = (time.perf_counter() - began) * 1e6

    def solve(
        self,
        start: Array,
        disturbance: Array,
        reference: Array,
        committed_torque: Array,
        remotes: list[Remote],
        commit_knot: int,
    ) -> Solution:
        """A plan from the commit knot on, around the motion that was prepared for it.

        start: (2n,) the state there; disturbance: (n,), as estimated by now; reference: (N+1, 2n)
        states at the nodes; committed_torque: (n,) motor torque there, zero on passive axes.
        """
        pool, holding = self._pool, self._gravity - disturbance
        pool["d"][:, 0], pool["reference"][...] = disturbance, reference.T
        pool["committed"][:, 0], pool["holding"][:, 0] = committed_torque, holding
        self.encoder.commit(remotes, commit_knot, self._along, start, disturbance)
        done = self._tick.feedback()
        if done.status == OSQP_SIGINT:
            signal.raise_signal(signal.SIGINT)  # OSQP caught a Ctrl-C that is not for it
        plan = (self.encoder.points(), self.encoder.rolled()) if done.accepted else None
        times = self._prepare_us, done.solve_us
        return Solution(done.status, done.iterations, done.residual, plan, *times)


def assembly(library: Path, ocp: Ocp, pool: dict[str, Array]) -> Call:
    """The linearized intervals' way into the constraints' entries."""
    pool["constant"] = ocp.constraints.data[:, None]
    pool["scale"] = ocp.dynamics_scale.reshape(-1, 1)
    pool["entries"] = pool["constant"].copy(order="F")
    return Call(library, "assemble", pool)


def squaring(library: Path, ocp: Ocp, pool: dict[str, Array]) -> Call:
    """The task's own costs' way into the Hessian's entries."""
    pool["square_constant"] = ocp.hessian.data[:, None]
    pool["square_scale"] = ocp.hessian_scale[:, None]
    pool["square_entries"] = pool["square_constant"].copy(order="F")
    return Call(library, "square", pool)


def _osqp(config: Config, ocp: Ocp, pool: dict[str, Array]) -> Solver:
    _, rows, starts = _by_columns(ocp.hessian)
    entries = pool["square_entries"][:, 0] if "square_entries" in pool else ocp.hessian.data
    return Osqp(
        entries,
        rows,
        starts,
        "square_entries" in pool,
        pool["gradient"][:, 0],
        pool["entries"][:, 0],
        *_by_columns(ocp.constraints)[1:],
        pool["lower"][:, 0],
        pool["upper"][:, 0],
        config.mpc.max_iterations,
        OSQP_TOLERANCE,
    )


def _hpipm(ocp: Ocp, pool: dict[str, Array]) -> Solver:
    vectors = pool["gradient"], pool["lower"], pool["upper"]
    scales, hessian, soft = ocp.stages()
    return Hpipm(
        ocp.driven,
        ocp.bounded.tolist(),
        *(pool["a"], pool["b0"], pool["b1"]),
        *vectors,
        *scales,
        *hessian,
        pool.get("curvature", np.empty((0, 0))),
        *soft,
        HPIPM_ITERATIONS,
        HPIPM_TOLERANCE,
    )


def _by_columns(matrix: sp.csc_matrix) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Entries, their rows, and where each column begins."""
    return matrix.data, matrix.indices.astype(np.int64), matrix.indptr.astype(np.int64)
