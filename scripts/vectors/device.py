"""Vectors of a whole device: sessions, states, commands, plans, stops, and what else it takes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import device_corners
import device_doors
import device_motion
import device_session
import device_stop
from bench import bench

SCENES = (
    *device_session.SCENES,
    *device_motion.SCENES,
    *device_session.LATER,
    *device_stop.SCENES,
    *device_corners.SCENES,
    *device_doors.SCENES,
)


def devices(judge: Path) -> Iterator[str]:
    """All scenes, one after another; each states what docs/device.md says of it."""
    with bench(judge) as b:
        for scene in SCENES:
            scene(b)
    yield from b.lines
