"""What the rules look at: a config, its model, and the task's motion with its efforts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from headway.configs.axis import Axis, DrivenAxis
from headway.configs.schema import Config
from headway.controller.reference import task_reference
from headway.models.envelope import Envelope, envelope
from headway.models.machine import Machine, load_machine
from headway.models.stated import Joint, stated
from headway.sim.drives import driven_model
from headway.sim.plant import start_of

Array = NDArray[np.float64]

SAMPLES = 64  # of what takes the least time, at least
STOP_POINTS = 9  # along a stop, at which its efforts are judged
STOP_PHASES = 64  # of the reference, from which stops are judged
STOPS_S = np.geomspace(1e-3, 10.0, 100).tolist()  # times to stop in that are tried, shortest first


@dataclass(frozen=True)
class Motion:
    """Samples (m, n) of the task over its period, SI."""

    time_s: Array
    position: Array
    velocity: Array
    acceleration: Array
    effort: Array  # that the motors need, by the controller's model


class Subject:
    """A config with its model. Raises ValueError where they do not fit together."""

    def __init__(self, config: Config, path: Path, folder: Path | None = None) -> None:
        """`path`: of the model file; `folder`: where a task's file is looked for."""
        self.config = config
        self.machine: Machine = load_machine(path, config.machine.coupling)
        self.axes: list[Axis] = config.machine.axes
        self.driven: dict[int, DrivenAxis] = config.machine.driven
        names = tuple(axis.joint for axis in self.axes)
        self.machine.require_axes(names)
        self.joints: list[Joint] = stated(path, names)
        self.reference = task_reference(config, folder or Path())
        start = start_of(config, self.reference)
        self.start: Array = np.array(start)
        period_us = config.device.servo_period_us
        self.plant: mujoco.MjModel = driven_model(path, config.machine, period_us, start)

    @property
    def effort_limit(self) -> Array:
        """By axis [Nm or N]."""
        return np.array([axis.effort_limit for axis in self.axes])

    @cached_property
    def envelope(self) -> Envelope:
        """Inertias and static loads over the config's range, or over one turn."""
        low, high = np.array([axis.poses for axis in self.axes]).T
        return envelope(self.machine, low, high)

    def effort(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Of the motors along a motion (m, n), with damping and known Coulomb friction."""
        coulomb = np.array([axis.coulomb for axis in self.axes])
        needed = self.machine.efforts(position, velocity, acceleration)
        total: Array = needed + coulomb * np.sign(velocity)
        return total

    @cached_property
    def motion(self) -> Motion:
        """The task over its period, but no longer than it lasts."""
        length_s = min(self.reference.period_s, self.config.duration_s)
        step_s = min(self.config.loop.knot_us * 1e-6, self.reference.fastest_s / SAMPLES)
        time_s = np.arange(0, length_s, step_s)
        q, v, a = self.reference.at(time_s)
        return Motion(time_s, q, v, a, self.effort(q, v, a))

    def touching(self, positions: Array) -> dict[str, int]:
        """Pairs of bodies that touch along positions (m, n), with the first row where they do."""
        model, met = self.plant, dict[str, int]()
        data = mujoco.MjData(model)
        for row, position in enumerate(self.machine.coupling.joints(positions)):
            for axis, q in zip(self.axes, position, strict=True):
                data.joint(axis.joint).qpos[0] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            for contact in data.contact:
                bodies = [model.body(model.geom_bodyid[geom]).name for geom in contact.geom]
                met.setdefault(" and ".join(bodies), row)
        return met

    def stop_s(self) -> float:
        """Longest time that the machine needs to stop from any point of the task.

        The stop goes straight on in joint space with constant deceleration, as fast as the effort
        limits allow at nine points along it.
        """
        motion, longest = self.motion, 0.0
        share = np.linspace(0, 1, STOP_POINTS)[:, None]
        every = max(1, len(motion.time_s) // STOP_PHASES)
        for q, v in zip(motion.position[::every], motion.velocity[::every], strict=True):

            def possible(stop_s: float, q: Array = q, v: Array = v) -> bool:
                position = q + v * stop_s * (share - share**2 / 2)
                slowing = np.tile(-v / stop_s, (STOP_POINTS, 1))
                efforts = np.abs(self.effort(position, v * (1 - share), slowing))
                driven = list(self.driven)  # nobody stops the others
                return bool(np.all(efforts[:, driven] <= self.effort_limit[driven]))

            if longest < np.inf and not (longest > 0 and possible(longest)):
                longest = max(longest, next((t for t in STOPS_S if possible(t)), np.inf))
        return longest
