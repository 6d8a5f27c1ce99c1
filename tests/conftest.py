"""Settings for all property tests: no judging by the clock; the build server repeats itself."""

import os

from hypothesis import HealthCheck, settings

settings.register_profile(
    "headway",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize="HEADWAY_CI" in os.environ,
)
settings.load_profile("headway")
