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
            for ticks in (old - 1, old, world.ticks + 1, world.ticks + (1 << 31)):
                yield line("bounds-prove", at_least_q16=world.theta_q16 - (1 << 40), ticks_us=ticks)
            for ticks in (world.ticks + 1, world.ticks + (1 << 31)):  # contradicts the set
                yield line("bounds-prove", at_least_q16=world.theta_q16 + (1 << 40), ticks_us=ticks)
            for pause in (1_000_000, AGE_MAX, AGE_MAX + 1, 1 << 31, 1 << 40):
                world.ticks += pause
                yield line("bounds-advance", ticks_us=world.ticks)
                yield line("bounds-prove", at_most_q16=world.theta_q16, ticks_us=world.ticks)
                world.theta_q16 -= 1 << 16
    for drift, wander in kinds[:3]:
        for count in (11, 12, 13, 40):
            for is_upper in (False, True):
                yield from _crowd(rng, drift, wander, count, is_upper)
    for is_upper in (False, True):
        yield from _oldest(is_upper)
        yield from _silence(is_upper)
        yield from _steep(is_upper)


def _proof(is_upper: bool, value_q16: int, ticks: int) -> str:
    """Of one side: theta >= value; of the other the mirror image."""
    value = {"at_most_q16": -value_q16} if is_upper else {"at_least_q16": value_q16}
    return line("bounds-prove", **value, ticks_us=ticks)


def _crowd(rng: Random, drift: int, wander: int, count: int, is_upper: bool) -> Iterator[str]:
    """Proofs in no order of which each matters at some skew: their outline is a parabola. Then the
    other side's, which leave ever fewer skews; then some that may contradict them by a little."""
    span, now = 2_000_000, 1 << 33
    yield line("bounds-clear", drift_q32=drift, wander_q64=wander, ticks_us=now)
    top = drift * span >> 16
    for age in rng.sample(range(span), count):
        value = drift * (age - age * age // span) >> 16
        yield _proof(is_upper, value - rng.randrange(200), now - age)
    for share in range(99, 29, -9):
        yield _proof(not is_upper, -(top * share // 100), now)
        yield _proof(not is_upper, -(top * share // 100), now - span + rng.randrange(9999))
        yield line("bounds-at", ticks_us=now - 999)
    for _ in range(14):
        now += rng.choice([0, 1, 999, 65_535, 65_536])
        yield line("bounds-advance", ticks_us=now)
        age, value = rng.randrange(span), rng.randrange(top + 2)
        yield _proof(rng.random() < 0.5, value * rng.choice([-1, 1]), now - age)


def _oldest(is_upper: bool) -> Iterator[str]:
    """A proof at the age to which one counts, and beyond; what it says once the skew is known."""
    drift, wander = 150 * PPM, 10 * PPB_S
    for age in (AGE_MAX - 1, AGE_MAX, AGE_MAX + 1):
        yield line("bounds-clear", drift_q32=drift, wander_q64=wander, ticks_us=AGE_MAX + 9)
        yield _proof(is_upper, 1 << 20, AGE_MAX + 9 - age)
        for elapsed in range(4):
            now = AGE_MAX + 9 + elapsed
            yield line("bounds-advance", ticks_us=now)
            known = (1 << 20) - (drift >> 2) * (AGE_MAX >> 14) + 900 * elapsed
            yield _proof(not is_upper, -known - (400 << 16) + (elapsed << 20), now)


def _steep(is_upper: bool) -> Iterator[str]:
    """An outline like a falling exponential, along which Newton's method goes from line to line."""
    drift, lines, oldest, now = 150 * PPM, 12, 1 << 21, 1 << 22
    step = 2 * drift // (lines + 1)  # of the skew
    for first in range(0, lines - 1, 2):
        yield line("bounds-clear", drift_q32=drift, wander_q64=0, ticks_us=now)
        for i in range(first, lines):
            age = oldest >> i
            value = age * (step * (i + 1) - drift) - (oldest >> lines) * step
            yield _proof(is_upper, value >> 16, now - age)
        yield _proof(not is_upper, 0, now)
        yield line("bounds-at", ticks_us=now + 99)


def _silence(is_upper: bool) -> Iterator[str]:
    """A known skew, of either sign, and nothing for more than an hour."""
    drift, wander = 100 * PPM, PPB_S
    for skew in (70 * PPM, -70 * PPM):
        for pause in ((1 << 31) + 5, (1 << 32) - 1, 1 << 32, (1 << 32) + 1, 1 << 33, 1 << 34):
            yield line("bounds-clear", drift_q32=drift, wander_q64=wander, ticks_us=0)
            for ticks in (1, 2_000_001):
                yield line("bounds-advance", ticks_us=ticks)
                yield _proof(is_upper, (skew * ticks >> 16) - (1 << 16), ticks)
                yield _proof(not is_upper, -(skew * ticks >> 16) - (1 << 16), ticks)
            yield line("bounds-advance", ticks_us=2_000_001 + pause)
            yield _proof(is_upper, skew * (2_000_001 + pause) >> 16, 2_000_001 + pause)


USUAL: dict[str, Value] = {
    "method": 0, "drift_ppm": 150, "wander_ppb_s": 1000, "to_device_least_us": 0,
    "to_host_least_us": 0, "limit_us": 1000, "interval_us": 16_384, "phase_gain": 4295,
    "skew_gain_q8": 10_995, "among_boards": 0, "id": 0,
}  # fmt: skip


def _talk(
    rng: Random, start: int, count: int, period_us: int, delay_us: int, lies: tuple[int, ...],
    least_us: tuple[int, int] = (0, 0), marked_us: int | None = None, epoch_us: int = EPOCH_US,
    skew: int | None = None, **changes: Value,
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
    world.epoch, world.skew = epoch_us, world.skew if skew is None else skew
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
        for lie_us in (90_000, -90_000, (1 << 45), -(1 << 45), 1 << 59):
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
            ends_ns = ((-OPEN, OPEN), (-OPEN, 5), (-5, OPEN), (-OPEN + 1, OPEN - 1), (-OPEN - 1, 5))
            for open_ns in ends_ns:
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
    yield from edges()
    yield from suspicion()
    yield from company(rng)
    yield from _talk(rng, 9, 200, 60_000, 900, honest, limit_us=3000)
    yield from _talk(rng, 3, 6, 9_000_000, 3_000_000, honest)
    yield from _talk(rng, 7, 80, 16_384, 500, honest, (2000, 1500), method=1, limit_us=3000)
    yield from _talk(rng, 7, 80, 16_384, 500, honest, method=1, epoch_us=-EPOCH_US)
    for skew in (290 * PPM, -290 * PPM):
        yield from _talk(rng, 7, 80, 16_384, 500, honest, drift_ppm=300, skew=skew, marked_us=300)
    far = (0, 86_400_000_000, -86_400_000_000, 1 << 45, -(1 << 45), 5000, -5000)
    yield from _talk(rng, WRAP - 5, 120, 16_384, 1000, far)
    yield from _talk(rng, 11, 120, 16_384, 1000, far, method=1, limit_us=1200)
    for wild in (1 << 60, -(1 << 60)):
        yield line("sync", **USUAL, count_us=1)
        for received_us, sent_us in ((0, wild), (-wild, 5), (wild, wild), (0, -wild), (5, wild)):
            stamps = {"echo_us": 1, "received_us": received_us, "sent_us": sent_us}
            yield line("sync-take", **stamps, arrived_us=10, count_us=12, may_step=1)
            yield line("sync-steer", count_us=12, may_step=1)


def _exchange(
    echo: int, received_us: int, sent_us: int, arrived: int, may_step: int = 1
) -> Iterator[str]:
    """Stamps as they are, taken and steered by at once."""
    stamps = {"echo_us": echo % WRAP, "received_us": received_us, "sent_us": sent_us}
    count = {"count_us": arrived % WRAP, "may_step": may_step}
    yield line("sync-take", **stamps, arrived_us=arrived % WRAP, **count)
    yield line("sync-steer", **count)


def edges() -> Iterator[str]:
    """Numbers at which something begins or ends, each from both sides."""
    e = EPOCH_US
    yield line("sync", **USUAL, count_us=7)  # nothing is heard, for longer than settling takes
    yield line("sync-steer", count_us=2_000_007, may_step=1)
    for ahead_us in (15, 16, 17, 18, 19):  # the middle is 7 to 9 us from where the clock was set
        yield line("sync", **USUAL, count_us=7)
        yield from _exchange(7, e + ahead_us, e, 7)
    for least_us in (20, 31, 33, 35):  # and as far the other way
        yield line("sync", **USUAL, count_us=7)
        yield from _exchange(7, 0, e, 7)
        yield from _exchange(7, e - least_us, e - 60, 90_007)
        yield from _exchange(7, e - least_us, e - 60, 190_007)
    for far in ((1 << 44) - 1, 1 << 44, (1 << 44) + 1, (1 << 44) + 2):
        for sent_us in (far, -far):  # with no upper proof yet, all that is near is possible
            yield line("sync", **USUAL, count_us=7)
            yield from _exchange(0, 0, e, 7)
            yield from _exchange(0, 0, e + sent_us + 1, 7)
        yield line("sync", **USUAL, count_us=7)
        yield from _exchange(7, e + far - 1, e, 7)
    for open_us in (2_000_000, 2_097_140, 2_097_150, 2_097_152, 2_097_160, 3_000_000):
        yield line("sync", **USUAL, count_us=7)  # a second and more to each side is no bound
        yield from _exchange(7, e + open_us, e, 7)
        yield line("sync-date", mark_number=1, at_us=7)
        yield from _exchange(7, e + 80_000, e + 1000, 90_007, 0)
    for wide_us in (65_520, 65_526, 65_527, 65_528, 65_529, 65_530, 65_531, 65_540):
        yield line("sync", **USUAL, count_us=7)
        yield from _exchange(7, e + wide_us, e, 7)
        yield line("sync-date", mark_number=1, at_us=7)
    for aside_us in (999_999, 1_000_000, 1_000_001):
        for at_us in (7 + aside_us, 7 - aside_us):
            yield line("sync", **USUAL, count_us=7)
            yield from _exchange(7, e + 9, e, 7)
            yield line("sync-date", mark_number=1, at_us=at_us % WRAP)
    yield line("sync", **USUAL | {"limit_us": 90_000}, count_us=7)
    yield from _exchange(7, e + 900, e, 7)
    for second in (1, 8):  # settled after one, known well after eight
        for early_us in (1000, 1, 0, -1000):
            count = {"count_us": 7 + second * 1_000_000 - early_us, "may_step": 0}
            yield line("sync-steer", **count)
    for limit_us, later_us in ((limit, us) for limit in range(600, 604) for us in (0, 5000)):
        yield line("sync", **USUAL | {"limit_us": limit_us}, count_us=7)
        yield from _exchange(7, e + 900, e, 7)
        yield line("sync-steer", count_us=1_000_007 + later_us, may_step=0)
    for elapsed_us in (65_534, 65_535, 65_536, 70_000):  # while an offset is steered to
        yield line("sync", **USUAL | {"limit_us": 90_000}, count_us=7)
        yield from _exchange(7, e + 900, e, 7)
        yield line("sync-steer", count_us=1_000_007, may_step=0)
        yield from _exchange(1_000_008, e + 1_000_700, e + 1_000_000, 1_000_008, 0)
        yield line("sync-steer", count_us=1_000_008 + elapsed_us, may_step=0)
    for begin_us, again_us in ((7, 7_999_500), (3_000_007, 5_999_500)):
        for later_us in (499, 500, 501, -3000):  # from eight seconds on it learns more slowly
            yield line("sync", **USUAL | {"limit_us": 90_000}, count_us=7)
            yield line("sync-steer", count_us=begin_us, may_step=1)
            shown_us = e + 450
            yield from _exchange(begin_us, shown_us + 450, shown_us - 450, begin_us)
            yield line("sync-steer", count_us=begin_us + 1_000_001, may_step=0)
            shown_us += 7 + again_us - begin_us
            at = 7 + again_us
            yield line("sync-steer", count_us=at - 1, may_step=0)
            yield from _exchange(at, shown_us + 15, shown_us - 9, at, 0)
            yield line("sync-steer", count_us=at + later_us, may_step=0)
    yield line("sync", **USUAL, count_us=7)  # it may not step, so it does not begin
    yield from _exchange(7, e + 9, e, 7, 0)
    yield line("sync", **USUAL, count_us=7)  # what is echoed has not left yet
    yield from _exchange(9, e + 9, e, 7)
    yield line("sync", **USUAL | {"among_boards": 1, "id": 40}, count_us=7)
    yield line("sync-steer", count_us=7, may_step=0)
    yield line("sync", **USUAL, count_us=7)  # nothing was echoed yet
    yield from _exchange(0, 0, e, 7)
    yield line("sync-date", mark_number=1, at_us=7)
    for age_us in (199_999, 200_000, 200_001, 200_002):
        yield line("sync", **USUAL, count_us=7)
        yield from _exchange(7, e + 900, e, 7)
        mark = {"mark_width_us": 9, "mark_least_us": e + 449, "at_us": 9, "count_us": 9}
        yield line("sync-mark", **mark)
        yield line("sync-steer", count_us=9 + age_us, may_step=0)
    yield line("sync", **USUAL, count_us=7)  # half of what is said is right, which is no better
    yield from _exchange(7, e + 900, e, 7)
    yield from _exchange(20_000, e + 18_000, e + 20_890, 20_009, 0)
    yield from _exchange(40_000, e + 40_000, e + 40_000, 40_000, 0)


def suspicion() -> Iterator[str]:
    """Sixteen contradictions in a row are too many; fifteen, one stamp that is right and one more
    are not, and are forgotten after as many that are right."""
    e = EPOCH_US
    rows = ("E" * 16 + "T" * 3, "E" * 15 + "TET" + "E" * 3, "E" + "T" * 64 + "E" * 15 + "TEE")
    for row in rows:
        yield line("sync", **USUAL | {"drift_ppm": 50}, count_us=7)
        yield from _exchange(7, e + 900, e, 7)
        for i, kind in enumerate(row):
            at = 20_000 * (i + 1)
            lie_us = 50_000 if kind == "E" else 0
            yield from _exchange(7 + at, e + at + 900 + lie_us, e + at + lie_us, 7 + at, 0)


def company(rng: Random) -> Iterator[str]:
    """Whom a board joins one after the other, and what it forgets by that; two neighbours of which
    one lies all the time; a wire with least delays among boards that are as old."""
    for first, then in ((39, 41), (39, 40)):
        given = USUAL | {"among_boards": 1, "id": 40, "limit_us": 50}  # it never settles
        yield line("sync", **given, count_us=9)
        yield line("sync-steer", count_us=9, may_step=1)
        world = _World(rng, 150 * PPM - 9, 1000 * PPB_S, 0)
        world.epoch = DAY_US
        for _ in range(4):
            world.go(world.ticks + 900_000)
            yield from _ask(rng, 9, world, 0, first, 0, 1)
        for _ in range(10):
            world.go(world.ticks + 30_000)
            yield from _ask(rng, 9, world, 0, 77, 0, 0)
        for _ in range(4):
            world.go(world.ticks + 30_000)
            yield from _ask(rng, 9, world, 0, then, 0, 1, DAY_US)
        for _ in range(7):
            world.go(world.ticks + 30_000)
            yield from _ask(rng, 9, world, 0, 77, 0, 0)
    for other in (1, 2):
        yield line("sync", **USUAL | {"id": 40}, count_us=5)
        world = _World(rng, 150 * PPM - 9, 1000 * PPB_S, 0)
        for i in range(44):
            for source in (1, 2):
                world.go(world.ticks + 15_000)
                lie_us = 90_000 if source == other and i > 20 else 0
                yield from _ask(rng, 5, world, 0, source, 1, int(i < 10), lie_us)
    yield line("sync", **USUAL | {"id": 40}, count_us=5)  # the only one lies from some time on
    world = _World(rng, 150 * PPM - 9, 1000 * PPB_S, 0)
    for i in range(40):
        world.go(world.ticks + 15_000)
        yield from _ask(rng, 5, world, 0, 1, 1, int(i < 10), 90_000 if i > 20 else 0)
    yield line("sync", **USUAL | {"id": 40}, count_us=5)  # one lies, then the other
    world = _World(rng, 150 * PPM - 9, 1000 * PPB_S, 0)
    for i in range(95):
        for source in (1, 2):
            world.go(world.ticks + 15_000)
            lies = 10 < i < 35 if source == 1 else i > 64
            yield from _ask(rng, 5, world, 0, source, 1, int(i < 10), 90_000 if lies else 0)
    for least_us in (0, 900):
        for ahead_us in (-700, 700):
            yield line("sync", **USUAL | {"among_boards": 1, "id": 40}, count_us=9)
            yield line("sync-steer", count_us=9, may_step=1)
            world = _World(rng, 150 * PPM - 9, 1000 * PPB_S, 0)
            world.epoch = ahead_us
            world.go(60_000)
            yield from _ask(rng, 9, world, 0, 39, 0, 1, least_us=least_us, delay_us=1)


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
    for gain, offset in ((999, -3), (999, 3), (65_535, -16_384)):
        yield line("average", ticks_us=0)
        for ticks in (1000, 2000):
            yield line("average-take", offset_us=offset)
            yield line("average-rate", **usual, phase_gain=0, skew_gain_q8=gain, ticks_us=ticks)
    for times in ((1 << 20) - 1, 1 << 20, (1 << 20) + 1):
        for offset in (1 << 30, -(1 << 30), 1 << 31):
            yield line("average", ticks_us=0)
            yield line("average-take", offset_us=0, times=times)
            yield line("average-take", offset_us=offset)
            yield line("average-rate", **usual, phase_gain=9, skew_gain_q8=0, ticks_us=1000)
    for times in ((1 << 20) - 1, 1 << 20, (1 << 20) + 1):
        yield line("average", ticks_us=-5)
        yield line("average-take", offset_us=100, times=times)
        yield line("average-take", offset_us=-1000, times=600_000)
        yield line("average-rate", **usual, phase_gain=100, skew_gain_q8=0, ticks_us=1 << 40)
