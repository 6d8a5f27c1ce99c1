"""Tracks and encoders as the host has them (module.cpp)."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from headway.firmware._core import GateLimits, Status, Track

Array = NDArray[np.float64]
Points = NDArray[np.int32]

def unwrap(values: Points, near: float) -> Array:
    """Values modulo 2^32, each less than half of that from the one before, without bounds; of all
    that the first may stand for the one next to `near`."""

class Holding:
    """The tracks that a device holds."""

    waiting_since_us: int

    def __init__(self) -> None: ...
    def forget(self) -> None:
        """A new epoch: the device drops its tracks."""

    def send(
        self,
        stamps_us: tuple[int, int, int],
        mark: tuple[int, int, int],
        number: int,
        epoch: int,
        first_knot: int,
        points: Points,
    ) -> bytes:
        """The payload of a plan, a row of points a sink, which from now on is under way. Raises
        ValueError for points that a frame cannot carry."""

    def settle(self, status: Status, patience_us: int) -> None:
        """Settles those plans that a status has an answer for; one without an answer after
        `patience_us` counts as lost."""

    def track(self, sink: int) -> Track:
        """The track as it will be once what is under way has arrived: always the same object."""

class Gate:
    """The gate, as on the devices, of several tracks."""

    def __init__(self, limits: Sequence[GateLimits], stored: Sequence[Track]) -> None: ...
    def refusal(self, first_knot: int, points: Points, knot: int) -> tuple[int, int] | None:
        """Of points from a knot on (devices, sinks, m), a row a track, at a knot: the first row
        that it would not take, and why, as in firmware/gate.h; None if it takes all."""

class Along:
    """What devices execute, as a function of system time."""

    def at(self, times_us: NDArray[np.int64], near: Array) -> Array:
        """Rows [r, r', f, Kp, Kd + c] by axis (m, 5n) at system times (m,), close together.
        `near` (n,): where the axes are at the first of them, give or take some turns."""

class Course(Along):
    """What the devices execute, as far as the host knows, in SI."""

    def __init__(
        self,
        axes: list[int],
        position: list[Track],
        torque: list[Track],
        pq_per_unit: list[float],
        tq_per_effort: list[float],
        continuous: list[bool],
        knot_shift: int,
        still: Array,
        kp: list[Track],
        kd: list[Track],
        kp_per_mantissa: Array,
        kd_per_mantissa: Array,
        emf: Array,
    ) -> None:
        """`axes`: those with a motor; the next five lists are of these. `still`: a row
        [r, r', f, Kp, Kd + c] (5n), of which `at` replaces what tracks tell. The last five are of
        gain tracks, or empty."""

    def points(self, first_knot: int, near: Array, position: Array, torque: Array) -> None:
        """Control points from a knot on, a row a driven axis, into arrays in Fortran order.
        `near` (n,): as in `at`."""

class Sample:
    """One encoder reading."""

    def __init__(self, time_us: int, axis: int, position: float) -> None: ...
    @property
    def time_us(self) -> int:
        """System time."""

    @property
    def axis(self) -> int: ...
    @property
    def position(self) -> float:
        """[rad or m]"""

class Samples:
    """A list of them."""

    def __init__(self, samples: Iterable[Sample] = ...) -> None: ...
    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[Sample]: ...
    def __getitem__(self, index: int) -> Sample: ...
    def __setitem__(self, index: int, sample: Sample) -> None: ...
    def __delitem__(self, index: int | slice) -> None: ...
    def append(self, sample: Sample) -> None: ...
    def clear(self) -> None: ...
    def extend(self, samples: Samples) -> None: ...
    def insert(self, index: int, sample: Sample) -> None: ...
    def pop(self, index: int = -1) -> Sample: ...

class Odometer:
    """Follows one encoder: of all counts that the told one may stand for it takes the one next to
    the last, so nothing but a jump by 2^31 is mistaken. Where the device has just begun to tell, or
    has found out where it is, its last count is taken as it is."""

    def __init__(self, axis: int, unit_per_count: float) -> None: ...
    def read(self, status: Status, samples: Samples) -> None:
        """Appends a status' samples."""
