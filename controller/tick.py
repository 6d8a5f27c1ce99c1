"""What one tick of the loop decides, and what there is to tell of it."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from headway.controller.estimator import Estimate
from headway.controller.motion import Motion
from headway.controller.mpc import Solution
from headway.devices.core import LIVE_KNOTS
from headway.devices.remote import Points

Array = NDArray[np.float64]


class DeviceError(Exception):
    """A device does not answer or does not do what it should."""


class Phase(enum.IntEnum):
    """Where the loop is."""

    HELLO = 0  # every device is asked for a session
    SYNC = 1  # stamps only, until every clock has settled
    ARM = 2  # the devices are asked to take the load
    START = 3  # a plan that holds still is under way
    RUN = 4


@dataclass
class Outbox:
    """What a tick decided to send: stamps alone, or a plan until it is too late for it."""

    first_knot: int = 0
    points: Points | None = None  # (driven axes, sinks, m)
    too_late_us: int = 2**62  # from then on its first new point is live

    def arriving_in(self, knot: int) -> Outbox:
        """Without the points that will have begun by then, at the earliest. They can change nothing
        any more; and if the frames that set them were lost, the device has others, and would refuse
        the plan for them."""
        if self.points is None:
            return self
        begun = min(knot + LIVE_KNOTS - self.first_knot, self.points.shape[2] - 3)  # its rest stays
        if begun <= 0:
            return self
        return Outbox(self.first_knot + begun, self.points[:, :, begun:], self.too_late_us)


@dataclass
class Tick:
    """A tick's results, for the record. Times by the wall clock are only measured, never used."""

    now_us: int
    phase: Phase
    samples: int = 0
    now: Estimate | None = None
    commit: Estimate | None = None
    solution: Solution | None = None
    accepted: bool = False
    motion: Motion | None = None  # the encoded plan's roll-out
    encoding_error: Array | None = None  # largest |encoded - planned torque|, 3 free knots on
    planned_torque: Array | None = None  # largest |torque| rolled out, past the committed points
    states: list[int] = field(default_factory=list)
    estimate_us: float = 0.0
    encode_us: float = 0.0
    total_us: float = 0.0
