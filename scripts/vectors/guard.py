"""Vectors of the guard: the servo's time, the stop's and the line's, at their ends."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from line import Value, line

PERIOD_US, BRAKE_PERIODS, STOP_US, LATE_US = 250, 8, 9000, 1000
BRAKE_US = PERIOD_US * BRAKE_PERIODS
STOPPED_US = STOP_US + BRAKE_US + 2 * PERIOD_US  # the longest stop
OPEN_US = STOPPED_US + PERIOD_US  # the longest time with an open line
IDLE, RUNNING, HOLD, FAULT, ESTOP = 2, 4, 7, 8, 9
WRAP = 1 << 32
STARTS = (5_000_000, (1 << 31) - 2000, WRAP - 400)  # counts


def guards(rng: Random) -> Iterator[str]:
    """Each limit, to the microsecond and over the counter's ends; the latch and what lets go."""
    yield line(
        "guard-usual",
        servo_period_us=PERIOD_US, brake_periods=BRAKE_PERIODS, stop_us=STOP_US, late_us=LATE_US,
    )  # fmt: skip
    for start in STARTS:
        yield from _servo(start)
        yield from _stop(start)
        yield from _line(start)
    yield from _latch()
    yield from _odd_settings()
    for _ in range(10):
        yield from _walk(rng)


def _call(count_us: int, **values: Value) -> str:
    return line("guard-call", count_us=count_us % WRAP, **values)


def _begin(start: int, **values: Value) -> Iterator[str]:
    """Driven, its servo due at `start`."""
    yield line("guard", **values)
    yield _call(start - 1, power=0, state=RUNNING, next_servo_us=start % WRAP)
    yield _call(start, power=1, stop_count_us=(start - 7) % WRAP)


def _servo(start: int) -> Iterator[str]:
    for late in (0, LATE_US - 1, LATE_US, (1 << 31) - 1):
        yield from _begin(start)
        yield _call(start + late)
        yield _call(start + late + 1)
    yield from _begin(start)
    for ahead in (1, PERIOD_US, 5000):  # not yet due
        yield _call(start, next_servo_us=(start + ahead) % WRAP)


def _stop(start: int) -> Iterator[str]:
    for state in range(10) if start == STARTS[0] else (FAULT,):
        yield from _begin(start)
        for elapsed in (STOPPED_US, STOPPED_US + 1):
            now = start + elapsed
            due = {"next_servo_us": now % WRAP}
            yield _call(now, state=state, stop_count_us=start % WRAP, line_open=0, **due)


def _line(start: int) -> Iterator[str]:
    for state in (HOLD, ESTOP):
        yield from _begin(start)
        for elapsed in (1, OPEN_US - 1, OPEN_US, OPEN_US + 1):
            now = (start + elapsed) % WRAP
            yield _call(now, state=state, stop_count_us=now, next_servo_us=now, line_open=1)
    yield from _begin(start)
    for elapsed in (1, OPEN_US, 2 * OPEN_US):  # closed again in time, each time
        now = (start + elapsed) % WRAP
        yield _call(now, next_servo_us=now, line_open=int(elapsed == OPEN_US))
    yield from _begin(start)
    for elapsed, power in ((OPEN_US, 1), (OPEN_US + 1, 0), (2 * OPEN_US, 1), (2 * OPEN_US + 2, 1)):
        now = (start + elapsed) % WRAP
        yield _call(now, next_servo_us=now, line_open=1, power=power)


def _latch() -> Iterator[str]:
    start = 1000
    yield from _begin(start)
    yield line("guard-assert")
    trip = start + LATE_US + 5
    for after in (0, 1, BRAKE_US - 1, BRAKE_US, BRAKE_US + 1):
        yield _call(trip + after)
        yield line("guard-assert")
    yield _call(trip + 9000, next_servo_us=trip + 9000)  # the servo runs again
    yield _call(trip + 9000, power=0, state=FAULT)
    yield line("guard-assert")
    yield line("guard-release")
    yield line("guard-assert")
    yield _call(trip + 9001, state=IDLE)
    yield _call(trip + 9002, power=1)
    yield _call(trip + 9100, next_servo_us=trip + 7000)  # and trips anew, from the beginning
    yield _call(trip + 9100 + BRAKE_US - 1)
    yield _call(trip + 9100 + BRAKE_US)
    # the brake's time is what it was at the trip; with the output off no settings are read
    yield from _begin(start)
    yield _call(trip)
    yield _call(trip + BRAKE_US - 1, brake_periods=0)
    yield _call(trip + BRAKE_US - 1, brake_periods=3, power=0)
    yield _call(trip + BRAKE_US)
    # several at once: the line, then the stop, then the servo is told
    for state, line_open, due in ((FAULT, 1, 0), (FAULT, 0, 0), (RUNNING, 1, 0), (FAULT, 1, 1)):
        yield from _begin(start)
        now = start + 2 * OPEN_US
        due_us = now if due else start
        stop = {"state": state, "stop_count_us": start}
        yield _call(now, line_open=line_open, next_servo_us=due_us, **stop)


def _odd_settings() -> Iterator[str]:
    top = WRAP - 1
    start = 77
    odd: list[dict[str, Value]] = [
        {"brake_periods": 0},
        {"brake_periods": 65535, "servo_period_us": 65535},
        {"brake_periods": 30000, "servo_period_us": 65535},
        {"stop_us": 0, "brake_periods": 0, "servo_period_us": 1},
        {"stop_us": top},
        {"stop_us": 1 << 31},
        {"stop_us": (1 << 31) - 1 - 3 * PERIOD_US - BRAKE_US},
        {"stop_us": (1 << 31) - 2 - 3 * PERIOD_US - BRAKE_US},
        {"late_us": top},
        {"late_us": 1 << 31},
        {"late_us": (1 << 31) - 1},
        {"late_us": (1 << 31) - 2},
        {"late_us": 0},
    ]
    for settings in odd:
        for elapsed in (2, 3, 5000, (1 << 31) - 1, top - 100):
            now = (start + elapsed) % WRAP
            yield from _begin(start, **settings)
            if "late_us" in settings:
                yield _call(now)
                continue
            yield _call(now, state=FAULT, stop_count_us=start, next_servo_us=now)
            yield _call(now + 1)
            yield from _begin(start, **settings)
            yield _call(now, line_open=1, next_servo_us=now)


def _walk(rng: Random) -> Iterator[str]:
    """A board's life: mostly in time, sometimes not."""
    yield line("guard", late_us=rng.choice([500, LATE_US, 1 << 30]))
    now = rng.randrange(WRAP)
    values = {"power": 0, "state": IDLE, "next_servo_us": now, "stop_count_us": now, "line_open": 0}
    last: dict[str, int] = {}
    for _ in range(40):
        now = (now + rng.choice([100, 500, 1000, 1000, 4000])) % WRAP
        if rng.random() < 0.7:
            values["next_servo_us"] = (now + rng.randrange(PERIOD_US)) % WRAP
        if rng.random() < 0.2:
            values["state"] = rng.choice([IDLE, RUNNING, HOLD, FAULT, ESTOP])
        if values["state"] < FAULT:
            values["stop_count_us"] = now
        if rng.random() < 0.1:
            values["line_open"] ^= 1
        if rng.random() < 0.2:
            values["power"] = int(rng.random() < 0.8)
        if rng.random() < 0.1 and values["power"] == 0:
            yield line("guard-release")
        yield _call(now, **{k: v for k, v in values.items() if last.get(k) != v})
        last = dict(values)
        if rng.random() < 0.1:
            yield line("guard-assert")
