"""Vectors of the clock: its map, what stamps prove, how it is steered, and the plain routine."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from line import Value, line

WRAP, HALF = 1 << 32, 1 << 31
RATE_MAX = 2_147_484
EPOCH_US = 1_700_000_000_000_123
PPM, PPB_S = 4295, 18_447  # of drift_q32 and of wander_q64
AGE_MAX = 1 << 25


def clocks(rng: Random) -> Iterator[str]:
    """Lines of each rate from each side of a wrap; fractions; offsets set and told."""
    for start in (0, 5, WRAP - 1, WRAP - 1000, HALF - 3, rng.randrange(WRAP)):
        for base_us, offset in ((0, 0), (EPOCH_US, 12_345), (-EPOCH_US, -1), (1 << 59, 65_535)):
            yield line("clock", count_us=start, base_us=base_us, offset_q16=offset)
            count = start
            rates = [0, 1, -1, RATE_MAX, -RATE_MAX, rng.randrange(-RATE_MAX, RATE_MAX)]
            for rate in rng.sample(rates, 3):
                yield line("clock-rate", rate_q32=rate)
                for back in (0, 1, -1, 999, -12_345, HALF - 1, -HALF):
                    yield line("clock-at", count_us=(count + back) % WRAP)
                count = (count + rng.choice([0, 1, 1000, 999_983, HALF - 1])) % WRAP
                yield line("clock-advance", count_us=count)
                yield line("clock-offset", base_us=base_us)
                yield line("clock-offset", base_us=base_us - 7)


class _World:
    """An oscillator's offset by ticks, in whole Q16, that keeps its bounds with some to spare."""

    def __init__(self, rng: Random, drift_q32: int, wander_q64: int, offset_us: int) -> None:
        self.rng, self.drift, self.wander = rng, drift_q32, wander_q64
        self.epoch = EPOCH_US
        self.ticks, self.theta_q16 = 0, offset_us << 16
        self.skew = rng.randrange(-drift_q32 // 2, drift_q32 // 2 + 1)

    def go(self, ticks: int) -> None:
        """On to later ticks: a step of the skew, then a straight line."""
        elapsed = ticks - self.ticks
        most = min(elapsed * self.wander >> 33, self.drift)
        self.skew += self.rng.randrange(-most, most + 1)
        self.skew = max(-self.drift, min(self.drift, self.skew))
        self.theta_q16 += self.skew * elapsed >> 16
        self.ticks = ticks

    def host_us(self) -> int:
        """The other clock, rounded down."""
        return self.epoch + self.ticks + (self.theta_q16 >> 16)


def _sides(rng: Random, world: _World, rows: int, gap_us: int, delay_us: int) -> Iterator[str]:
    """Proofs of both sides with random delays, advances in between."""
    for _ in range(rows):
        world.go(world.ticks + rng.randrange(gap_us) + 1)
        yield line("bounds-advance", ticks_us=world.ticks)
        slack = (rng.randrange(delay_us) + 2) << 16
        if rng.random() < 0.5:
            value = {"at_least_q16": world.theta_q16 - slack}
        else:
            value = {"at_most_q16": world.theta_q16 + slack}
        yield line("bounds-prove", **value, ticks_us=world.ticks)


def bounds(rng: Random) -> Iterator[str]:
    """Few and many proofs, old ones, contradictions by little and by much, a long silence."""
    kinds = [(150 * PPM, 1000 * PPB_S), (300 * PPM, 60_000 * PPB_S), (PPM, 0), (0, 0)]
    for drift, wander in kinds:
        for rows, gap_us, delay_us in ((10, 1_000_000, 1000), (60, 8000, 1000), (30, 8000, 10)):
            start = rng.choice([0, WRAP - 9, 1 << 50])
            yield line("bounds-clear", drift_q32=drift, wander_q64=wander, ticks_us=start)
            world = _World(rng, drift, wander, rng.choice([0, 77, -(1 << 30)]))
            world.ticks = start
            yield from _sides(rng, world, rows, gap_us, delay_us)
            for aside in (0, 1, -1, 1023, 1024, 1025, -5000, 20_000):
                yield line("bounds-at", ticks_us=world.ticks + aside)
            for skew in (0, 1, drift // 2, -drift // 3, drift, -drift, 1 << 30, -(1 << 30)):
                yield line("bounds-nearest", skew_q32=skew)
            for far in (1 << 22, 1 << 36, -(1 << 36), (1 << 43) << 16, -((1 << 43) << 16)):
                above = {"at_least_q16": world.theta_q16 + (delay_us + 100_000 << 16) + abs(far)}
                below = {"at_most_q16": world.theta_q16 - (delay_us + 100_000 << 16) - abs(far)}
                refused = above if far > 0 else below
                yield line("bounds-prove", **refused, ticks_us=world.ticks)
            old = world.ticks - AGE_MAX
            for ticks in (old - 1, old):
                yield line("bounds-prove", at_least_q16=world.theta_q16 - (1 << 40), ticks_us=ticks)
            for pause in (1_000_000, AGE_MAX, AGE_MAX + 1, 1 << 31, 1 << 40):
                world.ticks += pause
                yield line("bounds-advance", ticks_us=world.ticks)
                yield line("bounds-prove", at_most_q16=world.theta_q16, ticks_us=world.ticks)
                world.theta_q16 -= 1 << 16


USUAL: dict[str, Value] = {
    "method": 0, "drift_ppm": 150, "wander_ppb_s": 1000, "to_device_least_us": 0,
    "to_host_least_us": 0, "limit_us": 1000, "interval_us": 16_384, "phase_gain": 4295,
    "skew_gain_q8": 10_995, "among_boards": 0, "id": 0,
}  # fmt: skip


def _talk(
    rng: Random, start: int, count: int, period_us: int, delay_us: int, lies: tuple[int, ...],
    least_us: tuple[int, int] = (0, 0), marked_us: int | None = None, **changes: Value,
) -> Iterator[str]:  # fmt: skip
    """A host and a device, one frame each way in a period; then silence, and one frame more.

    With `marked_us` there is a mark in the second half of the talk every fourth period, which all
    boards together know so well.
    """
    given = USUAL | changes
    given |= {"to_device_least_us": least_us[0], "to_host_least_us": least_us[1]}
    yield line("sync", **given, count_us=start)
    drift, wander = int(str(given["drift_ppm"])), int(str(given["wander_ppb_s"]))
    world = _World(rng, drift * PPM - 9, wander * PPB_S, 0)
    yield line("sync-steer", count_us=start, may_step=1)
    echo = None
    settled = count * 2 // 3
    for i in range(count):
        lie_us = lies[i % len(lies)] if i > settled else 0
        world.go(i * period_us)
        left, sent_us = world.ticks, world.host_us() + lie_us
        world.go(world.ticks + rng.randrange(delay_us) + least_us[0] + least_us[0] // 2000 + 1)
        arrived = (start + world.ticks) % WRAP
        stamps = {"echo_us": 0, "received_us": 0, "sent_us": sent_us}
        if echo is not None:
            stamps |= {"echo_us": echo[0], "received_us": echo[1] + lie_us}
        now = world.ticks + rng.randrange(200)
        may_step = int(i <= settled)
        now_us = (start + now) % WRAP
        yield line("sync-take", **stamps, arrived_us=arrived, count_us=now_us, may_step=may_step)
        world.go(now)
        yield line("sync-steer", count_us=now_us, may_step=may_step)
        if marked_us is not None and i > count // 2 and i % 4 == 0:
            yield from _mark(rng, start, world, marked_us, i)
        world.go(world.ticks + rng.randrange(delay_us) + least_us[1] + least_us[1] // 2000 + 1)
        echo = ((start + now) % WRAP, world.host_us() + 1)
        assert left + period_us > world.ticks
    for pause in (100_000, 900_000, 1_000_000, 1_000_000):
        world.go(world.ticks + pause)
        yield line("sync-steer", count_us=(start + world.ticks) % WRAP, may_step=0)


def _mark(rng: Random, start: int, world: _World, width_us: int, number: int) -> Iterator[str]:
    """An instant that the board dates; then what all agree on; now and then, what cannot be."""
    at = (start + world.ticks) % WRAP
    truth_us = world.host_us()
    before_us = rng.randrange(width_us + 1)
    yield line("sync-date", mark_number=number, at_us=at)
    world.go(world.ticks + 1 + rng.randrange(300))
    now = (start + world.ticks) % WRAP
    mark = {"mark_width_us": width_us + 1, "mark_least_us": truth_us - before_us}
    yield line("sync-mark", **mark, at_us=at, count_us=now)
    if number % 3 == 0:
        for lie_us in (90_000, -90_000, (1 << 45), -(1 << 45)):
            wrong = {"mark_width_us": 9, "mark_least_us": truth_us + lie_us}
            yield line("sync-mark", **wrong, at_us=at, count_us=now)


OPEN = (1 << 31) - 1


def _ask(
    rng: Random, start: int, world: _World, error_us: int, lineage: int, settled: int,
    may_step: int, lie_us: int = 0, known_ns: tuple[int, int] = (-2000, 2000), least_us: int = 0,
    delay_us: int = 300,
) -> Iterator[str]:  # fmt: skip
    """A request to a neighbour and its response; its clock is `error_us` ahead of the truth."""
    asked = world.ticks

    def shows() -> int:
        return world.host_us() + error_us + lie_us

    def travel() -> None:
        least = least_us + least_us // 2000 + 1
        world.go(world.ticks + least + rng.randrange(delay_us))

    travel()
    received_us = shows() + 1
    world.go(world.ticks + rng.randrange(100))
    sent_us = shows()
    travel()
    arrived = world.ticks
    world.go(world.ticks + rng.randrange(200))
    now = (start + world.ticks) % WRAP
    errors = (error_us * 1000 + known_ns[0], error_us * 1000 + known_ns[1])
    yield line(
        "sync-hear", echo_us=(start + asked) % WRAP, received_us=received_us, sent_us=sent_us,
        arrived_us=(start + arrived) % WRAP, count_us=now, may_step=may_step,
        source=1 + lineage % 4, peer_least_us=least_us, least_error_ns=errors[0],
        most_error_ns=errors[1], lineage=lineage, settled=settled,
    )  # fmt: skip
    yield line("sync-steer", count_us=now, may_step=may_step)


DAY_US = 86_400_000_000


def among(rng: Random) -> Iterator[str]:
    """Own time, and whom it is left for; neighbours that know it badly, lie, or are of others."""
    rows = (
        (0, DAY_US, 39, 0, 40), (0, DAY_US, 41, 0, 4), (0, -DAY_US, 41, 0, 4),
        (0, -DAY_US, 39, 1, 50), (0, 0, 41, 0, 8), (0, 0, 39, 0, 8),
        (2_000_000, DAY_US, 41, 1, 4), (2_000_000, DAY_US, 41, 0, 4),
    )  # fmt: skip
    for start, method, drift, some in (
        (0, 0, 150, rows), (WRAP - 700_000, 0, 300, rows[:1]), (9, 1, 50, rows[:1]),
    ):  # fmt: skip
        for own_wait, offset_us, lineage, settled, rounds in some:
            given = USUAL | {"among_boards": 1, "id": 40, "drift_ppm": drift, "method": method}
            yield line("sync", **given, count_us=start)
            yield line("sync-steer", count_us=start, may_step=1)
            world = _World(rng, drift * PPM - 9, 1000 * PPB_S, 0)
            world.epoch = offset_us
            while world.ticks < own_wait:
                world.go(world.ticks + 500_000)
                yield line("sync-steer", count_us=(start + world.ticks) % WRAP, may_step=0)
            for i in range(rounds + 5):
                world.go(world.ticks + 30_000)
                error_us, early = rng.randrange(-50, 50), i < 5
                may_step, of = int(0 < i < 5), settled if early else 1
                yield from _ask(rng, start, world, error_us, lineage, of, may_step)
            for lie_us in (DAY_US, -DAY_US, 60_000, -60_000, 1 << 45, -(1 << 45)):
                yield from _ask(rng, start, world, 0, lineage, 1, 0, lie_us)
            yield from _ask(rng, start, world, 0, 77, 1, 0)
            for open_ns in ((-OPEN, OPEN), (-OPEN, 5), (-5, OPEN), (-OPEN + 1, OPEN - 1)):
                yield from _ask(rng, start, world, 0, lineage, 1, 0, known_ns=open_ns)
            yield from _ask(rng, start, world, 0, 40, 1, 0)  # its own number comes back
            yield from _ask(rng, start, world, 0, 77, 0, 1, lie_us=9 * DAY_US)


def doubts(rng: Random) -> Iterator[str]:
    """A host, and neighbours, whose clock is off by less than delays vary: some stamps contradict
    what is known, others do not, until all is doubted; unless another neighbour agrees."""
    yield from _talk(rng, 3, 200, 16_384, 1000, (300,))
    for others in ((1,), (1, 2)):
        yield line("sync", **USUAL | {"id": 40}, count_us=5)
        world = _World(rng, 150 * PPM - 9, 1000 * PPB_S, 0)
        for i in range(110):
            for other in others:
                world.go(world.ticks + 15_000)
                lie_us = 300 if other == 1 and i > 70 else 0
                yield from _ask(rng, 5, world, 0, other, 1, int(i < 40), lie_us, delay_us=600)


def hops(rng: Random) -> Iterator[str]:
    """No time of boards: what the host's board says counts, whoever hears it."""
    for start, least_us, error_us in ((0, 0, 30), (WRAP - 300_000, 1500, -700)):
        yield line("sync", **USUAL | {"id": 40}, count_us=start)
        yield line("sync-steer", count_us=start, may_step=1)
        world = _World(rng, 150 * PPM - 9, 1000 * PPB_S, 0)
        for i in range(60):
            world.go(world.ticks + 30_000)
            known = (-error_us * i, abs(error_us) * 9)
            known = (min(known[0], 0), known[1])
            yield from _ask(rng, start, world, error_us, 0, int(i > 9), int(i < 40), 0, known,
                            least_us)  # fmt: skip


def steering(rng: Random) -> Iterator[str]:
    """Both methods, wraps in the middle, least delays, hosts that lie, stamps of another age."""
    honest = (0,)
    yield from _talk(rng, 0, 100, 16_384, 1000, honest)
    yield from _talk(rng, WRAP - 1_000_000, 100, 16_384, 1000, honest)
    yield from _talk(rng, WRAP - 900_001, 60, 30_000, 9000, honest, drift_ppm=300,
                     wander_ppb_s=60_000, limit_us=5000)  # fmt: skip
    yield from _talk(rng, 7, 100, 16_384, 500, honest, (2000, 1500), limit_us=300)
    yield from _talk(rng, HALF - 800_000, 120, 16_384, 1000, honest, method=1, limit_us=1200)
    for marked_us in (0, 40):
        yield from _talk(rng, 5, 100, 16_384, 1000, honest, marked_us=marked_us)
    yield from _talk(rng, 5, 100, 16_384, 1000, honest, marked_us=9, method=1, limit_us=1200)
    yield line("sync", **USUAL, count_us=1)
    yield line("sync-date", mark_number=9, at_us=1)
    yield line("sync-mark", mark_width_us=9, mark_least_us=9, at_us=1, count_us=1)
    yield from among(rng)
    yield from hops(rng)
    yield from doubts(rng)
    far = (0, 86_400_000_000, -86_400_000_000, 1 << 45, -(1 << 45), 5000, -5000)
    yield from _talk(rng, WRAP - 5, 120, 16_384, 1000, far)
    yield from _talk(rng, 11, 120, 16_384, 1000, far, method=1, limit_us=1200)
    for wild in (1 << 60, -(1 << 60)):
        yield line("sync", **USUAL, count_us=1)
        for received_us, sent_us in ((0, wild), (-wild, 5), (wild, wild), (0, -wild), (5, wild)):
            stamps = {"echo_us": 1, "received_us": received_us, "sent_us": sent_us}
            yield line("sync-take", **stamps, arrived_us=10, count_us=12, may_step=1)
            yield line("sync-steer", count_us=12, may_step=1)


def averages(rng: Random) -> Iterator[str]:
    """Means of each sign and size, the interval's end, gains at their ends, many offsets."""
    usual = {"interval_us": 1000, "drift_q32": 150 * PPM}
    for phase, skew in ((4295, 10_995), (0, 0), (65_535, 65_535), (0, 256), (1, 0)):
        gains = {"phase_gain": phase, "skew_gain_q8": skew}
        yield line("average", ticks_us=0)
        yield line("average-rate", **usual, **gains, ticks_us=1000)
        ticks = 0
        for offsets in ([0], [1], [-1], [5, -6], [7, 8], [-7, -8], [16_383], [16_384], [16_385],
                        [-16_385], [1 << 30], [(1 << 30) + 1, -(1 << 30)], [1 << 62, -(1 << 62)],
                        [rng.randrange(-500, 500) for _ in range(9)]):  # fmt: skip
            for offset in offsets:
                yield line("average-take", offset_us=offset)
            for passed in (999, 1000, 1001):
                yield line("average-rate", **usual, **gains, ticks_us=ticks + passed)
            ticks += 1000
    for times in ((1 << 20) - 1, 1 << 20, (1 << 20) + 1):
        yield line("average", ticks_us=-5)
        yield line("average-take", offset_us=100, times=times)
        yield line("average-take", offset_us=-1000, times=600_000)
        yield line("average-rate", **usual, phase_gain=100, skew_gain_q8=0, ticks_us=1 << 40)
