"""A reference worked out for many ticks at once is that reference."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from headway.controller.ahead import TICKS, Ahead
from headway.controller.motion import Motion

Array = NDArray[np.float64]
KNOT_US, KNOTS, INTERVALS = 4096, 12, 4


class Cubic:
    """Tells what time it was asked for, on two axes."""

    asked = 0

    def __init__(self, factor: float) -> None:
        self._factor = factor

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        self.asked += 1
        t = time_s[:, None] * np.array([1.0, -2.0])
        return self._factor * t**3, 3 * self._factor * t**2, 6 * self._factor * t


@given(
    st.lists(st.tuples(st.integers(0, 3 * TICKS), st.booleans()), min_size=1, max_size=30),
    st.integers(-(10**9), 10**9),
)
def test_at_any_knot_it_is_the_reference_that_is_followed(
    asked: list[tuple[int, bool]], start_us: int
) -> None:
    """Knots forwards and back, and now and then another reference."""
    ahead, factor = Ahead(KNOT_US, KNOTS, INTERVALS), 1.0
    ahead.follow(Cubic(factor), start_us)
    for knot, another in asked:
        if another:
            factor += 1
            ahead.follow(Cubic(factor), start_us)
        time_s, states = ahead.at(knot)
        nodes_us = [(knot + KNOTS // INTERVALS * i) * KNOT_US for i in range(INTERVALS + 1)]
        np.testing.assert_allclose(time_s, [(us - start_us) * 1e-6 for us in nodes_us])
        position, velocity, _ = Cubic(factor).at(time_s)
        np.testing.assert_allclose(states, np.hstack((position, velocity)), rtol=1e-12)


def test_the_reference_is_asked_once_in_many_ticks() -> None:
    ahead, cubic = Ahead(KNOT_US, KNOTS, INTERVALS), Cubic(1.0)
    ahead.follow(cubic, 0)
    for knot in range(10 * TICKS):
        ahead.at(knot)
        ahead.at(knot)
    assert cubic.asked == 10


@pytest.mark.parametrize("knots", [-1000, -7, -1, 0, 1, 5, 6, 7, 1000])
def test_a_motion_later_on_rests_beyond_its_ends(knots: int) -> None:
    motion = Motion(np.arange(21.0).reshape(7, 3))
    rows = motion.rows.tolist()
    whole = [rows[0]] * 1000 + rows + [rows[-1]] * 1000
    assert motion.later(knots).rows.tolist() == whole[1000 + knots : 1007 + knots]
