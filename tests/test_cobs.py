"""COBS against an independent implementation (PyPI `cobs`)."""

import pytest
from cobs import cobs
from hypothesis import example, given
from hypothesis import strategies as st

from headway.firmware import _core

# Long runs without a zero, and their ends near a block's 254 bytes, are where encoders err.
runs = st.lists(
    st.tuples(st.sampled_from([0, 1, 2, 251, 252, 253, 254, 255, 256, 508]), st.booleans()),
    max_size=4,
).map(lambda parts: b"".join(b"\x01" * n + b"\0" * zero for n, zero in parts))
packets = st.binary(max_size=60) | runs


@given(packets)
@example(b"")
@example(b"\0")
def test_encodes_as_the_oracle_and_back(packet: bytes) -> None:
    encoded = _core.cobs_encode(packet)
    assert encoded == cobs.encode(packet)
    assert 0 not in encoded
    assert len(encoded) <= len(packet) + len(packet) // 254 + 1  # COBS_BOUND
    assert _core.cobs_decode(encoded) == packet


@pytest.mark.parametrize("size", [*range(252, 258), *range(506, 513), *range(760, 766), 1020])
@pytest.mark.parametrize("tail", [b"", b"\0", b"\x07", b"\0\0", b"\0\x07"])
def test_lengths_around_whole_blocks(size: int, tail: bytes) -> None:
    for head in (b"", b"\0", b"\x05\0"):
        packet = head + b"\xaa" * (size - len(head)) + tail
        encoded = _core.cobs_encode(packet)
        assert encoded == cobs.encode(packet)
        assert 0 not in encoded
        assert _core.cobs_decode(encoded) == packet


@given(st.binary(min_size=1, max_size=40) | runs.filter(len).map(cobs.encode))
def test_decodes_or_refuses_as_the_oracle(encoded: bytes) -> None:
    try:
        expected = cobs.decode(encoded)
    except cobs.DecodeError:
        expected = None
    assert _core.cobs_decode(encoded) == expected


@given(runs, st.data())
def test_truncated_block_is_refused(packet: bytes, data: st.DataObject) -> None:
    packet += b"\x09"  # so that the last block is more than its length byte
    encoded = _core.cobs_encode(packet)
    last = 0  # where the last block begins
    while last + encoded[last] < len(encoded):
        last += encoded[last]
    cut = data.draw(st.integers(last + 1, len(encoded) - 1))
    assert _core.cobs_decode(encoded[:cut]) is None


@given(packets, st.data())
def test_zero_inside_is_refused(packet: bytes, data: st.DataObject) -> None:
    encoded = bytearray(_core.cobs_encode(packet))
    encoded[data.draw(st.integers(0, len(encoded) - 1))] = 0
    assert _core.cobs_decode(bytes(encoded)) is None


def test_nothing_is_no_packet() -> None:
    assert _core.cobs_decode(b"") is None
