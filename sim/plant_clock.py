"""The host's clock of a simulated world: waiting is what makes the world go on."""

from __future__ import annotations

from headway.sim.world import World


class PlantClock:
    """For loops on a clock (controller/live.py), in virtual time."""

    def __init__(self, world: World) -> None:
        self._plant, self._link = world.plant, world.link

    def now_us(self) -> int:
        """The host's time."""
        return self._plant.true_us + self._link.epoch_us

    def wait_until(self, time_us: int) -> None:
        """Steps the plant to the first step at that time or later."""
        while self.now_us() < time_us:
            self._plant.step(1)
            self._link.collect()
