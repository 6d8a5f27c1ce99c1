"""The gate against the curve itself: nothing unsafe gets in, nothing legal stays out.

The plans, the oracle and the runs of a million are in scripts/gate_proof.py.
"""

import shutil
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scripted import load_script

from headway.firmware import _core

ROOT = Path(__file__).resolve().parents[1]


proof = load_script("gate_proof")


@pytest.fixture(scope="module")
def gate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    program: Path = proof.build(tmp_path_factory.mktemp("gate"))
    return program


def test_the_numbers_are_the_firmwares() -> None:
    assert proof.RESULTS[:-1] == _core.GATE_RESULTS
    assert (_core.LIVE_KNOTS, _core.POINT_MAX) == (proof.LIVE, proof.POINT_MAX)
    assert (_core.DIFFERENCE_MAX, _core.PLAN_POINTS_MAX) == (
        proof.DIFFERENCE_MAX,
        proof.PLAN_POINTS,
    )


@pytest.mark.parametrize("order", [0, 1, 2])
def test_the_oracles_curve_is_the_spline(order: int) -> None:
    """Its exact weights against scipy's floating-point splines."""
    points = np.random.default_rng(1).integers(-(2**20), 2**20, 12)
    scale = (proof.P_SCALE, proof.V_SCALE, proof.A_SCALE)[order]
    exact = proof.curve(points[None].astype(np.int64), order, scale)[0] / scale
    spline = BSpline(np.arange(16) - 2.0, points.astype(float), 3)
    x = 1 + np.arange(exact.size) / proof.STEPS
    assert np.abs(exact.ravel() - spline(x, order)).max() < 1e-6
    assert sum(Fraction(int(w), scale) for w in proof.weights(order, scale)[:, 5]) == (order == 0)


def test_no_unsafe_plan_is_accepted(gate: Path) -> None:
    tally = proof.safety(gate, seed=7, batches=12)
    assert not any(tally.unsafe.values()), tally.unsafe
    # A gate that lets nothing in would pass the above.
    assert tally.asked == 12 * proof.BATCH
    assert tally.accepted > 0.45 * tally.asked
    assert tally.tight > 0.35 * tally.asked
    for reason in ("late", "range", "speed", "acceleration", "rest", "room"):
        assert tally.results[reason] > 0.02 * tally.asked, tally.results


def test_every_legal_plan_is_accepted(gate: Path) -> None:
    tally = proof.liveness(gate, seed=7, batches=12)
    assert tally.results == {"accepted": 12 * proof.BATCH}


# What each line of the gate is there for: without it the oracle sees unsafe plans let in.
FAULTS = {
    "range": ("points[i] < limits->point_min)", "points[i] + 1 < limits->point_min)"),
    "speed": ("d > limits->difference_max", "d - 1 > limits->difference_max"),
    "acceleration": (
        "d2 < -limits->second_difference_max",
        "d2 + 1 < -limits->second_difference_max",
    ),
    "room above": (
        "(uint32_t)limit - (uint32_t)farthest",
        "2 * ((uint32_t)limit - (uint32_t)farthest)",
    ),
    "room below": ("point_max, stop) &&", "point_max, stop) ||"),
    "rest": ("&& points[count - 1] == points[count - 3]", ""),
    "live": ("if (i < live &&", "if (i < live && i == 0 &&"),
}


@pytest.mark.parametrize("promise", FAULTS)
def test_the_oracle_sees_a_fault_of_the_gate(
    promise: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("firmware", "tests"):
        (tmp_path / folder).mkdir()
    for source in [*(ROOT / "firmware").glob("*.[ch]"), ROOT / "tests" / "gate_batch.c"]:
        shutil.copy(source, tmp_path / source.relative_to(ROOT))
    file, (good, bad) = tmp_path / "firmware" / "gate.c", FAULTS[promise]
    text = file.read_text()
    assert text.count(good) == 1
    file.write_text(text.replace(good, bad))
    monkeypatch.setattr(proof, "ROOT", tmp_path)
    tally = proof.safety(proof.build(tmp_path), seed=7, batches=4)
    assert tally.unsafe[promise] > 0, tally.unsafe
