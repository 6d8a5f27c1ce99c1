"""A bus whose packets wait for their slot in a frame, by a clock of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# A USB host's frame is 1.000 ms +- 500 ns long (USB 2.0, section 7.1.12), by a crystal that is not
# the one that the operating system's clock counts.
DRIFT_PPM = 500
NUMBERS = 2048  # a start-of-frame packet carries 11 bits of the frame's number (USB 2.0, 8.4.3)
PS_PER_US = 1_000_000


@dataclass(frozen=True)
class Bus:
    """Frame n starts at `phase_ps` + n * `period_ps` of true time and has number n modulo 2048.

    All that is a bus's own is whole picoseconds: at a frame of 1 ms a picosecond is a ppb.
    """

    phase_ps: int
    period_ps: int

    @classmethod
    def of(cls, frame_us: int, rng: np.random.Generator) -> Bus:
        """A bus with frames of nominally `frame_us`; rate and phase are drawn."""
        drift = rng.uniform(-DRIFT_PPM, DRIFT_PPM) * 1e-6
        period_ps = frame_us * PS_PER_US + round(frame_us * PS_PER_US * drift)
        return cls(int(rng.integers(period_ps)), period_ps)

    def leave(self, ready_us: int, slot_us: int) -> int:
        """True time [us] of the first slot, `slot_us` after a frame's start, at or after
        `ready_us`."""
        first_ps = self.phase_ps + slot_us * PS_PER_US
        frame = -((first_ps - ready_us * PS_PER_US) // self.period_ps)
        return -(-(first_ps + frame * self.period_ps) // PS_PER_US)

    def frame_start(self, true_us: int) -> tuple[int, int]:
        """Number and true time [us, rounded up] of the last start of a frame at or before
        `true_us`."""
        frame = (true_us * PS_PER_US - self.phase_ps) // self.period_ps
        return frame % NUMBERS, -(-(self.phase_ps + frame * self.period_ps) // PS_PER_US)
