"""The simulated machine's own account of itself, which nobody else sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from headway.controller.record.recorder import Recorder
from headway.sim.plant import Plant

TRUTH_US = 1000  # from one note to the next


def note_truth(
    record: Recorder, plant: Plant, system_us: int, reference: NDArray[np.float64]
) -> None:
    """Notes how the machine and its servos are now, at a system time; `reference` (axes,) is what
    the task wants then, NaN where nobody knows."""
    truth = plant.position, plant.velocity, plant.torque, reference
    record.add(("truth", system_us, truth))
    true_us = plant.true_us
    servos = [node.truth(true_us, system_us) for node in plant.nodes]
    nobody = (0, 0, 0, 0, 0, 0)  # on an axis without a board
    servos += [nobody] * (len(reference) - len(servos))
    record.add(("servo", system_us, tuple(zip(*servos, strict=True))))
