"""Which settings a board takes: each number at its ends and one beyond."""

import pytest
from rig import TORQUE, device_settings

from headway.firmware import _core

INT_MAX = (1 << 31) - 1
ENDS: list[tuple[str, int, int]] = [
    ("knot_shift", 9, 15),
    ("servo_period_us", 1, 65535),
    ("sample_every", 1, 65535),
    ("torque_step_tq", 1, INT_MAX),
    ("servo.torque_limit_tq", 1, 1 << 25),
    ("monitor.following_pq", 1, INT_MAX),
    ("monitor.speed_pq", 1, INT_MAX),
    ("monitor.stuck_pq", 1, INT_MAX),
    ("monitor.deceleration_q16", 1, INT_MAX),
    ("monitor.spike_counts", 1, (1 << 18) - 1),
    ("monitor.rise_q16", 1, INT_MAX),
    ("home.method", 0, 3),
    ("home.speed_q16", 0, (1 << 30) - 1),
    ("home.acceleration_q16", 1, INT_MAX),
    ("home.torque_tq", 0, INT_MAX),
    ("home.way_counts", 0, INT_MAX),
    ("sync.method", 0, 1),
    ("sync.drift_ppm", 0, 300),
    ("sync.wander_ppb_s", 0, 60_000),
    ("sync.to_device_least_us", 0, 1_000_000),
    ("sync.to_host_least_us", 0, 1_000_000),
    ("sync.limit_us", 1, 1_000_000),
    ("sync.interval_us", 0, (1 << 32) - 1),
    ("sync.phase_gain", 0, 65535),
    ("sync.skew_gain_q8", 0, 65535),
]


def valid_with(name: str, value: int) -> bool:
    settings = device_settings()
    part, _, field = name.rpartition(".")
    target = getattr(settings, part) if part else settings
    setattr(target, field, value)
    return settings.valid


@pytest.mark.parametrize(("name", "low", "high"), ENDS, ids=[name for name, _, _ in ENDS])
def test_ends(name: str, low: int, high: int) -> None:
    assert valid_with(name, low) and valid_with(name, high)
    if low > 0 or (name.startswith("home.") and name != "home.method"):
        assert not valid_with(name, low - 1)
    if high not in (INT_MAX, 65535, (1 << 32) - 1):
        assert not valid_with(name, high + 1)


def test_limits_are_in_order() -> None:
    settings = device_settings()
    settings.monitor.low_pq = settings.monitor.high_pq = 7
    assert settings.valid
    settings.monitor.low_pq = 8
    assert not settings.valid


def test_a_turning_axis_has_no_room_to_watch() -> None:
    settings = device_settings()
    settings.set_limits(0, _core.GateLimits(0, 0, 1 << 20, 1 << 18, 0, True))
    assert settings.valid
    settings.monitor.bounded = True
    assert not settings.valid


def test_policies_are_judged() -> None:
    settings = device_settings()
    settings.set_gap_policy(TORQUE, _core.GAP_POLICIES.index("zero"))
    assert not settings.valid  # it carries gravity
    settings.carries_gravity = False
    assert settings.valid
