"""Short servo periods: what need not be done in each takes turns, and comes as late as docs say."""

import pytest
from rig import Rig, State, device_settings

from headway.firmware import _core

S = State
PERIOD_US = 100
TURNS = 16


def armed(**monitor: int) -> Rig:
    """An axis that holds its place, in short periods."""
    settings = device_settings()
    settings.servo_period_us = PERIOD_US
    changed = settings.monitor
    for name, value in monitor.items():
        setattr(changed, name, value)
    settings.monitor = changed
    return Rig(settings=settings, poll_us=50).sync().arm()


def until(rig: Rig, state: State, most_periods: int) -> int:
    """Periods until it is in that state."""
    begun = rig.now
    rig.run_until(state, most_periods * PERIOD_US)
    return (rig.now - begun) // PERIOD_US


@pytest.mark.parametrize("after", range(TURNS))
@pytest.mark.parametrize("supply_V", [10.0, 40.0])
def test_a_bad_supply_is_found_with_the_fourth_look(after: int, supply_V: float) -> None:
    rig = armed()
    rig.run(after * PERIOD_US)
    rig.node.supply_V = supply_V
    assert 24 <= until(rig, S.FAULT, 40) <= 33
    assert rig.reason == ("UNDERVOLTAGE" if supply_V < 20 else "OVERVOLTAGE")


@pytest.mark.parametrize("after", range(TURNS))
def test_a_jump_is_found_in_its_own_period(after: int) -> None:
    """Whatever has its turn."""
    rig = armed(spike_counts=100)
    rig.run(after * PERIOD_US)
    rig.encoder = lambda true_us: 101
    assert until(rig, S.FAULT, 3) <= 2
    assert rig.reason == "SPIKE" and rig.node.brake


@pytest.mark.parametrize("after", range(0, TURNS, 3))
def test_an_open_line_is_seen_in_its_own_period(after: int) -> None:
    rig = armed()
    rig.run(after * PERIOD_US)
    rig.node.stop_line = True
    assert until(rig, S.ESTOP, 3) <= 2


def test_stamps_all_the_time_keep_no_error_from_being_told() -> None:
    """What is known is compared at every other turn at the latest."""
    rig = armed()
    rig.run(40_000)
    told = set()
    for _ in range(800):
        rig.poll()
        payload = _core.sync_encode((*rig.stamps, rig.host_us - 1000))  # it was under way
        rig.node.deliver(rig.now, rig.host.seal(_core.FRAME_SYNC, payload))
        told.add(rig.node.error_ns)
    assert rig.node.status.stamps_excluded == 0
    assert len(told) > 5  # 40 ms are twelve of those
