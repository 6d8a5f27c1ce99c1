"""One joint of the machine, rotary or linear: its keys say which.

Both kinds have the same attributes, in SI at the joint: positions in `unit` (rad or m), times in
seconds, efforts in `effort_unit` (Nm or N; effort is the word for torque and force alike).
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, WrapValidator, model_validator

from headway.configs.section import Finite, NotNegative, Positive, Section


class Motor(Section):
    """A geared brushed DC motor that turns a joint, as the device's settings have it."""

    gear: Positive
    """Turns of the motor per turn of the joint."""
    torque_constant_Nm_per_A: Positive
    """Of the motor, before the gear."""
    resistance_ohm: Positive
    """Of the winding."""
    supply_V: Positive
    """What the bridge has at full duty."""
    supply_min_V: Positive | None = None
    """The board stops below it. Default: 70 % of supply_V."""
    supply_max_V: Positive | None = None
    """The board stops above it. Default: 125 % of supply_V. Half-way to it, what the motor feeds
    back is burnt in a resistor."""
    continuous_A: Positive | None = None
    """The current that it bears for ever. Default: that of the effort limit."""
    overload_s: Positive = 3.0
    """How long it bears twice that."""
    winding_s: Positive = 60.0
    """The time constant of its winding's temperature."""

    @property
    def constant(self) -> float:
        """Effort at the joint per current, and voltage per speed of the joint: SI."""
        return self.gear * self.torque_constant_Nm_per_A

    @property
    def turn(self) -> float:
        """What a turn of the motor moves the joint by [rad or m]."""
        return 2 * math.pi / self.gear

    @property
    def damping(self) -> float:
        """What the back-EMF brakes with, effort per speed of the joint: SI."""
        return self.constant**2 / self.resistance_ohm


class LinearMotor(Motor):
    """A motor that shifts a joint, by a screw or a belt."""

    gear: Positive = Field(alias="gear_rad_per_m")
    """Angle of the motor per way of the joint."""


class _Servo(Section):
    ahead_us: Annotated[int, Field(ge=0, le=32768)] | None = None
    """How far ahead along the tracks all feed-forward is taken; at most a knot. Default: half a
    servo period, the middle of the time for which an output holds. A motor whose torque lags takes
    more."""


class RotaryServo(_Servo):
    """The device's PID, at a rotary joint."""

    kp: NotNegative = Field(alias="kp_Nm_per_rad")
    """Proportional gain, on the following error."""
    ki: NotNegative = Field(default=0.0, alias="ki_Nm_per_rad_s")
    """Integral gain."""
    kd: NotNegative = Field(alias="kd_Nm_s_per_rad")
    """Derivative gain, on the change of the following error."""
    velocity: NotNegative = Field(default=0.0, alias="velocity_Nm_s_per_rad")
    """Feed-forward by the position track's speed: what viscous friction takes. Where no torque is
    planned alone: mpc.enabled: false and mpc.feedforward: none."""
    acceleration: NotNegative = Field(default=0.0, alias="acceleration_Nm_s2_per_rad")
    """Feed-forward by its acceleration: the inertia at the joint. Under the same condition."""


class LinearServo(_Servo):
    """The device's PID, at a linear joint."""

    kp: NotNegative = Field(alias="kp_N_per_m")
    """Proportional gain, on the following error."""
    ki: NotNegative = Field(default=0.0, alias="ki_N_per_m_s")
    """Integral gain."""
    kd: NotNegative = Field(alias="kd_N_s_per_m")
    """Derivative gain, on the change of the following error."""
    velocity: NotNegative = Field(default=0.0, alias="velocity_N_s_per_m")
    """Feed-forward by the position track's speed: what viscous friction takes. Where no force is
    planned alone: mpc.enabled: false and mpc.feedforward: none."""
    acceleration: NotNegative = Field(default=0.0, alias="acceleration_N_s2_per_m")
    """Feed-forward by its acceleration: the mass that moves. Under the same condition."""


class _Homing(Section):
    """How the board finds out where its axis is, if its encoder does not know at power-up."""

    method: Literal["index", "switch", "stop"]
    """The mark: the encoder's index pulse, a home switch, or a mechanical stop."""
    backwards: bool = False
    """The direction of the search."""


class RotaryHoming(_Homing):
    """Homing of a rotary axis."""

    mark: Finite = Field(alias="mark_rad")
    """The position of the mark."""
    speed: Positive = Field(alias="speed_rad_per_s")
    """Of the search."""
    effort: Positive = Field(alias="torque_Nm")
    """Of the feedback at most: what a mechanical stop has to bear."""
    way: Positive = Field(alias="way_rad")
    """The longest search."""


class LinearHoming(_Homing):
    """Homing of a linear axis."""

    mark: Finite = Field(alias="mark_m")
    """The position of the mark."""
    speed: Positive = Field(alias="speed_m_per_s")
    """Of the search."""
    effort: Positive = Field(alias="force_N")
    """Of the feedback at most: what a mechanical stop has to bear."""
    way: Positive = Field(alias="way_m")
    """The longest search."""


class _Search(Section):
    """How the board finds out where its axis is: its pulses begin to count at power-up."""

    method: Literal["index", "switch"]
    """The mark: an index pulse each turn, or a home switch."""
    backwards: bool = False
    """The direction of the search."""

    @property
    def effort(self) -> None:
        """Nobody feels a stop."""
        return None


class RotarySearch(_Search):
    """Homing of a rotary axis with a stepper."""

    mark: Finite = Field(alias="mark_rad")
    """The position of the mark."""
    speed: Positive = Field(alias="speed_rad_per_s")
    """Of the search."""
    way: Positive = Field(alias="way_rad")
    """The longest search."""


class LinearSearch(_Search):
    """Homing of a linear axis with a stepper."""

    mark: Finite = Field(alias="mark_m")
    """The position of the mark."""
    speed: Positive = Field(alias="speed_m_per_s")
    """Of the search."""
    way: Positive = Field(alias="way_m")
    """The longest search."""


class _Stepper(Section):
    rate: Positive = Field(alias="steps_per_s")
    """The largest rate: no pulse comes sooner after another one, whatever their directions. Plans
    have 1/1024 less."""
    microsteps: Annotated[int, Field(ge=1, le=256)] = 16
    """Steps in a full step of the motor."""
    supply_V: Positive
    """Of the driver."""
    supply_min_V: Positive | None = None
    """The board stops below it. Default: 70 % of supply_V."""
    supply_max_V: Positive | None = None
    """The board stops above it. Default: 125 % of supply_V."""


class RotaryStepperMotor(_Stepper):
    """A stepping motor with its driver, at a rotary joint."""

    holding: Positive = Field(alias="holding_torque_Nm")
    """What it holds at most, at the joint."""
    damping: Positive = Field(alias="damping_Nm_s_per_rad")
    """With which its windings brake it, at the joint."""


class LinearStepperMotor(_Stepper):
    """A stepping motor with its driver, at a linear joint."""

    holding: Positive = Field(alias="holding_force_N")
    """What it holds at most, at the joint."""
    damping: Positive = Field(alias="damping_N_s_per_m")
    """With which its windings brake it, at the joint."""


class _Axis(Section):
    joint: str
    """The joint's name in the model."""

    @property
    def board(self) -> bool:
        """It has one, with an encoder."""
        return True

    @property
    def lowest(self) -> float:
        """Of its positions, SI: minus infinity if it is continuous."""
        axis: Any = self
        return -math.inf if axis.continuous else axis.position_min

    @property
    def highest(self) -> float:
        """Of its positions, SI: infinity if it is continuous."""
        axis: Any = self
        return math.inf if axis.continuous else axis.position_max

    @property
    def poses(self) -> tuple[float, float]:
        """Positions between which it has every pose: its range, or one turn. SI."""
        axis: Any = self
        return (-math.pi, math.pi) if axis.continuous else (axis.position_min, axis.position_max)

    @model_validator(mode="after")
    def _ends(self) -> Self:
        mistakes = self._wrong_ends()
        if mistakes:
            raise ValueError("; ".join(mistakes))
        return self

    def _wrong_ends(self) -> list[str]:
        """What is wrong with the range and the soft limits."""
        axis: Any = self
        low, high = axis.position_min, axis.position_max
        if low >= high:
            return [f"{self.key('position_min')} must be below {self.key('position_max')}"]
        soft_low = low if axis.soft_min is None else axis.soft_min
        soft_high = high if axis.soft_max is None else axis.soft_max
        if not low <= soft_low < soft_high <= high:
            return [
                f"{self.key('soft_min')} must be below {self.key('soft_max')}, and both within "
                f"{self.key('position_min')} and {self.key('position_max')}"
            ]
        return []


class _Driven(_Axis):
    carries_gravity: bool = True
    """Without torque it would fall: the board never drops its torque."""

    @property
    def passive(self) -> bool:
        """It has a motor."""
        return False

    @property
    def steps(self) -> bool:
        """That is a stepper, without a servo."""
        return False

    @property
    def deceleration(self) -> float:
        """Of the board's own stop: SI."""
        axis: Any = self
        given: float | None = axis.stop_deceleration
        return axis.acceleration_limit / 10 if given is None else given

    @property
    def following(self) -> float:
        """The largest following error: SI."""
        axis: Any = self
        given: float | None = axis.following_limit
        low, high = self.poses
        return (high - low) / 8 if given is None else given


FULL_STEPS = 4  # of a cycle of a stepper's currents


class _Stepping(_Driven):
    """A stepper pulls at its rotor like a spring, whose end is where the steps are: near there, a
    servo with a proportional gain alone."""

    @property
    def steps(self) -> bool:
        return True

    def _wrong_ends(self) -> list[str]:
        axis: Any = self
        own, most, mistakes = axis.stepper, axis.stepper.holding / axis.stepper.damping, []
        if axis.velocity_limit >= most:
            mistakes = [
                f"{self.key('velocity_limit')} is {axis.velocity_limit:g}, but at {most:.4g} "
                f"stepper.{own.key('damping')} alone takes all of stepper.{own.key('holding')}: "
                "lower it or the damping"
            ]
        return super()._wrong_ends() + mistakes

    @property
    def cycle(self) -> int:
        """Steps in a cycle of its currents: half of it away the rotor is lost to another tooth."""
        axis: Any = self
        return FULL_STEPS * int(axis.stepper.microsteps)

    @property
    def effort_limit(self) -> float:
        axis: Any = self
        return float(axis.stepper.holding)

    @property
    def stiffness(self) -> float:
        """Effort per way, at its steps: SI."""
        axis: Any = self
        return self.effort_limit * 2 * math.pi * float(axis.counts_per_unit) / self.cycle

    @property
    def motor(self) -> Motor:
        """One that brakes as its windings do."""
        axis: Any = self
        own = axis.stepper
        return Motor.model_construct(
            gear=1.0,
            torque_constant_Nm_per_A=1.0,
            resistance_ohm=1 / own.damping,
            supply_V=own.supply_V,
            supply_min_V=own.supply_min_V,
            supply_max_V=own.supply_max_V,
        )


class _NoMotor(_Axis):
    @property
    def effort_limit(self) -> float:
        """Nothing drives it."""
        return 0.0

    @property
    def velocity_limit(self) -> float:
        """No plan decides on it."""
        return math.inf

    @property
    def homing(self) -> None:
        """Its encoder, if there is one, knows where it is."""
        return None


class _Passive(_NoMotor):
    passive: Literal[True]
    """It has no motor: an encoder and its board, which is never armed."""


class _Bare(_NoMotor):
    passive: Literal[True]
    """It has no motor."""
    encoder: Literal[False]
    """It has no encoder either, and no board: where it is has to show in how the others move."""

    @property
    def board(self) -> bool:
        """It has none."""
        return False

    @property
    def counts_per_unit(self) -> float:
        """No encoder counts."""
        return 0.0


def _ends_by_kind(schema: dict[str, Any]) -> None:
    """What `_wrong_ends` says of a rotary axis, for editors."""
    ends = ["position_min_rad", "position_max_rad", "soft_min_rad", "soft_max_rad"]
    marks = {"properties": {"method": {"enum": ["index", "switch"]}}}
    schema["if"] = {"properties": {"continuous": {"const": True}}, "required": ["continuous"]}
    schema["then"] = {"properties": {**{end: {"type": "null"} for end in ends}, "homing": marks}}
    schema["else"] = {
        "properties": {end: {"type": "number"} for end in ends[:2]},
        "required": ends[:2],
    }


class _Rotary(_Axis):
    model_config = ConfigDict(json_schema_extra=_ends_by_kind)

    continuous: bool = False
    """It turns for ever: there are no position limits, and no soft ones."""
    position_min: Finite | None = Field(default=None, alias="position_min_rad")
    """The lowest position that any plan may have. Required unless continuous."""
    position_max: Finite | None = Field(default=None, alias="position_max_rad")
    """The highest. Required unless continuous."""
    soft_min: Finite | None = Field(default=None, alias="soft_min_rad")
    """Plans keep above it where they can."""
    soft_max: Finite | None = Field(default=None, alias="soft_max_rad")
    """Plans keep below it where they can."""
    coulomb: NotNegative = Field(default=0.0, alias="coulomb_Nm")
    """Dry friction that the controller knows of."""

    def _wrong_ends(self) -> list[str]:
        ends = ("position_min", "position_max", "soft_min", "soft_max")
        if not self.continuous:
            missing = [self._missing(end) for end in ends[:2] if getattr(self, end) is None]
            return missing or super()._wrong_ends()
        return [
            f"{self.key(end)} is for axes that end somewhere: remove it, or continuous: true"
            for end in ends
            if getattr(self, end) is not None
        ]

    def _missing(self, end: str) -> str:
        key, value = self.key(end), "-3" if end == "position_min" else "3"
        return (
            f"{key} missing: a number, in rad; for example `{key}: {value}` (or say continuous: "
            "true, if it turns for ever)"
        )

    @property
    def unit(self) -> str:
        return "rad"

    @property
    def effort_unit(self) -> str:
        return "Nm"


class _RotaryEncoder(_Rotary):
    counts_per_turn: Annotated[int, Field(ge=16, le=2**22)]
    """Encoder counts per turn of the joint."""

    @property
    def counts_per_unit(self) -> float:
        """Encoder counts per radian."""
        return self.counts_per_turn / (2 * math.pi)


class _Linear(_Axis):
    position_min: Finite = Field(alias="position_min_m")
    """The lowest position that any plan may have."""
    position_max: Finite = Field(alias="position_max_m")
    """The highest."""
    soft_min: Finite | None = Field(default=None, alias="soft_min_m")
    """Plans keep above it where they can."""
    soft_max: Finite | None = Field(default=None, alias="soft_max_m")
    """Plans keep below it where they can."""
    coulomb: NotNegative = Field(default=0.0, alias="coulomb_N")
    """Dry friction that the controller knows of."""

    @property
    def continuous(self) -> bool:
        """A slide ends somewhere."""
        return False

    @property
    def unit(self) -> str:
        return "m"

    @property
    def effort_unit(self) -> str:
        return "N"


class _LinearEncoder(_Linear):
    counts_per_m: Annotated[float, Field(ge=16, le=1e10)]
    """Encoder counts per metre of the joint's way."""

    @property
    def counts_per_unit(self) -> float:
        """Encoder counts per metre."""
        return self.counts_per_m


class RotaryAxis(_RotaryEncoder, _Driven):
    """A hinge with its motor, encoder and board."""

    velocity_limit: Positive = Field(alias="velocity_limit_rad_per_s")
    """Of a plan, in either direction."""
    acceleration_limit: Positive = Field(alias="acceleration_limit_rad_per_s2")
    """Of a plan, in either direction."""
    stop_deceleration: Positive | None = Field(default=None, alias="stop_deceleration_rad_per_s2")
    """With which the board stops by itself, and always could before a position limit. Default: a
    tenth of the acceleration limit."""
    following_limit: Positive | None = Field(default=None, alias="following_limit_rad")
    """The board stops when the axis is further from where it should be. Default: an eighth of
    the range, or of a turn."""
    effort_limit: Positive = Field(alias="torque_limit_Nm")
    """The most that the servo asks of the motor, at the joint."""
    motor: Motor
    """The motor that moves it."""
    servo: RotaryServo
    """The gains of the board's servo."""
    homing: RotaryHoming | None = None
    """How the board finds out where the axis is. Default: the encoder knows."""

    def _wrong_ends(self) -> list[str]:
        mistakes = super()._wrong_ends()
        if self.continuous and self.homing is not None and self.homing.method == "stop":
            mistakes.append(
                "homing.method is stop, but an axis with continuous: true has no mechanical stop: "
                "use index or switch"
            )
        return mistakes


class LinearAxis(_LinearEncoder, _Driven):
    """A slide with its motor, encoder and board."""

    velocity_limit: Positive = Field(alias="velocity_limit_m_per_s")
    """Of a plan, in either direction."""
    acceleration_limit: Positive = Field(alias="acceleration_limit_m_per_s2")
    """Of a plan, in either direction."""
    stop_deceleration: Positive | None = Field(default=None, alias="stop_deceleration_m_per_s2")
    """With which the board stops by itself, and always could before a position limit. Default: a
    tenth of the acceleration limit."""
    following_limit: Positive | None = Field(default=None, alias="following_limit_m")
    """The board stops when the axis is further from where it should be. Default: an eighth of
    the range."""
    effort_limit: Positive = Field(alias="force_limit_N")
    """The most that the servo asks of the motor, at the joint."""
    motor: LinearMotor
    """The motor that moves it."""
    servo: LinearServo
    """The gains of the board's servo."""
    homing: LinearHoming | None = None
    """How the board finds out where the axis is. Default: the encoder knows."""


class RotaryStepper(_Stepping, _Rotary):
    """A hinge with its stepper and board, which counts its steps."""

    steps_per_turn: Annotated[int, Field(ge=16, le=2**22)]
    """Steps per turn of the joint, microsteps and gear included."""
    velocity_limit: Positive = Field(alias="velocity_limit_rad_per_s")
    """Of a plan, in either direction."""
    acceleration_limit: Positive = Field(alias="acceleration_limit_rad_per_s2")
    """Of a plan, in either direction."""
    stop_deceleration: Positive | None = Field(default=None, alias="stop_deceleration_rad_per_s2")
    """With which the board stops by itself, and always could before a position limit. Default: a
    tenth of the acceleration limit."""
    following_limit: Positive | None = Field(default=None, alias="following_limit_rad")
    """The board stops when its steps are further behind. Default: an eighth of the range, or of a
    turn."""
    stepper: RotaryStepperMotor
    """The motor and its driver."""
    homing: RotarySearch
    """How the board finds out where the axis is."""

    @classmethod
    def key(cls, attribute: str) -> str:
        if attribute == "effort_limit":
            return f"stepper.{RotaryStepperMotor.key('holding')}"
        return super().key(attribute)

    @property
    def counts_per_unit(self) -> float:
        """Steps per radian."""
        return self.steps_per_turn / (2 * math.pi)

    @property
    def servo(self) -> RotaryServo:
        """What the motor does by itself, as a servo's gains: no key of the config."""
        return RotaryServo.model_construct(kp=self.stiffness, kd=0.0)


class LinearStepper(_Stepping, _Linear):
    """A slide with its stepper and board, which counts its steps."""

    steps_per_m: Annotated[float, Field(ge=16, le=1e10)]
    """Steps per metre of the joint's way, microsteps and screw included."""
    velocity_limit: Positive = Field(alias="velocity_limit_m_per_s")
    """Of a plan, in either direction."""
    acceleration_limit: Positive = Field(alias="acceleration_limit_m_per_s2")
    """Of a plan, in either direction."""
    stop_deceleration: Positive | None = Field(default=None, alias="stop_deceleration_m_per_s2")
    """With which the board stops by itself, and always could before a position limit. Default: a
    tenth of the acceleration limit."""
    following_limit: Positive | None = Field(default=None, alias="following_limit_m")
    """The board stops when its steps are further behind. Default: an eighth of the range."""
    stepper: LinearStepperMotor
    """The motor and its driver."""
    homing: LinearSearch
    """How the board finds out where the axis is."""

    @classmethod
    def key(cls, attribute: str) -> str:
        if attribute == "effort_limit":
            return f"stepper.{LinearStepperMotor.key('holding')}"
        return super().key(attribute)

    @property
    def counts_per_unit(self) -> float:
        """Steps per metre."""
        return self.steps_per_m

    @property
    def servo(self) -> LinearServo:
        """What the motor does by itself, as a servo's gains: no key of the config."""
        return LinearServo.model_construct(kp=self.stiffness, kd=0.0)


class RotaryPassive(_RotaryEncoder, _Passive):
    """A hinge without a motor: its encoder and board."""


class LinearPassive(_LinearEncoder, _Passive):
    """A slide without a motor: its encoder and board."""


class RotaryBare(_Rotary, _Bare):
    """A hinge with neither motor nor encoder."""

    rest: Finite = Field(alias="rest_rad")
    """Where it rests at power-up: there the estimate begins."""
    rest_sigma: Positive = Field(default=0.1, alias="rest_sigma_rad")
    """Give or take this, as a standard deviation."""


class LinearBare(_Linear, _Bare):
    """A slide with neither motor nor encoder."""

    rest: Finite = Field(alias="rest_m")
    """Where it rests at power-up: there the estimate begins."""
    rest_sigma: Positive = Field(default=0.01, alias="rest_sigma_m")
    """Give or take this, as a standard deviation."""


class _Sine(Section):
    offset: Finite
    amplitude: Finite
    harmonic: Positive = 1.0
    """Times the task's frequency."""
    phase_rad: Finite = 0.0
    """At the start of the task."""

    @property
    def start(self) -> float:
        """Where it is at t = 0."""
        return self.offset + self.amplitude * math.sin(self.phase_rad)


class RotarySine(_Sine):
    """offset + rate t + amplitude sin(2 pi harmonic frequency t + phase), on a rotary axis."""

    offset: Finite = Field(default=0.0, alias="offset_rad")
    """The middle."""
    amplitude: Finite = Field(alias="amplitude_rad")
    """How far it goes to either side."""
    rate: Finite = Field(default=0.0, alias="rate_rad_per_s")
    """A constant speed that is added: a continuous axis turns on and on."""

    @property
    def unit(self) -> str:
        return "rad"


class LinearSine(_Sine):
    """offset + amplitude sin(2 pi harmonic frequency t + phase), on a linear axis."""

    offset: Finite = Field(default=0.0, alias="offset_m")
    """The middle."""
    amplitude: Finite = Field(alias="amplitude_m")
    """How far it goes to either side."""

    @property
    def rate(self) -> float:
        """A slide ends somewhere."""
        return 0.0

    @property
    def unit(self) -> str:
        return "m"


def _keys(section: type[Section]) -> set[str]:
    """All keys of a section, those of sections in it with dots."""
    keys = set[str]()
    for name, field in section.model_fields.items():
        key = section.key(name)
        keys.add(key)
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            keys |= {f"{key}.{inner}" for inner in _keys(field.annotation)}
    return keys


def _given(tree: dict[Any, Any]) -> set[str]:
    """All keys that are given, those within mappings with dots."""
    keys = {str(key) for key in tree}
    for key, value in tree.items():
        if isinstance(value, dict):
            keys |= {f"{key}.{inner}" for inner in _given(value)}
    return keys


def _either(rotary: type[Section], linear: type[Section], given: Any) -> Section:
    """Reads a mapping as the kind whose keys it has: linear if there is any of that kind alone.

    A union with pydantic's own discriminator would put the kind's name into the place of every
    mistake, where the file has no such key.
    """
    of_rotary, of_linear = _keys(rotary) - _keys(linear), _keys(linear) - _keys(rotary)
    keys = _given(given) if isinstance(given, dict) else set[str]()
    turning, sliding = sorted(keys & of_rotary), sorted(keys & of_linear)
    if turning == ["continuous"] and sliding:
        raise ValueError("continuous is for rotary axes alone: a slide ends, so remove it")
    if turning and sliding:
        raise ValueError(
            f"{turning[0]} is a key of rotary axes and {sliding[0]} of linear ones: "
            "use the keys of one kind"
        )
    return (linear if sliding else rotary).model_validate(given)


def _read_axis(value: Any, _: object) -> Section:
    if isinstance(value, _Axis):
        return value
    if isinstance(value, dict) and "stepper" in value:
        others = sorted(_given(value) & {"motor", "servo", "passive", "counts_per_turn"})
        if others:
            raise ValueError(
                f"an axis with a stepper has no {others[0]}: remove it, or stepper (its steps are "
                "steps_per_turn or steps_per_m)"
            )
        return _either(RotaryStepper, LinearStepper, value)
    if not isinstance(value, dict) or "passive" not in value:
        return _either(RotaryAxis, LinearAxis, value)
    drive = sorted(_given(value) & {"motor", "servo"})
    if drive and value["passive"] is True:
        raise ValueError(f"a passive axis has no {drive[0]}: remove it, or passive: true")
    if "encoder" not in value:
        return _either(RotaryPassive, LinearPassive, value)
    counts = sorted(_given(value) & {"counts_per_turn", "counts_per_m"})
    if counts and value["encoder"] is False:
        raise ValueError(f"{counts[0]} is of an encoder: remove it, or encoder: false")
    return _either(RotaryBare, LinearBare, value)


def _read_sine(value: Any, _: object) -> Section:
    return value if isinstance(value, _Sine) else _either(RotarySine, LinearSine, value)


StepperAxis = RotaryStepper | LinearStepper
DrivenAxis = RotaryAxis | LinearAxis | StepperAxis
PassiveAxis = RotaryPassive | LinearPassive
BareAxis = RotaryBare | LinearBare
Axis = Annotated[DrivenAxis | PassiveAxis | BareAxis, WrapValidator(_read_axis)]
Sine = Annotated[RotarySine | LinearSine, WrapValidator(_read_sine)]
