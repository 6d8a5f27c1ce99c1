"""From power-up to the first plan: the clocks settle, the machine is held where it stands.

Two phases. SYNC sends stamps alone until every device says that its clock has settled. START
repeats a plan that stands still, to begin some knots ahead, until it has begun on every device.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Config
from headway.controller.estimator import Sample
from headway.controller.prediction import Prediction
from headway.controller.tick import DeviceError, Outbox, Phase
from headway.devices import core
from headway.devices.axis import AxisUnits
from headway.devices.remote import Points, Remote

Array = NDArray[np.float64]

SETTLE_TICKS = 1000  # of synchronization before the first plan, at least; four times that at most
START_KNOTS = 16  # from the first plan's sending to its beginning, beyond the margin
STILL_POINTS = 6  # of the first plan
IDLE = core.STATES.index("IDLE")


class Start:
    """The start-up. From `phase` START on, `knot`, `position` and `torque` (n,) tell when the first
    plan begins and what it holds."""

    def __init__(
        self, config: Config, remotes: list[Remote], units: list[AxisUnits], prediction: Prediction
    ) -> None:
        self._joints = [axis.joint for axis in config.machine.axes]
        self._remotes, self._units, self._prediction = remotes, units, prediction
        self._margin = config.loop.margin_knots
        self._ticks = 0
        self.phase = Phase.SYNC
        self.knot = 0
        self.position = self.torque = np.zeros(len(remotes))

    def tick(self, knot: int, samples: list[Sample]) -> Outbox:
        """What to send at a knot. Samples are taken out of the list once they are of no more use.

        Raises DeviceError if a device does not settle, sends no samples or refuses the plan.
        """
        self._ticks += 1
        if self.phase is Phase.SYNC and not self._settled():
            del samples[: -100 * len(self._remotes)]
            return Outbox()
        if self.phase is Phase.SYNC:
            self.position = self._standing_at(samples)
            self.torque = self._prediction.holding(self.position, np.zeros_like(self.position))
            self.knot = knot + self._margin + START_KNOTS
            self.phase = Phase.START
        elif knot + self._margin >= self.knot + 1:
            self._check_started()
            self.phase = Phase.RUN
        samples.clear()
        return Outbox(self.knot, self._still())

    def _settled(self) -> bool:
        """Whether every clock has settled."""
        idle = all(r.status and r.status.state == IDLE for r in self._remotes)
        if idle:
            return self._ticks >= SETTLE_TICKS
        if self._ticks > 4 * SETTLE_TICKS:
            pairs = zip(self._joints, self._remotes, strict=True)
            unsynced = [joint for joint, r in pairs if not (r.status and r.status.synced)]
            raise DeviceError(f"{', '.join(unsynced)}: not synced within {4 * SETTLE_TICKS} ticks")
        return False

    def _standing_at(self, samples: list[Sample]) -> Array:
        """Median of the last samples of each axis: an outlier does not move it."""
        medians = []
        for axis, joint in enumerate(self._joints):
            values = [s.position for s in samples if s.axis == axis]
            if not values:
                raise DeviceError(f"{joint}: no samples arrive")
            medians.append(np.median(values[-50:]))
        return np.array(medians)

    def _still(self) -> list[Points]:
        """Points that stand still at the position, with the torque that holds it."""
        return [
            {
                core.TRACK_POSITION: units.position_points(np.full(STILL_POINTS, position)),
                core.TRACK_TORQUE: units.torque_points(np.full(STILL_POINTS, torque)),
            }
            for units, position, torque in zip(self._units, self.position, self.torque, strict=True)
        ]

    def _check_started(self) -> None:
        for joint, remote in zip(self._joints, self._remotes, strict=True):
            if remote.status is None or remote.status.plan_accepted == 0:
                raise DeviceError(f"{joint}: the device did not accept the first plan")
