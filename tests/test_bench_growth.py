"""The benchmark of how a tick grows: what it times are the compiled calls."""

import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "scripts" / "benches"))

from grid.world import Problem  # noqa: E402
from growth import Timed, raced  # noqa: E402


def test_each_tick_is_timed_by_its_compiled_calls() -> None:
    problem = Problem("arm2", "arm2.yaml")
    (lane,) = raced([(problem, 6)], "riccati", ticks=3)
    timed = lane.contender
    assert isinstance(timed, Timed)
    whole = [reply.cpu["prepare"] + reply.cpu["feedback"] for reply in lane.replies]
    assert len(timed.took_us) == len(whole) > 3
    assert np.all(np.array(timed.took_us) > 0) and np.all(np.array(timed.took_us) <= whole)
