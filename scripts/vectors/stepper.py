"""Vectors of the stepper: windows of pulses, at, below and beyond its rate, both ways; turns."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from line import line

STEP, HALF = 1 << 10, 1 << 9  # pq
US = 1 << 16
TOP, LOW = (1 << 31) - 1, -(1 << 31)


def steppers(rng: Random) -> Iterator[str]:
    """Where a step is, single windows, what is left over, then walks."""
    for position in (0, HALF - 1, HALF, HALF + 1, -HALF - 1, -HALF, 1 - HALF, TOP, TOP - HALF, LOW,
                     7 * STEP + 3):  # fmt: skip
        yield line("stepper", position_pq=position)
        for by_count in (-5, TOP):
            yield line("stepper-shift", by_count=by_count)
        yield _step(position + 3 * STEP if position < TOP - 3 * STEP else position)
    for sign in (1, -1):
        yield from _windows(sign)
        yield from _rates(sign)
    yield from _walk(rng)


def _step(target: int, least: int = 20 * US, window: int = 1000) -> str:
    return line("stepper-step", least_q16=least, target_pq=target, window_us=window)


def _windows(sign: int) -> Iterator[str]:
    """From rest to a target, the window after it, and back."""
    for start in (0, 300, HALF - 1, -HALF):
        for way in (0, 1, 211, 212, HALF, STEP, 9 * STEP + 77):
            yield line("stepper", position_pq=start)
            yield _step(start + sign * way)
            yield _step(start + sign * way)
            yield _step(start)
    for window in (1, 2, 100, 4096, 16_384, (1 << 15) - 1):
        for least in (1, US, 2 * US, 100 * US, (1 << 32) - 1):
            yield line("stepper", position_pq=0)
            yield _step(sign * 2 * STEP, least, window)
            yield _step(sign * 2 * STEP + sign, least, window)
            yield _step(0, least, window)
    for target in (1 << 29, (1 << 29) - 1, (1 << 29) + 1, (1 << 30) + 5, TOP):
        yield line("stepper", position_pq=0)
        yield _step(sign * target, 1, 1000)
        yield _step(sign * target, 7 * US, 1000)
        yield line("stepper", position_pq=0)
        yield _step(sign * target, 1, (1 << 15) - 1)


def _rates(sign: int) -> Iterator[str]:
    """At the rate, a little beyond it, and a turn within a window."""
    for extra in (-2, -1, 0, 1, 2, 60, 51_200):
        yield line("stepper", position_pq=0)
        for window in range(1, 4):
            yield _step(sign * window * (50 * STEP + extra))
        for _ in range(3):
            yield _step(sign * 3 * (50 * STEP + extra))
    for steps in (2, 4, 8):  # the last one at the window's very end: it is the next one's
        yield line("stepper", position_pq=-HALF)
        yield _step(steps * STEP - HALF, US, 1024)
        yield _step(steps * STEP - HALF, US, 1024)
    window = 1024 * US  # and one in the last moment that is still its own, of several that wait
    yield line("stepper", position_pq=0)
    yield _step(sign * 10 * STEP, window, 1024)
    yield _step(sign * 10 * STEP, window - window // 20 + window - 1, 1024)
    for way, back in ((HALF, 1), (HALF, HALF), (HALF + 3, 5), (STEP, STEP + 9), (8 * STEP, 8000)):
        for least in (3 * US, 999 * US, 1000 * US, 2500 * US):
            yield line("stepper", position_pq=0)
            yield _step(sign * way, least)
            for _ in range(4):
                yield _step(sign * (way - back), least)
    for least in (999 * US, 1000 * US - 1, 1000 * US, 1000 * US + 1):  # what just fits a window
        yield line("stepper", position_pq=0)
        for window in (1, 2, 3, 4, 9, 9, 9):
            yield _step(sign * window * STEP, least)
    yield line("stepper", position_pq=0)
    for times in range(68):  # the time since the last pulse ends somewhere
        if times in (0, 1, 66):
            yield _step(sign * STEP * (times + 1), (1 << 32) - 1, (1 << 15) - 1)
        else:
            yield _step(sign * STEP * (2 if times < 66 else 67), (1 << 32) - 1, 1 << 10)


def _walk(rng: Random) -> Iterator[str]:
    for _ in range(6):
        position = rng.choice([0, rng.randrange(LOW, TOP), TOP - 900])
        least = rng.randrange(1, 120 * US)
        yield line("stepper", position_pq=position)
        speed = 0
        for _ in range(16):
            speed += rng.randrange(-3 * STEP, 3 * STEP)
            position = (position + speed - LOW) % (1 << 32) + LOW
            yield _step(position, least)
            if rng.randrange(9) == 0:
                by = rng.randrange(-(1 << 22), 1 << 22)
                yield line("stepper-shift", by_count=by)
                position = (position + by * STEP - LOW) % (1 << 32) + LOW
