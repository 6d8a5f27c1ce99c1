"""One tick of model predictive control: from the estimate at the commit knot to a plan."""

from __future__ import annotations

import signal
import time
from typing import NamedTuple

import numpy as np

from headway.configs.schema import Config
from headway.controller.motion import Motion
from headway.controller.objective import Costs
from headway.controller.prediction import Prediction
from headway.controller.program import Program
from headway.controller.tracks import Encoder
from headway.devices.remote import Points, Remote
from headway.models.codegen import Array

OSQP_SIGINT = 10  # a Ctrl-C that OSQP has caught


class Solution(NamedTuple):
    """What the solver did."""

    status: int  # the solver's own
    iterations: int
    residual: float  # largest violation of a constraint, in parts of its tolerance
    stationarity: float  # the Lagrangian's largest slope, by a variable in SI; NaN: not known
    complementarity: float  # largest product of a multiplier and its constraint's distance; or NaN
    # If its answer is to be used: points by driven axis and sink, from the knot before the commit
    # knot on, and what the servos make of them.
    plan: tuple[Points, Motion] | None
    # What the record cannot tell otherwise: the disturbance that the motion was linearized for and
    # the torque that the plan goes on from, each (n,).
    assumed: Array
    committed: Array
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
        knots = config.mpc.horizon_us // config.loop.knot_us
        self._nodes = slice(None, None, knots // config.mpc.intervals)
        self.encoder = encoder
        self.program = Program(config, prediction, costs, encoder.encoding, encoder.pool)
        self._guess = Motion(np.zeros((knots + 1, 3 * prediction.n)))
        self._assumed = np.zeros(prediction.n)
        self._prepare_us = 0.0

    def prepare(self, guess: Motion, disturbance: Array, node_s: Array) -> None:
        """Linearizes along a motion that begins at the next commit knot, and factorizes.

        disturbance: (n,), as far as it is known now; node_s: (N+1,) times of the task.
        """
        began = time.perf_counter()
        self._guess, self._assumed = guess, disturbance
        nodes, states = guess.rows[self._nodes].T, 2 * len(disturbance)
        self.program.prepare(nodes[:states], nodes[states:], disturbance, node_s)
        self._prepare_us = (time.perf_counter() - began) * 1e6

    def solve(
        self,
        start: Array,
        disturbance: Array,
        reference: Array,
        committed_torque: Array,
        remotes: list[Remote],
        commit_knot: int,
        ending: Array | float = 0.0,
    ) -> Solution:
        """A plan from the commit knot on, around the motion that was prepared for it.

        start: (2n,) the state there; disturbance: (n,), as estimated by now; reference: (N+1, 2n)
        states at the nodes; committed_torque: (n,) motor torque there, zero on passive axes;
        ending: (w,) speeds of the driven axes at the end.
        """
        self.encoder.commit(remotes, commit_knot, self._guess, start, disturbance)
        ends = committed_torque, self.program.gravity - disturbance
        done = self.program.feedback(start, disturbance, reference.T, *ends, ending)
        if done.status == OSQP_SIGINT:
            signal.raise_signal(signal.SIGINT)  # OSQP caught a Ctrl-C that is not for it
        plan = (self.encoder.points(), self.encoder.rolled()) if done.accepted else None
        times = self._prepare_us, done.solve_us
        kkt = done.residual, done.stationarity, done.complementarity
        given = self._assumed, committed_torque
        return Solution(done.status, done.iterations, *kkt, plan, *given, *times)
