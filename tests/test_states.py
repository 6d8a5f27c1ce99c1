"""The table of states against DESIGN's text, and every exit taken on a device by its real cause."""

from collections.abc import Callable

import pytest
from rig import (
    EXITS,
    KNOT_US,
    MAKE,
    PERIOD_US,
    POLL_US,
    POSITION,
    SYNC_LOST_US,
    TORQUE,
    Rig,
    State,
    device_settings,
)

from headway.firmware import _core

S = State
EVENTS = _core.EVENTS


def test_names() -> None:
    assert [state.name for state in S] == _core.STATES
    assert {event for _, event in EXITS} == set(EVENTS)


@pytest.mark.parametrize("state", S)
@pytest.mark.parametrize("event", EVENTS)
def test_every_state_and_event(state: State, event: str) -> None:
    assert _core.next_state(state, EVENTS.index(event)) == EXITS.get((state, event), state)


@pytest.mark.parametrize(("state", "event"), [(-1, 0), (10, 0), (0, -1), (0, 13)])
def test_no_such_state_or_event(state: int, event: int) -> None:
    with pytest.raises(ValueError, match="no such"):
        _core.next_state(state, event)


# ---- a device in each state


@pytest.mark.parametrize("state", S)
def test_a_device_in_each_state(state: State) -> None:
    assert MAKE[state]().state == state


# ---- the real cause of each event, whether the state has an exit for it or not


def boot(rig: Rig) -> None:
    rig.period()


def settle(rig: Rig) -> None:
    rig.syncing = True
    for _ in range(400):
        if rig.state != S.UNSYNCED:
            break
        rig.run(4000)


def lose_sync(rig: Rig) -> None:
    """The host falls silent. A plan is running only while it is not: it goes on without stamps."""
    rig.syncing = False
    if rig.state == S.RUNNING:
        first = rig.knot - 10
        while rig.state == S.RUNNING:
            count = rig.knot + 20 - first
            if count > 120:
                first, count = first + 60, count - 60
            assert rig.give(first, {POSITION: [0] * count, TORQUE: [0] * count}) == "accepted"
            for _ in range(2 * KNOT_US // POLL_US):
                if rig.state == S.RUNNING:
                    rig.poll()
    else:
        state = rig.state
        end = rig.now + SYNC_LOST_US + 20_000
        while rig.state == state and rig.now < end:
            rig.poll()


def arm(rig: Rig) -> None:
    rig.ask("ARM", epoch=9)


def disarm(rig: Rig) -> None:
    rig.ask("DISARM")


def plan(rig: Rig) -> None:
    running_ = rig.state in (S.RUNNING, S.COAST)
    first = rig.knot - 15 if running_ else rig.knot + 4
    rig.give(first, {POSITION: [0] * 60, TORQUE: [0] * 60})


def overdue(rig: Rig) -> None:
    rig.run(6 * KNOT_US + PERIOD_US)


def come_to_rest(rig: Rig) -> None:
    state = rig.state
    for _ in range(1000):
        if rig.state != state:
            break
        rig.period()


def resume(rig: Rig) -> None:
    rig.ask("RESUME", epoch=9)


def stop(rig: Rig) -> None:
    rig.ask("STOP")


def fault(rig: Rig) -> None:
    if rig.state == S.BOOT:
        settings = device_settings()
        settings.torque_step_tq = 0
        rig.node.flash(settings)
        rig.period()
        return
    before = rig.encoder
    rig.encoder = lambda now: before(now) + 200_000
    rig.period()


def clear(rig: Rig) -> None:
    rig.run(50_000)  # until it is at rest and off, where it stops at all
    rig.ask("CLEAR")


def open_line(rig: Rig) -> None:
    rig.node.stop_line = True
    rig.period()


CAUSE: dict[str, Callable[[Rig], None]] = {
    "BOOTED": boot,
    "SYNCED": settle,
    "SYNC_LOST": lose_sync,
    "ARM": arm,
    "DISARM": disarm,
    "PLAN": plan,
    "OVERDUE": overdue,
    "RESTED": come_to_rest,
    "RESUME": resume,
    "STOP": stop,
    "FAULT": fault,
    "CLEAR": clear,
    "ESTOP": open_line,
}


@pytest.mark.parametrize(("state", "event"), EXITS, ids=lambda x: getattr(x, "name", x))
def test_every_exit_is_taken_by_its_cause(state: State, event: str) -> None:
    rig = MAKE[state]()
    CAUSE[event](rig)
    assert rig.state == EXITS[state, event]


COMMANDED = ("ARM", "DISARM", "PLAN", "RESUME", "STOP", "CLEAR")


@pytest.mark.parametrize("state", [s for s in S if s != S.BOOT])  # which ends by itself at once
@pytest.mark.parametrize("event", COMMANDED)
def test_the_host_moves_it_by_listed_exits_only(state: State, event: str) -> None:
    rig = MAKE[state]()
    if event == "CLEAR":  # the waiting in there is time's, not the host's
        assert rig.ask("CLEAR") == ("DONE" if state in (S.FAULT, S.ESTOP) else "NOT_NOW")
    else:
        CAUSE[event](rig)
    assert rig.state == EXITS.get((state, event), state)
