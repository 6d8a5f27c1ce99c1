"""The simulated network: delays and losses as configured, fates by seed, stamps as on a wire."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from headway.configs.load import load_config
from headway.configs.schema import Channel, Config
from headway.sim.lockstep import SimLink
from headway.sim.network import Mailbox, Wire

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
MANY = 50_000


def wire(seed: int = 1, **channel: float) -> Wire:
    return Wire(Channel.model_validate(channel), np.random.default_rng(seed))


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
        arrival_us = line.carry(sent_us)
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
    delays = np.array([line.carry(0) for _ in range(MANY)], dtype=float)
    assert abs(delays.mean() - 3000) < 4 * (1000 / math.sqrt(3)) / math.sqrt(MANY)
    assert stats.kstest(delays, stats.uniform(2000, 2000).cdf).pvalue > 1e-3
    assert delays.min() < 2010 and delays.max() > 3990


@pytest.mark.parametrize("loss", [0.0, 0.01, 0.3, 1.0])
def test_losses_are_as_many_as_configured_and_counted(loss: float) -> None:
    line = wire(4, loss=loss)
    lost = sum(line.carry(0) is None for _ in range(MANY))
    assert abs(lost - loss * MANY) <= 4 * math.sqrt(MANY * loss * (1 - loss))
    assert (line.sent, line.lost) == (MANY, lost)


def test_losses_are_independent_of_each_other() -> None:
    line = wire(5, loss=0.1)
    lost = np.array([line.carry(0) is None for _ in range(MANY)])
    both = (lost[1:] & lost[:-1]).sum()
    assert abs(both - 0.01 * MANY) < 4 * math.sqrt(MANY * 0.01)


@given(st.integers(0, 2**32))
def test_the_same_seed_has_the_same_fate(seed: int) -> None:
    first, again = wire(seed, loss=0.3, reorder=0.2), wire(seed, loss=0.3, reorder=0.2)
    assert [first.carry(t) for t in range(50)] == [again.carry(t) for t in range(50)]


def test_another_seed_has_another_fate() -> None:
    assert [wire(1).carry(0) for _ in range(20)] != [wire(2).carry(0) for _ in range(20)]


def test_more_loss_does_not_change_the_fate_of_what_arrives() -> None:
    """So runs with and without losses can be compared."""
    sure, lossy = wire(6, loss=0, reorder=0.2), wire(6, loss=0.3, reorder=0.2)
    pairs = [(sure.carry(t), lossy.carry(t)) for t in range(1000)]
    assert all(b is None or a == b for a, b in pairs)
    assert any(b is None for _, b in pairs)


def overtaken(line: Wire, spacing_us: int) -> float:
    arrivals = np.array([line.carry(k * spacing_us) for k in range(5000)], dtype=float)
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
    arrived = np.array([a for a in (line.carry(0) for _ in range(MANY)) if a is not None])
    late = arrived > 50_000
    assert abs(late.mean() - 0.5) < 4 * 0.5 / math.sqrt(len(arrived))
    slow = (arrived - 100_000 * late) > 3000
    assert abs((late & slow).mean() - 0.25) < 4 * math.sqrt(0.25 * 0.75 / len(arrived))


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
    assert len({tuple(w.carry(0) for _ in range(20)) for w in wires}) == 4
