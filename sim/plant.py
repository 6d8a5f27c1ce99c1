"""The plant: a MuJoCo model whose motors are boards running the firmware."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Config, Machine
from headway.configs.schema import Plant as PlantConfig
from headway.controller.reference import Reference
from headway.models.coupling import Coupling
from headway.sim import _board
from headway.sim.drives import driven_model

DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
# Impedance of dry friction (MuJoCo, "Solver parameters"). With the default, 0.9 to 0.95, a loaded
# joint that should stick creeps by a milliradian a second.
STICKING = 0.9995, 0.9999
COUNTS_PER_UNIT, GEAR, TORQUE_CONSTANT, RESISTANCE, SUPPLY, BRAKE = range(6)  # actuator user data


class UnstableError(Exception):
    """The simulated machine's motion grew beyond all bounds."""


def start_of(config: Config, reference: Reference) -> list[float]:
    """Where the axes are at power-up [rad or m]: as configured, else where the task starts."""
    return config.sim.start_rad_or_m or reference.at(np.zeros(1))[0][0].tolist()


class Plant:
    """Steps the machine; each axis of the config is one node (device and board), but for the last
    ones if they have no encoder.

    Raises ValueError where config and model do not fit together.
    """

    def __init__(
        self,
        path: Path,
        machine: Machine,
        config: PlantConfig,
        servo_period_us: int,
        start: Sequence[float],
    ) -> None:
        """`start`: positions of the axes at power-up [rad or m]."""
        self.model = driven_model(path, machine, servo_period_us, start)
        self._vary(machine, config)
        self.data = mujoco.MjData(self.model)
        # Views of what MuJoCo has: to ask it for them takes longer than to read them.
        self._q, self._v, self._effort = self.data.qpos, self.data.qvel, self.data.actuator_force
        self.step_us = round(self.model.opt.timestep * 1e6)
        self._warnings = [self.data.warning[kind] for kind in DIVERGED]
        self.nodes: list[_board.Node] = []
        self._coupling = Coupling.of(machine.coupling, len(machine.axes))
        joints = [self.model.joint(axis.joint).id for axis in machine.axes]
        self._qpos, self._dof = self.model.jnt_qposadr[joints], self.model.jnt_dofadr[joints]
        boards = {name: a for a, name in enumerate(map(self._driven, range(self.model.nu)))}
        self._actuator = np.array([boards[axis.joint] for axis in machine.boards], dtype=int)
        for actuator in self._actuator:
            window = self.model.plugin_stateadr[self.model.actuator_plugin[actuator]]
            numbers = self.data.plugin_state[window : window + _board.NODE_NUMBERS]
            self.nodes.append(_board.Node(numbers))
        self.position = np.array(start)

    def _driven(self, actuator: int) -> str:
        """The name of an actuator's joint or tendon."""
        target = int(self.model.actuator_trnid[actuator, 0])
        on_joint = self.model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
        return str((self.model.joint(target) if on_joint else self.model.tendon(target)).name)

    def _vary(self, machine: Machine, config: PlantConfig) -> None:
        model = self.model
        for body, factor in config.mass_scale.items():
            index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
            if index < 0:
                raise ValueError(f"sim.plant.mass_scale: the model has no body {body}")
            model.body_mass[index] *= factor
            model.body_inertia[index] *= factor
        model.dof_damping[:] *= config.viscous_scale
        for axis, coulomb in zip(machine.axes, config.coulomb_Nm_or_N or [], strict=False):
            tendon = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TENDON, axis.joint)
            if tendon >= 0:
                model.tendon_frictionloss[tendon] = coulomb
            else:
                model.dof_frictionloss[model.joint(axis.joint).dofadr] = coulomb
        model.dof_solimp[:, :2] = model.tendon_solimp_fri[:, :2] = STICKING
        if model.nuser_actuator > TORQUE_CONSTANT:
            model.actuator_user[:, TORQUE_CONSTANT] *= config.motor_constant_scale
        mujoco.mj_setConst(model, mujoco.MjData(model))

    @property
    def true_us(self) -> int:
        """The simulator's own time; nothing on the host or a device reads it."""
        return int(self.nodes[0].true_us)

    @property
    def position(self) -> NDArray[np.float64]:
        """True positions of the axes [rad or m]."""
        return self._coupling.axes(self._q[self._qpos])

    @position.setter
    def position(self, value: NDArray[np.float64]) -> None:
        self._q[self._qpos] = self._coupling.joints(value)

    @property
    def velocity(self) -> NDArray[np.float64]:
        """True velocities of the axes [rad/s or m/s]."""
        return self._coupling.axes(self._v[self._dof])

    @property
    def torque(self) -> NDArray[np.float64]:
        """Torque (or force) of motor and brake [Nm or N], by axis."""
        torque = np.zeros(len(self._dof))
        torque[: len(self._actuator)] = self._effort[self._actuator]
        return torque

    def set_bridge(self, capacitance_F: float) -> None:
        """Capacitance of every board's bridge [F]; 0: the supply takes back what it is fed."""
        for node in self.nodes:
            node.capacitance_F = capacitance_F

    def push(self, axis: int, effort: float) -> None:
        """From now on the axis is pushed at by so much more [Nm or N]."""
        self.data.qfrc_applied[self._dof] += effort * self._coupling.axes_by_joints[axis]

    def step(self, count: int) -> None:
        """Advances plant, servos and devices by `count` physics steps. Raises UnstableError."""
        mujoco.mj_step(self.model, self.data, count)
        position, velocity, acceleration = self._warnings
        if position.number or velocity.number or acceleration.number:  # MuJoCo has reset itself
            raise UnstableError(
                "the simulated machine's motion is unstable: check sim.plant, the "
                "servo's gains and the model"
            )
