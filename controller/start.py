"""From power-up to the first plan: the clocks settle, the machine is held where it stands.

Four phases. HELLO asks every device for a session until all have answered in it. SYNC sends stamps
alone until every device says that its clock has settled. ARM has the devices take the load, with
the torque that the model says; those that rest from an earlier run are asked to take plans again,
and those that do not know where they are look for it. START repeats a plan that stands still, to
begin some knots ahead, until it has begun on every device.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Config
from headway.controller.gains import Gains
from headway.controller.prediction import Prediction
from headway.controller.settle import NO_SESSION, Settle
from headway.controller.tick import DeviceError, Outbox, Phase
from headway.devices import core
from headway.devices._tracks import Samples
from headway.devices.axis import AxisUnits
from headway.devices.remote import Points, Remote
from headway.devices.stop import why

Array = NDArray[np.float64]

HELLO_TICKS = 500  # until every device has answered
SETTLED_US = 500_000  # for which all clocks have stayed settled before the machine is armed
SETTLE_US = 20_000_000  # until then, at most
START_KNOTS = 16  # from the first plan's sending to its beginning, beyond the margin
STILL_POINTS = 6  # of the first plan
ARM_TICKS = 250  # until a device has answered that it is armed
STAND_TICKS = 60  # of samples of where the machine stands: a brake gives as the torque comes up
LATCHED = [core.STATES.index(name) for name in ("FAULT", "ESTOP")]
IDLE, ARMED, HOLD = (core.STATES.index(name) for name in ("IDLE", "ARMED", "HOLD"))


class Start:
    """The start-up. From `phase` START on, `knot`, `position` and `torque` (n,) tell when the first
    plan begins and what it holds."""

    def __init__(
        self,
        config: Config,
        remotes: list[Remote],
        units: list[AxisUnits],
        prediction: Prediction,
        gains: Gains,
    ) -> None:
        self._axes, self._period_us = config.machine.boards, config.device.servo_period_us
        self._rest = [axis.rest for axis in config.machine.bare.values()]
        self._joints = [axis.joint for axis in self._axes]
        self._driven = list(config.machine.driven)  # the others are only listened to
        self._remotes, self._units, self._prediction = remotes, units, prediction
        self._gains = gains
        self._margin = config.loop.margin_knots
        self._ticks = self._began_us = 0
        self._knot_us = config.loop.knot_us
        self._settle = Settle(self._joints, remotes)
        self._homing = self._standing = False
        self._resumed: list[bool] = []
        self.phase = Phase.HELLO
        self.knot = 0
        self.position = self.torque = np.zeros(prediction.n)

    def tick(self, knot: int, samples: Samples) -> Outbox:
        """What to send at a knot. Samples are taken out of the list once they are of no more use.

        Raises DeviceError if a device does not answer, does not settle, sends no samples or refuses
        the plan.
        """
        self._ticks += 1
        now_us = knot * self._knot_us
        if self.phase is Phase.HELLO:
            if not self._greeted():
                return Outbox()
            self.phase, self._began_us = Phase.SYNC, now_us
        if self.phase is Phase.SYNC and not self._settled(now_us):
            del samples[: -100 * len(self._remotes)]
            return Outbox()
        if self.phase is Phase.SYNC:
            self._stand(samples)
            self._arm()
            self.phase, self._ticks = Phase.ARM, 0
        if self.phase is Phase.ARM:
            if not (self._armed() and self._stands(samples)):
                return Outbox()
            self._stand(samples)
            self._take_over()
            self.knot = knot + self._margin + START_KNOTS
            self.phase = Phase.START
        elif knot + self._margin >= self.knot + 1:
            self._check_started()
            self.phase = Phase.RUN
        samples.clear()
        return Outbox(self.knot, self._still())

    def _greeted(self) -> bool:
        """Whether every device has answered in its session."""
        silent = [
            f"{joint}: {NO_SESSION[remote.greeting]}"
            for joint, remote in zip(self._joints, self._remotes, strict=True)
            if not remote.established
        ]
        if silent and self._ticks > HELLO_TICKS:
            raise DeviceError("; ".join(silent))
        return not silent

    def _stand(self, samples: Samples) -> None:
        """Where the machine stands, and what holds it there. Nothing is known of a machine that has
        to be homed: then its brakes hold it."""
        self.position = self._standing_at(samples)
        self.torque = np.zeros_like(self.position)
        if all(r.status and r.status.homed for r in self._remotes):
            self.torque = self._prediction.holding(self.position, self.torque)

    def _take_over(self) -> None:
        """A machine that rests from an earlier run goes on with the torque that it holds itself by,
        which knows of loads that the model does not."""
        for device, (remote, units) in enumerate(zip(self._remotes, self._units, strict=True)):
            if self._resumed[device]:
                assert remote.status is not None
                self.torque[device] = remote.status.holding_tq / units.tq_per_effort

    def _stands(self, samples: Samples) -> bool:
        """Whether every device knows where it is, and has told it for a while under its torque."""
        lost = [r for r in self._remotes if not (r.status and r.status.homed)]
        if lost and not self._homing:
            self._homing = True
            for remote in lost:
                remote.ask("HOME")
        if lost or not self._standing:  # a search takes its time: the devices end a vain one
            samples.clear()
            self._ticks = 0
        self._standing = not lost
        return self._ticks >= STAND_TICKS

    def _arm(self) -> None:
        self._resumed = [bool(r.status and r.status.state == HOLD) for r in self._remotes]
        for device in self._driven:
            self._ask_to_arm(device)

    def _ask_to_arm(self, device: int) -> None:
        if self._resumed[device]:
            self._remotes[device].ask("RESUME")
        else:
            torque_tq = self._units[device].torque_points(self.torque[device])
            self._remotes[device].ask("ARM", int(torque_tq))

    def _armed(self) -> bool:
        """Whether every device has taken its load. One that was not at rest is asked again for a
        while: as the others take theirs a light joint swings in its brake."""
        late = []
        for device in self._driven:
            axis, units, remote = self._axes[device], self._units[device], self._remotes[device]
            answer, status = remote.answer(), remote.status
            swings = answer == "MOVING" and not self._homing and self._ticks < ARM_TICKS
            if swings:
                self._ask_to_arm(device)
            if answer is None or status is None or swings:
                late.append(axis.joint)
                continue
            if answer != "DONE":
                raise DeviceError(f"{axis.joint}: the device does not arm: {answer}")
            if status.state != ARMED:
                raise DeviceError(f"{axis.joint}: {why(status, axis, units, self._period_us)}")
        if not late:
            return True
        if self._ticks > ARM_TICKS:
            raise DeviceError(f"{', '.join(late)}: not armed within {ARM_TICKS} ticks")
        return False

    def _settled(self, now_us: int) -> bool:
        """Whether every clock has settled."""
        self._settle.tick(now_us)
        for axis, units, remote in zip(self._axes, self._units, self._remotes, strict=True):
            if remote.status is not None and remote.status.state in LATCHED:
                reason = why(remote.status, axis, units, self._period_us)
                raise DeviceError(f"{axis.joint}: {reason}")
        ready = all(r.status and r.status.state in (IDLE, HOLD) for r in self._remotes)
        if ready and self._settle.settled_us(now_us) >= SETTLED_US:
            return True
        if now_us - self._began_us > SETTLE_US:
            raise DeviceError(
                f"not settled within {SETTLE_US / 1e6:g} s: "
                + ("; ".join(self._settle.unsettled(now_us)) or "a device does not come to IDLE")
            )
        return False

    def _standing_at(self, samples: Samples) -> Array:
        """Median of the last samples of each axis: an outlier does not move it. Those without an
        encoder are where the config says."""
        medians = []
        for axis, joint in enumerate(self._joints):
            values = [s.position for s in samples if s.axis == axis]
            if not values:
                raise DeviceError(f"{joint}: no samples arrive")
            medians.append(np.median(values[-50:]))
        return np.array(medians + self._rest)

    def _still(self) -> Points:
        """Points that stand still at the position, with the torque that holds it and the gains."""
        still = np.ones(STILL_POINTS)
        motion = [
            (
                self._units[axis].position_points(self.position[axis] * still),
                self._units[axis].torque_points(self.torque[axis] * still),
            )
            for axis in self._driven
        ]
        gains = self._gains.still(self.position, STILL_POINTS)
        return np.concatenate((np.array(motion), gains), axis=1)

    def _check_started(self) -> None:
        for device in self._driven:
            status = self._remotes[device].status
            if status is None or status.plan_accepted == 0:
                raise DeviceError(
                    f"{self._joints[device]}: the device did not accept the first plan"
                )
