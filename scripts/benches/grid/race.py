"""Closed loops side by side, tick by tick, so that what disturbs one disturbs all."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from grid.reply import Reply
from grid.world import Problem, World
from headway.configs.section import by_axis
from headway.controller.ocp import ACCELERATION_SHARE, SPEED_SHARE, Limits

Array = NDArray[np.float64]


class Contender(Protocol):
    """Who solves the problem."""

    def prepare(
        self, x: Array, u: Array, d: Array, reference: Array, committed: Array, holding: Array
    ) -> None: ...
    def feedback(self, start: Array) -> Reply: ...
    def close(self) -> None: ...


@dataclass
class Lane:
    """A contender in its closed loop."""

    contender: Contender
    problem: Problem
    intervals: int
    knots: int
    seed: int
    measured: int | None = None  # intervals of the grid whose costs are counted; None: SHIPPED
    replies: list[Reply] = field(default_factory=list)
    costs: list[float] = field(default_factory=list)
    over: list[Array] = field(default_factory=list)  # by how much a plan is beyond limits
    active: int = 0  # ticks whose plan touches a limit

    def __post_init__(self) -> None:
        config = self.problem.config(self.intervals, self.knots)
        self.world = World(config, self.problem.machine(), self.seed)
        self._limits, n, mpc = Limits.of(config), len(self.world.q), config.mpc
        self._driven = list(config.machine.driven)
        self._node_s = np.linspace(0, mpc.horizon_us * 1e-6, self.intervals + 1)
        # The same measure for all grids of a problem.
        measured = self.measured or SHIPPED
        shipped = self.problem.config(measured, self.knots).mpc
        self._weight = np.concatenate(
            (by_axis(shipped.position_weight, n), by_axis(shipped.velocity_weight, n))
        )
        self._step_weight = np.array(by_axis(shipped.torque_step_weight, n))
        self._steps = self.knots / measured  # ticks in an interval of it
        q = self.world.q
        self._x = np.tile(np.concatenate((q, np.zeros(n)))[:, None], self.intervals + 1)
        self._u = np.tile(self.world.holding(q)[:, None], self.intervals + 1)

    def tick(self) -> None:
        """One tick of one contender."""
        world, n = self.world, len(self.world.q)
        world.advance_tasks()
        reference = world.wanted(self._node_s)
        holding = world.holding(self._x[:n, -1]) - world.d
        committed = self._u[:, 0].copy()
        self.contender.prepare(self._x, self._u, world.d, reference, committed, holding)
        state = world.measured()
        reply = self.contender.feedback(state)
        self.replies.append(reply)
        self._judge(reply, reference[:, 0], committed)
        self._shift(reply)
        world.move(state, reply.u[:, 0], self._u[:, 0])
        world.observe(world.measured())

    def _shift(self, reply: Reply) -> None:
        """The plan a tick on is the next guess."""
        n, at = len(self.world.q), np.minimum(self._node_s + self.world.tick_s, self._node_s[-1])
        spline = CubicHermiteSpline(self._node_s, reply.x[:n], reply.x[n:], axis=1)
        self._x = np.vstack((spline(at), spline(at, 1)))
        self._u = np.array([np.interp(at, self._node_s, row) for row in reply.u])

    def _judge(self, reply: Reply, reference: Array, committed: Array) -> None:
        world, limits, n = self.world, self._limits, len(self.world.q)
        error = np.concatenate((world.q, world.v)) - reference
        step = (reply.u[:, 0] - committed) * self._steps
        self.costs.append(float(error**2 @ self._weight + step**2 @ self._step_weight))
        x, u, h = reply.x, reply.u[self._driven], self._node_s[1] - self._node_s[0]
        v = x[n:][self._driven]
        # The machine's own limits, of which a plan may have a share.
        fastest = limits.velocity[:, None] / SPEED_SHARE
        most = limits.acceleration[:, None] * h / ACCELERATION_SHARE
        # Of the cubic from node to node, once it is free: speeds half-way; h times accelerations.
        lever, begins, ends = np.diff(x[:n][self._driven])[:, 1:] * 6 / h, v[:, 1:-1], v[:, 2:]
        half_way = (lever - begins - ends) / 4
        speed = np.abs(np.hstack((v[:, 1:], half_way))) / fastest
        acceleration = np.abs(lever - 4 * begins - 2 * ends) / most
        ahead = x[:n] + limits.approach_s[:, None] * x[n:]
        beyond = np.maximum(ahead - limits.soft_max[:, None], limits.soft_min[:, None] - ahead)
        self.over.append(np.array([
            (np.abs(u) / limits.torque.T).max() - 1,
            speed.max() - 1,
            acceleration.max() - 1,
            beyond[:, 1:].max(),
            np.abs(v[:, -2:]).max(),
        ]))  # fmt: skip
        self.active += bool(
            (np.abs(u) > 0.999 * limits.torque.T).any()
            or (speed > 0.999 * SPEED_SHARE).any()
            or (acceleration > 0.999 * ACCELERATION_SHARE).any()
            or (beyond[:, 1:] > -1e-4).any()
        )


SHIPPED = 24  # intervals of the shipped configs, nearly: 8.192 ms each


def race(lanes: dict[str, Lane], ticks: int) -> None:
    """All lanes, each tick another one first."""
    names = list(lanes)
    for tick in range(ticks):
        for i in range(len(names)):
            lanes[names[(tick + i) % len(names)]].tick()
