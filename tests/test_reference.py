"""References: derivatives agree, and the way in from rest."""

import numpy as np
import pytest

from headway.configs.schema import Task
from headway.controller.reference import Entry, Sines

TASK = Task.model_validate({
    "kind": "sines",
    "frequency_Hz": 0.45,
    "axes": [
        {"offset_rad": 0.7, "amplitude_rad": 0.8},
        {"offset_rad": 0.6, "amplitude_rad": 0.7, "harmonic": 2.0, "phase_rad": 0.4},
    ],
})  # fmt: skip
START = np.array([0.9, 0.2])


def differences(values: np.ndarray, step_s: float) -> np.ndarray:
    return (values[2:] - values[:-2]) / (2 * step_s)


@pytest.mark.parametrize("reference", [Sines(TASK), Entry(Sines(TASK), START, 0.0, 0.5)])
def test_derivatives_are_those_of_the_position(reference):
    step_s = 1e-4
    q, v, a = reference.at(np.arange(-0.0, 1.0, step_s))
    assert np.allclose(differences(q, step_s), v[1:-1], atol=1e-5)
    # At the entry's end the third derivative jumps, nothing lower does.
    assert np.allclose(differences(v, step_s), a[1:-1], atol=0.1)


def test_the_sine_is_the_formula():
    q, _, _ = Sines(TASK).at(np.array([0.0, 0.25 / 0.45]))
    assert q[0] == pytest.approx([0.7, 0.6 + 0.7 * np.sin(0.4)])
    assert q[1] == pytest.approx([0.7 + 0.8, 0.6 + 0.7 * np.sin(np.pi + 0.4)])


def test_the_entry_starts_at_rest_where_the_machine_stands():
    q, v, a = Entry(Sines(TASK), START, 0.0, 0.5).at(np.zeros(1))
    assert q[0] == pytest.approx(START)
    assert v[0] == pytest.approx(0, abs=1e-12)
    assert a[0] == pytest.approx(0, abs=1e-12)


def test_after_the_entry_there_is_nothing_but_the_reference():
    time_s = np.linspace(0.5, 3, 20)
    for entered, plain in zip(
        Entry(Sines(TASK), START, 0.0, 0.5).at(time_s), Sines(TASK).at(time_s), strict=True
    ):
        assert np.array_equal(entered, plain)
