"""Whether axes without an encoder show in how the others move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from headway.configs.schema import Config
from headway.controller.equations import Equations
from headway.controller.prediction import ServoLaw
from headway.models.machine import Machine

Array = NDArray[np.float64]

ZERO = float(np.sqrt(np.finfo(float).eps))  # beside the largest there is


def require_observable(config: Config, machine: Machine, start: Array) -> None:
    """Raises ValueError with the axes without an encoder that cannot be estimated from the others'
    at rest where the task starts (n,), they themselves where the config says that they rest."""
    bare, axes = config.machine.bare, config.machine.axes
    if not bare:
        return
    position = start.copy()
    for i, axis in bare.items():
        position[i] = axis.rest
    rates = _rates(machine, ServoLaw.of(axes), position)
    disturbed = config.estimator.disturbance
    hidden = _hidden(rates, list(bare), disturbed)
    if not hidden:
        return
    names, there = ", ".join(axes[i].joint for i in hidden), ", ".join(f"{q:.4g}" for q in position)
    more = ""
    if disturbed and not _hidden(rates, list(bare), False):
        more = ", or set estimator.disturbance: false, as a disturbance would look the same"
    raise ValueError(
        f"{names}: without an encoder, where it is has to show in how the other axes move, and at "
        f"rest at {there}, where the task starts, it does not (it is not observable): give it an "
        f"encoder{more}"
    )


def _hidden(rates: Array, bare: list[int], disturbed: bool) -> list[int]:
    """Those of the axes `bare` whose position or speed the others' positions leave open."""
    n = len(rates) // 3
    others = [axis for axis in range(n) if axis not in bare]
    states = [*range(2 * n), *(2 * n + axis for axis in others if disturbed)]
    unseen = unobservable(rates[np.ix_(states, states)], np.eye(len(states))[others])
    of_axis = np.linalg.norm(unseen[: 2 * n].reshape(2, n, -1), axis=(0, 2))
    return [axis for axis in bare if of_axis[axis] > ZERO]


def _rates(machine: Machine, law: ServoLaw, position: Array) -> Array:
    """Slope of d/dt [q, v, d] in [q, v, d] (3n, 3n), under the efforts that hold the machine at
    rest. The servos would not change what shows: they act on what is seen."""
    n, still = len(position), np.zeros_like(position)
    effort = np.where(law.limit > 0, machine.holding(position[None])[0], 0.0)
    state = np.concatenate((position, still))
    of = Equations(machine.tree).driven_slope(state, effort, still, law.parameters)
    rates = np.zeros((3 * n, 3 * n))
    rates[:n, n : 2 * n] = np.eye(n)
    rates[n : 2 * n, : 2 * n], rates[n : 2 * n, 2 * n :] = of[1], of[2]
    return rates


def unobservable(rates: Array, seen: Array) -> Array:
    """A basis (m, k), orthonormal, of the states whose x' = rates x leaves `seen` x (p, m) at zero
    for ever: none of them is seen, and none leads to one that is. By staircase: Paige, IEEE Trans.
    Automatic Control 26, 1981.
    """
    basis = _null(seen)
    while True:
        moved = rates @ basis
        leaving = moved - basis @ (basis.T @ moved)
        inner = _null(leaving, ZERO * float(np.linalg.norm(rates, 2)))
        if inner.shape[1] == basis.shape[1]:
            return basis
        basis = basis @ inner


def _null(matrix: Array, least: float = ZERO) -> Array:
    """A basis of what the matrix takes to nothing, or to less than `least`."""
    _, sizes, rows = np.linalg.svd(matrix)
    kernel: Array = rows[int(np.sum(sizes > least)) :].T
    return kernel
