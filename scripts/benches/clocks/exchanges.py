"""What a device lives through: its oscillator, its servo periods, and the stamps that reach it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Channel, Sync
from headway.sim import _board
from headway.sim.bus import Bus
from headway.sim.network import Wire
from headway.sim.profiles import PROFILES

KNOT_US = 4096  # between frames, each way
SERVO_US = 1000
DRIFT_PPM, WANDER_PPM_PER_S = 100.0, 1.0  # of the oscillators: the bounds that are told are wider
EPOCH_US = 10**15  # the host's clock at true time 0
SYNC_BYTES, STATUS_BYTES = 46, 160  # packets, as on the wire
REQUEST_BYTES, RESPONSE_BYTES = 20, 49  # of neighbours
DITHER_US = Sync().dither_us
DITHER_EVERY = 4  # firmware/device.h
ECHOES = 8  # statuses that wait for a frame to be echoed in (devices/remote.py)

Times = NDArray[np.int64]


class Least(NamedTuple):
    """Least delays [us] from the reference and to it, as a wire's owner knows them."""

    to_here: int
    to_there: int


class Stamps(NamedTuple):
    """Frames in the order of their arrival at a device, of shape (n,) each [us].

    `upstream` stamps are by the clock that is followed; `ticks` are the own counter's, without its
    wraps. `received` is 0 where a frame has nothing to echo.
    """

    arrived_ticks: Times
    sent_upstream: Times
    echo_ticks: Times
    received_upstream: Times
    arrived_us: Times  # true time
    least: Least


def ticks_of(numbers: tuple[int, int, int, int, int], true_us: Times) -> Times:
    """What the counter of an oscillator with these numbers shows, without its wraps, at true times
    of shape (n,), ascending."""
    offset = numbers[0]
    count = _board.Oscillator(*numbers).counts(true_us).astype(np.int64)
    gained = (count - true_us - offset) & 0xFFFFFFFF
    return true_us + offset + np.where(gained >= 2**31, gained - 2**32, gained)


class Counter:
    """A board's counter, without its wraps."""

    def __init__(self, rng: np.random.Generator, drift_ppm: float = DRIFT_PPM) -> None:
        drift_ppb = round(drift_ppm * 1000)
        self.numbers = (
            int(rng.integers(2**32)),
            int(rng.integers(-drift_ppb, drift_ppb + 1)),
            round(WANDER_PPM_PER_S * 1000),
            drift_ppb,
            int(rng.integers(2**63)),
        )

    def ticks(self, true_us: Times) -> Times:
        """At true times of shape (n,), ascending."""
        return ticks_of(self.numbers, true_us)

    def periods(self, duration_us: int) -> Times:
        """True times, at multiples of SERVO_US on the counter."""
        first = -(-self.numbers[0] // SERVO_US) * SERVO_US
        target = np.arange(first, first + duration_us, SERVO_US)
        true_us = target - self.numbers[0]
        for _ in range(3):  # the error shrinks by 10^-4 each time
            true_us = true_us - (self.ticks(true_us) - target)
        return true_us[true_us >= 0]


class Scene(NamedTuple):
    """One device: its servo periods, at which its clock is judged, and the host's frames."""

    servo_us: Times  # true time
    servo_ticks: Times
    stamps: Stamps


def least_of(channel: Channel, size_bytes: int) -> int:
    """Least delay [us] of a packet, its own bits included."""
    bits = 8_000_000 * size_bytes
    bandwidth = channel.bandwidth_bit_per_s
    return channel.least_us + (bits // bandwidth if bandwidth else 0)


def bus_of(profile: str, rng: np.random.Generator) -> Bus | None:
    """The bus that a profile's wires share, if they do."""
    frame_us = max(channel.frame_us for channel in PROFILES[profile])
    return Bus.of(frame_us, rng) if frame_us else None


def carried(
    wire: Wire, sent_us: Times, size_bytes: int, cut_us: tuple[int, int] = (0, 0)
) -> list[tuple[int, int]]:
    """(arrival, index) of the frames that arrive, in order of arrival; of two copies the first
    counts. Nothing that is sent in `cut_us` passes."""
    arrivals = []
    for index, sent in enumerate(sent_us.tolist()):
        times = wire.carry(sent, size_bytes)
        if times and not cut_us[0] <= sent < cut_us[1]:
            arrivals.append((times[0], index))
    return sorted(arrivals)


def scene(
    profile: str,
    duration_us: int,
    rng: np.random.Generator,
    bus: Bus | None,
    cut_us: tuple[int, int] = (0, 0),
    dither_us: int = DITHER_US,
) -> Scene:
    """A device and a host that send each other a frame a knot.

    The device's leave at the first servo period of a knot, one in four of them up to `dither_us`
    later, as statuses do; the host's at a phase of their own. `cut_us`: between these true times
    nothing passes.
    """
    channels = PROFILES[profile]
    out, back = (Wire(channel, rng, bus) for channel in channels)
    counter = Counter(rng)
    servo_us = counter.periods(duration_us)
    knots = np.arange(KNOT_US, servo_us[-1], KNOT_US)
    host_us = knots + int(rng.integers(KNOT_US))
    status_us = servo_us[np.searchsorted(servo_us, knots)]
    status_us[::DITHER_EVERY] += rng.integers(0, max(1, dither_us), len(status_us[::DITHER_EVERY]))
    status_ticks = counter.ticks(status_us)
    statuses, newest = deque[tuple[int, int]](), -1
    for arrival, index in carried(back, status_us, STATUS_BYTES, cut_us):
        if index > newest:  # one that was overtaken is not echoed
            newest = index
            statuses.append((arrival, index))
    waiting: deque[tuple[int, int]] = deque(maxlen=ECHOES)
    echoes = []
    for sent in host_us.tolist():
        while statuses and statuses[0][0] <= sent:
            arrival, index = statuses.popleft()
            waiting.append((int(status_ticks[index]), arrival + EPOCH_US))
        echoes.append(waiting.popleft() if waiting else (0, 0))
    frames = np.array(carried(out, host_us, SYNC_BYTES, cut_us))
    frames = frames[frames[:, 0] < servo_us[-1]]
    echo = np.array(echoes)[frames[:, 1]]
    stamps = Stamps(
        counter.ticks(frames[:, 0]),
        host_us[frames[:, 1]] + EPOCH_US,
        echo[:, 0],
        echo[:, 1],
        frames[:, 0],
        Least(least_of(channels.to_device, SYNC_BYTES), least_of(channels.to_host, STATUS_BYTES)),
    )
    return Scene(servo_us, counter.ticks(servo_us), stamps)


Clock = Callable[[Times], NDArray[np.float64]]  # true times to what a clock shows


def hop(
    profile: str, duration_us: int, ask_us: int, rng: np.random.Generator, bus: Bus | None
) -> Callable[[Clock], Scene]:
    """The same of a board that asks another one, whose clock is given then. Between boards both
    ways are like the profile's way to a device."""
    channel = PROFILES[profile].to_device
    there, here = Wire(channel, rng, bus), Wire(channel, rng, bus)
    counter = Counter(rng)
    servo_us = counter.periods(duration_us)
    pauses = rng.integers(ask_us - ask_us // 4, ask_us + ask_us // 4, len(servo_us))
    asked_us = np.cumsum(pauses)
    asked_us = asked_us[asked_us < servo_us[-1]]
    asked_us = servo_us[np.searchsorted(servo_us, asked_us)]
    asked_us = np.unique(asked_us)
    requests = np.array(carried(there, asked_us, REQUEST_BYTES))
    answers = np.array(carried(here, requests[:, 0], RESPONSE_BYTES))
    of = requests[answers[:, 1], 1]  # the question of each answer
    # A board has one open question: what is answered after the next one does not count.
    due = np.append(asked_us[1:], servo_us[-1])[of]
    answers, of = answers[answers[:, 0] < due], of[answers[:, 0] < due]
    turned_us = requests[answers[:, 1], 0]
    echo_ticks = counter.ticks(asked_us)[of]
    arrived_ticks = counter.ticks(answers[:, 0])
    servo_ticks = counter.ticks(servo_us)
    least = least_of(channel, REQUEST_BYTES)

    def given(upstream: Clock) -> Scene:
        shown = upstream(turned_us)
        kept = ~np.isnan(shown)  # before it has begun it has no time to tell
        turned = np.floor(shown[kept]).astype(np.int64)
        stamps = Stamps(
            arrived_ticks[kept], turned, echo_ticks[kept], turned, answers[kept, 0],
            Least(least, least),
        )  # fmt: skip
        return Scene(servo_us, servo_ticks, stamps)

    return given
