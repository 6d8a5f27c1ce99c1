"""The tightest interval that stamps allow: a linear program over all that an oscillator may do."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.sparse import coo_array

from clocks.exchanges import Stamps

AGE_MAX_US = 1 << 25  # as in firmware/bounds.h
STAMP_US = 1  # by which rounding may make a stamp too early, as in firmware/sync.c
NODE_US, NODE_SHARE = 16_000, 0.01  # between the path's nodes: at least, and of their age
BIN_US, BIN_SHARE = 64_000, 0.02  # a first choice of stamps: the best of each bin
ROUNDS, MORE = 16, 60
TOLERANCE_US = 0.02  # by which the optimal path may contradict a stamp that was left out

Array = NDArray[np.float64]


class Proofs(NamedTuple):
    """theta >= value (or <=) at an age [us] before now, of shape (n,) each."""

    age: Array
    value: Array  # the upstream clock minus the ticks, minus a base [us]
    upper: NDArray[np.bool_]


def proofs(stamps: Stamps, now_ticks: int, known_ticks: int, base_us: int) -> Proofs:
    """What the frames say that had arrived at `known_ticks`; `base_us` is the upstream clock minus
    the ticks, nearly."""
    first = np.searchsorted(stamps.arrived_ticks, now_ticks - AGE_MAX_US)
    known = slice(int(first), int(np.searchsorted(stamps.arrived_ticks, known_ticks, "right")))
    arrived, echo = stamps.arrived_ticks[known], stamps.echo_ticks[known]
    received = stamps.received_upstream[known]
    echoed = (received != 0) & (echo >= now_ticks - AGE_MAX_US)
    lower = stamps.sent_upstream[known] - arrived - base_us - STAMP_US + stamps.least.to_here
    upper = (received - echo)[echoed] - base_us + STAMP_US - stamps.least.to_there
    return Proofs(
        now_ticks - np.concatenate((arrived, echo[echoed])).astype(float),
        np.concatenate((lower, upper)).astype(float),
        np.repeat((False, True), (len(lower), len(upper))),
    )


def _choose(p: Proofs) -> NDArray[np.bool_]:
    """The best of each bin of ages and side, seen along the general trend."""
    residual = p.value - np.polyval(np.polyfit(p.age, p.value, 1), p.age)
    residual = np.where(p.upper, residual, -residual)
    bins = np.where(
        p.age < BIN_US / BIN_SHARE,
        p.age // BIN_US,
        1000 + np.log(np.maximum(p.age, 1)) // np.log1p(BIN_SHARE),
    )
    order = np.lexsort((residual, bins, p.upper))
    begins = np.ones(len(order), dtype=bool)
    begins[1:] = (np.diff(bins[order]) != 0) | np.diff(p.upper[order])
    chosen = np.zeros(len(order), dtype=bool)
    chosen[order[begins]] = True
    return chosen


def _nodes(oldest_us: float, node_us: float, share: float) -> Array:
    """Ages, the oldest first, to 0."""
    ages = [0.0]
    while ages[-1] < oldest_us:
        ages.append(ages[-1] + max(node_us, share * ages[-1]))
    return np.array(ages[::-1])


class _Path:
    """theta [us] and skew [ppm] at nodes; between them the skew changes evenly."""

    def __init__(self, age: Array, drift_ppm: float, wander_ppm_per_s: float) -> None:
        self.age, n = age, len(age)
        step = -np.diff(age)
        k = np.arange(n - 1)
        one, half = np.ones(n - 1), step * 0.5e-6
        wander = wander_ppm_per_s * step * 1e-6
        # Of all paths from one theta and skew to others in `step`, the furthest are within this.
        bend = wander_ppm_per_s * 1e-12 * step**2 / 4
        rows, columns, values, limits = [], [], [], []
        for i, sign in enumerate((1.0, -1.0)):
            skew_row, theta_row = 2 * i * (n - 1) + k, (2 * i + 1) * (n - 1) + k
            rows += [skew_row, skew_row, theta_row, theta_row, theta_row, theta_row]
            columns += [n + k + 1, n + k, k + 1, k, n + k, n + k + 1]
            values += [one, -one, one, -one, -half, -half]
            values[-6:] = [sign * v for v in values[-6:]]
            limits += [wander, bend]
        self._parts = [np.concatenate(part) for part in (rows, columns, values)]
        self._limits = np.concatenate(limits)
        self._bounds = np.column_stack(
            (
                np.repeat((-np.inf, -drift_ppm), n),
                np.repeat((np.inf, drift_ppm), n),
            )
        )

    def place(self, age: Array) -> tuple[NDArray[np.intp], Array]:
        """Index of the node before, and the share of the way to the next, of shape (m,)."""
        k = np.clip(np.searchsorted(-self.age, -age, "right") - 1, 0, len(self.age) - 2)
        return k, (self.age[k] - age) / (self.age[k] - self.age[k + 1])

    def extreme(self, p: Proofs, sign: float) -> tuple[float, Array]:
        """The least theta now (with sign -1: the largest), and the path there: values at nodes.
        Raises ArithmeticError if the proofs contradict each other."""
        n = len(self.age)
        k = np.rint(np.interp(-p.age, -self.age, np.arange(n))).astype(int)  # it is a node
        side = np.where(p.upper, 1.0, -1.0)
        rows, columns, values = self._parts
        m = len(self._limits)
        matrix = coo_array(
            (
                np.concatenate((values, side)),
                (np.concatenate((rows, m + np.arange(len(k)))), np.concatenate((columns, k))),
            ),
            shape=(m + len(k), 2 * n),
        )
        cost = np.zeros(2 * n)
        cost[n - 1] = sign
        found = linprog(
            cost,
            A_ub=matrix.tocsr(),
            b_ub=np.concatenate((self._limits, side * p.value)),
            bounds=self._bounds,
            method="highs",
        )
        if found.status != 0:
            raise ArithmeticError(f"no path: {found.message}")
        return sign * float(found.fun), found.x

    def excess(self, p: Proofs, values: Array) -> Array:
        """By how much a path contradicts proofs, of shape (m,); negative where it does not."""
        n = len(self.age)
        k, share = self.place(p.age)
        step = self.age[k] - self.age[k + 1]
        theta, skew = values[:n], values[n:]

        def bent(part: Array) -> Array:
            return skew[k] * part * step * 1e-6 + (skew[k + 1] - skew[k]) * part**2 * step * 0.5e-6

        off = theta[k + 1] - theta[k] - bent(np.ones_like(share))
        there = theta[k] + bent(share) + off * share
        return np.where(p.upper, there - p.value, p.value - there)


def tightest(
    p: Proofs,
    drift_ppm: float,
    wander_ppm_per_s: float,
    node_us: float = NODE_US,
    node_share: float = NODE_SHARE,
) -> tuple[float, float]:
    """The least and the largest theta now [us] that no proof contradicts.

    Only the stamps that matter are in the program: a path that is optimal for some of them is held
    against all, and those that it contradicts are added, until there are none. So leaving stamps
    out loosens nothing. What does: between two nodes a path is only held to what its ends may be,
    which more nodes tighten. Raises ArithmeticError if proofs contradict each other.
    """
    chosen, found = _choose(p), []
    for sign in (1.0, -1.0):
        for _ in range(ROUNDS):
            some = Proofs(p.age[chosen], p.value[chosen], p.upper[chosen])
            nodes = _nodes(float(p.age.max()), node_us, node_share)
            path = _Path(
                np.unique(np.concatenate((nodes, some.age)))[::-1], drift_ppm, wander_ppm_per_s
            )
            value, values = path.extreme(some, sign)
            excess = np.where(chosen, -np.inf, path.excess(p, values))
            worst = np.argsort(-excess)[:MORE]
            worst = worst[excess[worst] > TOLERANCE_US]
            if not len(worst):
                break
            chosen[worst] = True
        else:
            raise ArithmeticError("still more stamps matter")
        found.append(value)
    return found[0], found[1]
