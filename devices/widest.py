"""The largest plan that the gate lets pass: its points swing from knot to knot."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from headway.firmware import _core


def fits_a_frame(limits: Mapping[int, _core.GateLimits], count: int) -> bool:
    """Whether any plan of `count` points a track, with these tracks and limits, fits a frame."""
    sign = np.resize([1, -1], count)
    tracks = {}
    for sink, of in limits.items():
        swing = min(
            of.second_difference_max // 4,
            of.difference_max // 2,
            (of.point_max - of.point_min) // 2,
        )
        # Of a continuous axis about where 2^32 begins anew, since points are sent as differences.
        middle = 2**31 if of.continuous else of.point_max - swing
        tracks[sink] = (middle + swing * sign).astype(np.int64).astype(np.int32)
    try:
        _core.plan_encode((0, 0, 0), 1, 0, 0, tracks)
    except ValueError:
        return False
    return True
