"""A run as a sequence of pictures that fits into its share of the page."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from headway.cli.page.scene import Picture, Scene
from headway.controller.record.reader import Run
from headway.models.coupling import Coupling

Array = NDArray[np.float64]

FPS, FPS_MIN = 20.0, 10.0  # with less it would be no motion: a long run is shown in part
PICTURES = 600
BUDGET_BYTES = 2_000_000  # all pictures as they are in the page: in base64
# Scales and WebP qualities, tried in this order.
LADDER = ((1.0, 70), (1.0, 45), (0.75, 45), (0.5, 45), (0.5, 20), (0.25, 20))
EFFORT = 2  # of WebP's 0 to 6, to make files small
PROBES = 8  # pictures that tell whether all would fit

Draw = Callable[[int, float], Picture]  # number of the picture and scale to pixels
Progress = Callable[[float], None]  # takes seconds of the animation that are done


@dataclass(frozen=True)
class Animation:
    """Pictures at equal distances in time."""

    start_s: float  # of the task
    fps: float
    pictures: list[bytes]  # WebP

    @property
    def page_bytes(self) -> int:
        """What the pictures take in the page."""
        return sum(page_bytes(picture) for picture in self.pictures)

    @property
    def end_s(self) -> float:
        """Time of the last picture."""
        return self.start_s + (len(self.pictures) - 1) / self.fps


def page_bytes(data: bytes) -> int:
    """Length in base64."""
    return 4 * -(-len(data) // 3)


def picture_times(begin_s: float, end_s: float) -> tuple[Array, float]:
    """Times of the pictures of a run, and how many there are in a second.

    The rate is less in a longer run, but not below FPS_MIN: then only the beginning is shown.
    """
    duration_s = end_s - begin_s
    fps = FPS if duration_s * FPS < PICTURES else max(FPS_MIN, PICTURES / duration_s)
    count = min(PICTURES, 1 + int(duration_s * fps))
    return begin_s + np.arange(count) / fps, fps


def compress(
    draw: Draw, count: int, budget_bytes: int, progress: Callable[[int], None]
) -> tuple[list[bytes], int]:
    """WebP pictures that take no more than the budget, as good as it allows.

    Returns every n-th of the `count` pictures, and n, which is 1 unless even the smallest would
    take more. The budget must hold one of those.
    """
    for every in itertools.accumulate(itertools.repeat(2), int.__mul__, initial=1):
        numbers = range(0, count, every)
        probes = numbers[:: -(-len(numbers) // PROBES)]
        for scale, quality in LADDER:
            size = sum(page_bytes(_webp(draw(i, scale), quality)) for i in probes)
            if size * len(numbers) > budget_bytes * len(probes):
                continue
            pictures, size = [], 0
            for i in numbers:
                pictures.append(_webp(draw(i, scale), quality))
                size += page_bytes(pictures[-1])
                if size > budget_bytes:
                    break
                progress(i)
            else:
                return pictures, every
    raise AssertionError("not reached: the loop over `every` has no end")


def _webp(pixels: Picture, quality: int) -> bytes:
    file = BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", quality=quality, method=EFFORT)
    return file.getvalue()


class Motion:
    """Where the machine and its ghost stand over the time of the task.

    The ghost is the reference, and in a comparison the other run's machine.
    """

    def __init__(self, run: Run, other: Run | None) -> None:
        """Both must have recorded something of the task."""
        self._time_s, self._pose = run.arrays["truth_s"], _joints(run, "truth_position")
        if other is None:
            self._ghost_s, self._ghost = self._time_s, _joints(run, "truth_reference")
            self._ghost_span_s = 0.0, float(run.arrays["tick_s"][-1])
        else:
            self._ghost_s = other.arrays["truth_s"]
            self._ghost = _joints(other, "truth_position")
            self._ghost_span_s = float(self._ghost_s[0]), float(self._ghost_s[-1])

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time."""
        return float(self._time_s[0]), float(self._time_s[-1])

    @property
    def poses(self) -> Array:
        """All that the machine takes, (m, axes)."""
        return self._pose

    def pose(self, time_s: float) -> Array:
        """Of the machine [rad or m]."""
        return _at(time_s, self._time_s, self._pose)

    def ghost(self, time_s: float) -> Array | None:
        """Of the ghost; None while there is none."""
        low_s, high_s = self._ghost_span_s
        return _at(time_s, self._ghost_s, self._ghost) if low_s <= time_s <= high_s else None


def _at(time_s: float, times_s: Array, rows: Array) -> Array:
    """The row at a time or just after: a millisecond shows in no picture."""
    row: Array = rows[min(int(np.searchsorted(times_s, time_s)), len(rows) - 1)]
    return row


def _joints(run: Run, positions: str) -> Array:
    """Of the joints (m, n), where the record has the axes'."""
    rows = run.arrays[positions]
    return Coupling.of(run.config().machine.coupling, rows.shape[1]).joints(rows)


def scene_of(run: Run) -> Scene:
    """The machine of a run, ready to be drawn. Raises NoPicture."""
    machine = run.config().machine
    joints = [axis.joint for axis in machine.axes]
    return Scene(Path(machine.model), joints, _joints(run, "truth_position"))


def animate(run: Run, other: Run | None, progress: Progress) -> Animation:
    """Pictures of a run, with the other one's machine or the reference as a ghost.

    Raises NoPicture.
    """
    motion = Motion(run, other)
    times_s, fps = picture_times(*motion.span_s)
    with scene_of(run) as scene:

        def draw(number: int, scale: float) -> Picture:
            time_s = times_s[number]
            return scene.picture(motion.pose(time_s), motion.ghost(time_s), scale)

        pictures, every = compress(
            draw, len(times_s), BUDGET_BYTES, lambda i: progress(times_s[i] - times_s[0])
        )
    return Animation(float(times_s[0]), fps / every, pictures)
