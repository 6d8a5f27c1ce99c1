"""The ring between the loop and the writer, against a queue that cannot be wrong."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from headway.controller.record.ring import Ring


@contextmanager
def both_ends(capacity: int) -> Iterator[tuple[Ring, Ring]]:
    """The pushing and the popping end, as two processes have them."""
    pushing = Ring.create(capacity)
    popping = Ring(os.dup(pushing.file), capacity)
    try:
        yield pushing, popping
    finally:
        popping.close()
        pushing.close()


@given(st.integers(1, 40), st.lists(st.one_of(st.none(), st.binary(max_size=45)), max_size=60))
def test_it_is_a_bounded_stream(capacity: int, steps: list[bytes | None]) -> None:
    """None pops; bytes are pushed, wrap around, or find no room and leave no trace."""
    stream = b""
    with both_ends(capacity) as (pushing, popping):
        for step in steps:
            if step is None:
                assert popping.pop() == stream
                stream = b""
            else:
                fits = len(stream) + len(step) <= capacity
                assert pushing.push(step) == fits
                stream += step if fits else b""
        assert popping.pop() == stream
        assert popping.pop() == b""


def test_all_of_it_can_be_used_at_every_place() -> None:
    with both_ends(7) as (pushing, popping):
        for _ in range(20):
            assert pushing.push(b"abcde") and not pushing.push(b"xyz")
            assert popping.pop() == b"abcde"
            assert pushing.push(b"1234567") and not pushing.push(b"8")
            assert popping.pop() == b"1234567"


def test_memory_that_cannot_be_had() -> None:
    with pytest.raises((OSError, ValueError, OverflowError)):
        Ring.create(-1000)
