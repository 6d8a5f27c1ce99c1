"""A search that is the same for every method: at random, and as often."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def search(
    score: Callable[[dict[str, float]], float],
    ranges: dict[str, tuple[float, float]],
    draws: int,
    rng: np.random.Generator,
) -> tuple[dict[str, float], float]:
    """The best of `draws` points, uniform in the logarithm between each number's bounds, and its
    score; lower is better, NaN the worst. Raises ValueError for a bound that is not positive."""
    if draws < 1 or any(low <= 0 or high < low for low, high in ranges.values()):
        raise ValueError("at least one draw, of ranges above zero")
    best, least = dict[str, float](), np.inf
    for draw in range(draws):
        point = {
            name: float(np.exp(rng.uniform(np.log(low), np.log(high))))
            for name, (low, high) in ranges.items()
        }
        value = score(point)
        if value < least or draw == 0:
            best, least = point, value if value == value else np.inf
    return best, float(least)
