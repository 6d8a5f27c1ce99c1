"""One tick's quadratic program: its arrays, what fills them in, and a solver.

A tick is two calls of compiled code. `prepare` does all that can be done before the estimate is
known: the dynamics are linearized along a guess, and the solver factorizes. `feedback` takes the
estimate in, solves, judges the answer and encodes it (the two phases of the real-time iteration:
Diehl, Bock, Schloeder, SIAM J. Control Optim. 43, 2005).
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from headway.configs.schema import Config
from headway.controller._tick import (
    Encoding,
    Feedback,
    Hpipm,
    Osqp,
    Riccati,
    Solver,
    Stages,
    Tick,
)
from headway.controller.objective import Costs
from headway.controller.ocp import Limits, Ocp
from headway.controller.prediction import Prediction
from headway.models.codegen import Array, Call, compile_functions, compile_source

OSQP_TOLERANCE = 3e-4  # in scaled units: of 3e-4 mrad, and in parts of what the problem moves by
STAGES_TOLERANCE = 1e-4  # of the interior-point methods, in scaled units
STAGES_ITERATIONS = 30


# Arrays that weights, limits and scales go into.
OWN = {
    "parameters", "constant", "scale", "entries", "square_constant", "square_scale",
    "square_entries",
}  # fmt: skip


@dataclass(frozen=True)
class Weighing:
    """The program with some weights. `pool` has its arrays by name: what one function writes others
    read, and all weighings share them but for their OWN."""

    ocp: Ocp
    pool: dict[str, Array]
    tick: Tick


class Program:
    """The problem of one tick in arrays that stay where they are; ocp.py says what each is.

    `tick` is the two calls. `costs`: of the task's own. With `encoding` an answer that is accepted
    is encoded at once, from the arrays of `encoded`. What mpc.later brings is ready from the
    beginning: other weights are another `Weighing`, and nothing is compiled for them.
    """

    def __init__(
        self,
        config: Config,
        prediction: Prediction,
        costs: Costs | None = None,
        encoding: Encoding | None = None,
        encoded: dict[str, Array] | None = None,
    ) -> None:
        n, nodes = prediction.n, config.mpc.intervals + 1
        x, u = (np.zeros((rows, nodes), order="F") for rows in (2 * n, n))
        pool = {"x": x, "u": u, "x0": x[:, :-1], "u0": u[:, :-1], "u1": u[:, 1:]}
        pool["time_s"] = np.zeros((1, nodes), order="F")
        if encoded is not None:
            pool |= {name: encoded[name] for name in ("position", "velocity", "torque")}
            pool["start"] = encoded["x"]
        self.linearize = prediction.call("linearize", pool)
        resting = prediction.call("inverse", {"q": x[:n, -1:]})
        self.gravity = resting.outputs[0][:, 0]  # that motors bear where the guess ends (n,)
        self._along = [self.linearize.bound, resting.bound]
        self._weighings: list[Weighing] = []
        for i, weighed in enumerate(config.weighings):
            ocp = Ocp(weighed, Limits.of(weighed), costs and costs.after(i))
            if i == 0:
                pool["dt"][...] = ocp.interval_s
                knots = config.mpc.horizon_us // config.loop.knot_us
                self._library = compile_functions("mpc", ocp.functions(knots))
            pool = {name: array for name, array in pool.items() if name not in OWN}
            self._weighings.append(self._weighing(weighed, ocp, pool, encoding))
        self._from_s = [later.from_s for later in config.mpc.later]
        self._now = self._weighings[0]

    def _weighing(
        self, config: Config, ocp: Ocp, pool: dict[str, Array], encoding: Encoding | None
    ) -> Weighing:
        """In the arrays of `pool`, which gets those that it lacks."""
        pool["parameters"] = ocp.parameters[:, None]
        vectors, judge = (Call(self._library, name, pool) for name in ("vectors", "judge"))
        before = [*self._along]
        if ocp.costs is not None:
            before.append(Call(self._library, "weigh", pool).bound)
        if config.mpc.backend == "osqp":  # by stages it is not needed
            before.append(assembly(self._library, ocp, pool).bound)
            if ocp.costs is not None:
                before.append(squaring(self._library, ocp, pool).bound)
            solver = _osqp(config, ocp, pool)
        elif config.mpc.backend == "hpipm":
            solver = _hpipm(ocp, pool)
        else:
            solver = _riccati(ocp, pool)
        answer = judge.bound, pool["residual"], encoding
        guess = (pool[name] for name in ("x", "u", "assumed", "around", "d"))
        sqp = config.mpc.sqp_iterations, ocp.driven
        tick = Tick(
            before, solver, vectors.bound, pool["z"], *answer, *sqp, ocp.column_scale, *guess
        )
        return Weighing(ocp, pool, tick)

    @property
    def ocp(self) -> Ocp:
        """Of the last `prepare`."""
        return self._now.ocp

    @property
    def pool(self) -> dict[str, Array]:
        """Of the last `prepare`: the arrays by their names."""
        return self._now.pool

    @property
    def tick(self) -> Tick:
        """Of the last `prepare`."""
        return self._now.tick

    def prepare(self, x: Array, u: Array, disturbance: Array, node_s: Array | float = 0.0) -> None:
        """Linearizes along x (2n, N+1) and u (n, N+1) at the nodes, and factorizes.

        disturbance: (n,), as far as it is known now; node_s: (N+1,) times of the task, the first of
        which says what weights hold.
        """
        begin_s = node_s if isinstance(node_s, float) else node_s[0]
        self._now = self._weighings[bisect_right(self._from_s, begin_s)]
        self.pool["x"][...], self.pool["u"][...], self.pool["time_s"][0] = x, u, node_s
        self.pool["assumed"][:, 0] = disturbance
        self.tick.prepare()

    def feedback(
        self,
        start: Array,
        d: Array,
        reference: Array,
        committed: Array,
        holding: Array,
        ending: Array | float = 0.0,
    ) -> Feedback:
        """Solves for the state (2n,) at the horizon's start, the disturbance d (n,), reference
        (2n, N+1) at the nodes, the torques (n,) to begin and to end with, and the driven axes'
        speeds (w,) at the end: none but for a restoration."""
        pool = self.pool
        pool["start"][:, 0], pool["d"][:, 0], pool["reference"][...] = start, d, reference
        pool["committed"][:, 0], pool["holding"][:, 0] = committed, holding
        pool["ending"][:, 0] = ending
        return self.tick.feedback()

    def constraints(self) -> sp.csc_matrix:
        """Of the last program, in its scales: rows of lower <= A z <= upper."""
        entries = assembly(self._library, self.ocp, dict(self.pool)).run()[0]
        matrix = self.ocp.constraints.copy()
        matrix.data[:] = entries[:, 0]
        return matrix

    def hessian(self) -> sp.csc_matrix:
        """Of the last program, in its scales: the upper half."""
        matrix = self.ocp.hessian.copy()
        if "curvature" in self.pool:
            entries = squaring(self._library, self.ocp, dict(self.pool)).run()[0]
            matrix.data[:] = entries[:, 0]
        return matrix

    def cost(self, z: Array) -> float:
        """Of variables in the scales of the last program, but for a constant."""
        half = self.hessian()
        twice = float(z @ (half @ z)) * 2 - float(z**2 @ half.diagonal())
        return twice / 2 + float(self.pool["gradient"][:, 0] @ z)

    def answer(self) -> tuple[Array, Array]:
        """Of the last feedback: states (2n, N+1) and torques (n, N+1) at the nodes."""
        pool, ocp = self.pool, self.ocp
        step = pool["z"][:, 0] * ocp.column_scale
        x = pool["x"] + step[ocp.states].reshape(pool["x"].shape, order="F")
        u = pool["around"].copy()
        u[ocp.driven] += step[ocp.torques].reshape(len(ocp.driven), -1, order="F")
        return x, u


def assembly(library: Path, ocp: Ocp, pool: dict[str, Array]) -> Call:
    """The linearized intervals' way into the constraints' entries."""
    pool["constant"] = ocp.constraints.data[:, None]
    pool["scale"] = ocp.linearized_scale[:, None]
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
        ocp.column_scale,
        config.mpc.max_iterations,
        OSQP_TOLERANCE,
    )


def _stages(ocp: Ocp, pool: dict[str, Array]) -> Stages:
    vectors = pool["gradient"], pool["lower"], pool["upper"]
    scales, hessian, soft = ocp.stages()
    return Stages(
        ocp.cubic,
        ocp.driven,
        ocp.bounded.tolist(),
        *(pool["a"], pool["b0"], pool["b1"]),
        *vectors,
        *scales,
        *hessian,
        pool.get("curvature", np.empty((0, 0))),
        *(pool["kept"], pool["kept_slope"]),
        *soft,
    )


def _hpipm(ocp: Ocp, pool: dict[str, Array]) -> Solver:
    return Hpipm(_stages(ocp, pool), STAGES_ITERATIONS, STAGES_TOLERANCE)


def _riccati(ocp: Ocp, pool: dict[str, Array]) -> Solver:
    library = compile_source("riccati", riccati_source(ocp, "curvature" in pool))
    return Riccati(str(library), _stages(ocp, pool), STAGES_ITERATIONS, STAGES_TOLERANCE)


def riccati_source(ocp: Ocp, curved: bool) -> str:
    """riccati.c with what it is compiled for; `curved`: for costs of the task's own."""
    numbers = {
        "AXES": ocp.n, "MOTORS": len(ocp.driven), "SOFT": len(ocp.bounded),
        "INTERVALS": ocp.intervals, "CURVED": int(curved), "BETWEEN": len(ocp.cubic),
        "KEPT": ocp.kept,
    }  # fmt: skip
    lists: dict[str, list[int] | list[str]] = {
        "DRIVEN": ocp.driven,
        "BOUNDED": ocp.bounded.tolist() or [0],  # C has no empty array
        "CUBIC": [f"{{{', '.join(map(str, row))}}}" for row in ocp.cubic],
    }
    lines = [f"#define {name} {value}" for name, value in numbers.items()]
    lines += [f"#define {name} {{{', '.join(map(str, of))}}}" for name, of in lists.items()]
    here = Path(__file__).parent
    return "\n".join([*lines, *((here / file).read_text() for file in ("riccati.h", "riccati.c"))])


def _by_columns(matrix: sp.csc_matrix) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Entries, their rows, and where each column begins."""
    return matrix.data, matrix.indices.astype(np.int64), matrix.indptr.astype(np.int64)
