"""What the boards on one bus have seen at once, and what they make of it together.

Every board on a USB sees the same start of a frame, at the same instant but for some tens of
nanoseconds. Each tells between which times, by what it knows of the host's, that was
(firmware/mark.h). All of them are right, so the instant lies in the intersection, and this is told
to all: they come to know the same, and agree with each other better than any with the host.
"""

from __future__ import annotations

from headway.firmware import _core

Mark = tuple[int, int, int]  # number, width [us], least time [us]

NONE: Mark = (0, _core.MARK_OPEN, 0)
APART_US = 1_000_000  # marks of one number are one within this time: numbers come again
KEPT = 8


class Bus:
    """The marks of one bus."""

    def __init__(self, devices: int) -> None:
        self._devices = devices
        self._told: dict[int, dict[int, tuple[int, int]]] = {}  # by number, by device: least, most

    def tell(self, device: int, mark: Mark) -> None:
        """A device's own view of a mark."""
        number, width_us, least_us = mark
        if width_us == _core.MARK_OPEN:
            return
        views = self._told.get(number, {})
        if any(abs(least - least_us) > APART_US for least, _ in views.values()):
            views = {}
        views[device] = least_us, least_us + width_us
        self._told.pop(number, None)
        self._told[number] = views  # the newest last
        while len(self._told) > KEPT:
            self._told.pop(next(iter(self._told)))

    def mark(self) -> Mark:
        """The newest mark that all devices have told, as all of them have it; NONE if there is
        none, or if they contradict each other."""
        for number, views in reversed(self._told.items()):
            if len(views) < self._devices:
                continue
            least = max(least for least, _ in views.values())
            most = min(most for _, most in views.values())
            return (number, most - least, least) if least <= most else NONE
        return NONE
