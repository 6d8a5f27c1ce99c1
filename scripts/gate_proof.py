"""Puts random plans through the gate: it may accept none that is unsafe, refuse none that is legal.

gate_proof.py [--long] [--seed N]: 32,768 plans of each kind, or 1,048,576. Progress goes to
standard error, the counts to standard output. Exits 1 if an accepted plan is unsafe or a legal one
refused.

Whether a plan is safe is judged on the curve that the track then holds, in exact integers: the
basis functions and their derivatives come from Cox and de Boor's recursion in rational numbers (de
Boor, A Practical Guide to Splines, chapter IX), at sixteenths of every knot interval.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ["accepted", "late", "gap", "far", "range", "speed", "acceleration", "rest"]
RESULTS += ["start", "stale", "state", "sink", "room", "epoch", "no story"]  # the last one is -1
PLAN_POINTS, BEFORE, WINDOW = 128, 4, 144  # as in tests/gate_batch.c
LIVE, POINT_MAX, DIFFERENCE_MAX = 3, 2**30 - 1, 2**25
BATCH, BATCHES, BATCHES_LONG = 2048, 16, 512
LENGTHS = (12, 24, 40, 72, 120)  # of stored tracks and plans, by batch
LEGAL_SHARE = 0.98  # of each limit, that legal plans use
STEPS = 16  # instants in a knot interval

Integers = NDArray[np.int64]
Floats = NDArray[np.float64]

JOB = np.dtype(
    [
        *((name, np.int32) for name in ("continuous", "low", "high", "d", "d2", "stop")),
        *((name, np.int32) for name in ("stored_count", "count")),
        *((name, np.int64) for name in ("stored_first", "first_knot", "knot")),
        *((name, np.int32, PLAN_POINTS) for name in ("stored", "points")),
    ]
)
ANSWER = np.dtype([("result", np.int32), ("before", np.int32, WINDOW), ("after", np.int32, WINDOW)])


# ---- the gate


def build(folder: Path) -> Path:
    """Compiles the gate with the sanitizers that stop at an overflow; returns the program."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise SystemExit("no C compiler: install cc (gcc or clang)")
    program = folder / "gate_batch"
    sources = [
        ROOT / "tests" / "gate_batch.c",
        *(ROOT / "firmware" / f for f in ("gate.c", "track.c")),
    ]
    flags = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-O2", f"-I{ROOT / 'firmware'}"]
    flags += ["-fsanitize=undefined", "-fno-sanitize-recover=all"]
    subprocess.run([compiler, *flags, *map(str, sources), "-o", str(program)], check=True)
    return program


def through_the_gate(program: Path, jobs: NDArray[np.void]) -> NDArray[np.void]:
    """Raises CalledProcessError if something overflows."""
    ran = subprocess.run([str(program)], input=jobs.tobytes(), stdout=subprocess.PIPE, check=True)
    answers = np.frombuffer(ran.stdout, ANSWER)
    assert len(answers) == len(jobs)
    return answers


# ---- the oracle


def _basis(degree: int, i: int, u: Fraction) -> Fraction:
    """Cox and de Boor's recursion on the integers' knots: i, i+1, .. i+degree+1."""
    if degree == 0:
        return Fraction(i <= u < i + 1)
    rising = (u - i) / degree * _basis(degree - 1, i, u)
    return rising + (i + degree + 1 - u) / degree * _basis(degree - 1, i + 1, u)


def _derivative(order: int, degree: int, i: int, u: Fraction) -> Fraction:
    if order == 0:
        return _basis(degree, i, u)
    fall = _derivative(order - 1, degree - 1, i + 1, u)
    return _derivative(order - 1, degree - 1, i, u) - fall


@cache
def weights(order: int, scale: int) -> Integers:
    """`scale` times the weights of the points k-1 .. k+2 in the order-th derivative at k + j/16:
    (4, 16) integers."""
    rows = [
        [_derivative(order, 3, i, Fraction(j, STEPS)) * scale for j in range(STEPS)]
        for i in (-3, -2, -1, 0)
    ]
    assert all(w.denominator == 1 for row in rows for w in row)
    return np.array([[int(w) for w in row] for row in rows], dtype=np.int64)


P_SCALE, V_SCALE, A_SCALE = 6 * STEPS**3, 2 * STEPS**2, STEPS


def curve(points: Integers, order: int, scale: int) -> Integers:
    """Points (b, m) to `scale` times the derivative at all instants (b, m-3, 16); exact: of points
    below 2^31 and weights whose magnitudes add up to at most 2^15, sums stay below 2^47."""
    table, m = weights(order, scale), points.shape[1] - 3
    total = np.zeros((len(points), m, STEPS), dtype=np.int64)
    for i in range(4):
        total += points[:, i : i + m, None] * table[i]
    return total


def _rushing(v: Integers, room: Integers, stop: Integers) -> NDArray[np.bool_]:
    """Where v > 0 and v^2 > 2 stop room, which is scaled by P_SCALE, v by V_SCALE: judged in
    floating point where that is clear, in Python's integers where it is not."""
    # v^2 / V_SCALE^2 > 2 stop room / P_SCALE, with V_SCALE^2 = 2^18 and P_SCALE = 3 * 2^13
    left = 3 * v.astype(np.float64) ** 2
    right = 64 * stop[:, None, None] * room.astype(np.float64)
    wrong = (v > 0) & (left > right * (1 + 1e-12))
    close = (v > 0) & ~wrong & (left >= right * (1 - 1e-12))
    for b, k, j in np.argwhere(close):
        wrong[b, k, j] = 3 * int(v[b, k, j]) ** 2 > 64 * int(stop[b]) * int(room[b, k, j])
    return wrong


def unsafe(jobs: NDArray[np.void], answers: NDArray[np.void]) -> dict[str, NDArray[np.bool_]]:
    """By promise: which of the accepted plans (b,) break it."""
    before, after = (answers[name].astype(np.int64) for name in ("before", "after"))
    turns = jobs["continuous"] != 0
    for points in (before, after):  # positions modulo 2^32: the way from one to the next is short
        steps = np.diff(points[turns], axis=1)
        steps = (steps + 2**31) % 2**32 - 2**31
        points[turns, 1:] = points[turns, :1] + np.cumsum(steps, axis=1)
    low, high, d, d2, stop = (jobs[n].astype(np.int64) for n in ("low", "high", "d", "d2", "stop"))
    p, v, a = curve(after, 0, P_SCALE), curve(after, 1, V_SCALE), curve(after, 2, A_SCALE)

    def any_instant(wrong: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.any(wrong.reshape(len(wrong), -1), axis=1)

    def by_plan(limit: Integers) -> Integers:
        return limit[:, None, None]

    over, under = by_plan(high * P_SCALE) - p, p - by_plan(low * P_SCALE)
    asked = ~turns & (stop > 0)
    live = slice(BEFORE - 1, BEFORE)  # the interval that runs: of the curve, its first point
    end = jobs["first_knot"] + jobs["count"] - 1 - (jobs["knot"] - BEFORE)  # in the window
    last = jobs["points"][np.arange(len(jobs)), jobs["count"] - 1].astype(np.int64)
    resting = np.arange(v.shape[1]) >= end[:, None] - 2  # [end-1, end) and all after
    rest = any_instant((v != 0) & resting[..., None]) | any_instant((a != 0) & resting[..., None])
    rest |= (after[:, -1] - last) % 2**32 != 0
    has_live = jobs["stored_count"] > 0
    was, stays = curve(before, 0, P_SCALE), p
    return {
        "range": ~turns & any_instant((over < 0) | (under < 0)),
        "speed": any_instant(np.abs(v) > by_plan(d * V_SCALE)),
        "acceleration": any_instant(np.abs(a) > by_plan(d2 * A_SCALE)),
        "room above": asked & any_instant(_rushing(v, over, stop)),
        "room below": asked & any_instant(_rushing(-v, under, stop)),
        "rest": rest,
        "live": has_live & any_instant(was[:, live] != stays[:, live]),
    }


# ---- the plans


def wave(rng: np.random.Generator, count: int, length: int, free: Integers) -> Floats:
    """Smooth random ways (count, length) from zero, flat up to index `free` (count,) and in the
    last three points: with cruises at one speed, with constant accelerations, or with neither."""
    t, free = np.arange(length), free[:, None]
    share = np.clip((t - free + 1) / np.maximum(length - 3 - free, 1), 0, 1)
    speed = np.zeros((count, length))
    for harmonic in range(1, 6):
        speed += rng.normal(size=(count, 1)) * np.sin(np.pi * harmonic * share)
    gain = np.exp(rng.uniform(-1, 3, (count, 1)))
    speed = np.where(rng.random((count, 1)) < 0.6, np.clip(gain * speed, -1, 1), speed)
    speed[np.broadcast_to((t < free) | (t >= length - 2), speed.shape)] = 0
    for width in (2, 3, 5):  # a constant acceleration at every corner
        means = np.cumsum(np.pad(speed, ((0, 0), (width, 0))), axis=1)
        means = (means[:, width:] - means[:, :-width]) / width
        means[:, -2:] = 0
        speed = np.where(rng.random((count, 1)) < 0.5, means, speed)
    return np.cumsum(speed, axis=1)


@dataclass
class Limits:
    """Of each plan: (b,) each."""

    low: Integers
    high: Integers
    d: Integers
    d2: Integers
    stop: Integers

    @classmethod
    def random(cls, rng: np.random.Generator, count: int) -> Limits:
        """From 512 quanta, where rounding a point is well below 1 %, to the widest there are."""

        def power(low: float, high: float) -> Floats:
            return np.exp2(rng.uniform(low, high, count))

        d = np.minimum(power(9, 25.5), DIFFERENCE_MAX)
        d2 = np.clip(d * power(-6, 1), 512, None)
        half = np.clip(d * power(0, 8), 2**13, POINT_MAX)
        middle = rng.uniform(-1, 1, count) * (POINT_MAX - half)
        stop = np.clip(d2 * power(-6, 0), 512, 2 * DIFFERENCE_MAX) * (rng.random(count) < 0.9)
        numbers = np.ceil(middle - half), np.floor(middle + half), d, d2, stop
        return cls(*(n.astype(np.int64) for n in numbers))

    def legal(self, p: Floats, share: float) -> NDArray[np.bool_]:
        """Which of the ways (b, m) use at most this share of each limit."""
        low, high = self.low[:, None].astype(np.float64), self.high[:, None].astype(np.float64)
        slack = (1 - share) * (high - low) / 2
        d = np.diff(p, axis=1)
        good = np.all((p >= low + slack) & (p <= high - slack), axis=1)
        good &= np.all(np.abs(d) <= share * self.d[:, None], axis=1)
        good &= np.all(np.abs(np.diff(d, axis=1)) <= share * self.d2[:, None], axis=1)
        for sign, limit in ((1, high), (-1, -low)):
            energy, farthest = hull(sign * p)
            room = share * 2 * self.stop[:, None] * (limit - farthest)
            good &= np.all(energy <= room, axis=1) | (self.stop == 0)
        return good


def hull(p: NDArray[np.float64] | Integers) -> tuple[Floats, Floats]:
    """By span: the square of its fastest difference upwards, and its farthest point."""
    d, m = np.maximum(np.diff(p, axis=1), 0).astype(np.float64), p.shape[1] - 3
    fastest = np.max([d[:, i : i + m] for i in range(3)], axis=0)
    return fastest**2, np.max([p[:, i : i + m] for i in range(4)], axis=0).astype(np.float64)


def scaled(base: Floats, way: Floats, limits: Limits, share: float) -> Floats:
    """base + s * way with the largest s for which that is legal; legal ways are a convex set."""
    reach = np.maximum(np.abs(np.diff(way, axis=1)).max(axis=1), 1e-12)
    good, bad = np.zeros(len(base)), 2.5 * limits.d / reach
    for _ in range(24):
        s = (good + bad) / 2
        legal = limits.legal(base + s[:, None] * way, share)
        good, bad = np.where(legal, s, good), np.where(legal, bad, s)
    return base + good[:, None] * way


@dataclass
class Plans:
    """A stored track (b, m), the new track's points (b, m), and where they meet."""

    stored: Integers
    new: Integers
    live: Integers  # index of the knot that runs
    first: Integers  # index of the plan's first point
    fresh: NDArray[np.bool_]  # a first plan: nothing is stored

    @classmethod
    def legal(
        cls, rng: np.random.Generator, limits: Limits, length: int, share: float, past: float
    ) -> Plans:
        """Motions up to a share of the limits, each along a stored one up to its live points' end,
        which goes up to `past` of them."""
        count, zero = len(limits.d), np.zeros(len(limits.d), dtype=np.int64)
        inside = (limits.high - limits.low) * share / 2
        start = (limits.low + limits.high) / 2 + inside * rng.uniform(-1, 1, count)
        base = np.repeat(start[:, None], length, axis=1)
        stored = scaled(base, wave(rng, count, length, zero + 3), limits, past)
        stored -= (stored - base) * (rng.random((count, 1)) < 0.1)  # some stand still
        live = rng.integers(0, length - 6, count)
        new = scaled(stored, wave(rng, count, length, live + LIVE), limits, share)
        first = np.maximum(live + LIVE - rng.integers(0, 20, count), 0)
        fresh = rng.random(count) < 0.1
        first[fresh] = 0
        new[fresh] = scaled(base, wave(rng, count, length, zero + 3), limits, share)[fresh]
        return cls(
            np.rint(stored).astype(np.int64), np.rint(new).astype(np.int64), live, first, fresh
        )


def jobs_of(rng: np.random.Generator, plans: Plans, limits: Limits) -> NDArray[np.void]:
    """The same as records for the gate."""
    count, length = plans.new.shape
    jobs = np.zeros(count, JOB)
    for name in ("low", "high", "d", "d2", "stop"):
        jobs[name] = getattr(limits, name)
    base = rng.choice([0, -1000, 415_000_000_000], count)
    jobs["knot"] = base + np.where(plans.fresh, -LIVE - rng.integers(0, 4, count), plans.live)
    jobs["stored_first"], jobs["first_knot"] = base, base + plans.first
    jobs["stored_count"] = np.where(plans.fresh, 0, length)
    jobs["count"] = length - plans.first
    jobs["stored"][:, :length] = plans.stored
    index = np.minimum(plans.first[:, None] + np.arange(PLAN_POINTS), length - 1)
    jobs["points"] = np.take_along_axis(plans.new, index, axis=1)
    return jobs


def hugging(rng: np.random.Generator, plans: Plans) -> Limits:
    """Limits as tight as the plan is, or one quantum tighter or wider, or far from it."""
    told = np.where(plans.fresh[:, None], plans.new, plans.stored)
    both = plans.new, told
    count = len(told)

    def about(exact: Integers, far: Integers) -> Integers:
        kind = rng.random(count)
        by_one = exact + rng.choice([-1, 0, 0, 0, 0, 0, 0, 1], count)
        return np.where(kind < 0.7, by_one, far)

    lowest = np.min([p.min(axis=1) for p in both], axis=0)
    highest = np.max([p.max(axis=1) for p in both], axis=0)
    width = highest - lowest + 2
    asked = rng.random(count) < 0.5  # for room to stop, which a tight range has not
    beyond = np.ceil(width * rng.random(count) ** 3).astype(np.int64)
    high = np.where(asked, highest + beyond, about(highest, highest + width))
    low = np.where(asked, lowest - beyond, -about(-lowest, width - lowest))
    high, low = np.minimum(high, POINT_MAX), np.maximum(low, -POINT_MAX)
    high = np.maximum(high, low)
    fastest = np.max([np.abs(np.diff(p, axis=1)).max(axis=1) for p in both], axis=0)
    hardest = np.max([np.abs(np.diff(p, 2, axis=1)).max(axis=1) for p in both], axis=0)
    stop = np.zeros(count, dtype=np.int64)
    for sign, limit in ((1, high), (-1, -low)):
        for p in both:
            energy, farthest = hull(sign * p)
            room = np.maximum(limit[:, None] - farthest, 0.5)
            stop = np.maximum(stop, np.ceil((energy / room / 2).max(axis=1)).astype(np.int64))
    stop = np.clip(about(stop, stop * 5 // 8), 0, 2 * DIFFERENCE_MAX) * asked
    return Limits(
        low,
        high,
        np.clip(about(fastest, 2 * fastest + 2), 1, DIFFERENCE_MAX),
        np.clip(about(hardest, 2 * hardest + 2), 1, 2**31 - 1),
        stop,
    )


def spoil(rng: np.random.Generator, jobs: NDArray[np.void]) -> None:
    """Changes about half of the plans: a point, the place, the end, the size of all."""
    count, rows = len(jobs), np.arange(len(jobs))
    kind = rng.integers(0, 12, count)
    at = rng.integers(0, jobs["count"])
    points = jobs["points"].astype(np.int64)
    d, d2 = jobs["d"].astype(np.int64), jobs["d2"].astype(np.int64)
    little = rng.choice([-2, -1, 1, 2], count)
    large = rng.choice([-1, 1], count) * rng.choice([2**30, 2**31 - 1, 2**25, 2**20], count)
    change = np.select([kind == 0, kind == 1, kind == 2, kind == 3], [little, d, -d2, large], 0)
    points[rows, at] += change
    jobs["points"] = np.clip(points, -(2**31), 2**31 - 1)
    jobs["knot"] += np.where(kind == 4, rng.integers(-20, 20, count), 0)
    jobs["first_knot"] += np.where(kind == 5, rng.integers(-3, 4, count), 0)
    short = (kind == 6) & (jobs["count"] > 3)
    jobs["count"] = np.where(short, 3 + at % np.maximum(jobs["count"] - 2, 1), jobs["count"])
    jobs["continuous"] = kind == 7
    turn = rng.integers(-(2**31), 2**31, count)[:, None] * (kind == 7)[:, None]
    for name in ("stored", "points"):
        moved = jobs[name].astype(np.int64) + turn
        jobs[name] = (moved + 2**31) % 2**32 - 2**31


# ---- the campaign


@dataclass
class Tally:
    """What became of the plans."""

    asked: int = 0
    results: Counter[str] = field(default_factory=Counter)
    unsafe: Counter[str] = field(default_factory=Counter)
    tight: int = 0  # accepted, and with some limit one quantum tighter refused

    @property
    def accepted(self) -> int:
        return self.results["accepted"]

    def note(self, program: Path, jobs: NDArray[np.void]) -> None:
        answers = through_the_gate(program, jobs)
        good = answers["result"] == 0
        self.asked += len(jobs)
        self.results.update(RESULTS[r] for r in answers["result"].tolist())
        for promise, broken in unsafe(jobs[good], answers[good]).items():
            self.unsafe[promise] += int(broken.sum())
        refused = np.zeros(int(good.sum()), dtype=bool)
        for name, by in (("high", -1), ("low", 1), ("d", -1), ("d2", -1), ("stop", -1)):
            tighter = jobs[good].copy()
            possible = tighter[name] > 1 if by < 0 and name not in ("high", "low") else True
            possible &= tighter["low"] < tighter["high"]
            tighter[name] = np.where(possible, tighter[name] + by, tighter[name])
            refused |= through_the_gate(program, tighter)["result"] != 0
        self.tight += int(refused.sum())


def safety(program: Path, seed: int, batches: int, progress: bool = False) -> Tally:
    """Plans of which many are no good: half of them as near to their limits as can be."""
    tally = Tally()
    for batch in range(batches):
        rng = np.random.default_rng([seed, batch])
        length = LENGTHS[batch // 2 % len(LENGTHS)]
        limits = Limits.random(rng, BATCH)
        plans = Plans.legal(rng, limits, length, 1.0, 0.5)
        if batch % 2:
            jobs = jobs_of(rng, plans, hugging(rng, plans))
        else:
            jobs = jobs_of(rng, plans, limits)
            spoil(rng, jobs)
        tally.note(program, jobs)
        if progress:
            print(f"\r{tally.asked} plans, {tally.accepted} accepted", end="", file=sys.stderr)
    return tally


def liveness(program: Path, seed: int, batches: int, progress: bool = False) -> Tally:
    """Legal plans alone."""
    tally = Tally()
    for batch in range(batches):
        rng = np.random.default_rng([seed, batch, 1])
        limits = Limits.random(rng, BATCH)
        plans = Plans.legal(rng, limits, LENGTHS[batch % len(LENGTHS)], LEGAL_SHARE, LEGAL_SHARE)
        jobs = jobs_of(rng, plans, limits)
        tally.asked += BATCH
        tally.results.update(RESULTS[r] for r in through_the_gate(program, jobs)["result"].tolist())
        moved = np.abs(np.diff(plans.new, axis=1)).max(axis=1) > 0
        assert moved.mean() > 0.9
        if progress:
            print(f"\r{tally.asked} legal plans", end="", file=sys.stderr)
    return tally


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    batches = BATCHES_LONG if arguments.long else BATCHES
    with tempfile.TemporaryDirectory() as folder:
        program = build(Path(folder))
        safe = safety(program, arguments.seed, batches, True)
        alive = liveness(program, arguments.seed, batches, True)
    print(f"\n{safe.asked} plans: {dict(safe.results)}")
    print(f"accepted and one quantum from a limit: {safe.tight}; unsafe: {dict(safe.unsafe)}")
    print(f"{alive.asked} legal plans: {dict(alive.results)}")
    return int(any(safe.unsafe.values()) or alive.accepted != alive.asked)


if __name__ == "__main__":
    raise SystemExit(main())
