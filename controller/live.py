"""The loop on a clock that goes on by itself: ticks on the knots, as they come.

A tick that cannot begin in the first half of its knot is skipped and counted, never caught up: the
next one plans from what is true then, and the devices have plan enough for the pause.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np

from headway.configs.schema import Config
from headway.controller.loop import Loop
from headway.controller.record.columns import Arrays
from headway.controller.record.note import note_tick
from headway.controller.record.recorder import Recorder
from headway.controller.tick import DeviceError, Outbox, Phase
from headway.devices.core import COAST_KNOTS, STATES
from headway.devices.link import Link
from headway.devices.remote import Remote

LISTEN_TICKS = 3  # after a pause in which devices may have begun to coast
REST_US = 500_000  # beyond the last plan's end, for all to tell that they rest
AFTER_US = 300_000  # of listening once they have: friction lets an axis creep
RESTS = {STATES.index(name) for name in ("UNSYNCED", "IDLE", "HOLD", "FAULT", "ESTOP")}
ARMED = STATES.index("ARMED")


class Clock(Protocol):
    """The host's system time."""

    def now_us(self) -> int: ...

    def wait_until(self, time_us: int) -> None:
        """Returns at that time or later; at once if it has passed."""


class Live:
    """One machine in closed loop over a link, from its first HELLO to rest."""

    def __init__(
        self,
        config: Config,
        loop: Loop,
        remotes: list[Remote],
        link: Link,
        record: Recorder,
        clock: Clock,
    ) -> None:
        self.config, self.loop, self.record = config, loop, record
        self._remotes, self._link, self._clock = remotes, link, clock
        self._knot_us = config.loop.knot_us
        self._listen = 0  # ticks to come that only listen
        self.ticks = 0  # of the task
        self.deadline_misses = 0  # skipped, or too late for their plan
        self.stopping = False  # set it to end the run early: the last plan brings all to rest

    def run(self, progress: Callable[[float], None] | None = None) -> None:
        """From HELLO through the task's duration to rest; after each tick of the task `progress`
        gets its seconds.

        Raises DeviceError if a device does not answer, does not start or stops by itself; by then
        all have come to rest that can be heard.
        """
        try:
            self._run_task(progress)
        except DeviceError:
            self._come_to_rest()
            raise
        self._come_to_rest()

    def _run_task(self, progress: Callable[[float], None] | None) -> None:
        end_us: int | None = None
        for now_us in self._knots():
            if self.stopping or (end_us is not None and now_us >= end_us):
                return
            self._tick(now_us)
            if self.loop.phase is Phase.RUN and end_us is None:
                self.record.add(("task", now_us, (self.loop.start_us,)))
                end_us = self.loop.start_us + round(self.config.duration_s * 1e6)
            if progress and end_us is not None:
                progress((now_us - self.loop.start_us) * 1e-6)

    def _knots(self) -> Iterator[int]:
        """The times of the ticks."""
        knot_us = self._knot_us
        now_us = self._clock.now_us()
        next_us = now_us - now_us % knot_us + knot_us
        while True:
            self._clock.wait_until(next_us)
            late_us = self._clock.now_us() - next_us
            if late_us > knot_us // 2:  # on to a knot that is yet to come, with all heard till then
                skipped = late_us // knot_us + 1
                self.deadline_misses += skipped * (self.loop.phase is Phase.RUN)
                if skipped > COAST_KNOTS:
                    self._listen = LISTEN_TICKS
                next_us += skipped * knot_us
                continue
            yield next_us
            next_us += knot_us

    def _tick(self, now_us: int) -> None:
        """One round of the loop. After a long pause of this computer's it first hears how the
        devices are: what came in the pause is old, and buffers kept no more than they hold."""
        if self._listen:
            self._listen -= 1
            self.deadline_misses += self.loop.phase is Phase.RUN
            self._attend(now_us)
            return
        running = self.loop.phase is Phase.RUN
        self.loop.read(self._link, now_us)
        tick, outbox = self.loop.tick(now_us)
        sent_us = self._clock.now_us()
        in_time = self.loop.write(self._link, outbox, sent_us)
        if running:
            self.ticks += 1
            self.deadline_misses += not in_time
        note_tick(self.record, tick, sent_us, in_time)

    def _come_to_rest(self) -> None:
        """No more plans; stamps alone, until all tell that they rest."""
        plan_us = self.config.mpc.horizon_us + self.config.loop.margin_us
        last_us = self._clock.now_us() + plan_us + REST_US
        rested_us: int | None = None
        self._disarm()
        for now_us in self._knots():
            self._attend(now_us)
            resting = all(r.status is None or r.status.state in RESTS for r in self._remotes)
            if resting and rested_us is None:
                rested_us = now_us
            if now_us > last_us or (rested_us is not None and now_us > rested_us + AFTER_US):
                break
        self._note_end(now_us)

    def _attend(self, now_us: int) -> None:
        """Takes in what has arrived and sends stamps alone."""
        self.loop.read(self._link, now_us)
        self.loop.write(self._link, Outbox(), self._clock.now_us())
        self.record.publish()

    def _disarm(self) -> None:
        """A device that was armed and has no plan yet would hold its axis for good."""
        for remote in self._remotes:
            if remote.established and self.loop.phase is Phase.ARM:
                remote.ask("DISARM")

    def _note_end(self, now_us: int) -> None:
        statuses = [r.status for r in self._remotes if r.status is not None]
        states = [0 if r.status is None else r.status.state for r in self._remotes]
        late = sum(status.plans_late for status in statuses)
        refused = sum(status.plans_refused for status in statuses)
        counts = self.ticks, self.deadline_misses, 0, 0, late, refused, states
        self.record.add(("end", now_us, counts))
        self.record.publish()

    def frames(self, arrays: Arrays) -> dict[str, int | None]:
        """Frames to the devices while the task ran, as its record has them, and what the devices
        refused. What got lost nobody knows."""
        of_task = (arrays["sent_us"] >= self.loop.start_us) & (
            arrays["sent_us"] <= arrays["tick_sent_us"][-1]
        )
        statuses = [r.status for r in self._remotes if r.status is not None]
        return {
            "sent": int(np.sum(of_task)),
            "lost": None,
            "late_points": sum(status.plans_late for status in statuses),
            "gate_refused": sum(status.plans_refused for status in statuses),
        }

    def frames_bad(self) -> int:
        """Packets from the devices' ports that were not theirs, or damaged."""
        return sum(remote.frames_bad for remote in self._remotes)

    def device_states(self) -> list[str]:
        """State of every device, by name, as it told last."""
        return [STATES[r.status.state] if r.status else "UNKNOWN" for r in self._remotes]
