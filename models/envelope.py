"""What a joint has to move and to hold: inertias and static load over the machine's range."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from headway.models.machine import Machine

Array = NDArray[np.float64]

SAMPLES, SAMPLES_OF_MANY = 4096, 1024  # configurations, spread evenly over the range
MANY = 8  # joints


@dataclass(frozen=True)
class Envelope:
    """By joint, over all sampled configurations; SI."""

    inertia_max: Array  # with all other joints locked: the mass matrix' diagonal
    inertia_min: Array  # with all other joints free: one over the inverse's diagonal
    holding_max: Array  # magnitude of gravity's effort
    mobility: Array  # the sampled mass matrices' inverses (m, n, n)
    gravity_stiffness: Array  # gravity's effort by position (m, n, n): negative where it topples

    def fastest(self, damping: Array) -> tuple[float, Array]:
        """Largest decay rate [1/s] of the joints together under viscous damping (n,), and by joint
        the share that its damping has in it."""
        root = np.sqrt(damping)
        rates, modes = np.linalg.eigh(root[:, None] * self.mobility * root)
        pose = int(rates[:, -1].argmax())
        return float(rates[pose, -1]), modes[pose, :, -1] ** 2

    def toppling(self, stiffness: Array) -> tuple[float, Array]:
        """Share of the joints' stiffness (n,) that gravity takes in the worst pose, where one would
        be all of it, and by joint its part in that."""
        root = 1 / np.sqrt(stiffness)
        shares, modes = np.linalg.eigh(-root[:, None] * self.gravity_stiffness * root)
        pose = int(shares[:, -1].argmax())
        return float(shares[pose, -1]), modes[pose, :, -1] ** 2


def postures(low: Array, high: Array) -> Array:
    """Configurations (m, n) all over the range: a Sobol sequence, its corners and its middle."""
    n = len(low)
    count = SAMPLES if n <= MANY else SAMPLES_OF_MANY
    shares = qmc.Sobol(n, rng=np.random.default_rng(0)).random(count)
    corners = np.array(np.meshgrid(*[(0.0, 0.5, 1.0)] * min(n, 6))).reshape(min(n, 6), -1).T
    padded = np.full((len(corners), n), 0.5)
    padded[:, : corners.shape[1]] = corners
    all_shares: Array = np.vstack((shares, padded))
    return low + all_shares * (high - low)


def envelope(machine: Machine, low: Array, high: Array) -> Envelope:
    """Over the range (n,) to (n,), as `postures` samples it."""
    at = postures(low, high)
    matrices = machine.mass(at)
    mobility = np.linalg.inv(matrices).astype(float)
    return Envelope(
        np.diagonal(matrices, axis1=1, axis2=2).max(axis=0),
        (1 / np.diagonal(mobility, axis1=1, axis2=2)).min(axis=0),
        np.abs(machine.holding(at)).max(axis=0),
        mobility,
        machine.holding_slope(at),
    )
