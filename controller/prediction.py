"""The prediction model: the machine together with the servo loops that track its tracks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from headway.configs.axis import Axis
from headway.configs.schema import Config
from headway.controller.equations import LAW_ROWS, TRACK_ROWS, Equations, runge_kutta
from headway.models.codegen import Call, compile_functions, compile_mapped, named_function
from headway.models.machine import Machine

Array = NDArray[np.float64]

BORNE_SHARE = 0.7  # of the effort limit


@dataclass(frozen=True)
class ServoLaw:
    """The servos' configured gains and their limits in SI, by axis: zeros on passive ones."""

    kp: Array  # [Nm/rad or N/m]
    kd: Array  # [Nm s/rad or N s/m]
    emf: Array  # c [Nm s/rad or N s/m]
    limit: Array  # [Nm or N]
    coulomb: Array  # [Nm or N], as far as it is known

    @classmethod
    def of(cls, axes: list[Axis]) -> ServoLaw:
        """From the config's axes."""
        drives = [
            (0.0, 0.0, 0.0) if axis.passive else (axis.servo.kp, axis.servo.kd, axis.motor.damping)
            for axis in axes
        ]
        kp, kd, emf = np.array(drives).T
        limit, coulomb = ([a.effort_limit for a in axes], [a.coulomb for a in axes])
        return cls(kp, kd, emf, np.array(limit), np.array(coulomb))

    @property
    def driven(self) -> list[int]:
        """Indices of the axes with a motor."""
        return np.flatnonzero(self.limit > 0).tolist()

    def borne(self, disturbance: Array) -> Array:
        """What a plan counts on of an estimated disturbance (n,): no plan ends at rest under more
        than the motor can hold, and what pushes at a passive axis now would in a plan speed it up
        until the end."""
        least, most = self._borne
        return np.minimum(np.maximum(disturbance, least), most)

    @cached_property
    def _borne(self) -> tuple[Array, Array]:
        return -BORNE_SHARE * self.limit, BORNE_SHARE * self.limit

    @property
    def parameters(self) -> Array:
        """As the equations of motion take them (2n)."""
        return np.concatenate((self.limit, self.coulomb))

    @property
    def feedback(self) -> Array:
        """[Kp, Kd + c] as configured (2n)."""
        return np.concatenate((self.kp, self.kd + self.emf))


class Prediction:
    """Compiled functions of one machine: the closed loop's slope for the estimator, its roll-out,
    open-loop linearization for the optimal control problem, and inverse dynamics.

    States are x = [q, v] (2n); `tracks` are [r, r', f, Kp, Kd + c] (5n); d is the disturbance
    torque (n).

        servoed    x, tracks, d to x'
        slope      and to the accelerations' Jacobians in x (n, 2n) and in d (n, n)
        rollout    x, d, tracks at start, middle and end, dt, of each of `horizon_knots` steps in a
                   row to each x after, `states`
        linearize  x, torques u0 at start and u1 at end, d, dt, for each of `intervals`
                   to x after, its Jacobians in x, u0, u1
        given      x, tracks to the servos' torques, as far as the motors give them
        inverse    q, v, a to motor torques
        along      the same at `horizon_knots` + 1 knots, side by side
    """

    def __init__(self, machine: Machine, law: ServoLaw, intervals: int, horizon_knots: int) -> None:
        self.law, self.n, self.horizon_knots = law, len(law.kp), horizon_knots
        equations = Equations(machine.tree)
        rollout = _advance(equations).mapaccum("rollout", horizon_knots)
        along = equations.inverse.map("along", "serial", horizon_knots + 1, [3], [])
        rates = equations.servoed, equations.servoed_slope
        functions = [*rates, rollout, equations.given, equations.inverse, along]
        library = compile_functions("machine", functions)
        linearize = compile_mapped("linearize", interval(equations), intervals, [3, 4, 5])
        self._libraries = {"linearize": linearize} | dict.fromkeys(
            ("servoed", "slope", "rollout", "given", "inverse", "along"), library
        )
        self._inverse, self._along = self.call("inverse"), self.call("along")
        self._given = self.call("given")

    @classmethod
    def of(cls, config: Config, machine: Machine) -> Prediction:
        """A config's."""
        mpc, law = config.mpc, ServoLaw.of(config.machine.axes)
        return cls(machine, law, mpc.intervals, mpc.horizon_us // config.loop.knot_us)

    def call(self, name: str, pool: dict[str, Array] | None = None) -> Call:
        """A function by its name, on arrays of its own or on those of a pool, see `Call`. The servo
        law, which does not change, is no longer among its inputs."""
        call = Call(self._libraries[name], name, pool)
        call.inputs.pop()[...] = self.law.parameters[:, None]
        return call

    def given(self, x: Array, tracks: Array) -> Array:
        """The servos' torques (n,) at a state (2n,) under the tracks there (5n,)."""
        call = self._given
        call.inputs[0][:, 0], call.inputs[1][:, 0] = x, tracks
        return call.run()[0][:, 0].copy()

    def inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Motor torques (K+1, n) [Nm or N] of the motion at the horizon's knots by the model."""
        for given, rows in zip(self._along.inputs, (q, v, a), strict=True):
            given.T[...] = rows
        return self._along.run()[0].T.copy()

    def holding(self, q: Array, disturbance: Array) -> Array:
        """Motor torques (n,) that hold the machine at rest at q (n,); none on passive axes, which
        may fall."""
        self._inverse.inputs[0].T[...] = q  # at rest: the others stay zero
        needed = self._inverse.run()[0][:, 0]
        return np.where(self.law.limit > 0, needed - disturbance, 0.0)


def _symbols(n: int) -> tuple[Any, ...]:
    """x, d, dt, law."""
    sizes = {"x": 2 * n, "d": n, "dt": 1, "law": LAW_ROWS * n}
    return tuple(ca.MX.sym(name, size) for name, size in sizes.items())


def _tracks(n: int) -> tuple[Any, Any, Any]:
    """Tracks at a step's start, middle and end."""
    start, middle, end = (
        ca.MX.sym(f"tracks_{at}", TRACK_ROWS * n) for at in ("start", "middle", "end")
    )
    return start, middle, end


def _advance(equations: Equations) -> ca.Function:
    """One servoed step."""
    x, d, dt, law = _symbols(equations.n)
    tracks = _tracks(equations.n)

    def rate(x: Any, tracks: Any) -> Any:
        return equations.servoed(x, tracks, d, law)

    inputs = {"x": x, "d": d, "start": tracks[0], "middle": tracks[1], "end": tracks[2]}
    after = {"states": runge_kutta(rate, x, *tracks, dt)}
    return named_function("advance", {**inputs, "dt": dt, "law": law}, after)


def interval(equations: Equations) -> ca.Function:
    """One driven step, the torque going linearly from u0 to u1, with its Jacobians: the variational
    equation (Hairer, Norsett, Wanner, Solving ODEs I, section I.14), with positions' and
    velocities' halves apart. Half of it is known: a position's rate is the velocity."""
    n = equations.n
    x, d, dt, law = _symbols(n)
    u0, u1 = ca.MX.sym("u0", n), ca.MX.sym("u1", n)
    none = ca.DM.zeros(n, n)

    def rate(q: Any, v: Any, by_q: Any, by_v: Any, share: float) -> tuple[Any, Any]:
        """Accelerations, and their derivatives in [x, u0, u1] (n, 4n) by those of q and v."""
        u = (1 - share) * u0 + share * u1
        rates, by_state, by_torque = equations.driven_slope(ca.vertcat(q, v), u, d, law)
        in_torques = [w * by_torque if w else none for w in (1 - share, share)]
        if share == 0:  # the derivatives of x in itself
            return rates[n:], ca.horzcat(by_state, *in_torques)
        direct = ca.horzcat(none, none, *in_torques)
        return rates[n:], by_state[:, :n] @ by_q + by_state[:, n:] @ by_v + direct

    q, v = x[:n], x[n:]
    by_q, by_v = (ca.MX(ca.densify(ca.DM.eye(4 * n)[i * n : (i + 1) * n, :])) for i in range(2))
    at = q, v, by_q, by_v
    slopes = [(v, by_v, *rate(*at, 0.0))]
    for ahead, share in ((dt / 2, 0.5), (dt / 2, 0.5), (dt, 1.0)):
        dq, by_dq, dv, by_dv = slopes[-1]
        at = q + ahead * dq, v + ahead * dv, by_q + ahead * by_dq, by_v + ahead * by_dv
        slopes.append((at[1], at[3], *rate(*at, share)))
    dq, by_dq, dv, by_dv = (
        dt / 6 * (first + 2 * second + 2 * third + fourth)
        for first, second, third, fourth in zip(*slopes, strict=True)
    )
    after = ca.vertcat(q + dq, v + dv)
    jacobian = ca.vertcat(by_q + by_dq, by_v + by_dv)
    parts = ca.horzsplit(jacobian, [0, 2 * n, 3 * n, 4 * n])
    inputs = {"x0": x, "u0": u0, "u1": u1, "assumed": d, "dt": dt, "law": law}
    outputs = dict(zip(("after", "a", "b0", "b1"), (after, *parts), strict=True))
    return named_function("interval", inputs, outputs)
