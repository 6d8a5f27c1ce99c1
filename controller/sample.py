"""What the estimator hears of the machine."""

from typing import NamedTuple


class Sample(NamedTuple):
    """One encoder reading; ordered by stamp, then axis."""

    time_us: int
    axis: int
    position: float  # [rad or m]
