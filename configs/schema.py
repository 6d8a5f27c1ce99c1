"""What a config may say: every key with its unit, its range and its default."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

SMALL, LARGE = 1e-9, 1e12  # what is beyond, in any unit, is a slip of the pen
Positive = Annotated[float, Field(ge=SMALL, le=LARGE, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=LARGE, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-LARGE, le=LARGE, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Delay = Annotated[int, Field(ge=0, le=10_000_000)]  # us


class Section(BaseModel):
    """Unknown keys and wrong types are errors; nothing changes after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Motor(Section):
    """A geared brushed DC motor, as the device's settings have it."""

    gear: Positive
    torque_constant_Nm_per_A: Positive
    resistance_ohm: Positive
    supply_V: Positive


class Servo(Section):
    """The device's PID, at the joint."""

    kp_Nm_per_rad: NotNegative
    ki_Nm_per_rad_s: NotNegative = 0.0
    kd_Nm_s_per_rad: NotNegative


class Axis(Section):
    """One joint with its motor, encoder and board."""

    joint: str
    counts_per_turn: Annotated[int, Field(ge=16, le=2**22)]
    position_min_rad: Finite
    position_max_rad: Finite
    velocity_limit_rad_per_s: Positive
    acceleration_limit_rad_per_s2: Positive
    torque_limit_Nm: Positive
    coulomb_Nm: NotNegative = 0.0  # friction that the controller knows of
    motor: Motor
    servo: Servo

    @model_validator(mode="after")
    def _range(self) -> Axis:
        if self.position_min_rad >= self.position_max_rad:
            raise ValueError("position_min_rad must be below position_max_rad")
        return self


class Machine(Section):
    """The model file and the axes that move it; the order of axes is the order of devices."""

    model: str  # MJCF or URDF, relative to the config file
    axes: Annotated[list[Axis], Field(min_length=1)]


class Device(Section):
    """What all boards of the machine share."""

    servo_period_us: Annotated[int, Field(ge=100, le=10000)] = 1000
    sample_every: Annotated[int, Field(ge=1, le=100)] = 2  # servo periods
    integrate_while_running: bool = False


class Loop(Section):
    """The loop's rate and its distance ahead of now."""

    knot_us: Literal[512, 1024, 2048, 4096, 8192, 16384, 32768] = 4096
    margin_us: Annotated[int, Field(ge=1024, le=200000)]

    @property
    def knot_shift(self) -> int:
        """s of h = 2^s microseconds."""
        return self.knot_us.bit_length() - 1

    @property
    def margin_knots(self) -> int:
        """The margin in whole knots, rounded up."""
        return -(-self.margin_us // self.knot_us)


class Sine(Section):
    """offset + amplitude sin(2 pi harmonic frequency t + phase)."""

    offset_rad: Finite = 0.0
    amplitude_rad: Finite
    harmonic: Positive = 1.0
    phase_rad: Finite = 0.0


class Task(Section):
    """What to do: follow a sine on each axis."""

    kind: Literal["sines"]
    frequency_Hz: Positive
    axes: list[Sine]


class Mpc(Section):
    """The optimal control problem's horizon and weights."""

    enabled: bool = True  # off: the reference itself is streamed
    feedforward: Literal["none", "model"] = "model"  # with mpc off: the torque track
    horizon_us: Annotated[int, Field(ge=20000, le=2000000)] = 212992
    intervals: Annotated[int, Field(ge=4, le=200)] = 26
    position_weight: Positive = 1.0e6  # 1/rad^2
    velocity_weight: NotNegative = 2.0e2  # s^2/rad^2
    torque_step_weight: NotNegative = 0.5  # 1/Nm^2, on the change from node to node
    torque_start_weight: NotNegative = 20.0  # 1/Nm^2, on the jump from the committed torque
    # Shares of the horizon between which tracking gives way to stopping.
    fade_start: Share = 0.22
    fade_end: Share = 0.45
    # Share of the torque limit that is planned from the horizon's middle on. Less makes the plan
    # give way earlier to a reference that asks for more torque than there is.
    torque_share_end: Annotated[float, Field(gt=0, le=1)] = 0.85
    soft_min_rad: list[Finite] | None = None
    soft_max_rad: list[Finite] | None = None
    soft_weight: Positive = 1.0e7
    max_iterations: Annotated[int, Field(ge=10, le=100000)] = 150


class Estimator(Section):
    """Noise of the Kalman filter, as standard deviations."""

    disturbance: bool = True  # off: no disturbance torque is estimated
    acceleration_noise_rad_per_s15: NotNegative = 0.3  # rad/s^2 per sqrt(Hz)
    disturbance_noise_Nm_per_s05: NotNegative = 4.5  # random walk
    measurement_noise_counts: Positive = 0.289  # rounding to whole counts: 1 / sqrt(12)
    gate_sigma: Positive = 6.0  # samples further out are outliers


class Plant(Section):
    """How the simulated machine differs from the model: what the controller does not know."""

    mass_scale: dict[str, Positive] = {}  # body: factor on its mass and inertia
    coulomb_Nm: list[NotNegative] | None = None
    viscous_scale: Positive = 1.0
    motor_constant_scale: Positive = 1.0


class Channel(Section):
    """One direction of the simulated network."""

    delay_us: Delay = 3000
    jitter_us: Delay = 1000
    loss: Share = 0.01
    reorder: Share = 0.0
    reorder_us: Delay = 4000

    @model_validator(mode="after")
    def _order(self) -> Channel:
        if self.jitter_us > self.delay_us:
            raise ValueError("jitter_us must not exceed delay_us: no packet arrives before it left")
        return self


class Clocks(Section):
    """Oscillators of the simulated boards."""

    drift_ppm: Annotated[float, Field(ge=0, le=150)] = 30.0  # each device's drawn within +-


class Sim(Section):
    """The simulated world around the controller."""

    plant: Plant = Plant()
    to_device: Channel = Channel()
    to_host: Channel = Channel()
    clocks: Clocks = Clocks()
    # The p99.9 of a tick of arm2 on two shared cores, as measured (docs/performance.md).
    compute_us: Delay = 3500
    start_rad: list[Finite] | None = None  # default: where the task starts
    outlier_share: Share = 0.0  # samples replaced by nonsense before the controller sees them
    stall_host_at_s: NotNegative | None = None  # a tick overruns ...
    stall_host_s: Positive = 0.03  # ... by this much
    kill_host_at_s: NotNegative | None = None  # no message leaves the host afterwards


class Config(Section):
    """A machine, its loop, its task and its simulated world."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,25}$")]
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    duration_s: Positive = 10.0
    machine: Machine
    device: Device = Device()
    loop: Loop
    task: Task
    mpc: Mpc = Mpc()
    estimator: Estimator = Estimator()
    sim: Sim = Sim()

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        n = len(self.machine.axes)
        lists = {
            "task.axes": self.task.axes,
            "mpc.soft_min_rad": self.mpc.soft_min_rad,
            "mpc.soft_max_rad": self.mpc.soft_max_rad,
            "sim.plant.coulomb_Nm": self.sim.plant.coulomb_Nm,
            "sim.start_rad": self.sim.start_rad,
        }
        mistakes = [
            f"{key} has {len(value)} entries; the machine has {n} axes"
            for key, value in lists.items()
            if value is not None and len(value) != n
        ]
        if self.mpc.fade_start >= self.mpc.fade_end:
            mistakes.append("mpc.fade_start must be below mpc.fade_end")
        step_us = self.mpc.intervals * self.loop.knot_us
        if self.mpc.horizon_us % step_us:
            mistakes.append(
                f"mpc.horizon_us must be a multiple of mpc.intervals * loop.knot_us = {step_us}"
            )
        if mistakes:
            raise ValueError("; ".join(mistakes))
        return self
