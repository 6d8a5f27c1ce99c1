"""The firmware's numbers and kernels that the host's side works with: one definition, in C."""

from headway.firmware._core import (
    COAST_KNOTS,
    GATE_RESULTS,
    LIVE_KNOTS,
    PLAN_POINTS_MAX,
    STATES,
    TRACK_KD,
    TRACK_KI,
    TRACK_KP,
    TRACK_POSITION,
    TRACK_TORQUE,
    GateLimits,
    Track,
    gate_check_track,
    track_points,
)

__all__ = [
    "COAST_KNOTS",
    "GATE_RESULTS",
    "LIVE_KNOTS",
    "PLAN_POINTS_MAX",
    "STATES",
    "TRACK_KD",
    "TRACK_KI",
    "TRACK_KP",
    "TRACK_POSITION",
    "TRACK_TORQUE",
    "GateLimits",
    "Track",
    "gate_check_track",
    "track_points",
]
