"""At doctor's margin no plan is late; at half of it some are: on this computer, in real time.

margin [--long]: what doctor measures, in ten seconds of arm2's task over UDP, then ten seconds (or
five minutes) each at the margin that comes of it and at half of it, rounded up to knots, under FIFO
where that is allowed. What else the computer does counts as well: let it be idle.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from _report import arguments, finish, goal, table

from headway.cli.doctor import safe_margin_us
from headway.cli.failure import Failure
from headway.cli.linked import Linked
from headway.cli.measure import Measured, measure
from headway.configs.load import load_config

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "arm2.yaml"
SHORT_S, LONG_S = 10.0, 300.0
LIMIT = "sync.limit_us=2000"  # docs/links.md


def measured_at(margin_us: int | None, duration_s: float) -> Measured:
    """Of the task at a margin, or at the config's. Raises Failure."""
    said = [f"duration_s={duration_s}", LIMIT]
    said += [] if margin_us is None else [f"loop.margin_us={margin_us}"]
    linked = Linked("udp", spawn=True, punctual=True)
    return measure(linked, CONFIG, load_config(CONFIG, said), said)


def row(what: str, margin_us: int, m: Measured) -> dict[str, Any]:
    return {
        "at": what, "margin us": margin_us, "knots": m.knots, "late points": m.late_points,
        "knots without a plan": m.missed, "to its end": "no" if m.failure else "yes",
    }  # fmt: skip


def main() -> int:
    """Exit code: 1 if there is nothing to tell."""
    options = arguments(__doc__ or "")
    duration_s = LONG_S if options.long else SHORT_S
    config, rows, goals = load_config(CONFIG), list[dict[str, Any]](), list[Any]()
    try:
        margin_us = safe_margin_us(config, measured_at(None, SHORT_S))
        whole = measured_at(margin_us, duration_s)
        rows.append(row("doctor's margin", margin_us, whole))
        late = whole.late_points + whole.missed
        goals.append(goal("late points and knots without a plan, doctor's margin", late, "<=", 0))
        half_us = -(-margin_us // 2 // config.loop.knot_us) * config.loop.knot_us
        half = measured_at(half_us, duration_s)
        rows.append(row("half of it", half_us, half))
        late = half.late_points + half.missed
        goals.append(goal("late points and knots without a plan, half of it", late, ">=", 1))
    except Failure as failure:
        print(failure, file=sys.stderr)
        return 1
    table(f"arm2 over UDP, {duration_s:.0f} s of the task each", rows)
    finish(rows, goals, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
