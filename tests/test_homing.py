"""Homing on an axis that moves: by index, switch and stop, both ways, and searches that fail."""

import pytest
from rig import CART, POSITION, TORQUE, UNITS, Axis, Rig, State, cart_rig, cart_settings

from headway.firmware import _core

S = State
PQ = UNITS.pq_per_unit
TQ = UNITS.tq_per_effort
MARK = 1234  # counts: what the mark's place is called
SPEED = 0.5  # rad/s
COUNTS = CART.counts_per_unit
PER_COUNT = 1 / COUNTS
OFFSET = 77_777  # what the encoder does not know


def unhomed(method: str, backwards: bool = False, way: int = 8000) -> tuple[Rig, Axis]:
    settings = cart_settings()
    home = settings.home
    home.method = _core.HOME_METHODS.index(method)
    home.backwards, home.mark_count = backwards, MARK
    home.speed_q16 = round(SPEED * PQ * 1e-3 * 65536)
    home.acceleration_q16 = home.speed_q16 // 50
    home.torque_tq = round(0.5 * TQ)
    home.way_counts, home.still_periods = way, 100
    rig, axis = cart_rig(settings, encoder_offset=OFFSET)
    rig.node.switch_from = rig.node.switch_to = 1 << 30  # nowhere
    return rig.sync(), axis


def search(rig: Rig, within_us: int = 6_000_000) -> bool:
    """Arms and homes; whether it found its mark."""
    if rig.state != S.ARMED:
        rig.arm()
    assert rig.ask("HOME") == "DONE"
    end = rig.now + within_us
    while not rig.node.status.homed and rig.state == S.ARMED:
        assert rig.now < end, "neither found nor failed"
        rig.period()
    return rig.node.status.homed


def position_of(rig: Rig) -> int:
    """The last sample that the device has told, in counts."""
    rig.run(100_000)
    return rig.statuses[-1].samples[-1][1]


def assert_homed(rig: Rig, axis: Axis, mark: int, within: int = 1) -> None:
    """The axis knows where it is, rests there, armed, and takes a plan from there."""
    rig.run(300_000)
    assert rig.state == S.ARMED and rig.reason == "NONE"
    assert abs(axis.v) < 0.01
    assert abs(position_of(rig) - (axis.count - mark + MARK)) <= within
    assert abs(rig.node.setpoint(0)[0] / 1024 - position_of(rig)) <= 20  # it holds where it is
    assert rig.ask("HOME") == "DONE"  # it may be done again
    assert rig.ask("STOP") == "DONE"
    rig.run_until(S.HOLD)
    rig.arm()
    point = round(position_of(rig) * 1024)
    first = rig.knot + 16
    assert rig.give(first, {POSITION: [point] * 30, TORQUE: [0] * 30}) == "accepted"


@pytest.mark.parametrize("backwards", [False, True])
def test_index(backwards: bool) -> None:
    """The next pulse in the direction of the search, to the count."""
    rig, axis = unhomed("index", backwards)
    rig.node.index_every = 2000
    rig.node.index_at = 500
    assert search(rig)
    assert_homed(rig, axis, -1500 if backwards else 500)


def test_index_passed_by_hand_is_no_mark() -> None:
    rig, axis = unhomed("index")
    rig.node.index_every = 2000
    axis.v, axis._brake = 0.0, True
    for _ in range(450):  # by hand, against a brake that gives way
        axis.q += 5 * PER_COUNT
        rig.period()
    assert axis.count > 2000
    rig.run(200_000)
    assert search(rig)
    assert_homed(rig, axis, 4000)


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("width", [300, 1 << 29])
def test_switch(backwards: bool, width: int) -> None:
    """Where it goes on, within the way of one servo period."""
    rig, axis = unhomed("switch", backwards)
    mark = -700 if backwards else 700
    rig.node.switch_from, rig.node.switch_to = (
        (mark - width + 1, mark + 1) if backwards else (mark, mark + width)
    )
    assert search(rig)
    assert_homed(rig, axis, mark, within=round(SPEED * 1e-3 * COUNTS) + 1)


@pytest.mark.parametrize("backwards", [False, True])
def test_an_axis_on_its_switch_backs_off_first(backwards: bool) -> None:
    rig, axis = unhomed("switch", backwards)
    edge = 900 if backwards else -900
    rig.node.switch_from, rig.node.switch_to = (
        (-(1 << 29), edge + 1) if backwards else (edge, 1 << 29)
    )
    assert search(rig)
    assert_homed(rig, axis, edge, within=round(SPEED * 1e-3 * COUNTS) + 1)


@pytest.mark.parametrize("load", [-1.0, 0.0, 1.0])
def test_stop(load: float) -> None:
    """With little torque; then no longer pushing."""
    rig, axis = unhomed("stop")
    axis.load = load
    axis.wall = 900.4 * PER_COUNT
    rig.arm(round(-load * TQ))
    hardest = 0.0
    assert rig.ask("HOME") == "DONE"
    while not rig.node.status.homed:
        rig.period()
        hardest = max(hardest, abs(rig.node.torque_tq / TQ + load))
    assert 0.5 <= hardest < 0.6
    rig.run(200_000)
    assert abs(rig.node.torque_tq / TQ + load) < 0.1
    assert_homed(rig, axis, 900, within=2)


@pytest.mark.parametrize("method", ["index", "switch", "stop"])
@pytest.mark.parametrize("backwards", [False, True])
def test_a_search_without_a_mark_fails(method: str, backwards: bool) -> None:
    rig, axis = unhomed(method, backwards, way=3000)
    assert not search(rig)
    assert rig.state == S.TAIL and rig.reason == "HOMING"
    fault = rig.node.status.fault
    assert (abs(fault.value), fault.limit) == (3000 + abs(fault.value) - 3000, 3000)
    assert 3000 < abs(fault.value) < 3050 and (fault.value < 0) == backwards
    rig.run_until(S.HOLD)
    rig.run(200_000)
    assert not rig.node.status.homed and abs(axis.v) < 0.01
    assert abs(axis.count) < 3600


def test_an_unhomed_axis_takes_no_plan_but_jogs() -> None:
    rig, axis = unhomed("index")
    rig.arm()
    tracks = {POSITION: [axis.count * 1024 - OFFSET * 1024] * 30, TORQUE: [0] * 30}
    assert rig.give(rig.knot + 16, tracks) == "state"
    assert rig.ask("JOG", round(0.3 * PQ * 1e-3 * 65536)) == "DONE"
    rig.run(1_000_000)
    assert axis.v == pytest.approx(0.3, rel=0.05)
    assert rig.ask("HOME") == "MOVING"
    assert rig.ask("JOG", 0) == "DONE"
    rig.run(300_000)
    assert abs(axis.v) < 0.01 and rig.state == S.ARMED


def test_an_axis_without_homing_does_not_look() -> None:
    rig, _ = unhomed("none")
    assert rig.node.status.homed  # its encoder knows
    rig.arm()
    assert rig.ask("HOME") == "BAD"


def test_power_and_encoder_faults_unhome() -> None:
    rig, _ = unhomed("index")
    rig.node.index_every = 2000
    assert search(rig)
    rig.run(300_000)
    rig.node.stop_line = True
    rig.run(800_000)
    rig.node.stop_line = False
    rig.run(10_000)
    assert rig.ask("CLEAR") == "DONE"
    assert rig.node.status.homed  # nothing was wrong with the encoder
    rig.run_until(S.IDLE)
    rig.node.break_encoder(3, rig.now)
    rig.run_until(S.FAULT, 10_000)
    rig.run(200_000)
    assert rig.ask("CLEAR") == "DONE"
    assert not rig.node.status.homed
    rig.restart()
    assert not rig.node.status.homed


def test_a_stuck_encoder_ends_the_search() -> None:
    rig, axis = unhomed("index")
    rig.node.index_every = 100_000
    rig.arm()
    rig.node.break_encoder(1, rig.now)
    assert rig.ask("HOME") == "DONE"
    rig.run_until(S.FAULT)
    assert rig.reason == "STUCK"
    rig.run(100_000)
    assert rig.node.brake and not rig.node.power
    assert abs(axis.count) < 400


def test_settings_of_a_search() -> None:
    """A search needs a speed, a torque and a way; without one there may be none of them."""
    for method in _core.HOME_METHODS:
        for name in ("speed_q16", "torque_tq", "way_counts"):
            settings = cart_settings()
            home = settings.home
            home.way_counts = 100
            home.method = _core.HOME_METHODS.index(method)
            assert settings.valid
            setattr(home, name, 0)
            assert settings.valid == (method == "none")
            setattr(home, name, -1)
            assert not settings.valid
