"""Marks: instants that all boards on a bus see at once, and what the host makes of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from rig import KEY, device_settings

from headway.devices.bus import APART_US, KEPT, NONE, Bus
from headway.firmware import _core
from headway.sim import bus as sim_bus
from headway.sim.boards import Boards, Crystal, Host
from headway.sim.network import Wire
from headway.sim.profiles import PROFILES

KNOT_US = 4096
EPOCH_US = 1_700_000_000_000_000
SECOND = 1_000_000


# ---- what is told together


@given(
    truth_us=st.integers(-(1 << 50), 1 << 50),
    sides=st.lists(
        st.tuples(st.integers(0, 30_000), st.integers(0, 30_000)), min_size=1, max_size=6
    ),
)
def test_the_intersection_has_the_truth_and_is_no_wider_than_any(
    truth_us: int, sides: list[tuple[int, int]]
) -> None:
    """Whoever is right on his own is right together, too."""
    bus = Bus(len(sides))
    for device, (before, after) in enumerate(sides):
        assert bus.mark() == NONE
        bus.tell(device, (64, before + after, truth_us - before))
    number, width_us, least_us = bus.mark()
    assert number == 64 and least_us <= truth_us <= least_us + width_us
    assert width_us <= min(before + after for before, after in sides)
    assert any(truth_us - before == least_us for before, _ in sides)
    assert any(truth_us + after == least_us + width_us for _, after in sides)


def test_who_contradicts_the_others_spoils_the_mark() -> None:
    bus = Bus(2)
    bus.tell(0, (32, 10, 1000))
    bus.tell(1, (32, 10, 1011))
    assert bus.mark() == NONE
    bus.tell(1, (32, 10, 1010))  # the last word counts; they touch
    assert bus.mark() == (32, 0, 1010)


def test_who_knows_nothing_keeps_the_mark_open() -> None:
    bus = Bus(2)
    bus.tell(0, (32, 10, 1000))
    bus.tell(1, (32, _core.MARK_OPEN, 0))
    assert bus.mark() == NONE


def test_the_newest_mark_that_all_have_told_counts() -> None:
    bus = Bus(2)
    for number, device in ((32, 0), (64, 0), (32, 1), (96, 0)):
        bus.tell(device, (number, 10, 1000 * number))
    assert bus.mark() == (32, 10, 32_000)
    bus.tell(1, (64, 10, 64_000))
    assert bus.mark() == (64, 10, 64_000)


def test_numbers_come_again() -> None:
    """11 bits of a frame's number: what was told of its last time is another mark."""
    bus = Bus(2)
    later_us = 1000 + APART_US + 1
    bus.tell(0, (32, 10, 1000))
    bus.tell(1, (32, 10, later_us))
    assert bus.mark() == NONE
    bus.tell(0, (32, 10, later_us))
    assert bus.mark() == (32, 10, later_us)


@pytest.mark.parametrize(("number", "kept"), [(0, False), (32, True)])
def test_what_one_tells_alone_is_forgotten(number: int, kept: bool) -> None:
    bus = Bus(2)
    for k in range(KEPT + 1):
        bus.tell(0, (32 * k, 10, 32_000 * k))
    bus.tell(1, (number, 10, 1000 * number))
    assert bus.mark() == ((number, 10, 1000 * number) if kept else NONE)


# ---- boards on a bus


def star(boards: int, seed: int, marked: bool) -> Boards:
    """Boards that differ by up to 200 ppm around a host, on full-speed USB, from power-up on."""
    rng = np.random.default_rng(seed)
    bus = sim_bus.Bus.of(1000, rng)
    settings = device_settings()
    settings.dither_us = 1000  # a frame
    sync = settings.sync
    sync.drift_ppm, sync.limit_us = 300, 2000
    settings.sync = sync
    marks = Bus(boards) if marked else None
    channels = PROFILES["usb"]
    hosts = []
    for board in range(boards):
        out, home, nonces = rng.spawn(3)
        wires = Wire(channels.to_device, out, bus), Wire(channels.to_host, home, bus)
        phase_us = int(rng.integers(KNOT_US))
        hosts.append(Host(board, KEY, wires, EPOCH_US, phase_us, KNOT_US, nonces, marks))
    crystals = [
        Crystal(int(rng.integers(2**32)), int(rng.integers(-100_000, 100_000)), 500, 140_000, i)
        for i in range(boards)
    ]
    seen = bus if marked else None
    return Boards([settings] * boards, crystals, [], rng.spawn(1)[0], hosts, seen, 250)


def errors(boards: Boards, from_us: int, to_us: int) -> NDArray[np.int64]:
    """What each clock shows minus the host's, by milliseconds. All that is told is true."""
    found = []
    for now_us in range(from_us, to_us, 1000):
        boards.advance(now_us)
        shown = [us - now_us - EPOCH_US for us in boards.shown_us()]
        for error_us, (least, most) in zip(shown, boards.told_ns(), strict=True):
            # A count and a clock are rounded down; it was told up to a period ago, at 500 ppm.
            assert least / 1000 - 2.6 <= error_us <= most / 1000 + 0.6
        found.append(shown)
    return np.array(found)


@pytest.mark.parametrize("seed", [1, 2])
def test_boards_on_a_bus_agree_with_each_other_better_than_with_the_host(seed: int) -> None:
    """A wire is longer one way: all err by that. What they see at once makes them err alike."""
    boards = star(3, seed, True)
    boards.advance(6 * SECOND)
    assert all(node.synced for node in boards.nodes)
    found = errors(boards, 6 * SECOND, 8 * SECOND)
    apart = found.max(axis=1) - found.min(axis=1)
    assert np.percentile(apart, 99.9) <= 2  # whole microseconds
    assert np.abs(np.median(found)) > 20
    assert all(node.excluded == 0 for node in boards.nodes)


def test_without_marks_they_agree_less() -> None:
    """Else the marks would not be what does it."""
    spread = {}
    for marked in (True, False):
        boards = star(3, 3, marked)
        boards.advance(6 * SECOND)
        found = errors(boards, 6 * SECOND, 8 * SECOND)
        spread[marked] = np.percentile(found.max(axis=1) - found.min(axis=1), 50)
    assert spread[True] * 3 < spread[False]
