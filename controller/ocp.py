"""The optimal control problem of one tick as a quadratic program for OSQP.

Real-time iteration (Diehl, Bock, Schloeder, SIAM J. Control Optim. 43, 2005): the dynamics are
linearized along the trajectory that the last tick's encoded tracks give, and one QP is solved in
the deviations from it. Variables: states x_0..x_N (2n each), motor torques u_0..u_N at the nodes (n
each; linear in between), one slack per axis for the soft position limits, of which a continuous
axis has none.

    minimize    sum w_i |x_i - ref_i|^2_Q + |u_{i+1} - u_i|^2_S + |u_0 - committed|^2_R
                + sum over the last two nodes |u_i - holding|^2_R + soft |s|^2
    subject to  x_0 = estimate at the commit knot
                x_{i+1} = F(x_i, u_i, u_{i+1}, d)        linearized
                v_{N-1} = v_N = 0                        rest at the end
                |u| <= limit, |v| <= limit, |v_{i+1} - v_i| <= limit
                soft_min - s <= q + T v <= soft_max + s, with T by axis
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from headway.configs.schema import Config
from headway.configs.section import by_axis

Array = NDArray[np.float64]

TORQUE_SHARE = 0.99  # of the torque limit is planned at first: the rest is for the encoding
HULL_SHARE = 0.85  # of the gate's speed and acceleration limits: control points exceed the nodes
# A soft limit is approached no faster than its distance over this time, or over a longer one: a
# machine that brakes later than the model thinks then still stops short of it (a linear barrier:
# Ames et al., "Control barrier functions: theory and applications", 2019).
APPROACH_S = 0.1
STOP_SHARE = 0.8  # of the stop deceleration, with which a plan could stop anywhere
RETURN_S = 0.4  # time constant of the way back into the soft limits
# What a plan keeps to a position limit: what the model does not know goes there.
ROOM = {"rad": 4e-3, "m": 4e-4}
UNBOUNDED = 1e20
# A plan whose constraints hold within these is believed: rad or m, and per second; torques within a
# share of their limit.
POSITION_TOLERANCE, VELOCITY_TOLERANCE, TORQUE_TOLERANCE_SHARE = 3e-4, 1e-2, 5e-3
STOP_SMOOTHNESS = 20.0  # times the torque step weight, where tracking has faded out


@dataclass(frozen=True)
class Limits:
    """By axis; SI."""

    torque: Array  # (N+1, n), by node
    velocity: Array
    acceleration: Array
    soft_min: Array  # without bounds on continuous axes
    soft_max: Array
    approach_s: Array  # T

    @classmethod
    def of(cls, config: Config) -> Limits:
        """The plan's limits: shares of the device's, and the soft position limits."""
        axes, mpc = config.machine.axes, config.mpc
        low = [a.lowest if a.soft_min is None else a.soft_min for a in axes]
        high = [a.highest if a.soft_max is None else a.soft_max for a in axes]
        room = np.array([ROOM[a.unit] for a in axes])
        # Nearly all of the torque at the plan's start, less from its middle on: what is kept back
        # lets the next ticks correct what went wrong (constraint tightening: Chisci, Rossiter,
        # Zappa, Automatica 37, 2001).
        ramp = np.clip(2 * np.linspace(0, 1, mpc.intervals + 1), 0, 1)
        shares = TORQUE_SHARE + (mpc.torque_share_end - TORQUE_SHARE) * ramp
        velocity = HULL_SHARE * np.array([a.velocity_limit for a in axes])
        # T v <= room and v <= 2 a T give the gate's v^2 <= 2 a room: T is such that the second
        # holds up to the fastest plan, with a share of the a that the gate counts on. An axis with
        # soft limits at both ends has the way beyond them to stop on.
        stop = STOP_SHARE * np.array([a.deceleration for a in axes])
        soft = [a.soft_min is not None and a.soft_max is not None for a in axes]
        approach_s = np.where(soft, APPROACH_S, np.maximum(APPROACH_S, velocity / (2 * stop)))
        return cls(
            np.outer(shares, [a.effort_limit for a in axes]),
            velocity,
            HULL_SHARE * np.array([a.acceleration_limit for a in axes]),
            np.array(low) + room,
            np.array(high) - room,
            approach_s,
        )


class Ocp:
    """The QP's matrices, whose sparsity never changes, and its vectors, tick by tick."""

    def __init__(self, config: Config, limits: Limits) -> None:
        mpc = config.mpc
        n = self.n = len(config.machine.axes)
        self._bounded = np.flatnonzero([not axis.continuous for axis in config.machine.axes])
        count = self.intervals = mpc.intervals
        self.limits = limits
        self.interval_s = mpc.horizon_us * 1e-6 / count
        self.states = slice(0, (count + 1) * 2 * n)
        self.torques = slice(self.states.stop, self.states.stop + (count + 1) * n)
        self.slacks = slice(self.torques.stop, self.torques.stop + n)
        self.size = self.slacks.stop
        share = np.linspace(0, 1, count + 1)
        fade = (mpc.fade_end - share) / (mpc.fade_end - mpc.fade_start)
        self._weight = np.clip(fade, 0, 1) ** 2
        weights = by_axis(mpc.position_weight, n), by_axis(mpc.velocity_weight, n)
        self._state_weight = np.concatenate(weights)
        self._start_weight = np.array(by_axis(mpc.torque_start_weight, n))
        self._soft_weight = np.maximum(by_axis(mpc.soft_weight, n), 1.0)
        step_weight = np.array(by_axis(mpc.torque_step_weight, n))
        self.hessian = self._build_hessian(step_weight)
        torque = np.array([a.effort_limit for a in config.machine.axes])
        self._build_constraints(torque)
        self._scale(torque)

    def _scale(self, torque: Array) -> None:
        """Variables in units of one over the root of their weight (torques: their limit), rows of
        the dynamics likewise. Found by trying: OSQP then needs 30 to 70 iterations without a
        scaling of its own, where it stops at 200 with it."""
        n, nodes = self.n, self.intervals + 1
        state = 1 / np.sqrt(np.maximum(self._state_weight, 1.0))
        slack = 1 / np.sqrt(self._soft_weight)
        self.column_scale = np.concatenate((np.tile(state, nodes), np.tile(torque, nodes), slack))
        self._row_scale = np.ones(self.rows)
        self._row_scale[: 2 * n * nodes] = 1 / np.tile(state, nodes)
        self._row_scale[2 * n * nodes : self.equalities] = np.tile(1 / state[n:], 2)
        # Half-way to the states' own scale: less makes an active soft limit converge slowly, more
        # slows down everything else.
        soft = APPROACH_S / self.limits.approach_s / np.sqrt(state[:n])
        self._row_scale[self._soft_row :] = np.tile(soft[self._bounded], 2 * self.intervals)
        columns = sp.diags_array(self.column_scale)
        self.hessian = sp.csc_matrix(columns @ self.hessian @ columns)
        of_column = np.repeat(np.arange(self.size), np.diff(self.constraints.indptr))
        entry_scale = self._row_scale[self.constraints.indices] * self.column_scale[of_column]
        self.constraints.data *= entry_scale
        self._dynamics_scale = entry_scale[self._dynamics_place]

    def _build_hessian(self, step_weight: Array) -> sp.csc_matrix:
        states = np.outer(self._weight, self._state_weight).ravel() + 1e-3
        shape = (self.intervals, self.intervals + 1)
        difference = sp.diags_array([-1.0, 1.0], offsets=[0, 1], shape=shape)
        smooth = sp.diags_array(1 + STOP_SMOOTHNESS * (1 - self._weight[1:]))
        ends = np.zeros(self.intervals + 1)
        ends[[0, -2, -1]] = 1.0
        steps = difference.T @ smooth @ difference + 2e-6 * sp.eye_array(self.intervals + 1)
        torques = sp.kron(steps, sp.diags_array(step_weight)) + sp.kron(
            sp.diags_array(ends), sp.diags_array(self._start_weight)
        )
        self._torque_hessian = sp.csr_matrix(2 * torques)
        slacks = sp.diags_array(self._soft_weight)
        blocks = sp.block_diag([sp.diags_array(states), torques, slacks])
        return sp.csc_matrix(sp.triu(2 * blocks))

    def _build_constraints(self, torque_limit: Array) -> None:
        """One COO entry list; entries of the dynamics are remembered to be overwritten."""
        n, count = self.n, self.intervals
        rows: list[NDArray[np.int64]] = []
        columns: list[NDArray[np.int64]] = []
        values: list[Array] = []

        def put(row: int, column: int, block: Array) -> None:
            r, c = np.nonzero(block)  # not-a-number counts
            rows.append(r + row)
            columns.append(c + column)
            values.append(block[r, c])

        def state(i: int) -> int:
            return 2 * n * i

        def torque(i: int) -> int:
            return self.torques.start + n * i

        put(0, 0, np.eye(2 * n))
        row = 2 * n
        for i in range(count):  # linearized below, in `update`
            put(row, state(i), np.full((2 * n, 2 * n), np.nan))
            put(row, torque(i), np.full((2 * n, n), np.nan))
            put(row, torque(i + 1), np.full((2 * n, n), np.nan))
            put(row, state(i + 1), np.eye(2 * n))
            row += 2 * n
        for i in (count - 1, count):
            put(row, state(i) + n, np.eye(n))
            row += n
        self._torque_row = self.equalities = row
        put(row, self.torques.start, np.eye((count + 1) * n))
        row = self._velocity_row = row + (count + 1) * n
        for i in range(1, count + 1):
            put(row, state(i) + n, np.eye(n))
            row += n
        self._acceleration_row = row
        for i in range(count):
            put(row, state(i) + n, -np.eye(n))
            put(row, state(i + 1) + n, np.eye(n))
            row += n
        self._soft_row = row
        own = np.eye(n)[self._bounded]
        for sign in (1.0, -1.0):
            for i in range(1, count + 1):
                put(row, state(i), sign * own)
                put(row, state(i) + n, sign * own * self.limits.approach_s)
                put(row, self.slacks.start, -own)
                row += len(own)
        self.rows = row
        self._tolerance = np.full(row, VELOCITY_TOLERANCE)
        states = np.arange(2 * n * (count + 1))
        self._tolerance[states[states % (2 * n) < n]] = POSITION_TOLERANCE
        self._tolerance[self._torque_row : self._velocity_row] = np.tile(
            TORQUE_TOLERANCE_SHARE * torque_limit, count + 1
        )
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
        self._dynamics_place = place[np.isnan(entries)].reshape(count, -1)
        data[np.isnan(data)] = 1.0  # anything but zero, so that the entries are kept
        self.constraints = sp.csc_matrix((data, order.indices, order.indptr), shape=order.shape)
        self.lower, self.upper = np.full(row, -UNBOUNDED), np.full(row, UNBOUNDED)
        self.gradient = np.zeros(self.size)

    def update(
        self,
        x: Array,
        u: Array,
        linearized: list[Array],
        start: Array,
        reference: Array,
        committed: Array,
        holding: Array,
    ) -> None:
        """Fills matrices and vectors around a guess.

        x: (N+1, 2n) and u: (N+1, n), the guess; linearized: [F, A, B0, B1] of `linearize`;
        start: (2n,), the state at the commit knot; reference: (N+1, 2n); committed and holding:
        (n,), the torques that the plan should begin and end with.
        """
        n, count = self.n, self.intervals
        after, a, b0, b1 = linearized
        blocks = [  # side by side as the compiled function gives them, one row an interval here
            -part.reshape(2 * n, count, -1).transpose(1, 0, 2).reshape(count, -1)
            for part in (a, b0, b1)
        ]
        dynamics = np.concatenate(blocks, axis=1)
        self.constraints.data[self._dynamics_place] = dynamics * self._dynamics_scale

        low, high, limits = self.lower, self.upper, self.limits
        low[: 2 * n] = start - x[0]
        defects = slice(2 * n, 2 * n * (count + 1))
        low[defects] = (after.T - x[1:]).ravel()
        low[defects.stop : self.equalities] = -x[-2:, n:].ravel()
        high[: self.equalities] = low[: self.equalities]
        _bound(low, high, self._torque_row, u, limits.torque)
        _bound(low, high, self._velocity_row, x[1:, n:], limits.velocity)
        change = limits.acceleration * self.interval_s
        _bound(low, high, self._acceleration_row, np.diff(x[:, n:], axis=0), change)
        soft = high[self._soft_row :].reshape(2, count, len(self._bounded))
        soft_min, soft_max = self.soft_limits(start[:n])
        ahead = x[:, :n] + limits.approach_s * x[:, n:]
        soft[0] = (soft_max - ahead)[1:, self._bounded]
        soft[1] = (ahead - soft_min)[1:, self._bounded]

        error = (x - reference) * self._state_weight * self._weight[:, None]
        self.gradient[self.states] = 2 * error.ravel()
        pull = self._torque_hessian @ u.ravel()
        pull[:n] -= 2 * self._start_weight * committed
        pull[-2 * n :] -= 2 * np.tile(self._start_weight * holding, 2)
        self.gradient[self.torques] = pull
        self.gradient *= self.column_scale
        low[: self._soft_row] *= self._row_scale[: self._soft_row]
        high *= self._row_scale

    def soft_limits(self, position: Array) -> tuple[Array, Array]:
        """Soft position limits at the nodes, (N+1, n) each: outside of them the way back in is an
        exponential from where the machine is. Infinite on continuous axes."""
        time_s = np.arange(self.intervals + 1)[:, None] * self.interval_s
        fade = np.exp(-time_s / RETURN_S)
        low, high = self.limits.soft_min, self.limits.soft_max
        return (
            low + np.minimum(position - low, 0) * fade,
            high + np.maximum(position - high, 0) * fade,
        )

    def residual(self, z: Array) -> float:
        """Largest violation of any constraint but the soft ones by scaled variables z, in parts of
        its tolerance: up to one is good."""
        value = self.constraints @ z
        excess = np.maximum(self.lower - value, value - self.upper) / self._row_scale
        return float((excess / self._tolerance)[: self._soft_row].max())


def _bound(low: Array, high: Array, row: int, guess: Array, limit: Array) -> None:
    """|guess + deviation| <= limit, as rows from `row` on."""
    rows = slice(row, row + guess.size)
    low[rows] = (-limit - guess).ravel()
    high[rows] = (limit - guess).ravel()
