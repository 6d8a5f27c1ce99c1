"""An axis as far as it is known: its joint, and numbers with the reason for each guess."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from headway.configs.axis import LinearAxis, RotaryAxis
from headway.models.stated import Joint

RANGE = {"rad": 3.0, "m": 0.25}  # either way, where the model has none
ENDLESS = "if it turns for ever say `continuous: true` instead of this and the next"
# Acceleration that an unstated effort limit is made for, and beyond which a stated one is not
# believed [rad/s^2, m/s^2]: models often have 1000 Nm where nobody knew.
BUILT_FOR = {"rad": 30.0, "m": 5.0}
BELIEVED = {"rad": 1000.0, "m": 150.0}


@dataclass(frozen=True)
class Value:
    """A number (or true) for the file, and why if it is a guess."""

    number: float
    why: str = ""  # empty: the model states it


@dataclass
class AxisGuess:
    """One axis: numbers by attribute of its config class; dots lead into motor and servo."""

    joint: Joint
    values: dict[str, Value] = field(default_factory=dict)

    @property
    def kind(self) -> type[RotaryAxis] | type[LinearAxis]:
        """Its class in a config."""
        return LinearAxis if self.joint.linear else RotaryAxis

    @property
    def unit(self) -> str:
        """Of its positions."""
        return "m" if self.joint.linear else "rad"

    @property
    def poses(self) -> tuple[float, float]:
        """Its range, or one turn where it turns for ever [rad or m]."""
        if self.joint.continuous:
            return -math.pi, math.pi
        return self["position_min"], self["position_max"]

    def __getitem__(self, attribute: str) -> float:
        return self.values[attribute].number

    def state(self, attribute: str, number: float) -> None:
        """Notes what the model has."""
        self.values[attribute] = Value(number)

    def guess(self, attribute: str, number: float, why: str) -> None:
        """Notes a guess, to three digits."""
        self.values[attribute] = Value(float(f"{number:.3g}"), why)


def axes_of(joints: list[Joint]) -> list[AxisGuess]:
    """Each joint's axis with its range, from which all other numbers follow."""
    axes = []
    for joint in joints:
        axis = AxisGuess(joint)
        if joint.continuous:
            axis.state("continuous", True)
        elif joint.position is None:
            most, why = RANGE[axis.unit], "the model has no range"
            axis.guess("position_min", -most, why if joint.linear else f"{why}; {ENDLESS}")
            axis.guess("position_max", most, why)
        else:
            axis.state("position_min", joint.position[0])
            axis.state("position_max", joint.position[1])
        axes.append(axis)
    return axes
