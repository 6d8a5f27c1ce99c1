"""Our two backends as contenders."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grid.reply import Reply, Watch
from headway.configs.schema import Config
from headway.controller.prediction import Prediction
from headway.controller.program import Program
from headway.models.machine import Machine

Array = NDArray[np.float64]


class Ours:
    """A backend, without encoding: acados has no tracks to make."""

    def __init__(self, config: Config, machine: Machine) -> None:
        self.program = Program(config, Prediction.of(config, machine))
        self._solved = 1 if config.mpc.backend == "osqp" else 0

    def close(self) -> None:
        """Nothing to end."""

    def prepare(
        self, x: Array, u: Array, d: Array, reference: Array, committed: Array, holding: Array
    ) -> None:
        """All that is known before the state."""
        self._known = d, reference, committed, holding
        with Watch() as self._preparation:
            self.program.prepare(x, u, d)
        with Watch() as self._linearize:  # once more: the same from the same
            self.program.linearize.bound.run()

    def feedback(self, start: Array) -> Reply:
        """The state (2n,) has come."""
        with Watch() as watch:
            done = self.program.feedback(start, *self._known)
        x, u = self.program.answer()
        good = done.status == self._solved and done.accepted
        reply = Reply(x, u, good, done.iterations)
        for name, of in (
            ("linearize", self._linearize), ("prepare", self._preparation), ("feedback", watch),
        ):  # fmt: skip
            reply.cpu[name], reply.wall[name] = of.cpu, of.wall
        if not done.accepted:
            reply.x, reply.u = self.program.pool["x"].copy(), self.program.pool["u"].copy()
        return reply
