"""Whoever has the key cannot make a machine leave its limits by more than its monitors' margin.

What is promised of somebody who can sign anything, but sets no zero and lays no hand on it:

- tracks never leave the gate's limits, and no motor is asked for more than its effort limit;
- the true position stays within the limits and three following limits beyond them. The monitor
  stops an axis that could not stop within one following limit beyond (ROOM), and brakes it there
  at once (OUTSIDE). What is further is the brake's and the average's: a brake takes its time to
  engage, the speed is averaged over 8 periods, the other axis may push. How far that goes is not
  computed on the board: it was measured (1.9 at most in 40 minutes of arm2 and cart; 3.3 while the
  brake still waited for a ramp);
- the true speed stays below one and a half times its limit: 1.25 are watched, the rest is the
  average's lag (1.18 was measured).

The longer sieges are in scripts/hostile.py.
"""

from pathlib import Path

import pytest
from scripted import load_script

ROOT = Path(__file__).resolve().parents[1]


hostile = load_script("hostile")


@pytest.mark.parametrize("config", ["configs/arm2.yaml", "tests/cart/cart.yaml"])
def test_a_siege(config: str) -> None:
    total = hostile.Findings()
    for found in hostile.siege(ROOT / config, seed=5, seconds=20):
        total.add(found)
        assert found.reference == 0
        assert found.torque <= 1
        assert found.speed <= hostile.SPEED_MARGIN
        assert found.outside <= hostile.OUTSIDE_MARGIN
    # He did get through, and to the edges.
    assert total.accepted > 0.5 * total.plans > 500
    assert total.tight > 0.5 * total.accepted
    assert total.outside > 0.5
    assert {"RUNNING", "COAST", "TAIL", "HOLD", "FAULT", "ARMED"} <= set(total.states)
