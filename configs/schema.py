"""What a config may say: every key with its unit, its range and its default."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from headway.configs.axis import Axis, BareAxis, DrivenAxis, Sine
from headway.configs.section import (
    LARGE,
    ByAxis,
    Delay,
    Finite,
    NotNegative,
    Positive,
    Section,
    Share,
)

COUNTS = 2**31 - 1  # of an encoder from zero, either way


class Machine(Section):
    """The model file and its axes."""

    model: str
    """The MJCF or URDF file; a relative path starts at the config."""
    axes: Annotated[list[Axis], Field(min_length=1)]
    """All joints, in the model's order: the order of the devices. One with `passive: true` has an
    encoder alone, with `encoder: false` beside it not even that.
    """

    coupling: list[list[Finite]] | None = None
    """Where motors are not at the joints (belts, differentials): a row for each axis, with what
    each joint's position counts in its own. Without it each axis is its joint. Positions, limits
    and efforts of axes are the motors'.
    """

    @property
    def driven(self) -> dict[int, DrivenAxis]:
        """The axes with a motor, by their index."""
        return {i: axis for i, axis in enumerate(self.axes) if not axis.passive}

    @property
    def boards(self) -> list[Axis]:
        """The axes with a device of their own: the first ones, so that a device has its axis'
        index."""
        return [axis for axis in self.axes if axis.board]

    @property
    def bare(self) -> dict[int, BareAxis]:
        """The others, by their index."""
        return {i: axis for i, axis in enumerate(self.axes) if isinstance(axis, BareAxis)}

    @model_validator(mode="after")
    def _moves(self) -> Machine:
        if not self.driven:
            raise ValueError("every axis is passive: nothing can move the machine")
        for axis, later in pairwise(self.axes):
            if later.board and not axis.board:
                raise ValueError(
                    f"{axis.joint} has no encoder and comes before {later.joint}, which has one: "
                    "joints without an encoder have to be the model's last ones; give it an encoder"
                )
        if self.coupling and self.bare:
            raise ValueError(
                "coupling is of motors and encoders, and an axis with encoder: false has neither: "
                "leave one of the two out"
            )
        n = len(self.axes)
        if self.coupling and [len(row) for row in self.coupling] != [n] * n:
            raise ValueError(f"coupling needs {n} rows of {n} numbers: one for each axis and joint")
        return self


class Device(Section):
    """What all boards of the machine share."""

    servo_period_us: Annotated[int, Field(ge=100, le=10000)] = 1000
    """How often each board runs its servo."""
    sample_every: Annotated[int, Field(ge=1, le=100)] = 2
    """Servo periods from one encoder sample to the next."""
    integrate_while_running: bool = False
    """Whether the servo's integrator also works while a plan runs."""
    brake_us: Annotated[int, Field(ge=0, le=1_000_000)] = 30_000
    """The time that a brake is given to engage or to let go."""
    stop_us: Annotated[int, Field(ge=10_000, le=10_000_000)] = 500_000
    """From a fault or an emergency stop to the brake, at most."""
    sync_lost_us: Annotated[int, Field(ge=100_000, le=60_000_000)] = 1_000_000
    """Without a sign of the host's time for so long, a board stops."""
    position_gap: Literal["interpolate", "ramp", "fault"] = "interpolate"
    """What a board does about missing position points: fill in up to 4, come to rest, or fail."""
    torque_gap: Literal["interpolate", "hold", "zero", "fault"] = "hold"
    """The same for the torque track: fill in, keep the last torque, none, or fail."""


class Loop(Section):
    """The loop's rate and its distance ahead of now."""

    knot_us: Literal[512, 1024, 2048, 4096, 8192, 16384, 32768] = 4096
    """The grid of time: a tick, and a control point of each track, every so often."""
    margin_us: Annotated[int, Field(ge=1024, le=200000)]
    """The time after now in which nothing is changed: longer than wire and computation."""
    gains: Literal["off", "fixed", "scheduled"] = "off"
    """Gain tracks. off: none, the boards use the gains they have. fixed: the same gains as tracks.
    scheduled: gains that follow the inertia along the plan, so that each servo's bandwidth stays
    the same; they are those of machine.axes at the largest inertia and less elsewhere.
    """

    @property
    def knot_shift(self) -> int:
        """s of h = 2^s microseconds."""
        return self.knot_us.bit_length() - 1

    @property
    def margin_knots(self) -> int:
        """The margin in whole knots, rounded up."""
        return -(-self.margin_us // self.knot_us)


class Cable(Section):
    """A wire between two boards, for the time alone."""

    joints: Annotated[list[str], Field(min_length=2, max_length=2)]
    """Whose boards it joins."""
    ports: Annotated[list[Annotated[int, Field(ge=1, le=4)]], Field(min_length=2, max_length=2)]
    """At which port of each it is."""


class Sync(Section):
    """How the boards' clocks follow the host's, and what may be relied on for that."""

    method: Literal["bounds", "average"] = "bounds"
    """bounds: to the middle of what the stamps prove. average: by mean offsets and half the round
    trip; the interval is the same.
    """
    limit_us: Annotated[int, Field(ge=10, le=1_000_000)] = 5_000
    """A board whose clock may be off by more neither arms nor moves. Without known least delays
    this is half of the shortest round trip, and more.
    """
    to_device_least_us: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """No frame takes less time to a board: where it is known, it narrows the interval."""
    to_host_least_us: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """No frame takes less time to the host."""
    dither_us: Annotated[int, Field(ge=0, le=10_000)] = 1_000
    """One STATUS in four leaves up to so much later, at random: on a bus with frames of its own a
    board's stamps would keep step with them otherwise.
    """
    one_bus: bool = False
    """All boards hang on one USB host controller and see the same starts of frames: then they agree
    with each other by these.
    """
    cables: list[Cable] = Field(default=[])
    """Cables by which boards ask each other for the time, beside those to the host."""
    ask_us: Annotated[int, Field(ge=1_000, le=10_000_000)] = 8_192
    """How often they do."""
    cable_least_us: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """No frame takes less time by a cable, either way."""
    drift_ppm: Annotated[float, Field(gt=0, le=300)] = 200.0
    """A board's oscillator and the host's differ by this much at most."""
    wander_ppm_per_s: Annotated[float, Field(gt=0, le=60)] = 1.0
    """That difference changes by this much at most, in a second."""
    average_us: Annotated[int, Field(ge=1_000, le=1_000_000)] = 16_384
    """average: the time over which offsets are averaged."""
    average_phase_per_s: Annotated[float, Field(gt=0, le=10)] = 1.0
    """average: a clock that is behind by x runs faster by x times this."""
    average_skew_per_s: Annotated[float, Field(ge=0, le=0.05)] = 0.01
    """average: and by x times this more each time, which finds its oscillator's own drift."""


class Links(Section):
    """Where the machine's devices may be found, besides the ports of plants."""

    serial: list[str] = Field(default=["/dev/headway-*"])
    """Serial ports, with * and ? for what varies. devices/60-headway.rules has boards named so."""
    udp: list[Annotated[str, Field(pattern=r"^[A-Za-z0-9.-]+:[0-9]{1,5}$")]] = Field(default=[])
    """Addresses, as HOST:PORT. HELLO is said to each of them."""


class Task(Section):
    """What to do. Each kind has keys of its own."""

    kind: Literal["sines", "track", "regulate", "custom"]
    """sines: to follow a sine on each axis, turning on and on where that is asked for. track: to
    follow the positions in a file. regulate: to go somewhere and to stay there. custom: what costs
    of its own make of it (docs/tasks.md).
    """
    frequency_Hz: Positive | None = None
    """sines: of the sine whose harmonic is 1."""
    axes: list[Sine] = Field(default=[])
    """sines: a sine for each axis."""
    file: str | None = None
    """track: a CSV file with the columns time_s and one for each joint, by its name, in rad or m.
    Between its rows the motion is a cubic spline, at rest at both ends. custom: a Python file with
    a function `objective`. Relative to this config.
    """
    tool: str | None = None
    """track: a body or site of the model. The columns are then time_s and its place in the world,
    x_m, y_m and z_m; joints are found for each row, one posture near the other.
    """
    target_rad_or_m: list[Finite] | None = None
    """regulate, custom: a position for each axis."""
    parameters: dict[str, Finite] = Field(default={})
    """custom: numbers that the file asks for, by name, in place of its own."""

    @model_validator(mode="after")
    def _has_its_keys(self) -> Task:
        own = {
            "sines": ("frequency_Hz", "axes"),
            "track": ("file", "tool"),
            "regulate": ("target_rad_or_m",),
            "custom": ("file", "target_rad_or_m", "parameters"),
        }
        optional = {"tool", "parameters"}
        given = {key for keys in own.values() for key in keys if getattr(self, key)}
        missing = [key for key in own[self.kind] if key not in given | optional]
        if missing:
            raise ValueError(f"a task of the kind {self.kind} needs {' and '.join(missing)}")
        if others := sorted(given - set(own[self.kind])):
            raise ValueError(
                f"a task of the kind {self.kind} has no {' and '.join(others)}: leave it out"
            )
        return self


class Weighing(Section):
    """Other weights, from some time of the task on. What is not given stays as it was before."""

    from_s: Positive
    """Of the task: the first plan that begins then has them."""
    position_weight: ByAxis | None = None
    """As in mpc."""
    velocity_weight: ByAxis | None = None
    """As in mpc."""
    torque_step_weight: ByAxis | None = None
    """As in mpc."""
    torque_start_weight: ByAxis | None = None
    """As in mpc."""
    soft_weight: ByAxis | None = None
    """As in mpc."""
    parameters: dict[str, Finite] = Field(default={})
    """As in task: of the file of a custom task."""

    @property
    def weights(self) -> dict[str, ByAxis]:
        """Those that are given, by name."""
        given = self.model_dump(exclude={"from_s", "parameters"}, exclude_none=True)
        return dict(given)

    @model_validator(mode="after")
    def _changes_something(self) -> Weighing:
        if not self.weights and not self.parameters:
            raise ValueError("changes nothing: give a weight or parameters beside from_s")
        return self


class Mpc(Section):
    """The optimal control problem's horizon and weights."""

    enabled: bool = True
    """Off: the reference itself is streamed."""
    feedforward: Literal["none", "model"] = "model"
    """With MPC off: what the torque track is made of."""
    horizon_us: Annotated[int, Field(ge=20000, le=2000000)] = 212992
    """How far a plan reaches: a multiple of intervals times knot_us."""
    intervals: Annotated[int, Field(ge=4, le=200)] = 26
    """Steps of the horizon."""
    position_weight: ByAxis = 1.0e6
    """On the squared error of the position, in 1/rad^2 or 1/m^2."""
    velocity_weight: ByAxis = 2.0e2
    """On the squared error of the velocity, in s^2/rad^2 or s^2/m^2."""
    torque_step_weight: ByAxis = 0.5
    """On the squared change of effort from node to node, in 1/Nm^2 or 1/N^2."""
    torque_start_weight: ByAxis = 20.0
    """On the squared jump from the committed effort, in 1/Nm^2 or 1/N^2."""
    fade_start: Share = 0.22
    """Share of the horizon from which on tracking gives way to stopping."""
    fade_end: Share = 0.45
    """Share of the horizon from which on only stopping counts."""
    torque_share_end: Annotated[float, Field(gt=0, le=1)] = 0.85
    """Share of the effort limit that is planned from the horizon's middle on. Less makes the plan
    give way earlier to a reference that asks for more than there is.
    """
    soft_weight: ByAxis = 1.0e7
    """On what is beyond a soft limit, squared, in 1/rad^2 or 1/m^2."""
    backend: Literal["osqp", "hpipm", "riccati"] = "osqp"
    """The solver. osqp: an operator splitting method, warm-started. hpipm: an interior-point method
    by stages. riccati: the same kind of method, compiled for the machine, and the fastest: where no
    limit is active it takes one step.
    """
    max_iterations: Annotated[int, Field(ge=10, le=100000)] = 150
    """Of OSQP in one program."""
    sqp_iterations: Annotated[int, Field(ge=1, le=100)] = 1
    """Programs a tick, each linearized around the answer of the last. One is the real-time
    iteration; each more costs as much again, after the estimate has come.
    """
    later: list[Weighing] = Field(default=[])
    """Other weights while the task runs, by the time from which on they hold."""

    @model_validator(mode="after")
    def _in_order(self) -> Mpc:
        for i, (one, next_one) in enumerate(pairwise(self.later)):
            if next_one.from_s <= one.from_s:
                raise ValueError(
                    f"later.{i + 1}.from_s is {next_one.from_s:g}, not after {one.from_s:g} before "
                    "it: put them in the order of time"
                )
        return self


class Estimator(Section):
    """Noise of the Kalman filter, as standard deviations."""

    disturbance: bool = True
    """Off: no disturbance effort is estimated."""
    acceleration_noise_rad_or_m_per_s15: ByAxis = 0.3
    """Unmodelled acceleration, in rad/s^2 or m/s^2 per sqrt(Hz)."""
    disturbance_noise_Nm_or_N_per_s05: ByAxis = 4.5
    """How fast the disturbance wanders."""
    measurement_noise_counts: Positive = 0.289
    """Of an encoder sample. Rounding to whole counts gives 1 / sqrt(12)."""
    gate_sigma: Positive = 6.0
    """Samples further from what is expected are outliers and do not count."""


class Plant(Section):
    """How the simulated machine differs from the model: what the controller does not know."""

    mass_scale: dict[str, Positive] = Field(default={})
    """For a body by its name: the factor on its mass and inertia."""
    coulomb_Nm_or_N: list[NotNegative] | None = None
    """Dry friction of each axis, instead of the model's."""
    viscous_scale: Positive = 1.0
    """The factor on the joints' damping."""
    motor_constant_scale: Positive = 1.0
    """The factor on the motors' torque constants."""


class Channel(Section):
    """One direction of the simulated network."""

    delay_us: Delay = 3000
    """A packet's mean time under way, from when it has been sent and without its tail."""
    jitter_us: Delay = 1000
    """How far that time varies to either side."""
    tail: Share = 0.0
    """Share of packets that take longer, by a time of their own."""
    tail_us: Delay = 0
    """The mean of that time, which is distributed exponentially."""
    loss: Share = 0.01
    """Share of packets that get lost."""
    loss_run: Annotated[float, Field(ge=1, le=1000)] = 1.0
    """Packets that get lost in a row, on average. Never less than what chance alone makes of it."""
    reorder: Share = 0.0
    """Share of packets that are held up, so that others overtake them."""
    reorder_us: Delay = 4000
    """How long they are held up."""
    duplicate: Share = 0.0
    """Share of packets that arrive twice, each after a time of its own."""
    in_order: bool = False
    """No packet overtakes another: it arrives no earlier than those before it."""
    frame_us: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Frame of a bus that all boards share; a packet leaves in its slot of a frame. 0: no bus."""
    slot_us: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Where in the frame that slot is."""
    bandwidth_bit_per_s: Annotated[int, Field(ge=0, le=10**12)] = 0
    """Packets are sent one after the other, bit by bit. 0: at once."""

    @property
    def least_us(self) -> int:
        """No packet is faster: one that is sent the moment its slot comes, to a free wire."""
        return self.delay_us - self.jitter_us

    @property
    def usual_most_us(self) -> int:
        """None is slower but for tails, queues and those held up by `in_order`: one that has just
        missed its slot."""
        return self.delay_us + self.jitter_us + self.frame_us + self.reorder_us * (self.reorder > 0)

    @model_validator(mode="after")
    def _order(self) -> Channel:
        if self.jitter_us > self.delay_us:
            raise ValueError("jitter_us must not exceed delay_us: no packet arrives before it left")
        if self.slot_us and self.slot_us >= self.frame_us:
            raise ValueError("slot_us lies in the frame: it must be less than frame_us")
        if self.tail and not self.tail_us:
            raise ValueError("tail is a share of packets, and tail_us how late they are: set both")
        return self


class Clocks(Section):
    """Oscillators of the simulated boards."""

    drift_ppm: Annotated[float, Field(ge=0, le=150)] = 30.0
    """Each board's oscillator drifts by up to this much, in either direction."""
    # A crystal changes by about 1 ppm per degree (H. Murray, time-nuts, July 2006:
    # febo.com/pipermail/time-nuts/2006-July/021071.html); a board whose motors begin to work warms
    # by some 0.1 degrees a second, which is our choice.
    wander_ppm_per_s: Annotated[float, Field(ge=0, le=1)] = 0.1
    """How fast that drift changes at most, within the same bound: it warms and cools."""


class Mishap(Section):
    """Something that goes wrong in the simulated world."""

    kind: Literal[
        "emergency_stop",
        "reset",
        "partition",
        "encoder_stuck",
        "encoder_reversed",
        "encoder_spike",
        "supply_sag",
        "clock_step",
        "host_clock_step",
        "firmware_hangs",
        "push",
    ]
    """What goes wrong: the emergency line opens, a board restarts, no packet passes, an encoder
    stands still, counts backwards or jumps, the supply sags, a board's counter or the host's clock
    jumps, a board's main loop stands still, somebody
    pushes at a joint."""
    at_s: NotNegative
    """When in the task."""
    for_s: Positive = LARGE
    """How long it lasts; an encoder's defect stays, a reset and a jump are over at once."""
    joint: str | None = None
    """The axis that it happens to. Default: all."""
    supply_V: NotNegative = 0.0
    """What is left of a sagging supply."""
    effort_Nm_or_N: Finite = 0.0
    """What a joint is pushed with."""
    step_us: Annotated[int, Field(ge=-(10**9), le=10**9)] = 0
    """How far a counter or a clock jumps, ahead or back."""

    @model_validator(mode="after")
    def _has_what_it_needs(self) -> Mishap:
        if self.kind in ("clock_step", "host_clock_step") and self.step_us == 0:
            raise ValueError(f"a {self.kind} needs a step_us other than 0")
        if self.kind == "push" and (self.joint is None or self.effort_Nm_or_N == 0):
            raise ValueError("a push needs a joint and an effort_Nm_or_N other than 0")
        if self.kind == "host_clock_step" and self.joint is not None:
            raise ValueError("a host_clock_step happens to the host: leave joint out")
        return self


class Sim(Section):
    """The simulated world around the controller."""

    plant: Plant = Plant()
    """How the machine differs from its model."""
    network: Literal["channels", "usb", "usb-iid", "lan", "wifi", "awful"] = "channels"
    """What the wires are: as to_device and to_host say, or a kind of network with a name
    (docs/network.md)."""
    to_device: Channel = Channel()
    """The wires from the host to the boards."""
    to_host: Channel = Channel()
    """The wires from the boards to the host."""
    clocks: Clocks = Clocks()
    """The boards' oscillators."""
    # The p99.9 of a tick of arm2 on two shared cores, as measured (docs/performance.md).
    compute_us: Delay = 3500
    """Simulated time that a tick takes to compute."""
    start_rad_or_m: list[Finite] | None = None
    """Where each axis is at power-up. Default: where the task starts."""
    outlier_share: Share = 0.0
    """Share of samples replaced by nonsense before the controller sees them."""
    stall_host_at_s: NotNegative | None = None
    """When in the task a tick overruns, by stall_host_s."""
    stall_host_s: Positive = 0.03
    """How long that tick takes in addition."""
    kill_host_at_s: NotNegative | None = None
    """When in the task the host dies: no message leaves it afterwards."""
    mishaps: list[Mishap] = Field(default=[])
    """What else goes wrong."""
    bridge_F: NotNegative = 0.0
    """Capacitance of each board's bridge behind a diode; 0: the supply takes back what motors feed
    back."""

    @model_validator(mode="after")
    def _one_network(self) -> Sim:
        given = [
            key
            for key, channel in (("to_device", self.to_device), ("to_host", self.to_host))
            if channel != Channel()
        ]
        if self.network != "channels" and given:
            raise ValueError(
                f"network is {self.network}, which says what the wires do, and {given[0]} is given "
                f"as well: leave {' and '.join(given)} out, or write network: channels"
            )
        out, back = self.to_device.frame_us, self.to_host.frame_us
        if out and back and out != back:
            raise ValueError(
                f"to_device.frame_us is {out} and to_host.frame_us {back}; a bus has one frame: "
                "make them equal, or one 0"
            )
        return self


class Config(Section):
    """A machine, its loop, its task and its simulated world."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,25}$")]
    """Goes into the name of a run's folder."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Of everything random: the same seed repeats the same run."""
    duration_s: Positive = 10.0
    """Of the task."""
    machine: Machine
    """The model and its axes."""
    device: Device = Device()
    """What all boards share."""
    loop: Loop
    """The rate, and the distance ahead of now."""
    sync: Sync = Sync()
    """The clocks."""
    links: Links = Links()
    """Real devices."""
    task: Task
    """What to do."""
    mpc: Mpc = Mpc()
    """The planner's horizon and weights."""
    estimator: Estimator = Estimator()
    """The Kalman filter's noise."""
    sim: Sim = Sim()
    """The simulated world."""

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        n = len(self.machine.axes)
        lists: dict[str, object] = {
            "task.axes": self.task.axes or None,
            "task.target_rad_or_m": self.task.target_rad_or_m,
            "mpc.position_weight": self.mpc.position_weight,
            "mpc.velocity_weight": self.mpc.velocity_weight,
            "mpc.soft_weight": self.mpc.soft_weight,
            "mpc.torque_step_weight": self.mpc.torque_step_weight,
            "mpc.torque_start_weight": self.mpc.torque_start_weight,
            "estimator.acceleration_noise_rad_or_m_per_s15": (
                self.estimator.acceleration_noise_rad_or_m_per_s15
            ),
            "estimator.disturbance_noise_Nm_or_N_per_s05": (
                self.estimator.disturbance_noise_Nm_or_N_per_s05
            ),
            "sim.plant.coulomb_Nm_or_N": self.sim.plant.coulomb_Nm_or_N,
            "sim.start_rad_or_m": self.sim.start_rad_or_m,
        }
        for i, later in enumerate(self.mpc.later):
            lists |= {f"mpc.later.{i}.{key}": value for key, value in later.weights.items()}
        mistakes = [
            f"{key} has {len(value)} entries; the machine has {n} axes"
            for key, value in lists.items()
            if isinstance(value, list) and len(value) != n
        ]
        mistakes += [
            f"mpc.later.{i}.parameters is for custom tasks, and this one is of the kind "
            f"{self.task.kind}: leave it out"
            for i, later in enumerate(self.mpc.later)
            if later.parameters and self.task.kind != "custom"
        ]
        if self.mpc.fade_start >= self.mpc.fade_end:
            mistakes.append("mpc.fade_start must be below mpc.fade_end")
        step_us = self.mpc.intervals * self.loop.knot_us
        if self.mpc.horizon_us % step_us:
            mistakes.append(
                f"mpc.horizon_us must be a multiple of mpc.intervals * loop.knot_us = {step_us}"
            )
        joints = [axis.joint for axis in self.machine.axes]
        mistakes += [
            f"sim.mishaps.{i}.joint is {mishap.joint}; the machine's joints are {', '.join(joints)}"
            for i, mishap in enumerate(self.sim.mishaps)
            if mishap.joint is not None and mishap.joint not in joints
        ]
        mistakes += [
            f"sim.mishaps.{i} is of a board, and {mishap.joint} has none: only a push can happen "
            "to it"
            for i, mishap in enumerate(self.sim.mishaps)
            if mishap.kind != "push"
            and mishap.joint in {axis.joint for axis in self.machine.bare.values()}
        ]
        mistakes += self._of_feed_forward()
        mistakes += self._of_cables([axis.joint for axis in self.machine.boards])
        heavy = [axis.joint for axis in self.machine.driven.values() if axis.carries_gravity]
        if self.device.torque_gap == "zero" and heavy:
            mistakes.append(
                f"device.torque_gap is zero, which would drop {', '.join(heavy)}: choose another, "
                "or say carries_gravity: false where that is so"
            )
        if not mistakes:
            mistakes = [m for axis in range(n) for m in self._of_axis(axis)]
        if mistakes:
            raise ValueError("; ".join(mistakes))
        return self

    @property
    def weighings(self) -> list[Config]:
        """This config, and what each of mpc.later in turn makes of it."""
        found = [self]
        for later in self.mpc.later:
            mpc, task = found[-1].mpc, found[-1].task
            mpc = mpc.model_copy(update=later.weights)
            task = task.model_copy(update={"parameters": task.parameters | later.parameters})
            found.append(self.model_copy(update={"mpc": mpc, "task": task}))
        return found

    def _of_feed_forward(self) -> list[str]:
        """What the servos add by the position track alone, beside what is planned."""
        planned = self.mpc.enabled or self.mpc.feedforward != "none"
        mistakes = list[str]()
        for i, axis in self.machine.driven.items():
            if axis.steps:
                if planned or self.loop.gains != "off":
                    mistakes.append(
                        f"machine.axes.{i}.stepper takes positions alone, no effort and no gains: "
                        "mpc.enabled: false, mpc.feedforward: none and loop.gains: off"
                    )
                continue
            servo, at = axis.servo, f"machine.axes.{i}.servo"
            mistakes += [
                f"{at}.{servo.key(name)} would add to the effort that is planned for the same "
                "motion: leave it out, or plan none by mpc.enabled: false and mpc.feedforward: none"
                for name in ("velocity", "acceleration")
                if planned and getattr(servo, name) > 0
            ]
            if servo.ahead_us is not None and servo.ahead_us > self.loop.knot_us:
                mistakes.append(
                    f"{at}.ahead_us is {servo.ahead_us}; tracks are settled for a knot ahead: at "
                    f"most loop.knot_us = {self.loop.knot_us}"
                )
        return mistakes

    def _of_cables(self, joints: list[str]) -> list[str]:
        """What does not fit together about the cables between boards."""
        mistakes, taken = list[str](), dict[tuple[str, int], int]()
        for i, cable in enumerate(self.sync.cables):
            if cable.joints[0] == cable.joints[1]:
                mistakes.append(f"sync.cables.{i} joins {cable.joints[0]} with itself: name two")
            for end in zip(cable.joints, cable.ports, strict=True):
                joint, port = end
                if joint not in joints:
                    known = ", ".join(joints)
                    mistakes.append(
                        f"sync.cables.{i}.joints has {joint}; the joints with boards are {known}"
                    )
                elif taken.setdefault(end, i) != i:
                    mistakes.append(
                        f"sync.cables.{i} is at port {port} of {joint}, and so is "
                        f"sync.cables.{taken[end]}: take another port"
                    )
        return mistakes

    @staticmethod
    def _of_sine(axis: Axis, sine: Sine, index: int) -> str | None:
        if sine.unit != axis.unit:
            return (
                f"task.axes.{index} is in {sine.unit}, but {axis.joint} moves in {axis.unit}: "
                f"use offset_{axis.unit} and amplitude_{axis.unit}"
            )
        if sine.rate != 0 and not axis.continuous:
            return (
                f"task.axes.{index}.rate_rad_per_s would take {axis.joint} out of its range: "
                f"remove it, or give machine.axes.{index} continuous: true instead of a range"
            )
        return None

    def _of_axis(self, index: int) -> list[str]:
        """What does not fit together about one axis: its kind, and where it starts."""
        axis, start = self.machine.axes[index], self.sim.start_rad_or_m
        if start is not None:
            key, position = f"sim.start_rad_or_m.{index}", start[index]
        elif self.task.target_rad_or_m is not None:
            key, position = f"task.target_rad_or_m.{index}", self.task.target_rad_or_m[index]
        elif self.task.axes:
            key, position = f"task.axes.{index}", self.task.axes[index].start
        else:
            return []  # it starts where its file does
        if self.task.axes and (wrong := self._of_sine(axis, self.task.axes[index], index)):
            return [wrong]
        if axis.continuous and abs(position) * axis.counts_per_unit >= COUNTS:
            most = COUNTS / axis.counts_per_unit
            return [
                f"{key}: {axis.joint} would start at {position:g} {axis.unit}, where its encoder "
                f"has no count: begin between {-most:.6g} and {most:.6g} {axis.unit}"
            ]
        if axis.lowest <= position <= axis.highest:
            return []
        return [
            f"{key}: {axis.joint} would start at {position:g} {axis.unit}, outside of its range, "
            f"position_min_{axis.unit} {axis.lowest:g} to "
            f"position_max_{axis.unit} {axis.highest:g}"
        ]
