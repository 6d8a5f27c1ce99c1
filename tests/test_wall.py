"""The wall clock, on a computer of simulated clocks: what is done to others leaves it alone."""

import time

import pytest

from headway.cli.wall import WallClock

SECOND = 10**9
SLEW_PPM = 500  # the most by which NTP bends a clock


class Computer:
    """Its clocks [ns], as NTP and a hand have them: one is set, two are slewed."""

    def __init__(self) -> None:
        self.raw, self.monotonic, self.real = 5 * SECOND, 7 * SECOND, 1_700_000_000 * SECOND

    def go(self, ns: int) -> None:
        slewed = ns + ns * SLEW_PPM // 10**6
        self.raw, self.monotonic, self.real = (
            self.raw + ns, self.monotonic + slewed, self.real + slewed,
        )  # fmt: skip

    def read(self, clock: int) -> int:
        return {
            time.CLOCK_REALTIME: self.real,
            time.CLOCK_MONOTONIC: self.monotonic,
            time.CLOCK_MONOTONIC_RAW: self.raw,
        }[clock]


@pytest.fixture
def computer(monkeypatch: pytest.MonkeyPatch) -> Computer:
    made = Computer()
    monkeypatch.setattr(time, "clock_gettime_ns", made.read)
    # A sleep is measured by the slewed one, so that it is too short.
    short = SECOND * (1 - SLEW_PPM * 1e-6)
    monkeypatch.setattr(time, "sleep", lambda seconds: made.go(round(seconds * short)))
    return made


@pytest.mark.parametrize("factor", [1.0, 0.05])
def test_nobody_sets_or_slews_it(computer: Computer, factor: float) -> None:
    """Its rate is the computer's oscillator's, whatever NTP makes of the other clocks."""
    clock = WallClock(factor)
    began_us = clock.now_us()
    computer.real -= 86_400 * SECOND
    for second in range(1, 1001):
        computer.go(SECOND)
        assert abs(clock.now_us() - began_us - second * 1e6 * factor) <= 1


def test_it_sleeps_until_its_own_time(computer: Computer) -> None:
    """By another clock the sleep may end too early: then it goes on."""
    clock = WallClock(0.1)
    began_ns, due_us = computer.raw, clock.now_us() + 1_000_000
    clock.wait_until(due_us)
    assert clock.now_us() >= due_us
    assert computer.raw - began_ns == pytest.approx(10 * SECOND, rel=1e-4)
