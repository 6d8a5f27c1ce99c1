"""The receding-horizon loop: what runs every tick, for whatever link there is.

    samples  = link.read()                       encoder history, stamped in system time
    estimate = estimator.update(samples, now)    state at now, then at the commit knot
    plan     = mpc.solve(estimate, reference)
    link.write(tracks.encode(plan))              points past the margin, ending at rest

A tick lies on a knot. At knot k with a margin of m knots the first free point is k + m + 2, and the
plan begins at the commit knot k + m, whose state is predicted along what is already committed.
"""

from __future__ import annotations

import math
import time
from itertools import chain
from operator import contains

import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Config
from headway.controller._tick import finite
from headway.controller.ahead import Ahead
from headway.controller.estimator import Estimate, Estimator
from headway.controller.feedforward import Feedforward
from headway.controller.gains import Gains
from headway.controller.motion import Motion
from headway.controller.mpc import Mpc
from headway.controller.observable import require_observable
from headway.controller.prediction import Prediction
from headway.controller.record.recorder import Recorder
from headway.controller.reference import ENTRY_S, Entry, Reference, own_costs
from headway.controller.start import Start
from headway.controller.tick import DeviceError, Outbox, Phase, Tick
from headway.controller.tracks import Encoder
from headway.devices import core
from headway.devices._tracks import Gate, Odometer, Samples
from headway.devices.axis import AxisUnits, position_limits, torque_limits, whole_turns
from headway.devices.link import Link
from headway.devices.remote import Points, Remote
from headway.devices.stop import fit_states, why
from headway.models.machine import Machine

Array = NDArray[np.float64]


RESTING_SHARE = 0.01  # of the speed limits: slower, the machine rests
# Of the speed, with which a plan may end where none that ends at rest was found.
RESTORING_SHARE = 0.5
SHARES = 0.5, 0.25, 0.125  # of the way to a plan that the gate refuses, one of which it may take


def plan_points(config: Config) -> int:
    """Points of the longest plan that a tick may send, see Loop._join."""
    return config.mpc.horizon_us // config.loop.knot_us + max(config.loop.margin_knots - 1, 3)


class Loop:
    """The controller of one machine. `read`, `tick` and `write` are the three steps of a tick."""

    def __init__(
        self,
        config: Config,
        machine: Machine,
        remotes: list[Remote],
        reference: Reference,
        recorder: Recorder,
    ) -> None:
        axes, driven = config.machine.axes, config.machine.driven
        machine.require_axes(tuple(a.joint for a in axes))
        self._config, self._remotes, self.task = config, remotes, reference
        self._driven = list(driven)
        self._moved = [remotes[axis] for axis in driven]  # the others have an encoder alone
        rows = {device: row for row, device in enumerate(driven)}
        self._row = [rows.get(device) for device in range(len(remotes))]  # of a plan, by device
        self._recorder = recorder
        self._reference = reference
        self._knot_us, self._margin = config.loop.knot_us, config.loop.margin_knots
        self._least_us = config.sync.to_device_least_us  # no frame arrives sooner
        self._boards = config.machine.boards
        self._units = [AxisUnits.of(axis, config.loop) for axis in self._boards]
        moved_units = [self._units[axis] for axis in driven]
        self._limits = [
            {
                core.TRACK_POSITION: position_limits(axis, units),
                core.TRACK_TORQUE: torque_limits(axis, units),
            }
            for axis, units in zip(driven.values(), moved_units, strict=True)
        ]
        self._fit = [fit_states(axis) for axis in self._boards]
        self._resting = RESTING_SHARE * np.array([axis.velocity_limit for axis in axes])
        self._horizon = config.mpc.horizon_us // self._knot_us
        points = plan_points(config)
        if points > core.PLAN_POINTS_MAX:
            raise ValueError(
                f"mpc.horizon_us and loop.margin_us make plans of {points} points; a frame holds "
                f"{core.PLAN_POINTS_MAX}: choose a longer knot or a shorter horizon"
            )
        self._prediction = Prediction.of(config, machine)
        bare = config.machine.bare
        require_observable(config, machine, reference.at(np.zeros(1))[0][0])
        unit_per_count = [u.unit_per_count for u in self._units]
        self._odometers = [Odometer(*each) for each in enumerate(unit_per_count)]
        pitch = np.array(unit_per_count + [np.inf] * len(bare))
        rest_sigma = {i: axis.rest_sigma for i, axis in bare.items()}
        self.estimator = Estimator(self._prediction, config.estimator, pitch, rest_sigma)
        gains = Gains(config, machine, points)
        self._sinks = (core.TRACK_POSITION, core.TRACK_TORQUE, *gains.sinks)
        for limits, more in zip(self._limits, gains.limits, strict=True):
            limits.update(more)
        tracks = [[remote.track(sink) for sink in self._sinks] for remote in self._moved]
        bounds = [limits[sink] for limits in self._limits for sink in self._sinks]
        self._tracks = list(chain.from_iterable(tracks))  # every one, axis by axis
        self._gate = Gate(bounds, self._tracks)
        self._committed = gains.course(tracks, moved_units)
        self._encoder = Encoder(self._prediction, moved_units, gains, config.loop)
        costs = own_costs(reference, machine)
        self._mpc: Mpc | None = None
        if config.mpc.enabled:
            self._mpc = Mpc(config, self._prediction, self._encoder, costs)
        self._feedforward = Feedforward(self._prediction, config.mpc.feedforward == "model")
        self._ahead = Ahead(self._knot_us, self._horizon, config.mpc.intervals)
        self._knots: NDArray[np.int64] = np.arange(self._horizon + 1)
        self._last: tuple[int, Motion] | None = None  # what is expected, from a commit knot on
        self._restoring = False  # no plan was found in the last tick
        self._planned = 0  # commit knot of the last plan
        self._commit_knot: int | None = None  # of the last tick
        self._prepared: int | None = None  # commit knot of the problem that is ready
        self._wanted = np.empty((0, 0))  # the reference at that problem's nodes
        self._disturbance = np.zeros(self._prediction.n)  # as last estimated, and planned for
        self.samples = Samples()  # received, not yet estimated from
        self._start = Start(config, remotes, self._units, self._prediction, gains)
        self.phase = Phase.HELLO
        self.start_us = 0  # task time zero

    def read(self, link: Link, now_us: int) -> None:
        """Takes in all that has arrived."""
        packets, good = link.receive(now_us), []
        for device, received_us, packet in packets:
            status = self._remotes[device].receive(packet, received_us)
            good.append(status is not None)
            if status is not None:
                self._odometers[device].read(status, self.samples)
        self._recorder.add(("received", now_us, (packets, good)))

    def tick(self, now_us: int) -> tuple[Tick, Outbox]:
        """Decides what to send. `now_us` lies on a knot."""
        began = time.perf_counter()
        knot = now_us // self._knot_us
        tick = Tick(now_us, self.phase, len(self.samples))
        tick.states = [r.status.state if r.status else 0 for r in self._remotes]
        running = self.phase is Phase.RUN
        outbox = self._run(tick, knot) if running else self._start_up(knot)
        tick.total_us = (time.perf_counter() - began) * 1e6
        return tick, outbox

    def write(self, link: Link, outbox: Outbox, sent_us: int) -> bool:
        """Seals and sends what a tick decided. Returns False for a plan that took too long: then
        only stamps are sent. What can be done for the next tick before its estimate is done."""
        in_time = sent_us < outbox.too_late_us
        outbox = outbox.arriving_in((sent_us + self._least_us) // self._knot_us)
        points = outbox.points if in_time else None
        packets = list[tuple[int, bytes]]()
        for device, remote in enumerate(self._remotes):
            row = self._row[device]
            if points is not None and row is not None and remote.established:
                packets.append(
                    (device, remote.plan_packet(outbox.first_knot, points[row], sent_us))
                )
            else:
                packets += [(device, packet) for packet in remote.stamp_packets(sent_us)]
            packets += [(device, packet) for packet in remote.questions()]
        for device, packet in packets:
            link.send(device, packet, sent_us)
        self._recorder.add(("sent", sent_us, (points is not None, packets)))
        if self._commit_knot is not None:
            self._prepare(self._commit_knot + 1)
        return in_time

    def _start_up(self, knot: int) -> Outbox:
        """Until every device executes its first plan."""
        outbox = self._start.tick(knot, self.samples)
        if self.phase is not Phase.START and self._start.phase is Phase.START:
            start = self._start
            # The brakes let go at the start knot: till then the position is known, nothing moves.
            self.start_us = start.knot * self._knot_us
            self.estimator.reset(self.start_us, start.position)
            self._enter(start.position, start.torque, 0.0)
            row = np.concatenate((start.position, np.zeros_like(start.position), start.torque))
            rest = Motion(np.tile(row, (self._horizon + 1, 1)))
            self._last, self._planned = (start.knot, rest), start.knot
        self.phase = self._start.phase
        return outbox

    def _run(self, tick: Tick, knot: int) -> Outbox:
        commit_knot = self._commit_knot = knot + self._margin
        began = time.perf_counter()
        tick.now, tick.commit = self._estimate(tick.now_us, knot)
        tick.estimate_us = (time.perf_counter() - began) * 1e6
        law, n = self._prediction.law, self._prediction.n
        self._disturbance = law.borne(tick.commit.z[2 * n :])
        self._check_devices(tick)
        if self._silent(tick.now_us):
            return Outbox()  # nobody gets a new plan: all coast to rest together
        self._enter_anew(tick.commit, commit_knot)
        began = time.perf_counter()
        plan = self._plan(tick, commit_knot)
        if plan is not None:
            plan = self._passing(tick, *plan, commit_knot)
        tick.encode_us = (time.perf_counter() - began) * 1e6
        if tick.solution is not None:
            tick.encode_us -= tick.solution.solve_us
        self._restoring = plan is None
        if plan is None:
            self._restore(tick.commit, commit_knot)
            return self._repeat(knot)
        points, rolled = plan
        self._last, self._planned = (commit_knot, rolled), commit_knot
        tick.accepted, tick.motion = True, rolled
        tick.encoding_error, tick.planned_torque = self._encoder.largest()
        return self._join(knot, commit_knot, points)

    def _estimate(self, now_us: int, knot: int) -> tuple[Estimate, Estimate]:
        # What is yet to come stays among the samples: a clock that is ahead by more than its frame
        # was under way stamps such.
        now = self.estimator.update(self.samples, now_us, self._committed)
        if not all(map(math.isfinite, now.z.tolist())):
            raise DeviceError(
                "the estimated state has diverged: `headway check` says whether a joint is too "
                "stiff to be predicted"
            )
        knots = [(knot + i) * self._knot_us for i in range(1, self._margin + 1)]
        return now, self.estimator.predict(now, knots, self._committed)

    def _check_devices(self, tick: Tick) -> None:
        """A device that no longer executes plans ends the run; the others, who get no new ones,
        come to rest together."""
        if all(map(contains, self._fit, tick.states)):
            return
        axes = zip(self._boards, self._units, self._remotes, self._fit, strict=True)
        stopped = [
            f"{axis.joint}: {why(remote.status, axis, units, self._config.device.servo_period_us)}"
            for axis, units, remote, fit in axes
            if remote.status is not None and remote.status.state not in fit
        ]
        if stopped:
            mute = [
                f"{axis.joint}: the device no longer answers"
                for axis, remote in zip(self._boards, self._remotes, strict=True)
                if remote.overdue(tick.now_us)
            ]
            raise DeviceError("; ".join([*mute, *stopped]))

    def _silent(self, now_us: int) -> bool:
        """Whether an answer of any device is overdue. One that stays away ends the run."""
        if not any(remote.silent(now_us) for remote in self._remotes):
            return False
        # By then the others, who got plans until this one fell silent, have come to rest as well.
        rest_knots = self._margin + self._horizon + core.COAST_KNOTS + 1
        for axis, remote in zip(self._boards, self._remotes, strict=True):
            if remote.status is None or now_us - remote.status.sent_us > rest_knots * self._knot_us:
                raise DeviceError(f"{axis.joint}: the device no longer answers")
        return True

    def _restore(self, commit: Estimate, commit_knot: int) -> None:
        """The old plan runs on. What becomes of that from where the machine is now, which may not
        be where it was expected, is what the next problem is linearized along."""
        committed = self._stored(commit_knot - 1, self._horizon + 3)
        state = commit.state(self._prediction.n)
        old = self._encoder.roll_points(committed, state, self._disturbance)
        if finite(old.rows):
            self._last = (commit_knot, old)

    def _enter_anew(self, commit: Estimate, commit_knot: int) -> None:
        """When no new plan was found until the last one ended and the machine rests, perhaps far
        from its reference, it is led there as at the start."""
        n = self._prediction.n
        ended = commit_knot - self._planned >= self._horizon
        if ended and np.all(np.abs(commit.z[n : 2 * n]) <= self._resting):
            start_s = (commit_knot * self._knot_us - self.start_us) * 1e-6
            torque = self._prediction.given(commit.state(n), commit.tracks)
            self._enter(commit.z[:n], torque, start_s)
            _, self._wanted = self._ahead.at(commit_knot)

    def _enter(self, position: Array, torque: Array, start_s: float) -> None:
        """From rest at a position onto the task's reference; how often a continuous axis has turned
        before makes no difference."""
        way = position - self.task.at(np.array([start_s]))[0][0]
        turns = whole_turns(self._config.machine.axes, way)
        self._follow(Entry(self.task, position, start_s, ENTRY_S, turns))
        time_us = self.start_us + round(start_s * 1e6)
        self._recorder.add(("entry", time_us, (start_s, position, torque)))

    def _follow(self, reference: Reference) -> None:
        """From now on this one, wherever the machine is."""
        self._reference = reference
        self._ahead.follow(reference, self.start_us)

    def _plan(self, tick: Tick, commit_knot: int) -> tuple[Points, Motion] | None:
        """Points by driven axis and sink, and their roll-out, if there is a plan."""
        assert tick.commit is not None
        n = self._prediction.n
        state = tick.commit.state(n)
        if self._mpc is None:
            commit_us = commit_knot * self._knot_us - self.start_us
            knots_s = (commit_us + self._knots * self._knot_us).astype(np.float64) * 1e-6
            motion = self._feedforward.plan(self._reference, knots_s)
            return self._encoder.plan(motion, self._moved, commit_knot, state, self._disturbance)
        torque = self._prediction.given(state, tick.commit.tracks)
        if self._prepared != commit_knot:  # the first tick, or one was left out
            self._prepare(commit_knot)
        tick.solution = solution = self._mpc.solve(
            state,
            self._disturbance,
            self._wanted,
            torque,
            self._moved,
            commit_knot,
            self._ending(state),
        )
        return solution.plan

    def _ending(self, state: Array) -> Array:
        """Speeds of the driven axes (w,) at a problem's end: none. After a tick without a plan the
        machine may be too fast to stop within the horizon, and half of its speed will do: where its
        tracks end at rest the motors would not follow, but the next plan begins before that."""
        speed = state[self._prediction.n :][self._prediction.law.driven]
        return RESTORING_SHARE * self._restoring * speed

    def _prepare(self, commit_knot: int) -> None:
        if self._mpc is not None:
            node_s, self._wanted = self._ahead.at(commit_knot)
            self._mpc.prepare(self._guess(commit_knot), self._disturbance, node_s)
            self._prepared = commit_knot

    def _guess(self, commit_knot: int) -> Motion:
        """The last roll-out from the new commit knot on, extended at rest."""
        assert self._last is not None
        knot, motion = self._last
        return motion.later(commit_knot - knot)

    def _passing(
        self, tick: Tick, points: Points, rolled: Motion, commit_knot: int
    ) -> tuple[Points, Motion] | None:
        """The plan, if it passes the same gate as on the device and its roll-out is a motion. Where
        the gate refuses it, which is noted: a part of the way there from what is committed."""
        if not finite(rolled.rows):
            return None
        knot = commit_knot - 1
        refusal = self._gate.refusal(knot, points, knot)
        if refusal is None:
            return points, rolled
        row, result = refusal
        axis, sink = divmod(row, len(self._sinks))
        share, part = self._part_way(points, knot)
        told = self._driven[axis], self._sinks[sink], result, share
        self._recorder.add(("refused", tick.now_us, told))
        if part is None:
            return None
        assert tick.commit is not None
        state = tick.commit.state(self._prediction.n)
        rolled = self._encoder.roll_points(part, state, self._disturbance)
        return (part, rolled) if finite(rolled.rows) else None

    def _part_way(self, points: Points, knot: int) -> tuple[float, Points | None]:
        """Points between those that are committed from a knot on and a plan's, as near to it as the
        gate takes; none if it takes no share. Ranges, speeds and accelerations within limits make a
        convex set, so it most often does."""
        committed = self._stored(knot, points.shape[2])
        way = points - committed  # a continuous axis' modulo 2^32, as its positions are
        for share in SHARES:
            part = committed + np.rint(share * way).astype(np.int32)
            if self._gate.refusal(knot, part, knot) is None:
                return share, part
        return 0.0, None

    def _repeat(self, knot: int) -> Outbox:
        """The committed plan's points that have not begun, unchanged."""
        first = knot + core.LIVE_KNOTS
        ends = [r.track(core.TRACK_POSITION).end for r in self._moved]
        count = max(3, min(max(ends) - first + 1, core.PLAN_POINTS_MAX))
        return Outbox(first, self._stored(first, count))

    def _stored(self, first_knot: int, count: int) -> Points:
        """What is committed from a knot on."""
        stored = core.track_points(self._tracks, first_knot, count)
        return stored.reshape(len(self._moved), len(self._sinks), count)

    def _join(self, knot: int, commit_knot: int, points: Points) -> Outbox:
        """The new points, from before the commit knot on, and committed ones before them that have
        not begun."""
        first = commit_knot - 1
        ahead = first - (knot + core.LIVE_KNOTS)
        if ahead > 0:
            first -= ahead
            points = np.concatenate((self._stored(first, ahead), points), axis=2)
        return Outbox(first, points, commit_knot * self._knot_us)
