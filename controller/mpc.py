"""One tick of model predictive control: from the estimate at the commit knot to a plan."""

from __future__ import annotations

import signal
import time
from dataclasses import dataclass

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from headway.configs.schema import Config
from headway.controller.estimator import Estimate
from headway.controller.ocp import Limits, Ocp
from headway.controller.prediction import Prediction

Array = NDArray[np.float64]

SANE_MAX = 1e6  # OSQP marks failure with 2143289344.0, which is finite


@dataclass(frozen=True)
class Motion:
    """A planned motion at the knots of the horizon: (K+1, n) each, SI; ends at rest."""

    position: Array
    velocity: Array
    torque: Array  # of the motors


@dataclass(frozen=True)
class Solution:
    """What the solver did; `motion` is None where its answer is not to be used."""

    motion: Motion | None
    status: int  # OSQP's own
    iterations: int
    residual: float
    linearize_us: float  # wall clock, for the record only
    solve_us: float


class Mpc:
    """Solves the optimal control problem once a tick, warm-started."""

    def __init__(self, config: Config, prediction: Prediction) -> None:
        self._ocp = ocp = Ocp(config, Limits.of(config))
        self._prediction = prediction
        self._knots = config.mpc.horizon_us // config.loop.knot_us
        self._stride = self._knots // config.mpc.intervals
        self._interpolate = _Interpolation(config.mpc.intervals, self._stride, ocp.interval_s)
        self._solver = osqp.OSQP()
        self._solver.setup(
            ocp.hessian,
            ocp.gradient,
            ocp.constraints,
            ocp.lower,
            ocp.upper,
            eps_abs=1e-4,  # in scaled units: 1e-4 mrad
            eps_rel=1e-4,
            scaling=0,  # the problem is scaled already
            max_iter=config.mpc.max_iterations,
            check_termination=10,
            adaptive_rho=True,
            adaptive_rho_interval=25,  # in iterations: the same on every machine
            polishing=False,
            verbose=False,
            warm_starting=True,
        )
        self._idle = np.zeros(ocp.size)

    def solve(
        self, guess: Motion, start: Estimate, reference: Array, committed_torque: Array
    ) -> Solution:
        """A motion from `start` on.

        guess: the motion to linearize along, at the knots from the commit knot on; reference:
        (N+1, 2n) states at the nodes; committed_torque: (n,) motor torque at the commit knot.
        """
        began = time.perf_counter()
        ocp, n = self._ocp, self._ocp.n
        x = np.hstack((guess.position, guess.velocity))[:: self._stride]
        u = guess.torque[:: self._stride]
        disturbance = start.z[2 * n :]
        linearized = self._linearize(x, u, disturbance)
        holding = self._prediction.holding(x[-1, :n], disturbance)
        clipped = np.clip(reference[:, :n], *ocp.soft_limits(start.z[:n]))
        still = np.where(clipped == reference[:, :n], reference[:, n:], 0.0)
        target = np.hstack((clipped, still))
        ocp.update(x, u, linearized, start.state(n), target, committed_torque, holding)
        assembled = time.perf_counter()
        z, status, iterations = self._run_solver()
        solved = time.perf_counter()
        residual, motion = np.inf, None
        if z is not None:
            residual = ocp.residual(z)
            if residual <= 1.0:
                motion = self._motion(x, u, z)
        split = (assembled - began) * 1e6, (solved - assembled) * 1e6
        return Solution(motion, status, iterations, residual, *split)

    def _linearize(self, x: Array, u: Array, disturbance: Array) -> list[Array]:
        call = self._prediction.linearize
        call.inputs[0][...] = x[:-1].T
        call.inputs[1][...] = u[:-1].T
        call.inputs[2][...] = u[1:].T
        call.inputs[3][:, 0] = disturbance
        call.inputs[4][0, 0] = self._ocp.interval_s
        return call.run()

    def _run_solver(self) -> tuple[Array | None, int, int]:
        """The QP's answer, or None where the flag or the numbers are bad (design, invariant 8);
        OSQP's status and its iterations."""
        ocp = self._ocp
        self._solver.update(q=ocp.gradient, l=ocp.lower, u=ocp.upper, Ax=ocp.constraints.data)
        self._solver.warm_start(x=self._idle)
        result = self._solver.solve(raise_error=False)
        if result.info.status_val == osqp.SolverStatus.OSQP_SIGINT:
            signal.raise_signal(signal.SIGINT)  # OSQP caught a Ctrl-C that is not for it
        good = result.info.status_val in (
            osqp.SolverStatus.OSQP_SOLVED,
            osqp.SolverStatus.OSQP_SOLVED_INACCURATE,
            osqp.SolverStatus.OSQP_MAX_ITER_REACHED,  # the residual below decides
        )
        z = result.x
        usable = good and bool(np.all(np.isfinite(z))) and float(np.max(np.abs(z))) < SANE_MAX
        return (z if usable else None), int(result.info.status_val), int(result.info.iter)

    def _motion(self, x: Array, u: Array, z: Array) -> Motion:
        n, ocp = self._ocp.n, self._ocp
        z = z * ocp.column_scale
        nodes = x + z[ocp.states].reshape(-1, 2 * n)
        torques = u + z[ocp.torques].reshape(-1, n)
        position, velocity = self._interpolate.states(nodes[:, :n], nodes[:, n:])
        limit = ocp.limits.torque[0]  # the spline may swing beyond its nodes
        torque = np.clip(self._interpolate.torques(torques), -limit, limit)
        return Motion(position, velocity, torque)


class _Interpolation:
    """From nodes to knots: cubic Hermite for states; for torques the C2 cubic spline, which a track
    can represent, running out flat into the last interval, where the machine rests."""

    def __init__(self, intervals: int, stride: int, interval_s: float) -> None:
        s = np.arange(stride) / stride
        self._value = np.stack(
            [(1 + 2 * s) * (1 - s) ** 2, s * (1 - s) ** 2, s**2 * (3 - 2 * s), s**2 * (s - 1)]
        )
        self._slope = np.stack(
            [6 * s * (s - 1), (1 - s) * (1 - 3 * s), 6 * s * (1 - s), s * (3 * s - 2)]
        )
        self._h = interval_s
        nodes = np.arange(intervals)
        spline = CubicSpline(
            nodes, np.eye(intervals, intervals + 1), bc_type=("natural", "clamped")
        )
        knots = np.arange(intervals * stride + 1) / stride
        self._spline: Array = spline(np.minimum(knots, intervals - 1))

    def states(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Positions and velocities at the knots."""
        corners = np.stack([q[:-1], self._h * v[:-1], q[1:], self._h * v[1:]])
        position = np.einsum("cs,cin->isn", self._value, corners).reshape(-1, q.shape[1])
        velocity = np.einsum("cs,cin->isn", self._slope / self._h, corners).reshape(-1, q.shape[1])
        return np.vstack((position, q[-1])), np.vstack((velocity, v[-1]))

    def torques(self, u: Array) -> Array:
        """Torques at the knots."""
        return self._spline @ u
