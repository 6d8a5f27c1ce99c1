"""What scripts/bench sync judges by: stamps that are true, rivals that work, a search that finds
the best of its draws, an interval that none is narrower than."""

import importlib
import json
import math
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headway.configs.schema import Channel
from headway.sim import _board, profiles
from headway.sim.boards import Boards, Cable, Crystal, End, Host
from headway.sim.network import Wire

FOLDER = Path(__file__).resolve().parent.parent / "scripts" / "benches"
NAMES = (
    "exchanges", "rivals", "firmware", "search", "tally", "tight", "boards", "heard",
)  # fmt: skip
PERFECT = Channel(delay_us=300, jitter_us=0, loss=0.0)
NUMBERS = {  # that suit a network without jitter
    "half trip": {"alpha": 0.05, "beta": 1.0},
    "regression": {"decay": 0.02, "age": 1e-8, "gate": 5.0, "floor_us": 100.0},
    "minimum": {"count": 4, "time_s": 0.2, "ratio": 4.0},
}


@pytest.fixture(scope="module")
def clocks() -> Iterator[dict[str, ModuleType]]:
    """The bench's modules by name; they are no package of ours."""
    sys.path.insert(0, str(FOLDER))
    kept = importlib.import_module("_campaign")
    yield {name: importlib.import_module(f"clocks.{name}") for name in NAMES} | {"campaign": kept}
    sys.path.remove(str(FOLDER))
    for name in (*(f"clocks.{name}" for name in NAMES), "clocks", "_campaign"):
        del sys.modules[name]


@pytest.fixture
def perfect(monkeypatch: pytest.MonkeyPatch) -> str:
    """A network of constant, equal delays."""
    monkeypatch.setitem(profiles.PROFILES, "perfect", profiles.Profile(PERFECT, PERFECT))
    return "perfect"


def a_scene(
    clocks: dict[str, ModuleType], profile: str, duration_us: int, seed: int = 1, **more: Any
) -> Any:
    exchanges, rng = clocks["exchanges"], np.random.default_rng(seed)
    bus = exchanges.bus_of(profile, rng)
    return exchanges.scene(profile, duration_us, rng, bus, **more)


# The stamps.


@pytest.mark.parametrize("profile", profiles.PROFILES)
def test_no_stamp_contradicts_the_truth(clocks: dict[str, ModuleType], profile: str) -> None:
    seen = a_scene(clocks, profile, 4_000_000)
    s, epoch_us = seen.stamps, clocks["exchanges"].EPOCH_US
    theta = seen.servo_us + epoch_us - seen.servo_ticks
    at_arrival = np.interp(s.arrived_ticks, seen.servo_ticks, theta)
    assert (s.sent_upstream - s.arrived_ticks + s.least.to_here <= at_arrival + 2).all()
    echoed = s.received_upstream != 0
    at_echo = np.interp(s.echo_ticks[echoed], seen.servo_ticks, theta)
    upper = s.received_upstream[echoed] - s.echo_ticks[echoed] - s.least.to_there
    assert (upper >= at_echo - 2).all()
    assert echoed.mean() > 0.6 and len(s.arrived_us) > 0.85 * 4_000_000 / 4096
    assert (np.diff(s.arrived_ticks) >= 0).all()


def test_servo_periods_are_the_counters(clocks: dict[str, ModuleType]) -> None:
    counter = clocks["exchanges"].Counter(np.random.default_rng(2))
    ticks = counter.ticks(counter.periods(60_000_000))
    assert len(ticks) == 60_000 and (ticks[0] - counter.numbers[0]) <= 1001
    assert np.abs(ticks - 1000 * np.rint(ticks / 1000)).max() <= 1
    assert (np.diff(ticks) > 0).all() and ticks[-1] > 2**31  # beyond a sign at any rate


def test_nothing_passes_while_the_contact_is_cut(clocks: dict[str, ModuleType]) -> None:
    whole = a_scene(clocks, "usb-iid", 3_000_000)
    cut = a_scene(clocks, "usb-iid", 3_000_000, cut_us=(1_000_000, 2_000_000))
    arrived = cut.stamps.arrived_us
    assert not ((arrived > 1_001_000) & (arrived < 2_000_000)).any()
    assert len(arrived) < len(whole.stamps.arrived_us) - 200
    assert (cut.servo_us == whole.servo_us).all()


# Clocks on a perfect network: what is left is a count's microsecond, and the oscillator's wander.


@pytest.mark.parametrize("name", NUMBERS)
def test_rivals_on_a_perfect_network(
    clocks: dict[str, ModuleType], perfect: str, name: str
) -> None:
    make, ranges = clocks["rivals"].RIVALS[name]
    assert set(ranges) == set(NUMBERS[name])
    for seed in range(3):
        seen = a_scene(clocks, perfect, 12_000_000, seed)
        error = make(seen.stamps, **NUMBERS[name]).error(seen)
        assert np.abs(error[seen.servo_us > 6_000_000]).max() < 2.5
        assert abs(error[seen.servo_us > 6_000_000].mean()) < 1.0


def test_a_known_asymmetry_is_taken_off(
    clocks: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = Channel(delay_us=2300, jitter_us=0, loss=0.0)
    monkeypatch.setitem(profiles.PROFILES, "uneven", profiles.Profile(PERFECT, slow))
    seen = a_scene(clocks, "uneven", 12_000_000)
    for name, (make, _) in clocks["rivals"].RIVALS.items():
        error = make(seen.stamps, **NUMBERS[name]).error(seen)
        assert np.abs(error[seen.servo_us > 6_000_000]).max() < 2.5, name


def test_the_firmware_on_a_perfect_network(clocks: dict[str, ModuleType], perfect: str) -> None:
    firmware, seen = clocks["firmware"], a_scene(clocks, perfect, 12_000_000)
    for method in (firmware.BOUNDS, firmware.AVERAGE):
        told = firmware.follow(seen, firmware.settings_of(method, seen.stamps.least))
        late = seen.servo_us > 6_000_000
        assert np.abs(told.error[late]).max() < 2.5
        assert told.settled[late].all() and told.excluded == 0 and not told.violations.any()
        assert (told.most - told.least)[late].max() < 5


def test_a_wrong_least_delay_is_found_out(clocks: dict[str, ModuleType]) -> None:
    """The judge must be able to say no: 300 us that are not there, and the truth is outside."""
    firmware, exchanges = clocks["firmware"], clocks["exchanges"]
    seen = a_scene(clocks, "usb-iid", 4_000_000)
    settings = firmware.settings_of(firmware.BOUNDS, exchanges.Least(300, 0))
    assert firmware.follow(seen, settings).violations.sum() > 100


# The search.


@given(
    st.integers(0, 2**32),
    st.integers(1, 30),
    st.dictionaries(
        st.text(max_size=3), st.tuples(st.floats(1e-6, 1), st.floats(1, 1e6)), max_size=3
    ),
)
def test_the_search_returns_the_best_of_its_draws(
    clocks: dict[str, ModuleType], seed: int, draws: int, ranges: dict[str, tuple[float, float]]
) -> None:
    asked: list[tuple[dict[str, float], float]] = []

    def score(point: dict[str, float]) -> float:
        value = sum(abs(math.log(x) - 1) for x in point.values())
        asked.append((point, value if len(asked) % 3 else float("nan")))
        return asked[-1][1]

    best, least = clocks["search"].search(score, ranges, draws, np.random.default_rng(seed))
    assert len(asked) == draws
    good = [value for _, value in asked if value == value]
    assert least == min(good, default=np.inf)
    assert not good or (best, least) in asked
    for point, _ in asked:
        assert list(point) == list(ranges)
        assert all(
            low * (1 - 1e-9) <= point[name] <= high * (1 + 1e-9)
            for name, (low, high) in ranges.items()
        )


def test_a_search_needs_draws_and_positive_ranges(clocks: dict[str, ModuleType]) -> None:
    for ranges, draws in (({"a": (0.0, 1.0)}, 3), ({"a": (2.0, 1.0)}, 3), ({"a": (1.0, 2.0)}, 0)):
        with pytest.raises(ValueError, match="at least one draw"):
            clocks["search"].search(lambda p: 0.0, ranges, draws, np.random.default_rng(0))


# Quantiles.


def test_quantiles_of_a_tally(clocks: dict[str, ModuleType]) -> None:
    values = np.random.default_rng(3).normal(0, 40, 200_000)
    whole, part = clocks["tally"].Tally(), clocks["tally"].Tally()
    whole.add(values[:150_000])
    part.add(values[150_000:].reshape(2, -1))
    whole.merge(part)
    for share in (0.5, 0.99, 0.999):
        exact = np.quantile(np.abs(values), share)
        assert exact * 0.995 <= whole.quantile(share) <= exact * 1.015
    assert whole.quantile(1.0) == whole.largest == np.abs(values).max()
    part.add(np.array([np.nan]))
    assert part.quantile(1.0) == np.inf
    assert math.isnan(clocks["tally"].Tally().quantile(0.5))


def test_a_tally_is_what_it_was_after_a_file(clocks: dict[str, ModuleType]) -> None:
    tally = clocks["tally"].Tally()
    tally.add(np.random.default_rng(3).normal(0, 40, 1000))
    tally.add(np.array([np.inf]))
    again = clocks["tally"].Tally.of(json.loads(json.dumps(tally.told())))
    assert (again.counts == tally.counts).all() and again.largest == tally.largest


# A campaign.


def test_a_campaign_goes_on_where_it_was(clocks: dict[str, ModuleType], tmp_path: Path) -> None:
    campaign, path, called = clocks["campaign"], tmp_path / "results", list[int]()

    def job(number: int) -> list[float]:
        called.append(number)
        return [number / 3, math.inf]

    tasks = [campaign.Task(f"job {i}", job, i) for i in range(9)]
    with ThreadPoolExecutor(1) as pool:
        campaign.Campaign(pool, campaign.Journal(path, "this"), math.inf).run("", tasks[:4])
        with path.open("a") as file:
            file.write('{"job 8": [1.0')  # it was ended amid a line
        journal = campaign.Journal(path, "this")
        going_on = campaign.Campaign(pool, journal, math.inf)
        going_on.run("", tasks)
        assert going_on.complete and called == list(range(9))
        assert journal.found == {f"job {i}": [i / 3, math.inf] for i in range(9)}
        late = campaign.Campaign(pool, campaign.Journal(tmp_path / "others", "this"), 0)
        late.run("", tasks)
        assert not late.complete and len(called) == 9
    assert campaign.Journal(path, "this").found == journal.found
    with pytest.raises(SystemExit, match="of other sources"):
        campaign.Journal(path, "that")


# The tightest interval.


def test_two_proofs_by_hand(clocks: dict[str, ModuleType]) -> None:
    """The lower one is carried to now by the whole drift; the upper one by the skew of a line
    through both, since a greater one would have been below the lower proof."""
    tight = clocks["tight"]
    two = tight.Proofs(np.array([3e5, 1e5]), np.array([-5.0, 7.0]), np.array([False, True]))
    low, high = tight.tightest(two, 200.0, 1.0)
    assert low == pytest.approx(-5 - 200e-6 * 3e5, abs=0.01)
    assert high == pytest.approx(7 + 12 / 2e5 * 1e5, abs=0.03)


def test_wander_by_hand(clocks: dict[str, ModuleType]) -> None:
    """Two pairs fix a skew of 50 ppm; from the last of them on it may change evenly."""
    tight = clocks["tight"]
    age = np.repeat([1.2e7, 1.1e7, 1e7], 2)
    value = 50e-6 * (1.2e7 - age)
    both = tight.Proofs(age, value, np.tile([False, True], 3))
    low, high = tight.tightest(both, 200.0, 1.0, node_us=8000, node_share=0.005)
    bend = 1e-12 * 1e7**2 / 2
    # Between the pairs the skew had a second each to swing, which they leave it at the end.
    assert high - 50e-6 * 1.2e7 == pytest.approx(bend, rel=0.12)
    assert 50e-6 * 1.2e7 - low == pytest.approx(bend, rel=0.12)


@pytest.mark.parametrize("profile", ["usb", "usb-iid", "wifi"])
def test_nothing_is_narrower(clocks: dict[str, ModuleType], profile: str) -> None:
    """Not the firmware, which is nearly as narrow; and stamps that are left out do not matter."""
    tight, firmware = clocks["tight"], clocks["firmware"]
    seen = a_scene(clocks, profile, 3_000_000)
    told = firmware.follow(seen, firmware.settings_of(firmware.BOUNDS, seen.stamps.least))
    for i in (1500, 2900):
        now = int(seen.servo_ticks[i])
        base = int(seen.servo_us[i]) + clocks["exchanges"].EPOCH_US - now
        known = tight.proofs(seen.stamps, now, now, base)
        low, high = tight.tightest(known, firmware.DRIFT_PPM, 1.0)
        assert low <= 1 and high >= -1  # the truth is 0, but for the count's microsecond
        assert high - low <= told.most[i] - told.least[i] + 0.05
        assert told.most[i] - told.least[i] <= 1.3 * (high - low)
        ages = np.unique(np.concatenate((known.age, tight._nodes(known.age.max(), 16e3, 0.01))))
        whole = tight._Path(ages[::-1], firmware.DRIFT_PPM, 1.0)
        assert whole.extreme(known, 1.0)[0] == pytest.approx(low, abs=0.1)
        assert whole.extreme(known, -1.0)[0] == pytest.approx(high, abs=0.1)


def test_proofs_that_contradict_each_other(clocks: dict[str, ModuleType]) -> None:
    tight = clocks["tight"]
    wrong = tight.Proofs(np.array([2e5, 1e5]), np.array([100.0, 7.0]), np.array([False, True]))
    with pytest.raises(ArithmeticError, match="no path"):
        tight.tightest(wrong, 200.0, 1.0)


# Boards beside each other.


def test_a_chain_tells_the_truth(clocks: dict[str, ModuleType]) -> None:
    boards, method = clocks["boards"], clocks["firmware"].BOUNDS
    ran = boards.run(boards.chain("usb-iid", method, np.random.default_rng(4)), 2_500_000)
    late = ran.true_us > 1_500_000
    assert ran.settled[late].all() and not ran.violations.any() and ran.excluded == 0
    assert np.abs(ran.error[late]).max() < 200
    half = ((ran.most - ran.least) / 2)[late].mean(axis=0)
    assert (np.diff(half) > 0).all()  # each hop adds to what is not known
    again = boards.run(boards.chain("usb-iid", method, np.random.default_rng(4)), 2_500_000)
    assert (again.error == ran.error).all()


@pytest.mark.parametrize("profile", ["usb", "usb-iid", "awful"])
def test_nothing_is_narrower_in_a_chain(clocks: dict[str, ModuleType], profile: str) -> None:
    """By what its neighbours say no board is narrower than allowed, and the truth is allowed."""
    boards, heard, tight = clocks["boards"], clocks["heard"], clocks["tight"]
    exchanges, told_ppm = clocks["exchanges"], clocks["firmware"].DRIFT_PPM
    rng, method = np.random.default_rng(6), clocks["firmware"].BOUNDS
    made = boards.chain(profile, method, rng, None, heard.Tapped)
    least_us = exchanges.least_of(profiles.PROFILES[profile].to_device, exchanges.REQUEST_BYTES)
    for true_us in (2_000_300, 4_000_700):
        made.advance(true_us)
        for board in range(1, 5):
            told, tightest = heard.widths(made, board, 1000, least_us, told_ppm, 1.0)
            assert tightest - 0.05 <= told <= 1.3 * tightest
            crystal = made.crystals[board]
            now = int(exchanges.ticks_of(crystal, np.array([true_us]))[0])
            base = true_us + exchanges.EPOCH_US - now
            known = heard.proofs(made.heard[board], crystal, now, least_us, base)
            low, high = tight.tightest(known, told_ppm, 1.0)
            assert low <= 1 and high >= -1


def test_a_cascade_on_a_perfect_network(clocks: dict[str, ModuleType], perfect: str) -> None:
    exchanges, rng = clocks["exchanges"], np.random.default_rng(5)
    seen = exchanges.scene(perfect, 12_000_000, rng, None)
    true_us = np.arange(6_000_000, 11_900_000, 1000)
    for _ in range(3):
        curve = clocks["rivals"].alpha_beta(seen.stamps, **NUMBERS["half trip"])
        error = curve.shown(seen)(true_us) - true_us - exchanges.EPOCH_US
        assert np.abs(error).max() < 5
        seen = exchanges.hop(perfect, 12_000_000, 4096, rng, None)(curve.shown(seen))


def two_boards(clocks: dict[str, ModuleType], delay_us: int) -> Boards:
    """One beside the other, behind a host, on wires without jitter."""
    method = clocks["firmware"].BOUNDS
    settings = [
        clocks["boards"].board_settings("usb-iid", 1 << port, method, None) for port in (2, 1)
    ]
    wire = [
        Wire(Channel(delay_us=delay_us, jitter_us=0, loss=0.0), np.random.default_rng(i))
        for i in range(4)
    ]
    cable = Cable((End(0, 2), End(1, 1)), (wire[0], wire[1]))
    host = Host(0, settings[0].key, (wire[2], wire[3]), 10**15, 500, 4096, np.random.default_rng(9))
    crystals = [Crystal(7, 90_000), Crystal(2**32 - 5, -90_000)]
    return Boards(settings, crystals, [cable], np.random.default_rng(8), [host])


def test_two_boards_and_a_host(clocks: dict[str, ModuleType]) -> None:
    boards = two_boards(clocks, 200)
    boards.advance(3_000_000)
    assert all(node.synced for node in boards.nodes)
    # The least delays are not known, but equal both ways: the middle is right.
    assert np.abs(np.array(boards.shown_us()) - 10**15 - 3_000_000).max() <= 8
    for least, most in boards.told_ns():
        assert least <= 1000 and most >= -1000
    boards.cut_hosts(True)
    boards.advance(4_000_000)
    heard = boards.nodes[0].status.heard_us
    assert heard <= 10**15 + 3_000_000
    boards.cut_hosts(False)
    boards.advance(4_100_000)
    assert boards.nodes[0].status.heard_us > heard


def test_boards_are_polled_at_their_servo_periods(clocks: dict[str, ModuleType]) -> None:
    """By their own counters: the one whose oscillator is fast has more of them."""
    boards = two_boards(clocks, 200)
    polled: list[list[int]] = [[], []]
    for i in (0, 1):
        boards.encoders[i] = lambda true_us, i=i: polled[i].append(true_us) or 0  # type: ignore[misc]
    boards.advance(2_000_000)
    for i, crystal in enumerate((Crystal(7, 90_000), Crystal(2**32 - 5, -90_000))):
        counter, times = _board.Oscillator(*crystal), np.array(polled[i])
        assert (np.diff(times) >= 0).all()
        passed = (counter.counts(times).astype(int) - crystal.offset) % 2**32
        before = (counter.counts(times - 1).astype(int) - crystal.offset) % 2**32
        at_period = (passed // 1000 > before // 1000) | (times == 0)
        periods = 2_000_000 * (1 + crystal.drift_ppb * 1e-9) // 1000 + 1
        assert len(np.unique(passed[at_period] // 1000)) == periods
        # The others are arrivals: the host's 488 frames, and what the two have asked each other.
        assert 488 < len(times) - periods < 2500


def test_random_polls_come_as_often_as_asked_for(clocks: dict[str, ModuleType]) -> None:
    method = clocks["firmware"].BOUNDS
    settings = clocks["boards"].board_settings("usb-iid", 0, method, None)
    alone = Boards([settings], [Crystal()], [], np.random.default_rng(8), poll_us=100)
    polled: list[int] = []
    alone.encoders[0] = lambda true_us: polled.append(true_us) or 0  # type: ignore[func-returns-value]
    alone.advance(4_000_000)
    assert 43_000 <= len(polled) <= 45_000  # 1000 a second and 10000 a second
    pauses = np.diff(np.setdiff1d(polled, np.arange(0, 4_000_001, 1000)))
    assert 1 <= pauses.min() <= 5 and 195 <= pauses.max() <= 398


def test_boards_without_settings_are_not_polled() -> None:
    node = _board.Node(np.zeros(_board.NODE_NUMBERS))
    with pytest.raises(ValueError, match="needs settings"):
        _board.Polled().add(node, 0, 1)
