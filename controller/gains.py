"""Gain tracks: the servos' gains as the devices evaluate them, constant or following the inertia.

A servo's closed loop on an inertia m, m s^2 + (Kd + c) s + Kp + Ki / s, keeps its natural frequency
and its damping when all its gains go with m; c, the back-EMF's damping, is a constant of the motor,
so Kd = (Kd0 + c) m / m_max - c (gain scheduling: Astrom and Wittenmark, Adaptive Control, 1995,
chapter 9).

What inertia a joint's loop meets at its crossover depends on the others. They are held by servos:
one with a higher crossover is as good as locked, one with a lower crossover gives way, against its
own inertia and its own servo. With s = i w at the joint's configured crossover, S the joints of
lower crossover and Z = Kp + (Kd + c) s their servos at their scheduled gains, it is

    m_j = |M_jj - M_jS (M_SS + Z_S / s^2)^-1 M_Sj|

so the gains are found joint by joint, from the slowest on: successive loop closure, Maciejowski,
Multivariable Feedback Design, 1989, section 4.2.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Config
from headway.controller.prediction import ServoLaw
from headway.devices import core
from headway.devices._tracks import Course
from headway.devices.axis import (
    AxisUnits,
    gain_factors,
    gain_limits,
    gain_scales,
    position_limits,
    torque_limits,
)
from headway.devices.remote import GAIN_SINKS, Points
from headway.devices.widest import fits_a_frame
from headway.models.envelope import postures
from headway.models.machine import Machine

Array = NDArray[np.float64]


class Schedule:
    """The share of its configured gains that each joint has at a configuration."""

    def __init__(self, machine: Machine, law: ServoLaw, low: Array, high: Array) -> None:
        """`low` and `high` (n,): the range in which the largest inertias are looked for."""
        self._machine, self._law = machine, law
        mass = machine.mass(postures(low, high))
        self.crossover = _crossover(law, mass.diagonal(axis1=1, axis2=2).max(axis=0))  # [rad/s]
        self._order: list[int] = np.argsort(self.crossover, kind="stable").tolist()
        share, self._inertia_max = np.empty(mass.shape[:2]), np.empty(len(low))
        for at, joint in enumerate(self._order):
            inertia = self._inertia(mass, share, at)
            self._inertia_max[joint] = inertia.max()
            share[:, joint] = inertia / inertia.max()

    def __call__(self, position: Array) -> Array:
        """Shares (m, n), above 0 and at most 1, at positions (m, n)."""
        mass, share = self._machine.mass(position), np.empty(position.shape)
        for at, joint in enumerate(self._order):
            share[:, joint] = self._inertia(mass, share, at) / self._inertia_max[joint]
            np.minimum(share[:, joint], 1.0, out=share[:, joint])  # the largest is of a sample
        return share

    def _inertia(self, mass: Array, share: Array, at: int) -> Array:
        """What the loop number `at` from the slowest on meets at its crossover (m,) [kg m^2 or kg],
        where `share` (m, n) has the slower joints' shares."""
        law, joint, slower = self._law, self._order[at], self._order[:at]
        own: Array = mass[:, joint, joint]
        if not slower:
            return own
        s = 1j * self.crossover[joint]
        damping = np.maximum((law.kd + law.emf)[slower] * share[:, slower], law.emf[slower])
        servo = (law.kp[slower] * share[:, slower] + damping * s) / s**2
        others = mass[:, slower][:, :, slower] + servo[:, :, None] * np.eye(at)
        coupling = mass[:, slower, joint]
        moved = np.linalg.solve(others, coupling[:, :, None].astype(complex))[:, :, 0]
        inertia: Array = np.abs(own - (coupling * moved).sum(axis=1))
        return inertia


def _crossover(law: ServoLaw, inertia: Array) -> Array:
    """Frequencies (n,) [rad/s] at which |Kp + (Kd + c) i w| = m w^2."""
    square = (law.kd + law.emf) ** 2
    return np.sqrt((square + np.sqrt(square**2 + 4 * (law.kp * inertia) ** 2)) / (2 * inertia**2))


class Gains:
    """The gains that the servos use: as configured, or tracks of the sinks in `sinks`.

    Raises ValueError where a plan with gain tracks might not fit a frame.
    """

    def __init__(self, config: Config, machine: Machine, plan_points: int) -> None:
        device, loop, every_axis = config.device, config.loop, config.machine.axes
        axes = list(config.machine.driven.values())
        self._law, self._shift = ServoLaw.of(every_axis), loop.knot_shift
        self.axes, self.driven = len(every_axis), self._law.driven
        self.sinks: tuple[int, ...] = () if loop.gains == "off" else GAIN_SINKS
        units = [AxisUnits.of(axis, loop) for axis in axes]
        self.limits = [gain_limits(axis, device, u) for axis, u in zip(axes, units, strict=True)]
        # By sink, and in each by axis: SI per mantissa, the gate's limits.
        self._per_mantissa, self._top, self._step = (dict[int, Array]() for _ in range(3))
        for sink in GAIN_SINKS:
            scales = [gain_scales(a, device, u)[sink] for a, u in zip(axes, units, strict=True)]
            factors = np.array([gain_factors(device, u)[sink] for u in units])
            self._per_mantissa[sink] = 0.5 ** np.array([s.shift for s in scales]) / factors
            of_sink = [limits[sink] for limits in self.limits]
            self._top[sink] = np.array([float(limits.point_max) for limits in of_sink])
            self._step[sink] = np.array([float(limits.difference_max) for limits in of_sink])
        self._schedule: Schedule | None = None
        if loop.gains == "scheduled":
            low, high = np.array([axis.poses for axis in every_axis]).T
            self._schedule = Schedule(machine, self._law, low, high)
        if self.sinks:
            for axis, u, limits in zip(axes, units, self.limits, strict=True):
                every = {
                    core.TRACK_POSITION: position_limits(axis, u),
                    core.TRACK_TORQUE: torque_limits(axis, u),
                    **limits,
                }
                if not fits_a_frame(every, plan_points):
                    raise ValueError(
                        f"loop.gains is {loop.gains}: a plan of {plan_points} points with gain "
                        f"tracks, swinging as far as the gate of {axis.joint} allows, does not fit "
                        "a frame: choose a shorter mpc.horizon_us, a longer loop.knot_us or "
                        "loop.gains: off"
                    )

    def points(self, position: Array) -> Array:
        """The gains at positions (m, n) in units of control points: (m, s w), sink by sink, for w
        driven axes."""
        if self._schedule is None:
            top = [self._top[sink] for sink in self.sinks] or [np.empty(0)]
            return np.concatenate(top)[None].repeat(len(position), axis=0)
        law, share = self._law, self._schedule(position)
        emf = np.divide(law.emf, law.kd, out=np.zeros_like(law.kd), where=law.kd > 0)
        damping = np.clip((1 + emf) * share - emf, 0, 1)
        shares = {core.TRACK_KP: share, core.TRACK_KI: share, core.TRACK_KD: damping}
        return np.hstack([shares[sink][:, self.driven] * self._top[sink] for sink in self.sinks])

    def still(self, position: Array, count: int) -> Points:
        """By driven axis and sink, `count` equal control points of the gains at a position (n,)."""
        return self._by_axis(self.points(position[None]).repeat(count, axis=0))

    def bounded(self, points: Array) -> Points:
        """By driven axis and sink, control points that the gate takes.

        `points` (m, s w), as in `points`: the first three are committed. Where the others leave the
        gate's limits an axis' gains are drawn together towards the committed ones, which may
        always stay.
        """
        top = np.concatenate([self._top[sink] for sink in self.sinks])
        step = np.concatenate([self._step[sink] for sink in self.sinks])
        wanted, stay = np.clip(points, 0, top), points.copy()
        stay[3:] = points[2]
        share = np.ones_like(top)
        for order in (1, 2):
            rest = np.diff(stay, order, axis=0)
            way = np.diff(wanted, order, axis=0) - rest
            size = np.abs(way)
            # Rounding adds up to two quanta to a second difference.
            room = np.maximum(step - 2 - rest * np.sign(way), 0)
            shares = np.divide(room, size, out=np.ones_like(way), where=size > room)
            share = np.minimum(share, shares.min(axis=0))
        together = np.tile(share.reshape(len(self.sinks), -1).min(axis=0), len(self.sinks))
        return self._by_axis(stay + together * (wanted - stay))

    def _by_axis(self, points: Array) -> Points:
        shape = len(points), len(self.sinks), len(self.limits)
        return np.rint(points).reshape(shape).transpose(2, 1, 0).astype(np.int32, order="C")

    def course(self, tracks: Sequence[Sequence[core.Track]], units: list[AxisUnits]) -> Course:
        """What devices with such tracks execute; `tracks` has a row of them, by sink, for each
        driven axis, as `units` are."""
        by_sink = list(zip(*tracks, strict=True))
        kp, kd, none, constant = core.TRACK_KP, core.TRACK_KD, list[core.Track](), np.empty(0)
        gains = none, none, constant, constant, constant
        if self.sinks:
            scales = self._per_mantissa[kp], self._per_mantissa[kd], self._law.emf[self.driven]
            gains = [*by_sink[kp]], [*by_sink[kd]], *scales
        return Course(
            self.driven,
            [*by_sink[core.TRACK_POSITION]],
            [*by_sink[core.TRACK_TORQUE]],
            [u.pq_per_unit for u in units],
            [u.tq_per_effort for u in units],
            [u.continuous for u in units],
            self._shift,
            np.concatenate((np.zeros(3 * self.axes), self._law.feedback)),
            *gains,
        )
