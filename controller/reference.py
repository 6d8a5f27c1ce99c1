"""What the machine should do: positions, velocities and accelerations over the task's time."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Task

Array = NDArray[np.float64]

ENTRY_S = 0.5  # from rest onto the task's reference


class Reference(Protocol):
    """A motion to follow."""

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Position [rad or m], velocity, acceleration at times (m,) of the task: each (m, axes)."""


class Sines:
    """offset + rate t + amplitude sin(2 pi harmonic f t + phase) on each axis."""

    def __init__(self, task: Task) -> None:
        self._offset = np.array([a.offset for a in task.axes])
        self._amplitude = np.array([a.amplitude for a in task.axes])
        self._phase = np.array([a.phase_rad for a in task.axes])
        self._rate = np.array([a.rate for a in task.axes])
        harmonic = np.array([a.harmonic for a in task.axes])
        self._angular = 2 * np.pi * task.frequency_Hz * harmonic

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        angle = np.outer(time_s, self._angular) + self._phase
        sine, cosine = np.sin(angle), np.cos(angle)
        position = self._offset + self._amplitude * sine + np.outer(time_s, self._rate)
        velocity = self._amplitude * self._angular * cosine + self._rate
        return position, velocity, -self._amplitude * self._angular**2 * sine


class Entry:
    """A reference entered from rest: the difference to where the machine stands, at rest, fades
    out as the quintic that matches position, velocity and acceleration at both ends. What is
    entered is the reference `turns` (axes,) further on, for good."""

    def __init__(
        self,
        reference: Reference,
        start: Array,
        start_s: float,
        duration_s: float,
        turns: Array | float = 0.0,
    ) -> None:
        self._reference, self._start_s, self._duration_s = reference, start_s, duration_s
        self._turns = turns
        q, v, a = (value[0] for value in reference.at(np.array([start_s])))
        h = duration_s
        offset, slope, curve = start - q - turns, -v * h, -a * h**2 / 2
        # p(0..2) given, p(1) = p'(1) = p''(1) = 0
        cubic = -10 * offset - 6 * slope - 3 * curve
        quartic = 15 * offset + 8 * slope + 3 * curve
        quintic = -6 * offset - 3 * slope - curve
        value = np.stack([offset, slope, curve, cubic, quartic, quintic])
        power = np.arange(6)[:, None]
        first = value * power / h  # coefficient of s^(k-1)
        second = first * (power - 1) / h  # of s^(k-2)
        self._fade = value, first[1:], second[2:]

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        q, v, a = self._reference.at(time_s)
        q += self._turns
        share = (time_s - self._start_s) / self._duration_s
        entering = share < 1
        if entering.any():
            s = np.clip(share[entering], 0, 1)
            for target, coefficients in zip((q, v, a), self._fade, strict=True):
                powers = np.vander(s, len(coefficients), increasing=True)
                target[entering] += powers @ coefficients
        return q, v, a
