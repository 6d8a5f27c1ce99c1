"""What the machine should do: positions, velocities and accelerations over the task's time."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from headway.configs.schema import Config, Task
from headway.controller.kinematics import postures
from headway.controller.objective import Costs, read_costs
from headway.models.machine import Machine, load_machine

Array = NDArray[np.float64]

ENTRY_S = 0.5  # from rest onto the task's reference
PERIODS_MAX = 10.0  # of sines that do not repeat
ROWS_FASTEST = 4.0  # rows of a file in which something may begin and end


class Reference(Protocol):
    """A motion to follow."""

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Position [rad or m], velocity, acceleration at times (m,) of the task: each (m, axes)."""


class TaskReference(Reference, Protocol):
    """A task's own motion."""

    @property
    def period_s(self) -> float:
        """After this long nothing new comes."""

    @property
    def fastest_s(self) -> float:
        """How long its fastest part takes."""


def task_reference(config: Config, folder: Path) -> TaskReference:
    """Of a config whose relative paths start at `folder`. Raises ValueError for a file that cannot
    be followed."""
    task = config.task
    if task.kind == "custom":
        assert task.file is not None and task.target_rad_or_m is not None
        source = (folder / task.file).resolve()
        parameters = [weighed.task.parameters for weighed in config.weighings]
        return Custom(source, np.array(task.target_rad_or_m), *parameters)
    if task.file is not None and task.tool is not None:
        return _of_tool(config, folder, task.file, task.tool)
    if task.file is not None:
        joints = [axis.joint for axis in config.machine.axes]
        return Stamped(*read_stamped((folder / task.file).resolve(), joints))
    if task.target_rad_or_m is not None:
        return Target(np.array(task.target_rad_or_m))
    return Sines(task)


def _of_tool(config: Config, folder: Path, file: str, tool: str) -> Stamped:
    """Of the joints, from places of a tool. The first posture is the one near the machine's own at
    power-up, if that is given, else near the middle of its range."""
    path, axes = (folder / file).resolve(), config.machine.axes
    machine = load_machine((folder / config.machine.model).resolve(), config.machine.coupling)
    machine.require_axes(tuple(axis.joint for axis in axes))
    time_s, places = read_stamped(path, ["x_m", "y_m", "z_m"])
    low, high = np.array([(axis.lowest, axis.highest) for axis in axes]).T
    middle = np.array([axis.poses for axis in axes]).mean(axis=1)
    start = middle if config.sim.start_rad_or_m is None else np.array(config.sim.start_rad_or_m)
    try:
        return Stamped(time_s, postures(machine, tool, places, start, low, high))
    except ValueError as error:
        raise ValueError(f"task.file: {path}: {error}") from error


class Sines:
    """offset + rate t + amplitude sin(2 pi harmonic f t + phase) on each axis."""

    def __init__(self, task: Task) -> None:
        assert task.frequency_Hz is not None
        self._frequency_Hz = task.frequency_Hz
        self._offset = np.array([a.offset for a in task.axes])
        self._amplitude = np.array([a.amplitude for a in task.axes])
        self._phase = np.array([a.phase_rad for a in task.axes])
        self._rate = np.array([a.rate for a in task.axes])
        self._harmonic = np.array([a.harmonic for a in task.axes])
        self._angular = 2 * np.pi * task.frequency_Hz * self._harmonic

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        angle = time_s[:, None] * self._angular + self._phase
        sine, cosine = np.sin(angle), np.cos(angle)
        position = self._offset + self._amplitude * sine + time_s[:, None] * self._rate
        velocity = self._amplitude * self._angular * cosine + self._rate
        return position, velocity, -self._amplitude * self._angular**2 * sine

    @property
    def period_s(self) -> float:
        """Where an axis turns on and on it does not repeat: several periods of the base frequency,
        and at least one turn of each."""
        turns_s = [2 * np.pi / abs(rate) for rate in self._rate if rate != 0]
        repeats = not turns_s and np.all(self._harmonic == np.round(self._harmonic))
        periods_s = (1.0 if repeats else PERIODS_MAX) / self._frequency_Hz
        return float(max(periods_s, *turns_s, 0.0))

    @property
    def fastest_s(self) -> float:
        return float(1 / (self._frequency_Hz * self._harmonic.max()))


class Target:
    """A position to be at."""

    period_s = fastest_s = 1.0

    def __init__(self, position: Array) -> None:
        self._position = position

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        still = np.zeros((len(time_s), len(self._position)))
        return np.tile(self._position, (len(time_s), 1)), still, still.copy()


class Custom(Target):
    """Costs of the task's own, beside a position to be at."""

    def __init__(self, source: Path, position: Array, *parameters: dict[str, float]) -> None:
        super().__init__(position)
        self._source, self._parameters = source, parameters

    def costs(self, machine: Machine) -> Costs:
        """Raises ValueError where the user's file is wrong."""
        return read_costs(self._source, machine, self._position, *self._parameters)


def own_costs(reference: Reference, machine: Machine) -> Costs | None:
    """Of a custom task. Raises ValueError where the user's file is wrong."""
    return reference.costs(machine) if isinstance(reference, Custom) else None


class Stamped:
    """Positions at times, as a cubic spline at rest at both ends, where it stays (de Boor, A
    Practical Guide to Splines, chapter IV)."""

    def __init__(self, time_s: Array, position: Array) -> None:
        self._begin_s, self._end_s = float(time_s[0]), float(time_s[-1])
        self._spline = CubicSpline(time_s, position, bc_type="clamped")
        self.period_s = self._end_s - self._begin_s
        self.fastest_s = float(np.diff(time_s).min()) * ROWS_FASTEST

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Time 0 of the task is the first row's."""
        t = time_s + self._begin_s
        moving = ((t > self._begin_s) & (t < self._end_s))[:, None]
        t = np.clip(t, self._begin_s, self._end_s)
        position, v, a = (self._spline(t, order) for order in range(3))
        return position, np.where(moving, v, 0), np.where(moving, a, 0)


def read_stamped(path: Path, columns: list[str]) -> tuple[Array, Array]:
    """Times (m,) and values (m, k) of a CSV file with time_s and these columns, in any order.

    Raises ValueError with the line of what is wrong.
    """
    try:
        rows = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
    except (OSError, UnicodeError) as error:
        raise ValueError(f"task.file: {path}: cannot be read: {error}") from error
    head, wanted = [name.strip() for name in rows[0]] if rows else [], ["time_s", *columns]
    if sorted(head) != sorted(wanted):
        raise ValueError(
            f"task.file: {path}: line 1 names the columns {', '.join(head)}; the task "
            f"needs {', '.join(wanted)}"
        )
    order, values = [head.index(name) for name in wanted], []
    for number, row in enumerate(rows[1:], 2):
        try:
            values.append([float(row[i]) for i in order])
        except (ValueError, IndexError):
            values.append([np.nan])
        if len(row) != len(head) or not np.isfinite(values[-1]).all():
            raise ValueError(f"task.file: {path}: line {number} is not {len(head)} numbers")
        if len(values) > 1 and values[-1][0] <= values[-2][0]:
            raise ValueError(f"task.file: {path}: line {number}: time_s does not increase")
    if len(values) < 2:
        raise ValueError(f"task.file: {path}: has {len(values)} rows; a motion needs two")
    table = np.array(values)
    return table[:, 0], table[:, 1:]


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
