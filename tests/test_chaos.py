"""sim/chaos.py in virtual time: what it counts, that a seed is a fate, cuts, and flipped bits."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headway.configs.schema import Channel
from headway.devices.port import SerialPort
from headway.sim.chaos import Chaos, Trouble
from headway.sim.outlet import PtyOutlet

STEP_US = 500
MARKS = 3, 5, 6, 9  # of the ends, two bits apart
CLEAN = Channel(delay_us=500, jitter_us=0, loss=0)
BAD = Channel(
    delay_us=3000, jitter_us=1000, loss=0.2, loss_run=3, duplicate=0.1, reorder=0.1, reorder_us=4000
)

Passed = list[tuple[int, bytes]]  # when, what


class Time:
    """A clock that goes on whenever somebody waits, and ends a run."""

    def __init__(self, end_us: int) -> None:
        self.us, self.end_us = 0, end_us
        self.chaos: Chaos | None = None

    def now_us(self) -> int:
        return self.us

    def seconds(self, span_us: int) -> float:
        self.us += max(1, min(span_us, STEP_US))
        if self.us >= self.end_us and self.chaos is not None:
            self.chaos.stopping = True
        return 0.0


class End:
    """One end of a wire, at which packets arrive at their times."""

    name = where = "end"

    def __init__(self, time: Time, packets: Passed) -> None:
        self._time, self._left = time, list(packets)
        self._fd = os.eventfd(0)
        self.passed: Passed = []
        self.followed: list[tuple[int | None, int]] = []

    def fileno(self) -> int:
        return self._fd

    def read(self) -> list[bytes]:
        come = [packet for when, packet in self._left if when <= self._time.us]
        self._left = self._left[len(come) :]
        return come

    def write(self, packet: bytes) -> bool:
        self.passed.append((self._time.us, packet))
        return True

    def took(self, session: int | None, counter: int) -> None:
        self.followed.append((session, counter))

    def close(self) -> None:
        os.close(self._fd)


def packets(count: int, mark: int, every_us: int = 1000) -> Passed:
    """Each of its own, two bits from every other, of bytes of which no flipped bit makes a zero."""
    return [
        (every_us * i, bytes([mark, *(0x56 if i >> b & 1 else 0x55 for b in range(16))]))
        for i in range(count)
    ]


def troubled(
    channel: Channel, trouble: Trouble, count: int, seed: int
) -> tuple[Chaos, list[End], list[End]]:
    """A machine of two devices, of which each end sends as many packets."""
    time = Time(1000 * count + 200_000)
    ports = [End(time, packets(count, MARKS[device])) for device in range(2)]
    outlets = [End(time, packets(count, MARKS[2 + device])) for device in range(2)]
    of: Any = ports, outlets
    chaos = time.chaos = Chaos(*of, channel, trouble, time, np.random.default_rng(seed))
    try:
        chaos.run()
    finally:
        for end in (*ports, *outlets):
            end.close()
    return chaos, ports, outlets


@settings(max_examples=8, deadline=None)
@given(st.integers(1, 100), st.integers(0, 2**32))
def test_a_clean_wire_passes_all_in_time_and_to_whom_it_is_for(count: int, seed: int) -> None:
    chaos, ports, outlets = troubled(CLEAN, Trouble(), count, seed)
    assert (chaos.passed, chaos.lost, chaos.corrupted, chaos.cut) == (4 * count, 0, 0, 0)
    for device in range(2):
        sent = packets(count, MARKS[2 + device]), packets(count, MARKS[device])
        for end, expected in zip((ports[device], outlets[device]), sent, strict=True):
            assert [packet for _, packet in end.passed] == [packet for _, packet in expected]
            late = [got - left for (got, _), (left, _) in zip(end.passed, expected, strict=True)]
            assert min(late) >= 500 and max(late) <= 500 + 2 * STEP_US


@settings(max_examples=8, deadline=None)
@given(st.integers(50, 150), st.integers(0, 2**32))
def test_what_is_counted_is_what_became_of_it(count: int, seed: int) -> None:
    trouble = Trouble(corrupt=0.1, partition_every_us=100_000, partition_us=20_000)
    chaos, ports, outlets = troubled(BAD, trouble, count, seed)
    through = [packet for end in (*ports, *outlets) for _, packet in end.passed]
    known = {packet for mark in MARKS for _, packet in packets(count, mark)}
    assert chaos.passed == len(through)
    assert chaos.corrupted == sum(packet not in known for packet in through)
    assert 4 * count - chaos.lost - chaos.cut <= chaos.passed  # some came twice
    if chaos.corrupted == 0:
        assert len(set(through)) == 4 * count - chaos.lost - chaos.cut


def test_the_same_seed_is_the_same_fate_and_another_another() -> None:
    trouble = Trouble(corrupt=0.1, partition_every_us=100_000, partition_us=20_000)
    runs = []
    for seed in (5, 5, 6):
        chaos, ports, outlets = troubled(BAD, trouble, 400, seed)
        counted = chaos.passed, chaos.lost, chaos.corrupted, chaos.cut
        assert all(counted)
        runs.append((counted, [end.passed for end in (*ports, *outlets)]))
    assert runs[0] == runs[1] != runs[2]


def test_shares_are_those_asked_for() -> None:
    chaos, _, _ = troubled(BAD, Trouble(corrupt=0.1), 3000, 1)
    assert chaos.lost == pytest.approx(0.2 * 12_000, rel=0.1)
    assert chaos.corrupted == pytest.approx(0.1 * 0.8 * 1.1 * 12_000, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_nothing_passes_in_a_partition(seed: int) -> None:
    """What is sent in one is cut, at both ends of all wires; before and after all passes."""
    trouble = Trouble(partition_every_us=200_000, partition_us=50_000)
    chaos, ports, outlets = troubled(CLEAN, trouble, 2000, seed)
    assert chaos.cut > 4 * 40 and chaos.passed + chaos.cut == 4 * 2000
    gaps = []
    for end in (*ports, *outlets):
        times = np.array([when for when, _ in end.passed])
        wide = np.flatnonzero(np.diff(times) > 10_000)
        assert len(wide) >= 1
        assert np.all(np.diff(times)[wide] >= trouble.partition_us - 1000 - 2 * STEP_US)
        gaps.append([round(int(times[i]) / 5000) for i in wide])
    assert all(len(each) == len(gaps[0]) for each in gaps)  # the same ones for all


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[tuple[PtyOutlet, SerialPort]]:
    """An outlet at a pty, and the port of a controller that has opened it."""
    outlet = PtyOutlet(tmp_path, "arm", "q1")
    port = SerialPort(outlet.where)
    yield outlet, port
    port.close()
    outlet.close()


def test_a_bit_is_flipped_in_what_comes_through_a_pty(pty: tuple[PtyOutlet, SerialPort]) -> None:
    """With every packet corrupted: both ways, one bit of each, and none is lost."""
    outlet, port = pty
    time = Time(300_000)
    device = End(time, packets(100, 7))
    of: Any = [device], [outlet]
    chaos = time.chaos = Chaos(*of, CLEAN, Trouble(corrupt=1.0), time, np.random.default_rng(3))
    there = [packet for _, packet in packets(100, 9)]
    for packet in there:
        assert port.write(packet)
    chaos.run()
    device.close()
    back: list[bytes] = []
    while more := port.read():
        back += more
    assert chaos.corrupted == chaos.passed == 200
    for sent, got in (
        (there, [packet for _, packet in device.passed]),
        ([packet for _, packet in packets(100, 7)], [packet for packet in back if packet]),
    ):
        assert len(got) == 100
        for one, other in zip(sent, got, strict=True):
            bits = int.from_bytes(one, "little") ^ int.from_bytes(other, "little")
            assert len(one) == len(other) and bits.bit_count() == 1
