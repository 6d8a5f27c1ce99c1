"""A device walks at random through its states and never does what one of them forbids."""

import pytest
import walk
from rig import State
from walk import Broken, Walk


@pytest.mark.parametrize("seed", range(4))
def test_walk(seed: int) -> None:
    walker = Walk(seed)
    walker.walk(20_000)
    assert len(walker.visited) >= 12 and walker.visited.total() > 40


@pytest.mark.parametrize(
    ("pairs", "pair"),
    [
        (walk.BY_DEVICE, (State.RUNNING, State.COAST)),
        (walk.BY_DEVICE, (State.TAIL, State.HOLD)),
        (walk.BY_HOST, (State.IDLE, State.ARMED)),
    ],
)
def test_an_unlisted_transition_is_found(
    pairs: set[tuple[State, State]], pair: tuple[State, State], monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "BY_DEVICE" if pairs is walk.BY_DEVICE else "BY_HOST"
    monkeypatch.setattr(walk, name, pairs - {pair})
    with pytest.raises(Broken, match=f"from {pair[0].name} to {pair[1].name}"):
        Walk(1).walk(20_000)


def test_a_brake_that_is_given_too_little_time_is_found() -> None:
    """The walk expects more than what the device was flashed with."""
    walker = Walk(1)
    walker.settings.brake_periods += 20
    with pytest.raises(Broken, match="power off before"):
        walker.walk(20_000)
