"""From a planned motion to the control points that the devices are sent.

The position track r continues the committed points and closes in on the plan q*: least squares with
a penalty on the curvature of the difference, never interpolation (its recursion from the committed
points diverges). The torque track is f = tau* - Kp (r - q*) - (Kd + c)(r' - q*'), so that f and the
servo's own feedback sum to the planned torque with feedback around the plan. Gain tracks, where
there are any, follow the plan. All end in three equal points: the plan's rest, the torque that
holds it, its gains. Spline bases: de Boor, A Practical Guide to Splines, chapter IX.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Loop
from headway.controller.equations import TRACK_ROWS
from headway.controller.gains import Gains
from headway.controller.mpc import Motion
from headway.controller.prediction import Prediction
from headway.devices import core
from headway.devices.axis import AxisUnits
from headway.devices.remote import Points, Remote

Array = NDArray[np.float64]

POSITION_CURVATURE_WEIGHT = 100.0  # knots^4: of a step, half is gone after 5 knots
TORQUE_CURVATURE_WEIGHT = 0.002
FIXED_KNOTS = 3  # from the commit knot on, in which committed points still shape the tracks
RELIEF, RELIEF_ROUNDS = 1.4, 8

VALUE = np.array([1.0, 4.0, 1.0]) / 6  # of c[k-1], c[k], c[k+1] at knot k
SLOPE = np.array([-0.5, 0.0, 0.5])  # per knot interval
MIDDLE = np.array([1.0, 23.0, 23.0, 1.0]) / 48  # of c[k-1] .. c[k+2] half-way through [k, k+1)
MIDDLE_SLOPE = np.array([-1.0, -5.0, 5.0, 1.0]) / 8


def at_knots(points: Array, weights: Array) -> Array:
    """Sum of weights * points[k ..] for each k: (m + len - 1, n) to (m, n)."""
    m = len(points) - len(weights) + 1
    parts = [w * points[i : i + m] for i, w in enumerate(weights)]
    total: Array = np.sum(parts, axis=0)
    return total


class Fit:
    """Control points c[-1 .. K+1] over knots 0 .. K: the first three are committed, the last three
    equal the final value; those between fit samples at the knots in the least-squares sense.

    A linear map of (samples, committed), computed once.
    """

    def __init__(self, knots: int, curvature_weight: float) -> None:
        size = knots + 3  # c[-1] .. c[K+1], stored from index 0
        value, curve = np.zeros((knots + 1, size)), np.zeros((knots + 1, size))
        for k in range(knots + 1):
            value[k, k : k + 3] = VALUE
            curve[k, k : k + 3] = 1, -2, 1
        # Curvature of the samples as a spline through them would have it, to second order.
        sampled = np.zeros((knots + 1, knots + 1))
        for k in range(1, knots):
            sampled[k, k - 1 : k + 2] = 1, -2, 1
        sampled[0], sampled[knots] = sampled[1], sampled[knots - 1]
        sampled -= sampled @ sampled / 6
        weight = np.sqrt(curvature_weight)
        left = np.vstack((value, weight * curve))
        right = np.vstack((np.eye(knots + 1), weight * sampled))
        last = np.zeros((size, knots + 1))
        last[-3:, -1] = 1  # c[K-1] = c[K] = c[K+1] = the last sample
        first = np.zeros((size, 3))
        first[:3] = np.eye(3)
        free = slice(3, size - 3)
        solve = np.linalg.pinv(left[:, free])
        self._samples, self._committed = last, first
        self._samples[free] = solve @ (right - left @ last)
        self._committed[free] = -solve @ left @ first

    def __call__(self, samples: Array, committed: Array) -> Array:
        """(K+1, n) samples and (3, n) committed points to (K+3, n) points."""
        points = self._samples @ samples + self._committed @ committed
        points[:3] = committed
        points[-3:] = samples[-1]
        return points


class Encoder:
    """Encodes a motion and rolls the servos' model through what was encoded."""

    def __init__(
        self, prediction: Prediction, units: list[AxisUnits], gains: Gains, loop: Loop
    ) -> None:
        self._prediction, self._n, self._gains = prediction, prediction.n, gains
        self._units, self._h = units, loop.knot_us * 1e-6
        # Of knots and half-way between them, where a plan's first point is number 0.
        steps = loop.knot_us // 2 * np.arange(2, 2 * prediction.horizon_knots + 3)
        self._half_knots_us: NDArray[np.int64] = steps.astype(np.int64)
        self._scale = {
            core.TRACK_POSITION: np.array([u.pq_per_unit for u in units]),
            core.TRACK_TORQUE: np.array([u.tq_per_effort for u in units]),
        }
        self._position = Fit(prediction.horizon_knots, POSITION_CURVATURE_WEIGHT)
        self._torque = Fit(prediction.horizon_knots, TORQUE_CURVATURE_WEIGHT)

    def _committed(self, remotes: list[Remote], sink: int, knot: int, near: Array) -> Array:
        """The three points from `knot` on of one sink on all axes, in SI: (3, n)."""
        return self._in_si(sink, [remote.track(sink).points(knot, 3) for remote in remotes], near)

    def _in_si(self, sink: int, points: Sequence[NDArray[Any]], near: Array) -> Array:
        """Points of one sink (m,) by axis, in SI: (m, n). `near` (n,): where the axes are at the
        first of them."""
        if sink == core.TRACK_POSITION:
            axes = zip(self._units, points, near.tolist(), strict=True)
            points = [units.unwrapped(of_axis, about) for units, of_axis, about in axes]
        in_si: Array = np.stack(points, axis=1) / self._scale[sink]
        return in_si

    def plan(
        self, motion: Motion, remotes: list[Remote], knot: int, start: Array, disturbance: Array
    ) -> tuple[list[Points], Motion]:
        """Encodes a motion; returns the points and their roll-out.

        Where the servos' feedback adds up to more torque than there is, the ceiling cuts it: there
        the torque track gives way by as much, which leaves the motion as it is.
        """
        relief, limit = np.zeros_like(motion.torque), self._prediction.law.limit
        gains = self.gain_points(motion, remotes, knot)
        for _ in range(RELIEF_ROUNDS):
            points = self.encode(motion, remotes, knot, relief, gains)
            rolled = self.roll_out(points, start, disturbance)
            torque = rolled.torque[FIXED_KNOTS:]
            if np.all(np.abs(torque) <= limit):
                break
            # A little more than the excess, since the fit smoothes.
            relief[FIXED_KNOTS:] += RELIEF * (
                torque - np.clip(torque, -0.995 * limit, 0.995 * limit)
            )
        return points, rolled

    def encode(
        self,
        motion: Motion,
        remotes: list[Remote],
        knot: int,
        relief: Array | float = 0.0,
        gains: list[Points] | None = None,
    ) -> list[Points]:
        """Control points from knot - 1 on, by axis, of a motion that begins at knot `knot`.

        The first three points of each track are the committed ones. `relief`: (K+1, n) Nm, taken
        off the torque track at the knots; `gains`: what `gain_points` gives, if it is known.
        """
        law = self._prediction.law
        begin = motion.position[0]
        gains = self.gain_points(motion, remotes, knot) if gains is None else gains
        feedback = self._feedback(gains)[::2]
        kp, damping = feedback[:, : self._n], feedback[:, self._n :]
        r = self._position(
            motion.position, self._committed(remotes, core.TRACK_POSITION, knot - 1, begin)
        )
        r = self._quantize(r, core.TRACK_POSITION)
        value, rate = at_knots(r, VALUE), at_knots(r, SLOPE) / self._h
        f = motion.torque - kp * (value - motion.position) - damping * (rate - motion.velocity)
        f = np.clip(f - relief, -law.limit, law.limit)
        f = self._torque(f, self._committed(remotes, core.TRACK_TORQUE, knot - 1, begin))
        f = np.clip(self._quantize(f, core.TRACK_TORQUE), -law.limit, law.limit)
        return [
            {
                core.TRACK_POSITION: units.position_points(r[:, axis]),
                core.TRACK_TORQUE: units.torque_points(f[:, axis]),
                **gains[axis],
            }
            for axis, units in enumerate(self._units)
        ]

    def gain_points(self, motion: Motion, remotes: list[Remote], knot: int) -> list[Points]:
        """Control points of the gain tracks along a motion, as `encode` has them."""
        sinks = self._gains.sinks
        if not sinks:
            return [{} for _ in remotes]
        committed = [r.track(sink).points(knot - 1, 3) for sink in sinks for r in remotes]
        wanted = self._gains.points(motion.position)
        return self._gains.bounded(self._position(wanted, np.stack(committed, axis=1)))

    def _feedback(self, points: list[Points]) -> Array:
        """[Kp, Kd + c] of encoded gain tracks at the knots and half-way between: (2K+1, 2n)."""

        def track(axis: int, sink: int) -> core.Track:
            track = core.Track()
            track.write(0, points[axis][sink])
            return track

        return self._gains.feedback(track, self._half_knots_us)

    def _quantize(self, points: Array, sink: int) -> Array:
        quantized: Array = np.rint(points * self._scale[sink]) / self._scale[sink]
        return quantized

    def departure(self, motion: Motion, points: list[Points]) -> Array:
        """Torque that the encoded tracks give along the planned motion, minus the planned one, at
        the knots: (K+1, n) Nm."""
        tracks, _ = self._track_values(points, motion.position[0])
        states = np.hstack((motion.position, motion.velocity))
        departure: Array = self._prediction.law.torque(states, tracks) - motion.torque
        return departure

    def _track_values(self, points: list[Points], near: Array) -> tuple[Array, Array]:
        """[r, r', f, Kp, Kd + c] at the knots (K+1, 5n) and half-way between them (K, 5n).
        `near` (n,): where the axes begin."""
        h, sinks = self._h, (core.TRACK_POSITION, core.TRACK_TORQUE)
        r, f = (self._in_si(sink, [of_axis[sink] for of_axis in points], near) for sink in sinks)
        gains = self._feedback(points)
        knots = at_knots(r, VALUE), at_knots(r, SLOPE) / h, at_knots(f, VALUE), gains[::2]
        middle = (
            at_knots(r, MIDDLE),
            at_knots(r, MIDDLE_SLOPE) / h,
            at_knots(f, MIDDLE),
            gains[1::2],
        )
        return np.hstack(knots), np.hstack(middle)

    def roll_out(self, points: list[Points], start: Array, disturbance: Array) -> Motion:
        """The motion that the servos make of encoded points, from state `start` (2n,)."""
        n = self._n
        knots, middles = self._track_values(points, start[:n])
        call = self._prediction.rollout
        call.inputs[0][:, 0] = start
        call.inputs[1][...] = disturbance[:, None]
        call.inputs[2][...] = knots[:-1].T
        call.inputs[3][...] = middles.T
        call.inputs[4][...] = knots[1:].T
        call.inputs[5][...] = self._h
        states = np.vstack((start, call.run()[0].T))
        return Motion(states[:, :n], states[:, n:], self._prediction.law.torque(states, knots))


class Commitment:
    """What the devices execute, as far as the host knows, as a function of system time."""

    def __init__(
        self, remotes: list[Remote], units: list[AxisUnits], gains: Gains, loop: Loop
    ) -> None:
        self._remotes, self._gains, self._shift = remotes, gains, loop.knot_shift
        self._units = units
        self._position = 1 / np.array([u.pq_per_unit for u in units])
        self._speed = self._position / (loop.knot_us * 1e-6)
        self._torque = 1 / np.array([u.tq_per_effort for u in units])

    def at(self, times_us: NDArray[np.int64], near: Array) -> Array:
        """[r, r', f, Kp, Kd + c] at system times (m,), close together: (m, 5n) in rad, Nm and
        seconds. `near` (n,): where the axes are at the first of them, give or take some turns."""
        n = len(self._remotes)
        values = np.empty((len(times_us), TRACK_ROWS * n))
        for axis, remote in enumerate(self._remotes):
            position = remote.track(core.TRACK_POSITION).evaluate(times_us, self._shift)
            torque = remote.track(core.TRACK_TORQUE).evaluate(times_us, self._shift)
            unwrapped = self._units[axis].unwrapped(position[0], near[axis])
            values[:, axis] = unwrapped * self._position[axis]
            values[:, n + axis] = position[1] * self._speed[axis]
            values[:, 2 * n + axis] = torque[0] * self._torque[axis]
        values[:, 3 * n :] = self._gains.feedback(self._track, times_us)
        return values

    def _track(self, axis: int, sink: int) -> core.Track:
        return self._remotes[axis].track(sink)
