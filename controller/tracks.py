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

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Loop
from headway.controller._tick import Encoding
from headway.controller.equations import TRACK_ROWS, servo_torque
from headway.controller.gains import Gains
from headway.controller.motion import Motion
from headway.controller.prediction import Prediction
from headway.devices import core
from headway.devices.axis import AxisUnits
from headway.devices.remote import Points, Remote
from headway.models.codegen import Array, Call, among, compile_functions, named_function

POSITION_CURVATURE_WEIGHT = 100.0  # knots^4: of a step, half is gone after 5 knots
TORQUE_CURVATURE_WEIGHT = 0.002
FIXED_KNOTS = 3  # from the commit knot on, in which committed points still shape the tracks
RELIEF = 1.4

VALUE = 1 / 6, 4 / 6, 1 / 6  # of c[k-1], c[k], c[k+1] at knot k
SLOPE = -0.5, 0.0, 0.5  # per knot interval
MIDDLE = 1 / 48, 23 / 48, 23 / 48, 1 / 48  # of c[k-1] .. c[k+2] half-way through [k, k+1)
MIDDLE_SLOPE = -1 / 8, -5 / 8, 5 / 8, 1 / 8


class Fit:
    """Control points c[-1 .. K+1] over knots 0 .. K: the first three are committed, the last three
    equal the final value; those between fit samples at the knots in the least-squares sense.

    A linear map of samples (K+1,) and committed points (3,), computed once.
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
        self.of_samples: Array = last
        self.of_committed: Array = first
        self.of_samples[free] = solve @ (right - left @ last)
        self.of_committed[free] = -solve @ left @ first

    def __call__(self, samples: Any, committed: Any) -> Any:
        """Samples (n, K+1) and committed points (n, 3) to points (n, K+3), as expressions."""
        return samples @ ca.DM(self.of_samples.T) + committed @ ca.DM(self.of_committed.T)


class Encoder:
    """Encodes a motion and rolls the servos' model through what was encoded.

    `encoding` encodes the motion that stands in `pool`: position, velocity and torque (n, K+1), a
    column a knot. Points, units and remotes are those of the driven axes; a passive one has none.
    """

    def __init__(
        self, prediction: Prediction, units: list[AxisUnits], gains: Gains, loop: Loop
    ) -> None:
        n, knots, driven = prediction.n, prediction.horizon_knots, prediction.law.driven
        self._n, self._gains, self._law, self._units = n, gains, prediction.law, units
        self._driven = driven
        self._of: list[Remote] | None = None  # whose tracks are committed
        sinks = range(2 + len(gains.sinks))
        self._encoded = [[core.Track() for _ in sinks] for _ in units]  # gains, of the last plan
        self._own_course = gains.course(self._encoded, units)
        self._h = loop.knot_us * 1e-6
        # Of knots and half-way between them, where a plan's first point is number 0.
        steps = loop.knot_us // 2 * np.arange(2, 2 * knots + 3)
        self._half_knots_us: NDArray[np.int64] = steps.astype(np.int64)
        self._scale = {
            core.TRACK_POSITION: np.array([[u.pq_per_unit] for u in units]),
            core.TRACK_TORQUE: np.array([[u.tq_per_effort] for u in units]),
        }
        self._continuous = any(u.continuous for u in units)
        self._gain_fit = Fit(knots, POSITION_CURVATURE_WEIGHT)
        self._gain_points: Points = np.empty((len(units), len(gains.sinks), knots + 3), np.int32)
        library = compile_functions(
            "encoder", [_encode(n, driven, knots, self._h), _relieve(n, driven, knots)]
        )
        self.pool = pool = dict[str, Array]()
        encode = Call(library, "encode", pool)
        tracks = pool["tracks"]
        pool |= {"start": tracks[:, :-1], "middle": pool["middles"], "end": tracks[:, 1:]}
        self._states = np.zeros((2 * n, knots + 1), order="F")  # in one piece, see `rolled`
        pool |= {"x": self._states[:, :1], "states": self._states[:, 1:]}
        self._rollout = rollout = prediction.call("rollout", pool)
        self._relieve = relieve = Call(library, "relieve", pool)
        pool["dt"][...], pool["limit"][:, 0] = self._h, self._law.limit
        pool["quanta"][...] = np.concatenate(list(self._scale.values()))
        pool["feedback"][...] = self._law.feedback[:, None]
        self.encoding = Encoding(
            encode.bound, rollout.bound, relieve.bound, pool["relief"], pool["more"], pool["over"]
        )

    def plan(
        self, motion: Motion, remotes: list[Remote], knot: int, start: Array, disturbance: Array
    ) -> tuple[Points, Motion]:
        """Encodes a motion that begins at knot `knot`, from state `start` (2n,) on; returns the
        points from knot - 1 on, by driven axis and sink, and their roll-out."""
        for name in ("position", "velocity", "torque"):
            self.pool[name][...] = getattr(motion, name).T
        self.commit(remotes, knot, motion, start, disturbance)
        self.encoding.run()
        return self.points(), self.rolled()

    def commit(
        self, remotes: list[Remote], knot: int, along: Motion, start: Array, disturbance: Array
    ) -> None:
        """Takes over what the devices have from `knot` - 1 on: the first three points of each
        track. Gains go with `along`, which need not be the motion to the last bit."""
        pool = self.pool
        if remotes is not self._of:
            self._of = remotes
            sinks = range(len(self._encoded[0]))
            tracks = [[remote.track(sink) for sink in sinks] for remote in remotes]
            self._course = self._gains.course(tracks, self._units)
        self._course.points(knot - 1, start[: self._n], pool["r0"], pool["f0"])
        if self._gains.sinks:
            self._gain_points = self.gain_points(along.position, remotes, knot)
            pool["feedback"][...] = self._gains_along().T
        pool["x"].T[...], pool["d"].T[...] = start, disturbance

    def roll_points(self, points: Points, start: Array, disturbance: Array) -> Motion:
        """What the servos make of control points, as `plan` returns them, from state `start` (2n,).
        They encode no motion, from which they could depart."""
        self.pool["departed"][...] = np.nan
        if self._gains.sinks:
            self._gain_points = points[:, 2:]
            self.pool["feedback"][...] = self._gains_along().T
        both = points[:, : core.TRACK_TORQUE + 1].astype(np.float64)
        for axis, (units, near) in enumerate(zip(self._units, start[self._driven], strict=True)):
            both[axis, core.TRACK_POSITION] = units.unwrapped(
                points[axis, core.TRACK_POSITION], near
            )
        return self.roll(both, start, disturbance)

    def roll(self, points: Array, start: Array, disturbance: Array) -> Motion:
        """What the servos, with the gains at hand, make of control points (from a plan's first on,
        by driven axis and sink, positions without bounds) from state `start` (2n,)."""
        r, f = (
            points[:, sink] / self._scale[sink] for sink in (core.TRACK_POSITION, core.TRACK_TORQUE)
        )
        pool, h = self.pool, self._h
        at = _at_knots(r, VALUE), _at_knots(r, SLOPE) / h, _at_knots(f, VALUE)
        half_way = _at_knots(r, MIDDLE), _at_knots(r, MIDDLE_SLOPE) / h, _at_knots(f, MIDDLE)
        pool["tracks"][...] = self._rows(*at, pool["feedback"][:, ::2])
        pool["middles"][...] = self._rows(*half_way, pool["feedback"][:, 1::2])
        pool["x"].T[...], pool["d"].T[...] = start, disturbance
        self._rollout.run()
        self._relieve.run()
        return self.rolled()

    def _rows(self, r: Array, rate: Array, f: Array, feedback: Array) -> Array:
        """Tracks (w, m) and gains (2n, m) as the prediction has them: (5n, m)."""
        rows = np.zeros((3, self._n, r.shape[1]))
        rows[:, self._driven] = r, rate, f
        return np.vstack((*rows, feedback))

    def points(self) -> Points:
        """Of the last encoding: control points by driven axis and sink, the first three of each
        track the committed ones."""
        made: NDArray[Any] = self.pool["points"]
        if self._continuous:  # a position goes on from 2^31 at -2^31
            made = made.astype(np.int64)
        width, sinks = len(self._driven), 2 + len(self._gains.sinks)
        points = np.empty((width, sinks, made.shape[1]), np.int32)
        points[:, core.TRACK_POSITION] = made[:width]
        points[:, core.TRACK_TORQUE] = made[width:]
        if self._gains.sinks:
            points[:, 2:] = self._gain_points
        return points

    def rolled(self) -> Motion:
        """Of the last encoding: the motion that the servos make of it."""
        return Motion(np.concatenate((self._states, self.pool["motor"])).T)

    def departure(self) -> Array:
        """Of the last encoding: torque that the tracks give along the motion itself, minus the
        motion's own, at the knots: (K+1, n) [Nm or N]."""
        return self.pool["departure"].T

    def largest(self) -> tuple[Array, Array]:
        """Of the last encoding, each (n,) [Nm or N]: the largest departure once the points are
        free, and the largest torque in the roll-out past the committed points."""
        return self.pool["departed"][:, 0].copy(), self.pool["reached"][:, 0].copy()

    def gain_points(self, position: Array, remotes: list[Remote], knot: int) -> Points:
        """Control points of the gain tracks along positions (K+1, n), as `plan` has them."""
        sinks = self._gains.sinks
        committed = [r.track(sink).points(knot - 1, 3) for sink in sinks for r in remotes]
        wanted = self._gains.points(position)
        fit = self._gain_fit
        points = fit.of_samples @ wanted + fit.of_committed @ np.stack(committed, axis=1)
        return self._gains.bounded(points)

    def _gains_along(self) -> Array:
        """[Kp, Kd + c] of the gain points at the knots and half-way between: (2K+1, 2n)."""
        for tracks, points in zip(self._encoded, self._gain_points, strict=True):
            for sink, row in zip(self._gains.sinks, points, strict=True):
                tracks[sink].write(0, row)
        return self._own_course.at(self._half_knots_us, np.zeros(self._n))[:, 3 * self._n :]


def _at_knots(points: Any, weights: Sequence[float]) -> Any:
    """Sum of weights * points[k ..] for each k: (n, m) to (n, m - len + 1)."""
    m = points.shape[1] - len(weights) + 1
    return sum(w * points[:, i : i + m] for i, w in enumerate(weights))


def _largest(values: Any) -> Any:
    """Largest size in each row: (n, m) to (n,)."""
    return ca.vertcat(*(ca.mmax(ca.fabs(row)) for row in ca.vertsplit(values)))


def _encode(n: int, driven: list[int], knots: int, h: float) -> ca.Function:
    """position, velocity, torque (n, K+1): the motion; r0, f0 (w, 3): committed points of the w
    driven axes; feedback (2n, 2K+1): [Kp, Kd + c] at the knots and half-way between; relief
    (n, K+1): taken off the torque track; quanta (2w,): of position and torque, per unit; limit
    (n,): of the torque; all SI.

    To the points of r and f (2w, K+3) in quanta, to the tracks [r, r', f, Kp, Kd + c] at the knots
    (5n, K+1) and half-way between them (5n, K), to the torque that the tracks give along the motion
    itself, minus the motion's own (n, K+1), and to the largest of that once the points are free.
    """
    w = len(driven)
    sizes = {
        "position": (n, knots + 1), "velocity": (n, knots + 1), "torque": (n, knots + 1),
        "r0": (w, 3), "f0": (w, 3), "feedback": (2 * n, 2 * knots + 1), "relief": (n, knots + 1),
        "quanta": (2 * w, 1), "limit": (n, 1),
    }  # fmt: skip
    inputs = {name: ca.MX.sym(name, *size) for name, size in sizes.items()}
    r0, f0, feedback, quanta = (inputs[name] for name in ("r0", "f0", "feedback", "quanta"))
    position, velocity, torque, relief, limit = (
        inputs[name][driven, :] for name in ("position", "velocity", "torque", "relief", "limit")
    )
    at, between = feedback[:, ::2], feedback[:, 1::2]
    kp, damping = at[driven, :], at[[n + axis for axis in driven], :]
    ceiling = ca.repmat(limit, 1, knots + 1), ca.repmat(limit, 1, knots + 3)

    def every(rows: Any) -> Any:
        """Rows of the driven axes among zeros of the passive ones."""
        return among(rows, driven, n)

    def clip(values: Any, ceiling: Any) -> Any:
        return ca.fmin(ca.fmax(values, -ceiling), ceiling)

    def whole(points: Any, per_unit: Any) -> Any:
        return ca.floor(points * per_unit + 0.5)

    r_points = whole(Fit(knots, POSITION_CURVATURE_WEIGHT)(position, r0), quanta[:w])
    r = r_points / quanta[:w]
    value, rate = _at_knots(r, VALUE), _at_knots(r, SLOPE) / h
    feedback_torque = kp * (value - position) + damping * (rate - velocity)
    f = clip(torque - feedback_torque - relief, ceiling[0])
    f = whole(Fit(knots, TORQUE_CURVATURE_WEIGHT)(f, f0), quanta[w:]) / quanta[w:]
    f = clip(f, ceiling[1])
    effort = _at_knots(f, VALUE)
    tracks = ca.vertcat(*map(every, (value, rate, effort)), at)
    half_way = _at_knots(r, MIDDLE), _at_knots(r, MIDDLE_SLOPE) / h, _at_knots(f, MIDDLE)
    middles = ca.vertcat(*map(every, half_way), between)
    departure = every(effort + feedback_torque - torque)
    outputs = {
        "points": ca.vertcat(r_points, whole(f, quanta[w:])),
        "tracks": tracks,
        "middles": middles,
        "departure": departure,
        "departed": _largest(departure[:, FIXED_KNOTS + 2 :]),
    }
    return named_function("encode", inputs, outputs)


def _relieve(n: int, driven: list[int], knots: int) -> ca.Function:
    """x (2n,), states (2n, K): a roll-out; tracks (5n, K+1) at the knots; relief (n, K+1) so far;
    limit (n,).

    To the torque of the motors (n, K+1), to more relief, and past the committed points to the
    largest excess over the limits and to the largest torque by axis.
    """
    sizes = {
        "x": (2 * n, 1), "states": (2 * n, knots), "tracks": (TRACK_ROWS * n, knots + 1),
        "relief": (n, knots + 1), "limit": (n, 1),
    }  # fmt: skip
    inputs = {name: ca.MX.sym(name, *size) for name, size in sizes.items()}
    start, after, tracks, relief, limit = inputs.values()
    states = ca.horzcat(start, after)
    torque = servo_torque(ca.vertsplit(tracks, n), states[:n, :], states[n:, :])
    free, ceiling = torque[:, FIXED_KNOTS:], ca.repmat(limit, 1, knots + 1 - FIXED_KNOTS)
    excess = free - ca.fmin(ca.fmax(free, -0.995 * ceiling), 0.995 * ceiling)
    # A little more than the excess, since the fit smoothes.
    more = relief + RELIEF * ca.horzcat(ca.MX(n, FIXED_KNOTS), excess)
    over = ca.mmax(ca.fabs(free[driven, :]) - ceiling[driven, :])
    outputs = {"motor": torque, "more": more, "over": over, "reached": _largest(free)}
    return named_function("relieve", inputs, outputs)
