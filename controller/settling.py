"""Devices that get stamps and nothing else, until their clocks have settled."""

from __future__ import annotations

from collections.abc import Sequence

from headway.controller.live import Clock
from headway.controller.settle import Settle
from headway.devices.attend import attend
from headway.devices.clock import ClockState
from headway.devices.link import Link
from headway.devices.remote import Remote


class Settling:
    """The host says hello and sends stamps, one frame a knot, in simulation or over real links."""

    def __init__(
        self, names: Sequence[str], knot_us: int, remotes: Sequence[Remote], link: Link,
        clock: Clock,
    ) -> None:  # fmt: skip
        """`names`: of the devices, for what is told of them. `knot_us`: between two frames."""
        self._remotes, self._link, self._clock = remotes, link, clock
        self._settle = Settle(names, remotes)
        self._knot_us = knot_us
        self._now_us = self._began_us = clock.now_us()

    @property
    def time_s(self) -> float:
        """Since the beginning."""
        return (self._now_us - self._began_us) * 1e-6

    @property
    def settled_s(self) -> float:
        """For how long all clocks have stayed settled; below 0: they are not."""
        return self._settle.settled_us(self._now_us) * 1e-6

    def unsettled(self) -> list[str]:
        """Who is not settled, and why."""
        return self._settle.unsettled(self._now_us)

    def run(self, duration_s: float) -> list[ClockState]:
        """Goes on for so long; returns how each clock is then."""
        states = []
        end_us = self._now_us + max(self._knot_us, round(duration_s * 1e6))
        while self._now_us < end_us:
            self._clock.wait_until(self._now_us + self._knot_us)
            late_us = self._clock.now_us() - self._now_us
            self._now_us += max(1, late_us // self._knot_us) * self._knot_us
            attend(self._remotes, self._link, self._now_us)
            states = self._settle.tick(self._now_us)
        return states
