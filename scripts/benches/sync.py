"""How well clocks agree on five networks: the firmware's, and others made of the same stamps.

A star of eight boards around a host, and a chain of five behind one. Each has an oscillator within
100 ppm that wanders by up to 1 ppm/s; told is a drift of 200 ppm, the same wander, and the
network's least delays. Frames go 250 times a second each way. Every method that has numbers to
choose is tuned for each network and topology by the same random search, as often, for the p99.9 of
the error, on other seeds than those that are judged.

A long campaign keeps each result as it comes (`--results`), and goes on from there when it is
called again; `--minutes` ends it, and the tables are of what there is by then.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _campaign import Campaign, Journal, Task, campaign_options, fingerprint
from _report import arguments, finish, goal, table
from clocks import boards, firmware, heard, tight
from clocks.exchanges import (
    EPOCH_US,
    REQUEST_BYTES,
    WANDER_PPM_PER_S,
    Scene,
    bus_of,
    hop,
    least_of,
    scene,
)
from clocks.rivals import RIVALS
from clocks.search import search
from clocks.tally import Tally
from numpy.typing import NDArray

from headway.cli.simulation import Simulation
from headway.configs.load import load_config
from headway.sim.profiles import PROFILES

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
OURS, DOCUMENT, MARKED = "bounds", "mean", "with marks"
METHODS = (OURS, DOCUMENT, *RIVALS)
DEVICES = 8
TUNING, JUDGING, TIGHT, HOLDOVER = range(4)  # which seeds
CUT_US = (60_000_000, 60_500_000)
P999_LIMIT_US = {"usb-iid": 15, "lan": 20, "usb": 50}
# A clock has settled when its error stays within this for a second; of a chain five times as much.
SETTLED_US = {"usb": 50, "usb-iid": 15, "lan": 20, "wifi": 50, "awful": 100}
SETTLED_FOR_US = 1_000_000
STAR, CHAIN, BEAT, WHOLE = "star of 8", "chain of 5", "star, no dither", "star, whole"
PAIR_LIMIT_US = 2
HOLDOVER_LIMIT_US = 50

Array = NDArray[np.float64]
Tuned = dict[str, dict[str, float]]  # by method
Verdicts = dict[str, dict[str, Any]]  # by method: what a Judged tells


class Effort(NamedTuple):
    """How much is simulated."""

    stars: int  # seeds
    chains: int
    wholes: int  # of the whole firmware around a host
    duration_us: int
    skip_us: int  # not judged: settling
    draws: int
    star_tuning: tuple[int, int]  # scenes that a draw is judged by, and how long they are [us]
    chain_tuning: tuple[int, int]
    instants: int  # a network, for the tightest interval
    holdovers: int
    arms: int


QUICK = Effort(
    stars=6, chains=3, wholes=3, duration_us=20_000_000, skip_us=8_000_000, draws=12,
    star_tuning=(2, 20_000_000), chain_tuning=(1, 12_000_000), instants=12, holdovers=4, arms=3,
)  # fmt: skip
LONG = Effort(
    stars=100, chains=100, wholes=100, duration_us=120_000_000, skip_us=20_000_000, draws=60,
    star_tuning=(4, 60_000_000), chain_tuning=(1, 20_000_000), instants=100, holdovers=40, arms=40,
)  # fmt: skip


def generator(profile: str, purpose: int, seed: int) -> np.random.Generator:
    return np.random.default_rng([list(PROFILES).index(profile), purpose, seed])


def errors(method: str, seen: Scene, tuned: Tuned) -> Array:
    """A clock's minus the host's at each servo period [us], (m,)."""
    if method in RIVALS:
        make, _ = RIVALS[method]
        return make(seen.stamps, **tuned[method]).error(seen)
    kind = firmware.BOUNDS if method == OURS else firmware.AVERAGE
    settings = firmware.settings_of(kind, seen.stamps.least, tuned.get(method))
    return firmware.follow(seen, settings).error


def tune(job: tuple[str, str, str, Effort]) -> tuple[dict[str, float], float]:
    """The numbers of a method for a network and topology, and the score that they had."""
    profile, topology, method, effort = job
    count, duration_us = effort.star_tuning if topology == STAR else effort.chain_tuning
    skip_us = min(effort.skip_us, duration_us // 2)
    scenes = list[Scene]()
    if topology == STAR:
        for seed in range(count):
            rng = generator(profile, TUNING, seed)
            scenes.append(scene(profile, duration_us, rng, bus_of(profile, rng)))

    def score(numbers: dict[str, float]) -> float:
        found = Tally()
        for each in scenes:
            found.add(errors(method, each, {method: numbers})[each.servo_us > skip_us])
        for seed in range(count if topology == CHAIN else 0):
            rng = generator(profile, TUNING, seed)
            true_us, error, _ = behind(profile, method, numbers, rng, duration_us, TUNED_EVERY_US)
            found.add(np.abs(error).max(axis=1)[true_us > skip_us])
        return found.quantile(0.999)

    ranges = firmware.AVERAGE_RANGES if method == DOCUMENT else RIVALS[method][1]
    return search(score, ranges, effort.draws, np.random.default_rng(0))


class Judged:
    """What came of a method on a network."""

    def __init__(self) -> None:
        self.error, self.pairs, self.half = Tally(), Tally(), Tally()
        self.settle_s: list[float] = []  # inf: it has not
        self.inside = self.outside = self.excluded = 0

    def told(self) -> dict[str, Any]:
        """As what JSON has."""
        return {
            name: part.told() if isinstance(part, Tally) else part
            for name, part in vars(self).items()
        }

    @classmethod
    def of(cls, told: dict[str, Any]) -> Judged:
        """What `told` told."""
        judged = cls()
        for name, part in told.items():
            is_tally = isinstance(getattr(judged, name), Tally)
            setattr(judged, name, Tally.of(part) if is_tally else part)
        return judged

    def merge(self, other: Judged) -> None:
        self.error.merge(other.error)
        self.pairs.merge(other.pairs)
        self.half.merge(other.half)
        self.settle_s += other.settle_s
        self.inside += other.inside
        self.outside += other.outside
        self.excluded += other.excluded

    def take(
        self, true_us: NDArray[np.int64], error: Array, skip_us: int, settled_us: float
    ) -> None:
        """Errors of shape (m,) at times of the same shape."""
        self.error.add(error[true_us > skip_us])
        outside = true_us[~(np.abs(error) <= settled_us)]
        begins = np.append(true_us[0], outside)  # of stretches within the limit
        lengths = np.diff(np.append(begins, true_us[-1]))
        long = np.flatnonzero(lengths > SETTLED_FOR_US)
        self.settle_s.append(float(begins[long[0]]) * 1e-6 if len(long) else float("inf"))

    def take_told(self, least: Array, most: Array, outside: NDArray[np.bool_]) -> None:
        """Of any one shape: the interval of the error, and where it did not hold."""
        known = ~np.isnan(most - least)
        self.half.add((most - least)[known] / 2)
        self.outside += int(outside.sum())
        self.inside += int(known.sum() - outside.sum())


def told_of(judged: dict[str, Judged]) -> Verdicts:
    """As what JSON has."""
    return {name: each.told() for name, each in judged.items()}


def star(job: tuple[str, int, Tuned, Effort]) -> Verdicts:
    """Boards around a host, on one bus if there is one."""
    profile, seed, tuned, effort = job
    rng = generator(profile, JUDGING, seed)
    bus = bus_of(profile, rng)
    judged = {method: Judged() for method in METHODS}
    for _ in range(DEVICES):
        seen = scene(profile, effort.duration_us, rng, bus)
        for method in METHODS:
            if method != OURS:
                error = errors(method, seen, tuned)
                judged[method].take(seen.servo_us, error, effort.skip_us, SETTLED_US[profile])
        settings = firmware.settings_of(firmware.BOUNDS, seen.stamps.least)
        told, ours = firmware.follow(seen, settings), judged[OURS]
        ours.take(seen.servo_us, told.error, effort.skip_us, SETTLED_US[profile])
        late = seen.servo_us > effort.skip_us
        ours.take_told(told.least[late], told.most[late], told.violations[late])
        ours.outside += int(told.violations[~late].sum())
        ours.excluded += told.excluded
    return told_of(judged)


def row(job: tuple[str, int, Tuned, Effort]) -> Verdicts:
    """A chain: at each ms the largest error against the host, and the largest difference between
    two boards."""
    profile, seed, tuned, effort = job
    judged = {method: Judged() for method in METHODS}
    for method, mine in judged.items():
        rng = generator(profile, JUDGING, seed)
        true_us, error, ran = behind(
            profile, method, tuned.get(method), rng, effort.duration_us, boards.PERIOD_US
        )
        late = true_us > effort.skip_us
        worst = np.abs(error).max(axis=1)
        mine.take(true_us, worst, effort.skip_us, boards.CHAIN * SETTLED_US[profile])
        mine.pairs.add(np.ptp(error, axis=1)[late])
        if ran is not None and method == OURS:
            mine.take_told(ran.least[late], ran.most[late], ran.violations[late])
            mine.outside += int(ran.violations[~late].sum())
            mine.excluded += ran.excluded
    return told_of(judged)


def behind(
    profile: str,
    method: str,
    numbers: dict[str, float] | None,
    rng: np.random.Generator,
    duration_us: int,
    every_us: int,
) -> tuple[NDArray[np.int64], Array, boards.Ran | None]:
    """Times (m,) and errors against the host (m, boards) of a chain. The firmware's boards run it
    all; of the others' each follows the clock that the one before it has made."""
    if method not in RIVALS:
        kind = firmware.BOUNDS if method == OURS else firmware.AVERAGE
        ran = boards.run(boards.chain(profile, kind, rng, numbers), duration_us, every_us)
        return ran.true_us, ran.error, ran
    bus = bus_of(profile, rng)
    true_us = np.arange(10 * every_us, duration_us - 20 * every_us, every_us)
    seen = scene(profile, duration_us, rng, bus)
    columns = []
    for _ in range(boards.CHAIN):
        clock = RIVALS[method][0](seen.stamps, **(numbers or {})).shown(seen)
        columns.append(clock(true_us) - true_us - EPOCH_US)
        seen = hop(profile, duration_us, boards.ASK_US, rng, bus)(clock)
    return true_us, np.stack(columns, axis=1), None


def ratios(job: tuple[str, int, Effort]) -> list[float]:
    """Widths over the tightest there are, at some instants of one board."""
    profile, seed, effort = job
    rng = generator(profile, TIGHT, seed)
    seen = scene(profile, effort.duration_us, rng, bus_of(profile, rng))
    told = firmware.follow(seen, firmware.settings_of(firmware.BOUNDS, seen.stamps.least))
    first = int(np.searchsorted(seen.servo_us, effort.skip_us))
    found = []
    for i in rng.integers(first, len(seen.servo_us), PER_BOARD).tolist():
        now = int(seen.servo_ticks[i])
        known = tight.proofs(seen.stamps, now, now, int(seen.servo_us[i]) + EPOCH_US - now)
        low, high = tight.tightest(known, firmware.DRIFT_PPM, WANDER_PPM_PER_S)
        found.append(float(told.most[i] - told.least[i]) / (high - low))
    return found


def row_ratios(job: tuple[str, int, Effort]) -> list[float]:
    """The same of the boards of a chain that have neighbours alone: over the tightest there is by
    what these say of their clocks and of their own intervals."""
    profile, seed, effort = job
    rng = generator(profile, TIGHT, CHAINS_FROM + seed)
    made = boards.chain(profile, firmware.BOUNDS, rng, None, heard.Tapped)
    least_us = least_of(PROFILES[profile].to_device, REQUEST_BYTES)
    bounds = firmware.DRIFT_PPM, WANDER_PPM_PER_S
    found = []
    for true_us in sorted(rng.integers(effort.skip_us, effort.duration_us, PER_BOARD).tolist()):
        made.advance(true_us)
        for board in range(1, boards.CHAIN):
            told, tightest = heard.widths(made, board, boards.PERIOD_US, least_us, *bounds)
            found.append(told / tightest)
    return found


def holdover(job: tuple[str, int]) -> tuple[float, int]:
    """Worst error [us] of our clock while nothing passes, and how often it was not inside."""
    profile, seed = job
    rng = generator(profile, HOLDOVER, seed)
    seen = scene(profile, CUT_US[1] + 1_000_000, rng, bus_of(profile, rng), CUT_US)
    told = firmware.follow(seen, firmware.settings_of(firmware.BOUNDS, seen.stamps.least))
    gap = (seen.servo_us >= CUT_US[0]) & (seen.servo_us < CUT_US[1])
    return float(np.abs(told.error[gap]).max()), int(told.violations.sum())


def on_beat(job: tuple[str, int, Tuned, Effort]) -> Verdicts:
    """Our clock around a host where no status is dithered: each leaves at a servo period."""
    profile, seed, _, effort = job
    rng = generator(profile, JUDGING, seed)
    bus = bus_of(profile, rng)
    judged = Judged()
    for _ in range(DEVICES):
        seen = scene(profile, effort.duration_us, rng, bus, dither_us=0)
        told = firmware.follow(seen, firmware.settings_of(firmware.BOUNDS, seen.stamps.least))
        judged.take(seen.servo_us, told.error, effort.skip_us, SETTLED_US[profile])
        late = seen.servo_us > effort.skip_us
        judged.take_told(told.least[late], told.most[late], told.violations[late])
    return told_of({OURS: judged})


def marked(job: tuple[str, int, Tuned, Effort]) -> Verdicts:
    """The whole firmware around a host on a bus, with and without its starts of frames."""
    profile, seed, _, effort = job
    judged = {}
    for name, marks in ((OURS, False), (MARKED, True)):
        made = boards.star(profile, DEVICES, generator(profile, JUDGING, seed), marks)
        ran, mine = boards.run(made, effort.duration_us), Judged()
        late = ran.true_us > effort.skip_us
        for error in ran.error.T:
            mine.take(ran.true_us, error, effort.skip_us, SETTLED_US[profile])
        mine.pairs.add(np.ptp(ran.error, axis=1)[late])
        mine.take_told(ran.least[late], ran.most[late], ran.violations[late])
        mine.outside += int(ran.violations[~late].sum())
        judged[name] = mine
    return told_of(judged)


def arm(job: tuple[float, int]) -> list[float]:
    """RMS error [mrad] of arm2's joints with oscillators off by up to so much."""
    drift_ppm, seed = job
    changes = [f"sim.clocks.drift_ppm={drift_ppm}", f"seed={seed}", "duration_s=4"]
    summary = Simulation(load_config(CONFIGS / "arm2.yaml", changes), CONFIGS).run()
    return list(map(float, summary["tracking"]["rms"]))


PER_BOARD = 4  # instants
CHAINS_FROM = 1000  # seeds, where other chains have none
DRIFTS_PPM = (0.0, 100.0)
TUNED_EVERY_US = 10_000  # a chain is looked at


def figures(
    network: str, topology: str, seeds: int, clock: str, judged: Judged, ratio: str
) -> dict[str, Any]:
    """A line of the table."""
    told = judged.inside + judged.outside > 0
    pairs, settle_s = judged.pairs.quantile(0.999), float(np.median(judged.settle_s))
    share = 100 * judged.inside / (judged.inside + judged.outside) if told else 0.0
    return {
        "network": network,
        "boards": topology,
        "seeds": seeds,
        "clock": clock,
        "settle s": f"{settle_s:.2f}" if settle_s < np.inf else "never",
        **{
            name: round(judged.error.quantile(share), 1)
            for name, share in (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999), ("worst", 1.0))
        },
        "pairs p99.9": f"{pairs:.1f}" if pairs == pairs else "",
        "told +-": f"{judged.half.quantile(0.5):.1f}" if told else "",
        "p99 of it": f"{judged.half.quantile(0.99):.1f}" if told else "",
        "inside %": f"{share:.4g}" if told else "",
        "over tightest": ratio,
    }


def merged(parts: Sequence[Verdicts]) -> dict[str, Judged]:
    """All seeds' in one."""
    whole: dict[str, Judged] = {}
    for part in parts:
        for name, told in part.items():
            whole.setdefault(name, Judged()).merge(Judged.of(told))
    return whole


def tuned_by(found: dict[str, Any], profile: str, topology: str) -> Tuned:
    """The numbers of all methods."""
    return {m: found[f"tuning {profile}, {topology}, {m}"][0] for m in METHODS[1:]}


def tunings(topology: str, effort: Effort) -> list[Task]:
    return [
        Task(f"tuning {p}, {topology}, {m}", tune, (p, topology, m, effort))
        for p in PROFILES
        for m in METHODS[1:]
    ]


def stars(found: dict[str, Any], effort: Effort) -> list[Task]:
    """Seed by seed, so that all networks have as many when the time is over."""
    tasks = []
    for seed in range(effort.stars):
        for profile in PROFILES:
            mine = tuned_by(found, profile, STAR)
            tasks.append(Task(f"{profile}, {STAR}, {seed}", star, (profile, seed, mine, effort)))
        tasks.append(Task(f"usb, {BEAT}, {seed}", on_beat, ("usb", seed, Tuned(), effort)))
    return tasks


def chains(found: dict[str, Any], effort: Effort) -> list[Task]:
    """The same of chains, and of the whole firmware around a host."""
    tasks = []
    for seed in range(max(effort.chains, effort.wholes)):
        if seed < effort.wholes:
            tasks.append(Task(f"usb, {WHOLE}, {seed}", marked, ("usb", seed, Tuned(), effort)))
        for profile in PROFILES if seed < effort.chains else ():
            mine = tuned_by(found, profile, CHAIN)
            tasks.append(Task(f"{profile}, {CHAIN}, {seed}", row, (profile, seed, mine, effort)))
    return tasks


def others(effort: Effort) -> list[Task]:
    """The tightest intervals, the gaps and arm2."""
    boards_of = range(-(-effort.instants // PER_BOARD))
    tasks = [
        Task(f"{p}, tightest, {s}", ratios, (p, s, effort)) for p in PROFILES for s in boards_of
    ]
    rows = range(-(-effort.instants // (PER_BOARD * (boards.CHAIN - 1))))
    tasks += [
        Task(f"{p}, tightest in a chain, {s}", row_ratios, (p, s, effort))
        for p in PROFILES
        for s in rows
    ]
    tasks += [
        Task(f"{p}, cut, {s}", holdover, (p, s)) for p in PROFILES for s in range(effort.holdovers)
    ]
    tasks += [Task(f"arm2, {d}, {s}", arm, (d, s)) for d in DRIFTS_PPM for s in range(effort.arms)]
    return tasks


def main() -> int:
    """Exit code."""
    options = arguments((__doc__ or "").splitlines()[0], campaign_options)
    effort = LONG if options.long else QUICK
    journal = Journal(options.results, fingerprint(effort))
    with ProcessPoolExecutor(options.processes) as pool:
        campaign = Campaign(pool, journal, options.minutes)
        campaign.run("tuning stars", tunings(STAR, effort))
        if campaign.complete:
            campaign.run("stars", stars(journal.found, effort))
            campaign.run("intervals, gaps, arm2", others(effort))
            campaign.run("tuning chains", tunings(CHAIN, effort))
        if campaign.complete:
            campaign.run("chains", chains(journal.found, effort))
    report(journal.found, effort, options.json)
    return 0


def report(found: dict[str, Any], effort: Effort, file: Path | None) -> None:
    """The tables of all results that there are, and the goals."""

    def of(what: str) -> list[Any]:
        return [value for key, value in found.items() if key.rpartition(", ")[0] == what]

    rows: list[dict[str, Any]] = []
    goals: list[dict[str, Any]] = []
    for profile in PROFILES:
        for topology, what in ((STAR, "tightest"), (CHAIN, "tightest in a chain")):
            over = ""
            if widths := of(f"{profile}, {what}"):
                ratio = float(np.median(np.concatenate(widths)))
                over = f"{ratio:.3f}"
                key = f"{profile}, {topology}: median width over the tightest"
                goals.append(goal(key, ratio, "<=", 1.3))
            verdicts = of(f"{profile}, {topology}")
            judged = merged(verdicts)
            for name, each in judged.items():
                ours = over if name == OURS else ""
                rows.append(figures(profile, topology, len(verdicts), name, each, ours))
            goals += judge(profile, topology, judged) if judged else []
    for topology in (BEAT, WHOLE):
        verdicts = of(f"usb, {topology}")
        for name, each in merged(verdicts).items():
            rows.append(figures("usb", topology, len(verdicts), name, each, ""))
            if topology == WHOLE:
                key = f"usb, {topology}, {name}"
                goals.append(goal(f"{key}: truths outside", each.outside, "<=", 0))
                # Of whole microseconds, as clocks are read; the tally has the upper edge of a bin.
                pairs = float(np.floor(each.pairs.quantile(0.999)))
                if name == MARKED:
                    goals.append(goal(f"{key}: pairs p99.9 [us]", pairs, "<=", PAIR_LIMIT_US))
    gaps = []
    for profile in PROFILES:
        if cuts := of(f"{profile}, cut"):
            worst, outside = zip(*cuts, strict=True)
            gaps.append({
                "network": profile, "boards": len(cuts), "cut ms": (CUT_US[1] - CUT_US[0]) / 1e3,
                "median of the worst us": float(np.median(worst)), "worst us": max(worst),
                "not inside": sum(outside),
            })  # fmt: skip
            goals.append(
                goal(f"{profile}: worst in the gap [us]", max(worst), "<=", HOLDOVER_LIMIT_US)
            )
    arms = [
        {"drift ppm": drift, "seeds": len(rms), "rms q1 mrad": float(np.median(rms, axis=0)[0]),
         "rms q2 mrad": float(np.median(rms, axis=0)[1])}
        for drift in DRIFTS_PPM if (rms := of(f"arm2, {drift}"))
    ]  # fmt: skip
    if len(arms) == len(DRIFTS_PPM):
        worse = max(arms[1][key] / arms[0][key] for key in ("rms q1 mrad", "rms q2 mrad"))
        goals.append(goal("arm2: tracking at 100 ppm over that at 0", worse, "<=", 1.05))
    numbers = [
        {"network and boards": key.removeprefix("tuning "), "p99.9 then": round(value[1], 1),
         "numbers": ", ".join(f"{name} {number:.3g}" for name, number in value[0].items())}
        for key, value in found.items() if key.startswith("tuning")
    ]  # fmt: skip
    for title, some in (
        (f"clocks, {effort.duration_us * 1e-6:g} s a seed; errors against the host in us", rows),
        ("the contact is cut", gaps),
        ("arm2, medians over seeds of 4 s", arms),
        (f"tuned, best of {effort.draws} draws", numbers),
    ):
        if some:
            table(title, some)
    finish([*rows, *gaps, *arms, *numbers], goals, file)


def judge(profile: str, topology: str, found: dict[str, Judged]) -> list[dict[str, Any]]:
    """The goals of one network and topology."""
    name, ours = f"{profile}, {topology}", found[OURS]
    goals = []
    if topology == STAR and profile in P999_LIMIT_US:
        limit = P999_LIMIT_US[profile]
        goals.append(goal(f"{name}: p99.9 [us]", ours.error.quantile(0.999), "<=", limit))
    others = {
        method: judged.error.quantile(0.999)
        for method, judged in found.items()
        if method in METHODS[1:]
    }
    nearest = min(others, key=others.__getitem__)
    share = ours.error.quantile(0.999) / others[nearest]
    goals.append(goal(f"{name}: p99.9 over that of the next, {nearest}", share, "<", 1))
    goals.append(goal(f"{name}: truths outside of what was told", ours.outside, "<=", 0))
    return goals


if __name__ == "__main__":
    sys.exit(main())
