"""The simulated network: delays and losses as configured, fates by seed, stamps as on a wire."""

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rig import device_settings
from scipy import stats

from headway.configs.load import load_config
from headway.configs.schema import Channel, Config
from headway.sim import _board
from headway.sim.bus import Bus
from headway.sim.link import SimLink
from headway.sim.network import Mailbox, Wire

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
MANY = 50_000


SIZE = 100  # bytes


class One(Wire):
    """A wire on which a packet arrives once or not at all."""

    def arrival(self, sent_us: int) -> int | None:
        arrivals = self.carry(sent_us, SIZE)
        assert len(arrivals) <= 1
        return arrivals[0] if arrivals else None


def wire(seed: int = 1, **channel: float) -> One:
    return One(Channel.model_validate(channel), np.random.default_rng(seed))


@st.composite
def channels(draw: st.DrawFn) -> dict[str, float]:
    delay = draw(st.integers(0, 50_000))
    return {
        "delay_us": delay,
        "jitter_us": draw(st.integers(0, delay)),
        "loss": draw(st.floats(0, 1)),
        "reorder": draw(st.floats(0, 1)),
        "reorder_us": draw(st.integers(0, 10_000)),
    }


@given(channels(), st.integers(0, 2**32), st.integers(-(10**15), 10**15))
def test_delay_lies_within_the_jitter(channel: dict[str, float], seed: int, sent_us: int) -> None:
    line, late = wire(seed, **channel), channel["reorder_us"] if channel["reorder"] else 0
    for _ in range(50):
        arrival_us = line.arrival(sent_us)
        if arrival_us is not None:
            assert isinstance(arrival_us, int)
            delay_us = arrival_us - sent_us
            assert abs(delay_us - channel["delay_us"]) <= channel["jitter_us"] or (
                abs(delay_us - channel["delay_us"] - late) <= channel["jitter_us"]
            )
            assert delay_us >= 0  # nothing arrives before it left


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_delays_are_uniform_over_the_jitter(seed: int) -> None:
    line = wire(seed, delay_us=3000, jitter_us=1000, loss=0)
    delays = np.array([line.arrival(0) for _ in range(MANY)], dtype=float)
    assert abs(delays.mean() - 3000) < 4 * (1000 / math.sqrt(3)) / math.sqrt(MANY)
    assert stats.kstest(delays, stats.uniform(2000, 2000).cdf).pvalue > 1e-3
    assert delays.min() < 2010 and delays.max() > 3990


@pytest.mark.parametrize("loss", [0.0, 0.01, 0.3, 1.0])
def test_losses_are_as_many_as_configured_and_counted(loss: float) -> None:
    line = wire(4, loss=loss)
    lost = sum(line.arrival(0) is None for _ in range(MANY))
    assert abs(lost - loss * MANY) <= 4 * math.sqrt(MANY * loss * (1 - loss))
    assert (line.sent, line.lost) == (MANY, lost)


def test_losses_are_independent_of_each_other() -> None:
    line = wire(5, loss=0.1)
    lost = np.array([line.arrival(0) is None for _ in range(MANY)])
    both = (lost[1:] & lost[:-1]).sum()
    assert abs(both - 0.01 * MANY) < 4 * math.sqrt(MANY * 0.01)


@pytest.mark.parametrize(("loss", "run"), [(0.01, 3.0), (0.1, 4.0), (0.3, 20.0)])
def test_losses_come_in_runs_of_the_length_asked_for(loss: float, run: float) -> None:
    """Their lengths are geometric, their share stays what it was."""
    line, count = wire(5, loss=loss, loss_run=run), 4 * MANY
    lost = np.array([line.arrival(0) is None for _ in range(count)])
    assert lost.mean() == pytest.approx(loss, abs=4 * math.sqrt(2 * run * loss / count))
    edges = np.flatnonzero(np.diff(np.concatenate(([0], lost, [0]))))
    lengths = edges[1::2] - edges[::2]
    assert abs(lengths.mean() - run) < 4 * math.sqrt(run * (run - 1) / len(lengths))
    alone = (lengths == 1).mean()
    assert abs(alone - 1 / run) < 4 * math.sqrt((1 - 1 / run) / run / len(lengths))


@given(st.integers(0, 2**32))
def test_the_same_seed_has_the_same_fate(seed: int) -> None:
    first, again = wire(seed, loss=0.3, reorder=0.2), wire(seed, loss=0.3, reorder=0.2)
    assert [first.arrival(t) for t in range(50)] == [again.arrival(t) for t in range(50)]


def test_another_seed_has_another_fate() -> None:
    assert [wire(1).arrival(0) for _ in range(20)] != [wire(2).arrival(0) for _ in range(20)]


def test_more_loss_does_not_change_the_fate_of_what_arrives() -> None:
    """So runs with and without losses can be compared."""
    sure, lossy = wire(6, loss=0, reorder=0.2), wire(6, loss=0.3, reorder=0.2)
    pairs = [(sure.arrival(t), lossy.arrival(t)) for t in range(1000)]
    assert all(b is None or a == b for a, b in pairs)
    assert any(b is None for _, b in pairs)


def overtaken(line: One, spacing_us: int) -> float:
    arrivals = np.array([line.arrival(k * spacing_us) for k in range(5000)], dtype=float)
    return float((np.diff(arrivals) < 0).mean())


def test_packets_overtake_each_other_only_where_they_can() -> None:
    steady = {"delay_us": 3000, "loss": 0}
    assert overtaken(wire(jitter_us=1000, **steady), 2000) == 0  # further apart than the jitter
    # Two uniform delays of 2 ms width differ by more than 1 ms in one case of eight.
    assert overtaken(wire(jitter_us=1000, **steady), 1000) == pytest.approx(1 / 8, abs=0.02)
    assert overtaken(wire(jitter_us=0, **steady), 1) == 0
    # One in ten is 4 ms late: the next, but for those late as well, overtakes it.
    late = overtaken(wire(jitter_us=0, reorder=0.1, reorder_us=4000, **steady), 1000)
    assert late == pytest.approx(0.09, abs=0.02)


def test_being_late_is_independent_of_loss_and_jitter() -> None:
    line = wire(7, delay_us=3000, jitter_us=1000, loss=0.5, reorder=0.5, reorder_us=100_000)
    arrived = np.array([a for a in (line.arrival(0) for _ in range(MANY)) if a is not None])
    late = arrived > 50_000
    assert abs(late.mean() - 0.5) < 4 * 0.5 / math.sqrt(len(arrived))
    slow = (arrived - 100_000 * late) > 3000
    assert abs((late & slow).mean() - 0.25) < 4 * math.sqrt(0.25 * 0.75 / len(arrived))


# Tails, copies, order, frames and bandwidth.


@pytest.mark.parametrize(("tail", "tail_us"), [(0.1, 5000), (1.0, 300)])
def test_the_tail_is_exponential(tail: float, tail_us: int) -> None:
    line = wire(8, delay_us=2000, jitter_us=0, loss=0, tail=tail, tail_us=tail_us)
    late = np.array([line.arrival(0) for _ in range(MANY)], dtype=float) - 2000
    assert late.min() >= 0
    beyond = (late > 0.5).mean()  # but for those that are rounded away
    assert abs(beyond - tail) < 4 * math.sqrt(tail * (1 - tail) / MANY) + 0.5 / tail_us
    shape = stats.kstest(
        late[late > 0.5] + np.random.default_rng(1).uniform(-0.5, 0.5, int((late > 0.5).sum())),
        stats.expon(scale=tail_us).cdf,
    )
    assert shape.statistic < 1.63 / math.sqrt(beyond * MANY) + 1 / tail_us


@pytest.mark.parametrize("duplicate", [0.0, 0.05, 1.0])
def test_as_many_copies_as_configured_each_with_a_delay_of_its_own(duplicate: float) -> None:
    line = wire(9, delay_us=3000, jitter_us=1000, loss=0.2, duplicate=duplicate)
    fates = [line.carry(0, SIZE) for _ in range(MANY)]
    arrived = [fate for fate in fates if fate]
    twice = np.array([fate for fate in arrived if len(fate) == 2], dtype=float).reshape(-1, 2)
    expected, n = duplicate, len(arrived)
    assert abs(len(twice) - expected * n) <= 4 * math.sqrt(n * expected * (1 - expected))
    assert line.duplicated == len(twice) and line.lost == MANY - n
    if len(twice):
        assert (twice[:, 1] >= twice[:, 0]).all()
        assert twice.min() >= 2000 and twice.max() <= 4000
        # The earlier of two uniform delays and the later: a third and two thirds of the way.
        assert twice.mean(axis=0) == pytest.approx([2000 + 2000 / 3, 2000 + 4000 / 3], abs=40)


full = st.fixed_dictionaries(
    {
        "delay_us": st.integers(1000, 20_000),
        "jitter_us": st.integers(0, 1000),
        "tail": st.floats(0, 1),
        "tail_us": st.integers(1, 5000),
        "loss": st.floats(0, 0.5),
        "reorder": st.floats(0, 1),
        "reorder_us": st.integers(0, 10_000),
        "duplicate": st.floats(0, 1),
        "bandwidth_bit_per_s": st.sampled_from([0, 9600, 1_000_000, 12_000_000]),
    }
)
gaps = st.lists(st.tuples(st.integers(0, 3000), st.integers(1, 1000)), min_size=1, max_size=60)


@given(full, gaps, st.integers(0, 2**32))
def test_in_order_nothing_is_overtaken(
    channel: dict[str, float], packets: list[tuple[int, int]], seed: int
) -> None:
    """And nothing else about a packet changes: it arrives when it would, or with those before."""
    kept, free = wire(seed, in_order=True, **channel), wire(seed, **channel)
    now_us = latest = 0
    for gap_us, size in packets:
        now_us += gap_us
        arrivals, would = kept.carry(now_us, size), free.carry(now_us, size)
        assert len(arrivals) == len(would)
        if would:
            assert arrivals[-1] == max(would[-1], latest)
            assert latest <= arrivals[0] <= arrivals[-1]
            latest = arrivals[-1]


@given(full, gaps, st.integers(0, 2**32))
def test_least_us_is_the_least(
    channel: dict[str, float], packets: list[tuple[int, int]], seed: int
) -> None:
    model = Channel.model_validate(channel)
    line, now_us = wire(seed, **channel), 0
    for gap_us, size in packets:
        now_us += gap_us
        assert all(a - now_us >= model.least_us for a in line.carry(now_us, size))


def test_least_us_is_reached_and_so_is_usual_most_us() -> None:
    bus = Bus.of(1000, np.random.default_rng(3))
    model = Channel(delay_us=500, jitter_us=300, loss=0, frame_us=1000, slot_us=200)
    line = Wire(model, np.random.default_rng(1), bus)
    sent_us = np.random.default_rng(2).integers(0, 10**9, MANY).tolist()
    delays = [line.carry(t, SIZE)[0] - t for t in sent_us]
    assert model.least_us == 200 and min(delays) <= 215
    assert model.usual_most_us == 1800 and 1785 <= max(delays) <= 1801


@given(gaps, st.sampled_from([9600, 115_200, 12_000_000, 10**9]))
def test_packets_are_sent_one_after_the_other(
    packets: list[tuple[int, int]], bandwidth: int
) -> None:
    """By exact fractions: a queue with one server (Lindley, 1952)."""
    line = wire(delay_us=0, jitter_us=0, loss=0, bandwidth_bit_per_s=bandwidth)
    sent_us, free = 0, Fraction(0)
    for gap_us, size in packets:
        sent_us += gap_us
        free = max(free, Fraction(sent_us)) + Fraction(8_000_000 * size, bandwidth)
        (arrival_us,) = line.carry(sent_us, size)
        # Each packet's time is rounded down to a ns, its arrival up to a us.
        assert free - Fraction(len(packets), 1000) <= arrival_us < free + 1


@given(st.integers(0, 2**32), st.integers(0, 999), st.lists(st.integers(0, 10**9), max_size=40))
def test_packets_leave_in_their_slot(seed: int, slot_us: int, times: list[int]) -> None:
    """Against all slots of the bus in floating point."""
    bus = Bus.of(1000, np.random.default_rng(seed))
    assert abs(bus.period_ps / 1e9 - 1) <= 500e-6
    for ready_us in times:
        slots = (
            bus.phase_ps
            + bus.period_ps * np.arange(ready_us // 1001 - 2, ready_us // 999 + 2, dtype=float)
        ) * 1e-6 + slot_us
        first = slots[slots >= ready_us - 1e-4].min()
        assert first - 1e-3 <= bus.leave(ready_us, slot_us) <= first + 1.001
    line = Wire(
        Channel(delay_us=7, jitter_us=0, loss=0, frame_us=1000, slot_us=slot_us),
        np.random.default_rng(1),
        bus,
    )
    for ready_us in times:
        assert line.carry(ready_us, SIZE) == [bus.leave(ready_us, slot_us) + 7]


@given(st.integers(0, 2**32), st.integers(1000, 10**12))
def test_starts_of_frames(seed: int, true_us: int) -> None:
    bus = Bus.of(1000, np.random.default_rng(seed))
    number, start_us = bus.frame_start(true_us)
    assert true_us - 1001 <= start_us <= true_us
    assert bus.leave(true_us - 1001, 0) <= start_us == bus.leave(start_us - 1, 0)
    after, next_us = bus.frame_start(start_us + 1001)
    assert after == (number + 1) % 2048 and 998 <= next_us - start_us <= 1002


def test_rates_and_phases_of_buses_differ() -> None:
    buses = [Bus.of(1000, np.random.default_rng(seed)) for seed in range(200)]
    rates = np.array([bus.period_ps / 1e9 - 1 for bus in buses])
    assert rates.min() < -450e-6 and rates.max() > 450e-6
    assert len({bus.phase_ps for bus in buses}) == 200


@pytest.mark.parametrize("epoch_us", [0, 12_345_678])
def test_a_board_sees_the_starts_of_its_buss_frames(epoch_us: int) -> None:
    """With the count of that moment, by its own oscillator, late by 100 ns at most."""
    bus = Bus.of(1000, np.random.default_rng(5))
    node = _board.Node(np.zeros(_board.NODE_NUMBERS))
    numbers = (99, 20_000, 500, 30_000, 7)
    node.flash(device_settings(), *numbers)
    node.poll(epoch_us, 0)
    assert node.sof is None
    node.join_bus(bus.phase_ps, bus.period_ps, seed=3)
    oscillator = _board.Oscillator(*numbers)
    seen = set()
    for now_us in range(epoch_us + 2000, epoch_us + 3_000_000, 250):
        node.poll(now_us, 0)
        number, start_us = bus.frame_start(now_us)
        assert node.sof is not None and node.sof[0] == number
        assert node.sof[1] - oscillator.count_at(start_us) in (-1, 0)
        seen.add(number)
    assert seen == set(range(2048))


def test_a_channel_with_frames_needs_a_bus() -> None:
    with pytest.raises(ValueError, match="of a bus"):
        wire(frame_us=1000)
    for mistake in ((-1, 1000), (0, 0)):
        with pytest.raises(ValueError, match="phase from 0"):
            _board.Node(np.zeros(_board.NODE_NUMBERS)).join_bus(*mistake)


# The mailbox.


@given(
    st.lists(st.tuples(st.integers(0, 100), st.integers(0, 3)), max_size=30),
    st.lists(st.integers(0, 110), max_size=5),
)
def test_a_mailbox_hands_out_by_arrival_each_packet_once(
    packets: list[tuple[int, int]], times: list[int]
) -> None:
    box, expected = Mailbox(), []
    for number, (arrival_us, device) in enumerate(packets):
        box.put(arrival_us, device, str(number).encode())
        expected.append((device, arrival_us, str(number).encode()))
    expected.sort(key=lambda item: item[1])  # stable: of equals, the first sent comes first
    taken = []
    for now_us in [*sorted(times), 110]:
        batch = box.take(now_us)
        assert all(arrival_us <= now_us for _, arrival_us, _ in batch)
        taken += batch
        later = [item for item in expected if item[1] <= now_us]
        assert taken == later  # all that has arrived, and nothing else
    assert taken == expected
    assert box.take(10**18) == []


# The link of a simulated machine.


class Board:
    """Stands in for a node: says what it sent, remembers what arrives."""

    def __init__(self, sent: list[tuple[int, bytes]]) -> None:
        self.sent = sent
        self.arrived: list[tuple[int, bytes]] = []

    def collect(self) -> list[tuple[int, bytes]]:
        sent, self.sent = self.sent, []
        return sent

    def deliver(self, arrival_us: int, packet: bytes) -> bool:
        self.arrived.append((arrival_us, packet))
        return True


class Boards:
    def __init__(self, *nodes: Board) -> None:
        self.nodes = nodes


EPOCH_US = 1_700_000_000_000_000


def config_with(to_device: dict[str, float], to_host: dict[str, float]) -> Config:
    config = load_config(CONFIGS / "arm2.yaml")
    sim = config.sim.model_copy(
        update={
            "to_device": Channel.model_validate(to_device),
            "to_host": Channel.model_validate(to_host),
        }
    )
    return config.model_copy(update={"sim": sim})


def link_to(boards: Boards, config: Config, seed: int = 1) -> SimLink:
    seeds = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4)]
    return SimLink(config, boards, EPOCH_US, seeds)  # type: ignore[arg-type]


STEADY = {"delay_us": 3000, "jitter_us": 0, "loss": 0}


def test_packets_to_the_host_are_stamped_in_the_hosts_time() -> None:
    boards = Boards(Board([(100, b"a"), (900, b"c")]), Board([(500, b"b")]))
    link = link_to(boards, config_with(STEADY, {**STEADY, "delay_us": 2000}))
    link.collect()
    assert link.receive(EPOCH_US + 2099) == []
    assert link.receive(EPOCH_US + 2100) == [(0, EPOCH_US + 2100, b"a")]
    assert link.receive(EPOCH_US + 10_000) == [
        (1, EPOCH_US + 2500, b"b"),
        (0, EPOCH_US + 2900, b"c"),
    ]
    link.collect()
    assert link.receive(EPOCH_US + 10**9) == []


def test_packets_to_a_device_arrive_by_true_time() -> None:
    boards = Boards(Board([]), Board([]))
    link = link_to(boards, config_with({**STEADY, "delay_us": 1500}, STEADY))
    link.send(1, b"plan", EPOCH_US + 4000)
    assert boards.nodes[0].arrived == []
    assert boards.nodes[1].arrived == [(5500, b"plan")]


def test_a_lost_packet_never_arrives() -> None:
    lost = {**STEADY, "loss": 1}
    boards = Boards(Board([(100, b"a")]), Board([]))
    link = link_to(boards, config_with(lost, lost))
    link.collect()
    link.send(0, b"plan", EPOCH_US)
    assert boards.nodes[0].arrived == [] and link.receive(EPOCH_US + 10**9) == []
    assert [w.lost for w in (*link.to_device, *link.to_host)] == [1, 0, 1, 0]


def test_each_direction_of_each_device_has_its_own_luck() -> None:
    link = link_to(Boards(Board([]), Board([])), load_config(CONFIGS / "arm2.yaml"))
    wires = [*link.to_device, *link.to_host]
    assert len({tuple((w.carry(0, SIZE) or [0])[0] for _ in range(20)) for w in wires}) == 4


def test_a_copy_arrives_as_well() -> None:
    twice = {**STEADY, "duplicate": 1}
    boards = Boards(Board([(100, b"a")]), Board([]))
    link = link_to(boards, config_with(twice, twice))
    link.collect()
    link.send(1, b"plan", EPOCH_US)
    assert boards.nodes[1].arrived == [(3000, b"plan"), (3000, b"plan")]
    assert link.receive(EPOCH_US + 10**6) == [(0, EPOCH_US + 3100, b"a")] * 2


def test_all_wires_share_a_bus() -> None:
    framed = {**STEADY, "frame_us": 1000}
    boards = Boards(Board([(100, b"a")]), Board([(300, b"b")]))
    seeds = [np.random.default_rng(s) for s in np.random.SeedSequence(1).spawn(5)]
    link = SimLink(config_with(framed, framed), boards, EPOCH_US, seeds)  # type: ignore[arg-type]
    assert link.bus is not None
    slot_us = link.bus.leave(300, 0)
    link.collect()
    arrivals = [at_us for _, at_us, _ in link.receive(EPOCH_US + 10**6)]
    assert arrivals[1] - EPOCH_US == slot_us + 3000
    assert (slot_us + 3000 - (arrivals[0] - EPOCH_US)) in (0, 999, 1000, 1001)
    link.send(0, b"plan", EPOCH_US + 250)
    assert boards.nodes[0].arrived[0][0] == link.bus.leave(250, 0) + 3000


def test_what_arrived_before_the_hosts_clock_jumped_keeps_its_stamp() -> None:
    boards = Boards(Board([(100, b"a"), (900, b"b")]), Board([]))
    link = link_to(boards, config_with(STEADY, STEADY))
    link.step_clock(3500, 1_000_000)
    now_us = EPOCH_US + 1_000_000
    assert link.receive(now_us + 3800) == [(0, EPOCH_US + 3100, b"a")]
    assert link.receive(now_us + 3900) == [(0, now_us + 3900, b"b")]
    link.send(1, b"plan", now_us + 5000)
    assert boards.nodes[1].arrived == [(8000, b"plan")]
