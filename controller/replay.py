"""A tick's quadratic program from a record: what it was linearized along, and what it was given.

The record has no matrices: what a tick was linearized along is what the servos make of the last
plan that passed, which the frames that were sent have, from the state that it began at.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from headway.controller.gains import Gains
from headway.controller.loop import plan_points
from headway.controller.motion import Motion
from headway.controller.prediction import Prediction
from headway.controller.record.reader import Run
from headway.controller.reference import ENTRY_S, Entry, own_costs, task_reference
from headway.controller.tracks import Encoder
from headway.devices.axis import AxisUnits, whole_turns
from headway.models.machine import load_machine

Array = NDArray[np.float64]


class ReplayError(Exception):
    """The record does not tell what the tick was given; says why."""


@dataclass(frozen=True)
class Given:
    """What a tick's program is made of: see Program.prepare and Program.feedback."""

    x: Array  # (2n, N+1)
    u: Array  # (n, N+1)
    assumed: Array  # (n,)
    start: Array  # (2n,)
    d: Array  # (n,)
    reference: Array  # (2n, N+1)
    committed: Array  # (n,)
    holding: Array  # (n,)
    node_s: Array  # (N+1,) times of the task


class Replay:
    """A run's ticks, counted from the task's first."""

    def __init__(self, run: Run) -> None:
        """Raises ReplayError for a run that had no programs, or whose gains the record lacks, and
        ValueError where the file of a task's own costs cannot be read any more."""
        self.config = config = run.config()
        self._arrays = run.arrays
        if not config.mpc.enabled:
            raise ReplayError("the run had no MPC: there is nothing to solve")
        if config.loop.gains != "off":
            raise ReplayError(
                f"loop.gains is {config.loop.gains}: the record does not decode gain tracks, and a "
                "program is linearized along what they do"
            )
        if not len(run.arrays["entry_us"]):
            raise ReplayError("the record has no entry onto the task: it is too old, or too short")
        machine = load_machine(Path(config.machine.model), config.machine.coupling)
        self._knot_us = config.loop.knot_us
        self._horizon = config.mpc.horizon_us // self._knot_us
        self._units = {
            i: AxisUnits.of(axis, config.loop) for i, axis in config.machine.driven.items()
        }
        self.prediction = Prediction.of(config, machine)
        gains = Gains(config, machine, plan_points(config))
        units = list(self._units.values())
        self._encoder = Encoder(self.prediction, units, gains, config.loop)
        self._task = task_reference(config, Path())
        self.costs = own_costs(self._task, machine)
        self._n = self.prediction.n

    @property
    def ticks(self) -> int:
        """So many there are."""
        return len(self._arrays["tick_us"])

    def row(self, tick: int) -> int:
        """Of the solver's channel. Raises ReplayError for a tick that solved nothing."""
        if not 0 <= tick < self.ticks:
            raise ReplayError(f"there is no tick {tick}: the run has {self.ticks}, from 0 on")
        rows = np.flatnonzero(self._arrays["solver_us"] == self._arrays["tick_us"][tick])
        if not len(rows):
            raise ReplayError(
                f"tick {tick} solved nothing: a device had been silent for too long, or its state "
                "was not known"
            )
        return int(rows[0])

    def given(self, tick: int) -> Given:
        """Of one tick. Raises ReplayError where the record does not tell."""
        row, arrays, n = self.row(tick), self._arrays, self._n
        estimate = arrays["commit_estimate"][tick]
        motion = self._guess(tick)
        nodes = slice(None, None, self._horizon // self.config.mpc.intervals)
        d = self.prediction.law.borne(estimate[2 * n :])
        gravity = self.prediction.holding(motion.position[-1], np.zeros(n))
        return Given(
            x=np.hstack((motion.position[nodes], motion.velocity[nodes])).T,
            u=motion.torque[nodes].T,
            assumed=arrays["solver_assumed"][row],
            start=estimate[: 2 * n],
            d=d,
            reference=self._reference(tick),
            committed=arrays["solver_committed"][row],
            holding=gravity - d,
            node_s=self._node_s(tick),
        )

    def _guess(self, tick: int) -> Motion:
        """The last plan that passed, from this tick's commit knot on, extended at rest."""
        arrays, commit_us = self._arrays, self._arrays["commit_us"]
        if tick and not arrays["tick_accepted"][tick - 1]:
            raise ReplayError(
                f"tick {tick} comes after one that was refused: what the machine was to make of "
                "the old plan is not in the record"
            )
        before = np.flatnonzero(arrays["tick_accepted"][:tick])
        if len(before):
            last = int(before[-1])
            motion, began_us = self._rolled(last), commit_us[last]
        else:
            rest = arrays["entry_position"][0], np.zeros(self._n), arrays["entry_torque"][0]
            motion = Motion(np.tile(np.concatenate(rest), (self._horizon + 1, 1)))
            began_us = arrays["task_start_us"][0]
        later = int(commit_us[tick] - began_us) // self._knot_us
        return motion.later(later)

    def _rolled(self, tick: int) -> Motion:
        arrays, n = self._arrays, self._n
        estimate = arrays["commit_estimate"][tick]
        first = int(arrays["commit_us"][tick]) // self._knot_us - 1
        points = [self._points(tick, axis, first, estimate[axis]) for axis in self._units]
        d = self.prediction.law.borne(estimate[2 * n :])
        return self._encoder.roll(np.array(points), estimate[: 2 * n], d)

    def _points(self, tick: int, axis: int, first: int, near: float) -> tuple[Array, Array]:
        """Of position and torque that a tick's plan has of an axis, from knot `first` on, without
        bounds: from its frame, and those that were under way already from the frames before it."""
        arrays = self._arrays
        mine = arrays["sent_plan"] & (arrays["sent_device"] == axis)
        rows = np.flatnonzero(mine & (arrays["sent_us"] <= arrays["tick_sent_us"][tick]))
        if not arrays["tick_in_time"][tick]:
            raise ReplayError(
                f"tick {tick}, whose plan comes before, was too late to send it: the record lacks "
                "its points"
            )
        points = []
        for name in ("position_pq", "torque_tq"):
            found = np.empty(0, dtype=np.int64)
            begins = first + self._horizon + 3  # of what is found
            for row in rows[::-1]:
                if begins <= first:
                    break
                knot = int(arrays["sent_first_knot"][row])
                begin, end = arrays[f"sent_{name}_offsets"][row : row + 2]
                of_frame = arrays[f"sent_{name}"][begin:end]
                if knot < begins:
                    found = np.concatenate((of_frame[: begins - knot], found))
                    begins = knot
            if begins > first:
                raise ReplayError(f"the record lacks points of the plan before, of tick {tick}")
            points.append(found[first - begins :].astype(np.int32))
        position, torque = points
        return self._units[axis].unwrapped(position, near), torque.astype(np.float64)

    def _reference(self, tick: int) -> Array:
        """At the nodes, (2n, N+1)."""
        arrays = self._arrays
        commit_us = int(arrays["commit_us"][tick])
        entered = np.flatnonzero(arrays["entry_us"] <= commit_us)[-1]
        position = arrays["entry_position"][entered]
        start_s = float(arrays["entry_start_s"][entered])
        way = position - self._task.at(np.array([start_s]))[0][0]
        turns = whole_turns(self.config.machine.axes, way)
        entry = Entry(self._task, position, start_s, ENTRY_S, turns)
        return np.hstack(entry.at(self._node_s(tick))[:2]).T

    def _node_s(self, tick: int) -> Array:
        """Times of the task at the nodes (N+1,)."""
        arrays, mpc = self._arrays, self.config.mpc
        begin_us = int(arrays["commit_us"][tick]) - int(arrays["task_start_us"][0])
        nodes_us = np.arange(mpc.intervals + 1) * mpc.horizon_us // mpc.intervals
        at_s: Array = (begin_us + nodes_us.astype(np.float64)) * 1e-6
        return at_s
