"""The optimal control problem of one tick as a quadratic program for OSQP.

Real-time iteration (Diehl, Bock, Schloeder, SIAM J. Control Optim. 43, 2005): the dynamics are
linearized along the trajectory that the last tick's encoded tracks give, and one QP is solved in
the deviations from it. Variables: states x_0..x_N (2n each), torques u_0..u_N of the w motors at
the nodes (w each; linear in between), one slack per axis for the soft position limits, of which a
continuous axis has none, and one at each node for each row of the task's own. Passive axes have no
torque, no limit but soft ones, and need not rest.

    minimize    sum w_i |x_i - ref_i|^2_Q + |u_{i+1} - u_i|^2_S + |u_0 - committed|^2_R
                + sum over the last two nodes |u_i - holding|^2_R + soft |s|^2
                + the task's own costs, see objective.py, and |t_i|^2
    subject to  x_0 = estimate at the commit knot
                x_{i+1} = F(x_i, u_i, u_{i+1}, d)        linearized
                v_{N-1} = v_N = 0                        rest at the end, or `ending`
                |u| <= limit
                |6 (q_{i+1} - q_i) / h - v_i - v_{i+1}| <= 4 limit         speed
                |6 (q_{i+1} - q_i) / h - 4 v_i - 2 v_{i+1}| <= limit h     acceleration
                soft_min - s <= q + T v <= soft_max + s, with T by axis
                g(x_i) <= t_i after the first node       what the task keeps below, linearized

Of the cubic through two nodes, over an interval of h, these are the speed half-way and the
acceleration where it begins. Torques are linear in between: where they swing from node to node, the
speeds at the nodes and the mean accelerations between them do not show it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from headway.configs.schema import Config
from headway.configs.section import by_axis
from headway.controller.objective import Costs
from headway.models.codegen import among, named_function

Array = NDArray[np.float64]

TORQUE_SHARE = 0.99  # of the torque limit is planned at first: the rest is for the encoding
SPEED_SHARE = 0.85  # of the gate's limit: control points exceed the nodes
# So do accelerations, and most where a plan leaves the committed points at full acceleration.
ACCELERATION_SHARE = 0.7
# A soft limit is approached no faster than its distance over this time, or over a longer one: a
# machine that brakes later than the model thinks then still stops short of it (a linear barrier:
# Ames et al., "Control barrier functions: theory and applications", 2019).
APPROACH_S = 0.1
STOP_SHARE = 0.8  # of the stop deceleration, with which a plan could stop anywhere
RETURN_S = 0.4  # time constant of the way back into the soft limits
# What a plan keeps to a position limit: what the model does not know goes there.
ROOM = {"rad": 4e-3, "m": 4e-4}
UNBOUNDED = 1e20
# What two nodes say of the cubic between them: so many times 6 (q_{i+1} - q_i) / h, plus these
# times v_i and v_{i+1}, are the speed half-way, and h times the acceleration where it begins.
CUBIC = (0.25, -0.25, -0.25), (1.0, -4.0, -2.0)
# A plan whose constraints hold within these is believed: rad or m, and per second; torques within a
# share of their limit.
POSITION_TOLERANCE, VELOCITY_TOLERANCE, TORQUE_TOLERANCE_SHARE = 3e-4, 1e-2, 5e-3
STOP_SMOOTHNESS = 20.0  # times the torque step weight, where tracking has faded out
# Scales of limits' rows, found by trying on programs after jumps of the reference, of machines of
# one to eight axes.
TORQUE_SCALE = 4.0  # in units of one over the root of the torque step weight
CUBIC_SCALE = 1 / 3  # of the rows of a cubic, whose positions come with 6 / h
ACCELERATION_SCALE = 2.0  # times that
SOON_NODES = (
    8  # nodes to which speed rows count for more: the start is given, and little can change
)
SOFT_SCALE = 0.5
TORQUE_FLOOR = (
    2e-6  # times the torque step weight, on the torque itself: the problem has one solution
)


@dataclass(frozen=True)
class Limits:
    """SI; torque, velocity and acceleration of the w driven axes, the others of all n."""

    torque: Array  # (N+1, w), by node
    velocity: Array
    acceleration: Array
    soft_min: Array  # without bounds on continuous axes
    soft_max: Array
    approach_s: Array  # T

    @classmethod
    def of(cls, config: Config) -> Limits:
        """The plan's limits: shares of the device's, and the soft position limits."""
        axes, driven, mpc = config.machine.axes, config.machine.driven, config.mpc
        low = [a.lowest if a.soft_min is None else a.soft_min for a in axes]
        high = [a.highest if a.soft_max is None else a.soft_max for a in axes]
        room = np.array([ROOM[a.unit] for a in axes])
        # Nearly all of the torque at the plan's start, less from its middle on: what is kept back
        # lets the next ticks correct what went wrong (constraint tightening: Chisci, Rossiter,
        # Zappa, Automatica 37, 2001).
        ramp = np.clip(2 * np.linspace(0, 1, mpc.intervals + 1), 0, 1)
        shares = TORQUE_SHARE + (mpc.torque_share_end - TORQUE_SHARE) * ramp
        velocity = SPEED_SHARE * np.array([a.velocity_limit for a in driven.values()])
        # T v <= room and v <= 2 a T give the gate's v^2 <= 2 a room: T is such that the second
        # holds up to the fastest plan, with a share of the a that the gate counts on. An axis with
        # soft limits at both ends has the way beyond them to stop on.
        approach_s = np.full(len(axes), APPROACH_S)
        for speed, (i, axis) in zip(velocity, driven.items(), strict=True):
            if axis.soft_min is None or axis.soft_max is None:
                approach_s[i] = max(APPROACH_S, speed / (2 * STOP_SHARE * axis.deceleration))
        return cls(
            np.outer(shares, [a.effort_limit for a in driven.values()]),
            velocity,
            ACCELERATION_SHARE * np.array([a.acceleration_limit for a in driven.values()]),
            np.array(low) + room,
            np.array(high) - room,
            approach_s,
        )


class Ocp:
    """The QP's constant parts, and as CasADi expressions what fills in the others.

    Expressions have a column for each node. `parameters` are their last argument: weights, limits
    and scales, so that these need no compiler.
    """

    def __init__(self, config: Config, limits: Limits, costs: Costs | None = None) -> None:
        mpc, self.costs = config.mpc, costs
        n = self.n = len(config.machine.axes)
        self.driven = list(config.machine.driven)
        w = len(self.driven)
        self.bounded = np.flatnonzero([not axis.continuous for axis in config.machine.axes])
        count = self.intervals = mpc.intervals
        self.limits = limits
        self.interval_s = mpc.horizon_us * 1e-6 / count
        # The same, of q_{i+1} - q_i in SI, v_i and v_{i+1}.
        self.cubic = [(6 / self.interval_s * lever, v0, v1) for lever, v0, v1 in CUBIC]
        self.states = slice(0, (count + 1) * 2 * n)
        self.torques = slice(self.states.stop, self.states.stop + (count + 1) * w)
        self.slacks = slice(self.torques.stop, self.torques.stop + n)
        self.kept = 0 if costs is None else costs.rows  # rows of the task's own at a node
        self.kept_slacks = slice(self.slacks.stop, self.slacks.stop + count * self.kept)
        self.size = self.kept_slacks.stop
        share = np.linspace(0, 1, count + 1)
        fade = (mpc.fade_end - share) / (mpc.fade_end - mpc.fade_start)
        self._weight = np.clip(fade, 0, 1) ** 2
        weights = by_axis(mpc.position_weight, n), by_axis(mpc.velocity_weight, n)
        self._state_weight = np.concatenate(weights)
        self._start_weight = np.array(by_axis(mpc.torque_start_weight, n))[self.driven]
        self._soft_weight = np.maximum(by_axis(mpc.soft_weight, n), 1.0)
        self._step_weight = np.array(by_axis(mpc.torque_step_weight, n))[self.driven]
        self._effort = np.array([a.effort_limit for a in config.machine.driven.values()])
        self.hessian = self._build_hessian()
        self._build_constraints()
        self._scale()
        self._values = self._parameter_values()  # by name, two-dimensional
        self.parameters = np.concatenate([v.ravel(order="F") for v in self._values.values()])
        self._vector = ca.MX.sym("parameters", len(self.parameters))

    def _parameter_values(self) -> dict[str, Array]:
        limits = self.limits
        return {
            "weight": self._weight[:, None],
            "state_weight": self._state_weight[:, None],
            "step_weight": self._step_weight[:, None],
            "start_weight": self._start_weight[:, None],
            "effort": self._effort[:, None],
            "torque": limits.torque.T,
            "velocity": limits.velocity[:, None],
            "surge": limits.acceleration[:, None] * self.interval_s,
            "soft_min": limits.soft_min[:, None],
            "soft_max": limits.soft_max[:, None],
            "approach_s": limits.approach_s[:, None],
            "column_scale": self.column_scale[:, None],
            "row_scale": self.row_scale[:, None],
            "costs": np.empty((0, 1)) if self.costs is None else self.costs.parameters[:, None],
        }

    def _scale(self) -> None:
        """Variables in units of one over the root of their weight (torques: their limit), rows of
        the dynamics likewise. Found by trying: OSQP then needs 30 to 70 iterations without a
        scaling of its own, where it stops at 200 with it."""
        n, nodes = self.n, self.intervals + 1
        state = 1 / np.sqrt(np.maximum(self._state_weight, 1.0))
        slack = 1 / np.sqrt(self._soft_weight)
        self.column_scale = np.concatenate(
            (
                np.tile(state, nodes), np.tile(self._effort, nodes), slack,
                np.ones(self.kept * self.intervals),  # their unit is one of cost already
            )
        )  # fmt: skip
        self.row_scale = np.ones(self.rows)
        self.row_scale[: 2 * n * nodes] = 1 / np.tile(state, nodes)
        self.row_scale[2 * n * nodes : self.equalities] = np.tile(1 / state[n:][self.driven], 2)
        # OSQP converges where limits' rows are of a size with what the cost leaves free of them.
        # Powers of two: other solvers take these scales off again, and get the very same numbers.
        torque = TORQUE_SCALE * np.sqrt(self._step_weight)
        self.row_scale[self.equalities : self._speed_row] = np.tile(_power_of_two(torque), nodes)
        cubic = CUBIC_SCALE * self.interval_s / state[:n][self.driven]
        soon = _power_of_two(np.maximum(1, SOON_NODES / np.arange(1, nodes)))
        acceleration = np.full(self.intervals, ACCELERATION_SCALE)
        of_cubic = np.outer(np.append(soon, acceleration), cubic).ravel()
        self.row_scale[self._speed_row : self._soft_row] = of_cubic
        # Half-way to the states' own scale: less makes an active soft limit converge slowly, more
        # slows down everything else.
        soft = SOFT_SCALE * APPROACH_S / self.limits.approach_s / np.sqrt(state[:n])
        soft_rows = slice(self._soft_row, self.kept_rows.start)  # the task's own: `_own_scale`
        self.row_scale[soft_rows] = np.tile(soft[self.bounded], 2 * self.intervals)
        rows, columns = self._by_entry(self.hessian, self.column_scale)
        self.hessian_scale = rows * columns
        self.hessian.data *= rows
        self.hessian.data *= columns
        rows, columns = self._by_entry(self.constraints, self.row_scale)
        entry_scale = rows * columns
        self.constraints.data *= entry_scale
        self.linearized_scale = entry_scale[self._linearized_place]
        self.linearized_scale[: self._dynamics] *= -1

    def _by_entry(self, matrix: sp.csc_matrix, row_scale: Array) -> tuple[Array, Array]:
        """The scales of each entry's row and column."""
        of_column = np.repeat(np.arange(self.size), np.diff(matrix.indptr))
        return row_scale[matrix.indices], self.column_scale[of_column]

    def _build_hessian(self) -> sp.csc_matrix:
        """Its upper half; with costs of the task's own, with room for what they add each tick."""
        states = np.outer(self._weight, self._state_weight).ravel() + 1e-3
        shape = (self.intervals, self.intervals + 1)
        difference = sp.diags_array([-1.0, 1.0], offsets=[0, 1], shape=shape)
        smooth = sp.diags_array(self._smoothness(self._weight[1:]))
        ends = np.zeros(self.intervals + 1)
        ends[[0, -2, -1]] = 1.0
        steps = difference.T @ smooth @ difference + TORQUE_FLOOR * sp.eye_array(self.intervals + 1)
        torques = sp.kron(steps, sp.diags_array(self._step_weight)) + sp.kron(
            sp.diags_array(ends), sp.diags_array(self._start_weight)
        )
        slacks = sp.diags_array(np.append(self._soft_weight, np.ones(self.kept * self.intervals)))
        blocks = sp.block_diag([sp.diags_array(states), torques, slacks])
        constant: Any = sp.coo_matrix(sp.triu(2 * blocks))
        row, column = self._curvature_entries()
        rows, columns = np.append(constant.row, row), np.append(constant.col, column)
        values: Array = np.append(constant.data, np.zeros(len(row)))
        hessian = sp.csc_matrix((values, (rows, columns)), shape=(self.size, self.size))
        hessian.sort_indices()
        return hessian

    def _curvature_entries(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of the upper half of each state's block, as far as it may be filled."""
        if self.costs is None:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        row, column = np.triu_indices(2 * self.n)
        first = 2 * self.n * np.arange(self.intervals + 1)[:, None]
        return (first + row).ravel(), (first + column).ravel()

    def _build_constraints(self) -> None:
        """One COO entry list; entries of what is linearized are remembered, to be filled in each
        tick."""
        n, w, count = self.n, len(self.driven), self.intervals
        speeds = np.eye(2 * n)[[n + axis for axis in self.driven]]
        rows: list[NDArray[np.int64]] = []
        columns: list[NDArray[np.int64]] = []
        values: list[Array] = []

        def put(row: int, column: int, block: Array) -> None:
            r, c = np.nonzero(block)  # not-a-number and infinity count
            rows.append(r + row)
            columns.append(c + column)
            values.append(block[r, c])

        def state(i: int) -> int:
            return 2 * n * i

        def torque(i: int) -> int:
            return self.torques.start + w * i

        put(0, 0, np.eye(2 * n))
        row = 2 * n
        for i in range(count):  # linearized, see `_assemble`
            put(row, state(i), np.full((2 * n, 2 * n), np.nan))
            put(row, torque(i), np.full((2 * n, w), np.nan))
            put(row, torque(i + 1), np.full((2 * n, w), np.nan))
            put(row, state(i + 1), np.eye(2 * n))
            row += 2 * n
        for i in (count - 1, count):
            put(row, state(i), speeds)
            row += w
        self.equalities = row
        put(row, self.torques.start, np.eye((count + 1) * w))
        row += (count + 1) * w
        self._speed_row = row
        positions = np.eye(2 * n)[self.driven]
        for lever, begins, ends in self.cubic:
            for i in range(count):
                put(row, state(i), -lever * positions + begins * speeds)
                put(row, state(i + 1), lever * positions + ends * speeds)
                row += w
        self._soft_row = row
        own = np.eye(n)[self.bounded]
        for sign in (1.0, -1.0):
            for i in range(1, count + 1):
                put(row, state(i), sign * own)
                put(row, state(i) + n, sign * own * self.limits.approach_s)
                put(row, self.slacks.start, -own)
                row += len(own)
        kept = self.kept
        self.kept_rows = slice(row, row + kept * count)
        for i in range(count):  # linearized, too
            put(row, state(i + 1), np.full((kept, 2 * n), np.inf))
            put(row, self.kept_slacks.start + kept * i, np.diag(np.full(kept, np.inf)))
            row += kept
        self.rows = row
        entries = np.concatenate(values)
        order = sp.csc_matrix(  # of the entries' numbers
            (np.arange(1, len(entries) + 1), (np.concatenate(rows), np.concatenate(columns))),
            shape=(row, self.size),
        )
        order.sort_indices()
        place = np.empty(len(entries), dtype=np.int64)  # entry -> position in the CSC data
        place[order.data - 1] = np.arange(len(entries))
        data = np.empty(len(entries))
        data[place] = entries
        parts = place[np.isnan(entries)], place[np.isinf(entries)]
        self._dynamics, self._linearized_place = len(parts[0]), np.concatenate(parts)
        data[~np.isfinite(data)] = 1.0  # anything but zero, so that the entries are kept
        self.constraints = sp.csc_matrix((data, order.indices, order.indptr), shape=order.shape)

    def stages(
        self,
    ) -> tuple[tuple[Array, Array], tuple[Array, Array, Array], tuple[Array, Array]]:
        """For a solver that goes by stages: the scales of variables and constraints; the Hessian's
        diagonal of states (2n, N+1) and of torques (w, N+1), and its steps of torque from node to
        node (w, N); T of the soft limits and the slacks' weight (n,)."""
        n, w, diagonal = self.n, len(self.driven), self.hessian.diagonal()
        steps = -self.hessian.diagonal(w)[self.torques][:-w].reshape(-1, w).T
        torque = diagonal[self.torques].reshape(-1, w).T
        torque[:, 1:] -= steps
        torque[:, :-1] -= steps
        state = diagonal[self.states].reshape(-1, 2 * n).T
        hessian = np.asfortranarray(state), np.asfortranarray(torque), np.asfortranarray(steps)
        scales = self.column_scale, self.row_scale
        return scales, hessian, (self.limits.approach_s, self._soft_weight)

    def functions(self, knots: int) -> list[ca.Function]:
        """What a tick computes of the problem, for a horizon of `knots`:

        assemble  the linearized intervals to the constraints' entries
        vectors   what the estimate decides: gradient, lower and upper bounds
        judge     an answer to its residual and to its motion at the knots

        and of the task's own costs, where there are any:

        weigh     the guess to their curvature and slope at the nodes, and to their rows
        square    the curvature to the Hessian's entries
        """
        common = [self._assemble(), self._vectors(), self._judge(knots)]
        return common if self.costs is None else [*common, self._weigh(), self._square()]

    def _weigh(self) -> ca.Function:
        """x (2n, N+1): the guess; time_s (1, N+1) of the task at the nodes; to curvature
        (2n, 2n(N+1)) and slope (2n, N+1), and after the first node to the rows' values (r, N) and
        slopes (r, 2nN)."""
        assert self.costs is not None
        nodes, p = self.intervals + 1, self._parameters()
        x, time_s = ca.MX.sym("x", 2 * self.n, nodes), ca.MX.sym("time_s", 1, nodes)
        share = ca.DM(np.linspace(0, 1, nodes)).T
        every = self.costs.function.map("every", "serial", nodes, [3], [])
        curvature, slope = every(x, time_s, share, p["costs"])
        inputs = {"x": x, "time_s": time_s, "parameters": self._vector}
        outputs = {"curvature": curvature, "slope": slope}
        if self.kept:
            later = self.costs.kept.map("later", "serial", self.intervals, [3], [])
            kept, kept_slope = later(x[:, 1:], time_s[:, 1:], share[:, 1:], p["costs"])
            outputs |= {"kept": kept, "kept_slope": kept_slope}
        return named_function("weigh", inputs, outputs)

    def _square(self) -> ca.Function:
        """curvature, and the entries' constant and scale, to all entries of the Hessian."""
        rows, columns = self._curvature_entries()
        place = self.hessian.copy()  # of the entries' numbers
        place.data[:] = np.arange(1, len(place.data) + 1)
        # Of each entry the row within its block: curvature has the blocks side by side.
        source = ca.MX.sym("curvature", 2 * self.n, 2 * self.n * (self.intervals + 1))
        constant = ca.MX.sym("square_constant", len(self.hessian.data))
        scale = ca.MX.sym("square_scale", len(self.hessian.data))
        at = (np.asarray(place[rows, columns]).ravel().astype(int) - 1).tolist()
        taken = (rows % (2 * self.n) + 2 * self.n * columns).tolist()
        entries = ca.MX(constant)
        entries[at] = constant[at] + scale[at] * ca.vec(source)[taken]
        inputs = {"curvature": source, "square_constant": constant, "square_scale": scale}
        return named_function("square", inputs, {"square_entries": entries})

    def _assemble(self) -> ca.Function:
        """a, b0, b1 (intervals side by side), the task's own rows, constant and scale of the
        entries to all entries."""
        n, count = self.n, self.intervals
        a, b0, b1 = self._linearized()
        # The generated code has them column by column; in the list they stand row by row.
        of_a = np.arange(a.numel()).reshape(count, 2 * n, 2 * n).transpose(0, 2, 1)
        of_b = np.arange(b0.numel()).reshape(count, n, 2 * n).transpose(0, 2, 1)[:, :, self.driven]
        parts = (0, of_a), (a.numel(), of_b), (a.numel() + b0.numel(), of_b)
        of_dynamics = np.hstack([(first + part).reshape(count, -1) for first, part in parts])
        _, kept_slope = self._own_rows()
        own_scale = self._own_scale(kept_slope)
        own = own_scale @ self._each_node().T * kept_slope, -own_scale
        first, k = a.numel() + b0.numel() + b1.numel(), self.kept
        of_slope = np.arange(own[0].numel()).reshape(count, 2 * n, k).transpose(0, 2, 1)
        of_slack = own[0].numel() + np.arange(own[1].numel())
        of_own = np.hstack([of_slope.reshape(count, -1), of_slack.reshape(count, -1)])
        source = np.append(of_dynamics.ravel(), first + of_own.ravel()).tolist()
        constant = ca.MX.sym("constant", len(self.constraints.data))
        scale = ca.MX.sym("scale", len(source))
        blocks = ca.vertcat(ca.vec(a), ca.vec(b0), ca.vec(b1), *map(ca.vec, own))
        entries = ca.MX(constant)
        entries[self._linearized_place.tolist()] = scale * blocks[source]
        inputs = {
            "a": a, "b0": b0, "b1": b1, "kept_slope": kept_slope, "constant": constant,
            "scale": scale, "parameters": self._vector,
        }  # fmt: skip
        return named_function("assemble", inputs, {"entries": entries})

    def _vectors(self) -> ca.Function:
        """x, u: the guess; after: linearized along it, for the disturbance `assumed`; start (2n,):
        the state at the commit knot, d: the disturbance; reference (2n, N+1); committed, holding
        (n,): the torques that the plan should begin and end with; ending (w,): speeds of the driven
        axes at the end, zero but for a restoration. To the vectors, and to the torque (n, N+1)
        around which they are.
        """
        n, w, count, p = self.n, len(self.driven), self.intervals, self._parameters()
        driven, moved = self.driven, [n + axis for axis in self.driven]
        (x, linearized), after = self._nodes(), ca.MX.sym("after", 2 * n, count)
        start, reference = ca.MX.sym("start", 2 * n), ca.MX.sym("reference", 2 * n, count + 1)
        assumed, d = ca.MX.sym("assumed", n), ca.MX.sym("d", n)
        committed, holding = ca.MX.sym("committed", n), ca.MX.sym("holding", n)
        ending = ca.MX.sym("ending", w)

        # The same motion under another disturbance takes as much less torque: nothing else changes.
        u = (linearized - (d - assumed))[driven, :]
        q, v, speed = x[:n, :], x[n:, :], x[moved, :]
        equal = (
            start - x[:, 0],
            ca.vec(after - x[:, 1:]),
            ca.vec(ca.horzcat(ending, ending) - speed[:, -2:]),
        )
        all_along = ca.DM.ones(1, count)
        fastest, surge = self._between(q[driven, :], speed)
        pairs = (
            (u, p["torque"]),
            (fastest, p["velocity"] @ all_along),
            (surge, p["surge"] @ all_along),
        )
        soft_min, soft_max = self._soft_limits(p, start[:n])
        ahead = q + v * p["approach_s"]
        soft = soft_max - ahead, ahead - soft_min
        kept, kept_slope = self._own_rows()
        room = [
            *(ca.vec(side[self.bounded.tolist(), 1:]) for side in soft),
            -ca.vec(kept * self._own_scale(kept_slope)),
        ]
        lower = [*equal, *(ca.vec(-limit - value) for value, limit in pairs)]
        upper = [*equal, *(ca.vec(limit - value) for value, limit in pairs), *room]
        free = ca.DM.ones(sum(side.numel() for side in room)) * -UNBOUNDED

        clipped = ca.fmin(ca.fmax(reference[:n, :], soft_min), soft_max)
        still = ca.if_else(clipped == reference[:n, :], reference[n:, :], 0)
        error = (x - ca.vertcat(clipped, still)) * p["state_weight"] * _rows(p["weight"], 2 * n)
        ends = ca.horzcat(
            u[:, 0] - committed[driven], ca.MX(w, count - 2), u[:, -2:] - holding[driven]
        )
        step = (u[:, 1:] - u[:, :-1]) * _rows(self._smoothness(p["weight"][1:]), w)
        none = ca.MX(w, 1)
        steps = ca.horzcat(none, step) - ca.horzcat(step, none) + TORQUE_FLOOR * u
        torque = steps * p["step_weight"] + ends * p["start_weight"]
        slope = ca.MX.sym("slope", 2 * n, 0 if self.costs is None else count + 1)
        own = ca.MX(error.shape[0], error.shape[1]) if self.costs is None else slope
        slacks = ca.MX(self.size - self.slacks.start, 1)
        gradient = ca.vertcat(ca.vec(2 * error + own), 2 * ca.vec(torque), slacks)
        inputs = {
            "x": x, "u": linearized, "after": after, "assumed": assumed,
            "start": start, "d": d, "reference": reference, "committed": committed,
            "holding": holding, "ending": ending, "slope": slope, "kept": kept,
            "kept_slope": kept_slope, "parameters": self._vector,
        }  # fmt: skip
        outputs = {
            "gradient": gradient * p["column_scale"],
            "lower": ca.vertcat(ca.vertcat(*lower) * p["row_scale"][: self._soft_row], free),
            "upper": ca.vertcat(*upper) * p["row_scale"],
            "around": among(u, driven, n),
        }
        return named_function("vectors", inputs, outputs)

    def _judge(self, knots: int) -> ca.Function:
        """z: an answer; x, around, a, b0, b1, kept, lower, upper as above; to its residual, and to
        position, velocity and torque at the knots (n, K+1); passive axes have no torque.

        The residual is the largest violation of any constraint but the soft ones, in parts of its
        tolerance: up to one is good. It is evaluated on the blocks, not on the solver's matrix.
        """
        n, w, count, p = self.n, len(self.driven), self.intervals, self._parameters()
        (x, _), (a, b0, b1) = self._nodes(), self._linearized()
        around, z = ca.MX.sym("around", n, count + 1), ca.MX.sym("z", self.size)
        rows, own = self._soft_row, self._own_rows()
        lower, upper = ca.MX.sym("lower", self.rows), ca.MX.sym("upper", self.rows)
        driven, u, unscaled = self.driven, around[self.driven, :], z * p["column_scale"]
        dx = ca.reshape(unscaled[self.states], 2 * n, count + 1)
        du = ca.reshape(unscaled[self.torques], w, count + 1)
        intervals = zip(
            *(ca.horzsplit(part, 2 * n if part is a else n) for part in (a, b0, b1)), strict=True
        )
        defects = [
            dx[:, i + 1]
            - a_i @ dx[:, i]
            - b0_i[:, driven] @ du[:, i]
            - b1_i[:, driven] @ du[:, i + 1]
            for i, (a_i, b0_i, b1_i) in enumerate(intervals)
        ]
        dq, dv = dx[driven, :], dx[[n + axis for axis in driven], :]
        value = ca.vertcat(
            dx[:, 0], *defects, ca.vec(dv[:, -2:]), ca.vec(du),
            *map(ca.vec, self._between(dq, dv)),
        )  # fmt: skip
        scale = p["row_scale"][:rows]
        excess = ca.fmax(lower[:rows] / scale - value, value - upper[:rows] / scale)
        state = ca.vertcat(ca.DM.ones(n) * POSITION_TOLERANCE, ca.DM.ones(n) * VELOCITY_TOLERANCE)
        torques = ca.vec(TORQUE_TOLERANCE_SHARE * p["effort"] @ ca.DM.ones(1, count + 1))
        others = ca.DM.ones(rows - self.equalities - w * (count + 1)) * VELOCITY_TOLERANCE
        rest = ca.DM.ones(2 * w) * VELOCITY_TOLERANCE
        tolerance = ca.vertcat(ca.repmat(state, count + 1), rest, torques, others)
        residual = ca.mmax(excess / tolerance)

        along = Interpolation(count, knots // count, self.interval_s)
        position, velocity = along.states(x[:n, :] + dx[:n, :], x[n:, :] + dx[n:, :])
        limit = p["torque"][:, 0] @ ca.DM.ones(1, knots + 1)
        # The spline may swing beyond its nodes.
        torque = among(ca.fmin(ca.fmax(along.torques(u + du), -limit), limit), driven, n)
        inputs = {
            "z": z, "x": x, "around": around, "a": a, "b0": b0, "b1": b1, "kept": own[0],
            "kept_slope": own[1], "lower": lower, "upper": upper, "parameters": self._vector,
        }  # fmt: skip
        # The largest of numbers hides one that is not a number; their sum does not.
        judged = ca.vertcat(residual, ca.sum1(ca.vertcat(value, *map(ca.vec, own))))
        outputs = {
            "residual": judged, "position": position, "velocity": velocity, "torque": torque,
        }  # fmt: skip
        return named_function("judge", inputs, outputs)

    def _nodes(self) -> tuple[Any, Any]:
        """The guess: x (2n, N+1) and u (n, N+1)."""
        n, nodes = self.n, self.intervals + 1
        return ca.MX.sym("x", 2 * n, nodes), ca.MX.sym("u", n, nodes)

    def _linearized(self) -> tuple[Any, Any, Any]:
        """a (2n, 2nN), b0 and b1 (2n, nN): the intervals side by side."""
        n, count = self.n, self.intervals
        widths = {"a": 2 * n * count, "b0": n * count, "b1": n * count}
        a, b0, b1 = (ca.MX.sym(name, 2 * n, width) for name, width in widths.items())
        return a, b0, b1

    def _own_rows(self) -> tuple[Any, Any]:
        """Of what the task keeps below, after the first node: values (r, N) and slopes (r, 2nN)."""
        rows, count = self.kept, self.intervals
        return ca.MX.sym("kept", rows, count), ca.MX.sym("kept_slope", rows, 2 * self.n * count)

    def _own_scale(self, kept_slope: Any) -> Any:
        """Of these rows in OSQP's program, (r, N): as of soft limits half-way to the states' own
        scale, by the row's own slope, so that it goes with its weight; one at the most. Found by
        trying, with weights from 1 to 1e8 on a wall before an arm: 5 to 9 of 36 programs need more
        than 150 iterations, 5 without the wall, and 28 with the weight of 1e8 and a scale of 1."""
        column_scale = self._parameters()["column_scale"][: 2 * self.n]
        scaled = kept_slope * _rows(ca.repmat(column_scale, self.intervals), self.kept)
        half = ca.sum1(column_scale[: self.n]) / self.n
        return ca.sqrt(half / (half + scaled**2 @ self._each_node()))

    def _each_node(self) -> Any:
        """(2nN, N): sums over a node's states."""
        return ca.DM(sp.csc_matrix(sp.kron(sp.eye_array(self.intervals), np.ones((2 * self.n, 1)))))

    def _parameters(self) -> dict[str, Any]:
        """By name, as expressions of `_vector`."""
        shapes = [value.shape for value in self._values.values()]
        sizes = np.cumsum([0, *(int(np.prod(shape)) for shape in shapes)]).tolist()
        parts = ca.vertsplit(self._vector, sizes)
        return {
            name: ca.reshape(part, *shape)
            for name, part, shape in zip(self._values, parts, shapes, strict=True)
        }

    def _between(self, q: Any, v: Any) -> list[Any]:
        """Of each interval the speed half-way, and h times the acceleration where it begins, (w, N)
        each."""
        moved = q[:, 1:] - q[:, :-1]
        return [
            lever * moved + begins * v[:, :-1] + ends * v[:, 1:]
            for lever, begins, ends in self.cubic
        ]

    @staticmethod
    def _smoothness(weight: Any) -> Any:
        """Of the torque's step into each node: more where tracking has faded out."""
        return 1 + STOP_SMOOTHNESS * (1 - weight)

    def _soft_limits(self, p: dict[str, Any], position: Any) -> tuple[Any, Any]:
        """Soft position limits at the nodes, (n, N+1) each: outside of them the way back in is an
        exponential from where the machine is. Infinite on continuous axes."""
        time_s = np.arange(self.intervals + 1) * self.interval_s
        fade = ca.DM(np.exp(-time_s / RETURN_S)).T
        low, high = p["soft_min"], p["soft_max"]
        all_along = ca.DM.ones(1, self.intervals + 1)
        return (
            low @ all_along + ca.fmin(position - low, 0) @ fade,
            high @ all_along + ca.fmax(position - high, 0) @ fade,
        )


class Interpolation:
    """From nodes (n, N+1) to knots (n, K+1): cubic Hermite for states; for torques the C2 cubic
    spline, which a track can represent, running out flat into the last interval, where the machine
    rests."""

    def __init__(self, intervals: int, stride: int, interval_s: float) -> None:
        nodes, s = np.arange(intervals + 1), np.arange(intervals * stride + 1) / stride
        hermite = [
            CubicHermiteSpline(nodes, *values)
            for values in (
                (np.eye(intervals + 1), np.zeros((intervals + 1, intervals + 1))),
                (np.zeros((intervals + 1, intervals + 1)), np.eye(intervals + 1)),
            )
        ]
        by_q, by_v = ((basis(s), basis(s, 1)) for basis in hermite)
        flat = CubicSpline(
            nodes[:-1], np.eye(intervals, intervals + 1), bc_type=("natural", "clamped")
        )
        self._position = _sparse(by_q[0]), _sparse(by_v[0] * interval_s)
        self._velocity = _sparse(by_q[1] / interval_s), _sparse(by_v[1])
        self._torque = _sparse(flat(np.minimum(s, intervals - 1)))

    def states(self, q: Any, v: Any) -> tuple[Any, Any]:
        """Positions and velocities at the knots."""
        (pq, pv), (vq, vv) = self._position, self._velocity
        return q @ pq + v @ pv, q @ vq + v @ vv

    def torques(self, u: Any) -> Any:
        """Torques at the knots."""
        return u @ self._torque


def _rows(column: Any, count: int) -> Any:
    """A column as so many equal rows."""
    return ca.repmat(column.T, count, 1)


def _power_of_two(values: Array) -> Array:
    """The nearest."""
    return np.exp2(np.round(np.log2(values)))


def _sparse(basis: Array) -> Any:
    """Of (K+1, N+1) values what is not zero, turned: to be multiplied with from the right."""
    return ca.DM(sp.csc_matrix(np.where(np.abs(basis) < 1e-15, 0, basis).T))
