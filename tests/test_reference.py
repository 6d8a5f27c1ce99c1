"""References: derivatives agree, and the way in from rest."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from headway.configs.load import ConfigError, load_config
from headway.configs.schema import Task
from headway.controller.reference import Entry, Sines, Stamped, read_stamped
from headway.sim.lockstep import Lockstep

Array = NDArray[np.float64]
ARM2 = Path(__file__).resolve().parent.parent / "configs" / "arm2.yaml"

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


# A file of stamped positions.


def table(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_a_file_is_followed_through_its_rows_and_at_rest_at_its_ends(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    time_s = np.cumsum(rng.uniform(0.05, 0.2, 20)) + 7
    q = np.cumsum(rng.normal(0, 0.1, (20, 2)), axis=0)
    rows = [f"{b:.17g},{t:.17g},{a:.17g}" for t, (a, b) in zip(time_s, q, strict=True)]
    file = table(tmp_path / "way.csv", "\n".join(["q2, time_s, q1", *rows]))
    stamped = Stamped(*read_stamped(file, ["q1", "q2"]))
    at, v, _ = stamped.at(time_s - time_s[0])
    np.testing.assert_allclose(at, q, atol=1e-12)
    for ends in (v[0], v[-1]):
        np.testing.assert_allclose(ends, 0, atol=1e-12)
    oracle = make_interp_spline(time_s, q, k=3, bc_type="clamped")
    times = np.linspace(0.01, time_s[-1] - time_s[0] - 0.01, 300)
    for order, values in enumerate(stamped.at(times)):
        np.testing.assert_allclose(values, oracle(times + time_s[0], order), atol=1e-8)
    before, after = stamped.at(np.array([-1.0])), stamped.at(np.array([100.0]))
    np.testing.assert_allclose(before[0][0], q[0])
    np.testing.assert_allclose(after[0][0], q[-1])
    assert not np.any([before[1:], after[1:]])


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "line 1 names the columns "),
        ("time_s,q1\n0,1\n", r"line 1 names the columns time_s, q1; .* needs time_s, q1, q2"),
        ("time_s,q1,q2\n0,1,2\n0.1,a,3\n", "line 3 is not 3 numbers"),
        ("time_s,q1,q2\n0,1,2\n0.1,nan,3\n", "line 3 is not 3 numbers"),
        ("time_s,q1,q2\n0,1,2\n0.1,3\n", "line 3 is not 3 numbers"),
        ("time_s,q1,q2\n0,1,2\n0.1,3,4,5\n", "line 3 is not 3 numbers"),
        ("time_s,q1,q2\n0,1,2\n0,3,4\n", "line 3: time_s does not increase"),
        ("time_s,q1,q2\n0,1,2\n", "has 1 rows; a motion needs two"),
    ],
)
def test_a_file_that_cannot_be_followed(tmp_path: Path, text: str, what: str) -> None:
    with pytest.raises(ValueError, match=what):
        read_stamped(table(tmp_path / "way.csv", text), ["q1", "q2"])
    with pytest.raises(ValueError, match="cannot be read"):
        read_stamped(tmp_path / "nothing.csv", ["q1", "q2"])


# The other kinds in closed loop.


def final(lock: Lockstep) -> tuple[Array, float]:
    """The last position of the task, and the largest error in its last 0.3 s."""
    lock.run()
    record = lock.record.arrays()
    assert record["tick_accepted"].all()
    late = (record["truth_s"] > 1.2) & (record["truth_s"] < 1.5)
    error = np.abs(record["truth_position"] - record["truth_reference"])[late].max()
    return record["truth_position"][late][-1], float(error)


def test_a_machine_goes_to_a_target_and_stays(tmp_path: Path) -> None:
    task = "task={kind: regulate, target_rad_or_m: [1.1, 0.2]}"
    start = "sim.start_rad_or_m=[0.785, 0.6]"
    lock = Lockstep(load_config(ARM2, [task, start, "duration_s=1.5"]), ARM2.parent)
    position, error = final(lock)
    np.testing.assert_allclose(position, [1.1, 0.2], atol=2e-3)
    assert error < 2e-3


def test_a_machine_follows_a_file(tmp_path: Path) -> None:
    file = table(tmp_path / "way.csv", "time_s,q1,q2\n0,0.8,0.6\n0.6,1.2,0.3\n1.2,1.0,0.5\n")
    lock = Lockstep(
        load_config(ARM2, [f"task={{kind: track, file: {file}}}", "duration_s=1.5"]), ARM2.parent
    )
    position, error = final(lock)
    np.testing.assert_allclose(position, [1.0, 0.5], atol=2e-3)
    assert error < 2e-3


@pytest.mark.parametrize(
    ("task", "what"),
    [
        ("{kind: sines}", "kind sines needs frequency_Hz and axes"),
        ("{kind: track}", "kind track needs file"),
        ("{kind: track, file: a.csv, frequency_Hz: 1}", "kind track has no frequency_Hz"),
        ("{kind: regulate, target_rad_or_m: [1]}", "has 1 entries; the machine has 2 axes"),
    ],
)
def test_a_task_has_the_keys_of_its_kind(task: str, what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        load_config(ARM2, [f"task={task}"])
