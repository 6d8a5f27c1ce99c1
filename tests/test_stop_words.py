"""Why a device stopped, in words that say what to do."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from headway.configs.load import ConfigError, load_config
from headway.devices.axis import AxisUnits
from headway.devices.stop import LIMIT_MAX_US, REASONS, STATES, why

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "arm2.yaml"
OPEN_NS = 2**31 - 1


def clock_words(value: int, limit: int, least_ns: int, most_ns: int) -> str:
    """Of a device in TAIL as its clock may be off by too much."""
    config = load_config(CONFIG)
    axis = config.machine.axes[0]
    status: Any = SimpleNamespace(
        state=STATES.index("TAIL"), reason=REASONS.index("CLOCK"), reason_value=value,
        reason_limit=limit, least_error_ns=least_ns, most_error_ns=most_ns,
    )  # fmt: skip
    return why(status, axis, AxisUnits.of(axis, config.loop), config.device.servo_period_us)


@pytest.mark.parametrize(
    ("value", "least_ns", "most_ns", "limit_us"),
    [(201, -150_000, 201_000, 500), (201, -640_500, 20_000, 1300), (999_999, -1, 1, 1_000_000)],
)
def test_a_clock_that_is_off_names_the_key_and_a_value_that_the_config_takes(
    value: int, least_ns: int, most_ns: int, limit_us: int
) -> None:
    """Twice what was measured, when it stopped or since."""
    said = clock_words(value, 200, least_ns, most_ns)
    assert "sync.limit_us, which is 200 us" in said and f"sync.limit_us={limit_us}," in said
    assert load_config(CONFIG, [f"sync.limit_us={limit_us}"]).sync.limit_us == limit_us


def test_no_limit_helps_a_clock_that_knows_nothing() -> None:
    said = clock_words(OPEN_NS, 200, -OPEN_NS, OPEN_NS)
    assert "contradicts itself" in said and "sync.limit_us=" not in said


def test_the_largest_limit_is_that_of_the_config() -> None:
    load_config(CONFIG, [f"sync.limit_us={LIMIT_MAX_US}"])
    with pytest.raises(ConfigError, match="limit_us"):
        load_config(CONFIG, [f"sync.limit_us={LIMIT_MAX_US + 1}"])
