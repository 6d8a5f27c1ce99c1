"""Packets on a stream of bytes: whole, in order, whatever pieces the bytes come in."""

from hypothesis import given
from hypothesis import strategies as st

from headway.devices.stream import END, Splitter
from headway.firmware import _core

MAX = _core.PACKET_MAX
packets = st.lists(st.binary(min_size=1, max_size=40).map(lambda b: b.replace(END, b"\1")))


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    ends = sorted({cut % (len(data) + 1) for cut in cuts} | {len(data)})
    return [data[a:b] for a, b in zip([0, *ends], ends, strict=False)]


@given(packets, st.lists(st.integers(0, 10_000)))
def test_packets_come_back_whole_and_in_order(sent: list[bytes], cuts: list[int]) -> None:
    splitter, got = Splitter(), list[bytes]()
    for piece in pieces(b"".join(packet + END for packet in sent), cuts):
        got += splitter.feed(piece)
    assert got == sent and splitter.overlong == 0


@given(st.integers(0, 3 * MAX), st.lists(st.integers(0, 10_000)))
def test_what_is_too_long_is_dropped_once_and_the_next_is_good(size: int, cuts: list[int]) -> None:
    splitter, got = Splitter(), list[bytes]()
    for piece in pieces(b"x" * size + END + b"good" + END, cuts):
        got += splitter.feed(piece)
    fits = 0 < size <= MAX
    assert got == [b"x" * size, b"good"][not fits :]
    assert splitter.overlong == (size > MAX)


def test_noise_without_end_does_not_grow() -> None:
    splitter = Splitter()
    for _ in range(1000):
        assert splitter.feed(b"x" * 1000) == []
    assert len(splitter._open) == 0 and splitter.overlong == 1
    assert splitter.feed(END + b"good" + END) == [b"good"]
