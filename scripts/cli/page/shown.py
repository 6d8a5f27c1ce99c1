"""A run as one of those that a page shows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from headway.configs.schema import Config
from headway.controller.record.columns import Arrays
from headway.controller.record.reader import Run
from headway.controller.reference import ENTRY_S

POINTS, POINTS_MIN = 24_000, 2_000  # of a curve over all axes, and of one curve


@dataclass(frozen=True, eq=False)
class Shown:
    """A run with its name and its colour on the page."""

    name: str  # "" if it is alone
    colour: str  # page.css has a variable of that name
    run: Run
    summary: dict[str, Any] | None  # None of a run that was killed

    @property
    def arrays(self) -> Arrays:
        return self.run.arrays

    @cached_property
    def config(self) -> Config:
        return self.run.config()

    @property
    def joints(self) -> list[str]:
        return [axis.joint for axis in self.config.machine.axes]

    @property
    def end_s(self) -> float:
        """Last tick of the task: from then on the machine coasts to rest."""
        return float(self.arrays["tick_s"][-1])

    @property
    def span_s(self) -> tuple[float, float]:
        """Where tracking is judged: after the entry, before the coasting."""
        return ENTRY_S, self.end_s

    @property
    def points(self) -> int:
        """Points of a curve, fewer on a machine of many axes: the page must stay small."""
        return max(POINTS_MIN, POINTS // max(2, len(self.joints)))

    def label(self, what: str) -> str:
        """In a legend: with the run's name if there are two."""
        return f"{self.name}: {what}" if self.name else what
