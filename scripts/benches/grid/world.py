"""A machine that is not as its model says, disturbed, and where it is to go."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from headway.configs.load import load_config
from headway.configs.schema import Config
from headway.controller.ocp import Limits
from headway.controller.reference import task_reference
from headway.models.machine import Machine, load_machine

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[3]

STEP_S = 256e-6  # of the simulated machine
MASS_ERROR = 0.1, 0.3  # each body's, either way
FRICTION_SHARE, FRICTION_SPEED = 0.02, 0.03  # of the torque limit; smoothed over [rad/s or m/s]
POSITION_NOISE, SPEED_NOISE = 5e-5, 5e-3  # standard deviations: rad or m, and per second
PULSE_S, PULSE_EVERY_S, PULSE_SHARE = 0.06, 0.7, 0.4  # of the torque limit, on one axis at a time
JUMP_EVERY_S, JUMP_SHARE = 0.8, 0.3  # of the range of the axis, or of a radian
OBSERVER = 0.05  # share of what a tick's speed is off by that is taken for a disturbance at once


@dataclass(frozen=True)
class Problem:
    """A shipped machine with its weights, on a grid of so many intervals."""

    name: str
    config_file: str  # in configs/, or anywhere
    changes: tuple[str, ...] = ()

    @property
    def _path(self) -> Path:
        return ROOT / "configs" / self.config_file

    def config(self, intervals: int, knots: int, *more: str) -> Config:
        """The cost is an integral over the horizon: weights of nodes go with their distance, those
        of torque steps against it."""
        base = load_config(self._path, list(self.changes))
        knot_us, mpc = base.loop.knot_us, base.mpc
        longer = knots * knot_us / intervals / (mpc.horizon_us / mpc.intervals)

        def times(weight: Any, factor: float) -> str:
            values = weight if isinstance(weight, list) else [weight]
            scaled = [float(value) * factor for value in values]
            return str(scaled if isinstance(weight, list) else scaled[0])

        said = [
            f"mpc.horizon_us={knots * knot_us}", f"mpc.intervals={intervals}",
            f"mpc.position_weight={times(mpc.position_weight, longer)}",
            f"mpc.velocity_weight={times(mpc.velocity_weight, longer)}",
            f"mpc.soft_weight={times(mpc.soft_weight, longer)}",
            f"mpc.torque_step_weight={times(mpc.torque_step_weight, 1 / longer)}",
        ]  # fmt: skip
        return load_config(self._path, [*self.changes, *said, *more])

    def machine(self) -> Machine:
        """As the controller knows it."""
        base = load_config(self._path, list(self.changes))
        return load_machine(self._path.parent / base.machine.model)


class World:
    """One closed loop's machine. Equal seeds meet equal masses, noise, pulses and jumps."""

    def __init__(self, config: Config, machine: Machine, seed: int) -> None:
        axes, self.tick_s = config.machine.axes, config.loop.knot_us * 1e-6
        rng = self._rng = np.random.default_rng(seed)
        self._nominal, self._plant = machine.model, machine.model.copy()
        for body in range(1, self._plant.njoints):
            size = rng.uniform(*MASS_ERROR) * rng.choice([-1, 1])
            inertia = self._plant.inertias[body]
            self._plant.inertias[body] = pin.Inertia(
                inertia.mass * (1 + size), inertia.lever, inertia.inertia * (1 + size)
            )
        self._data, self._own = self._plant.createData(), machine.model.createData()
        self.effort = np.array([a.effort_limit for a in axes])
        self.speed = np.array([a.velocity_limit for a in axes])
        limits = Limits.of(config)
        self._low, self._high = limits.soft_min, limits.soft_max
        self._task = task_reference(config, ROOT / "configs")
        self.q: Array = self._task.at(np.zeros(1))[0][0]
        self.v = np.zeros_like(self.q)
        self.d = np.zeros_like(self.q)  # as the controllers estimate it
        self._offset, self._pulse, self._ticks = np.zeros_like(self.q), np.zeros_like(self.q), 0
        self._predicted = np.zeros_like(self.q)

    def advance_tasks(self) -> None:
        """A new tick: perhaps a jump of the reference or a pulse."""
        n, rng, t = len(self.q), self._rng, self._ticks * self.tick_s
        jump, axis, sign = rng.uniform(-1, 1, n), rng.integers(n), rng.choice([-1, 1])

        def begins(every_s: float) -> bool:
            return int(t / every_s) != int((t - self.tick_s) / every_s)

        if self._ticks and begins(JUMP_EVERY_S):
            self._offset = jump * JUMP_SHARE * np.minimum((self._high - self._low) / 2, 2.0)
        if self._ticks and begins(PULSE_EVERY_S):
            self._pulse = np.eye(n)[axis] * sign * PULSE_SHARE * self.effort
        if t % PULSE_EVERY_S > PULSE_S:
            self._pulse = np.zeros(n)
        self._noise = rng.normal(size=2 * n)

    def wanted(self, after_s: Array) -> Array:
        """States (2n, m) at so long after now."""
        q, v = self._task.at(self._ticks * self.tick_s + after_s)[:2]
        return np.vstack((np.clip(q + self._offset, self._low, self._high).T, v.T))

    def measured(self) -> Array:
        """State (2n,)."""
        n = len(self.q)
        noise = np.repeat([POSITION_NOISE, SPEED_NOISE], n) * self._noise
        return np.concatenate((self.q, self.v)) + noise

    def observe(self, state: Array) -> None:
        """From what the last tick's speed should be, the disturbance."""
        if self._ticks:
            n = len(self.q)
            mass = pin.crba(self._nominal, self._own, state[:n])
            off = mass @ (state[n:] - self._predicted) / self.tick_s
            self.d = np.clip(self.d + OBSERVER * off, -0.5 * self.effort, 0.5 * self.effort)

    def holding(self, q: Array) -> Array:
        """Torques (n,) that hold the model there; none on passive axes."""
        gravity = np.array(pin.computeGeneralizedGravity(self._nominal, self._own, q))
        return np.where(self.effort > 0, gravity, 0.0)

    def move(self, state: Array, begin: Array, end: Array) -> None:
        """A tick long, torques (n,) going from one to another; `state`: as it was measured."""
        n, steps = len(self.q), round(self.tick_s / STEP_S)
        at = np.array(state)
        for i in range(steps):
            torque = np.clip(begin + (end - begin) * (i + 0.5) / steps, -self.effort, self.effort)
            friction = FRICTION_SHARE * self.effort * np.tanh(self.v / FRICTION_SPEED)
            friction = friction + self._plant.damping * self.v
            net = torque + self._pulse - friction
            self.v = self.v + STEP_S * pin.aba(self._plant, self._data, self.q, self.v, net)
            self.q = self.q + STEP_S * self.v
            net = torque + self.d - self._nominal.damping * at[n:]
            if i % 4 == 0:
                rate = pin.aba(self._nominal, self._own, at[:n], at[n:], net)
            at[n:] += STEP_S * rate
            at[:n] += STEP_S * at[n:]
        self._predicted = at[n:]
        self._ticks += 1
