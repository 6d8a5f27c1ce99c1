"""What a tick costs around its compiled calls, in closed loop: of arm2's ticks and of arm6's.

Time is the thread's; the simulated link's, which no machine has, is left out. Compiled calls are
`prepare` and `feedback` of controller/program.py, with all that they write into their arrays; the
estimator's filter counts as Python. A tick whose samples came late, so that the filter goes over
later ones again, is told apart: of those with more than the median number of such rows. To ask that
clock is a call of the system: what the measuring itself takes is measured first and left out.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from time import thread_time_ns
from typing import Any

import numpy as np
from _report import arguments, finish, goal, table

from headway.configs.load import load_config
from headway.controller.estimator import Estimator
from headway.controller.loop import Loop
from headway.controller.program import Program
from headway.controller.record.recorder import Memory
from headway.sim import lockstep
from headway.sim.link import SimLink
from headway.sim.lockstep import Lockstep

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
GOALS_US = {"arm2": 120, "arm6": 200}
PARTS: dict[str, tuple[type, str]] = {
    "arrive": (SimLink, "receive"),
    "leave": (SimLink, "send"),
    "read": (Loop, "read"),
    "tick": (Loop, "tick"),
    "estimate": (Loop, "_estimate"),
    "write": (Loop, "write"),
    "feedback": (Program, "feedback"),
    "prepare": (Program, "prepare"),
}


class Watch:
    """Times of a tick's parts [us], a row a tick."""

    def __init__(self) -> None:
        self.now = dict.fromkeys((*PARTS, "record"), 0.0)
        self.rows: list[dict[str, float]] = []
        self.replayed = self._calls = 0
        asked = [thread_time_ns() for _ in range(2001)]
        self._clock_ns = float(np.median(np.diff(asked)))

    def timed(self, part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def measured(*given: Any) -> Any:
            before, began = self._calls, thread_time_ns()
            result = call(*given)
            took_ns = thread_time_ns() - began
            within, self._calls = self._calls - before, self._calls + 1
            self.now[part] += (took_ns - (1 + 2 * within) * self._clock_ns) * 1e-3
            return result

        return measured

    def end(self, rows: int) -> None:
        self.rows.append({**self.now, "replayed": rows - self.replayed})
        self.now, self.replayed = dict.fromkeys(self.now, 0.0), rows


def run(machine: str, duration_s: float) -> list[dict[str, float]]:
    watch, kept = Watch(), {}
    for part, (owner, name) in PARTS.items():
        kept[owner, name] = getattr(owner, name)
        setattr(owner, name, watch.timed(part, kept[owner, name]))
    note = lockstep.note_tick
    noting = watch.timed("record", note)
    estimators: list[Estimator] = []

    def noted(*given: Any) -> None:
        noting(*given)
        watch.end(estimators[0].replayed)

    lockstep.note_tick = noted
    try:
        changes = [f"duration_s={duration_s}"]
        config = load_config(CONFIGS / f"{machine}.yaml", changes)
        simulated = Lockstep(config, CONFIGS, Memory())
        estimators.append(simulated.loop.estimator)
        simulated.run()
    finally:
        lockstep.note_tick = note
        for (owner, name), call in kept.items():
            setattr(owner, name, call)
    return [row for row in watch.rows if row["feedback"] > 0]


def main() -> None:
    options = arguments(__doc__ or "")
    rows, goals = list[dict[str, Any]](), []
    for machine, most_us in GOALS_US.items():
        ticks = run(machine, 20.0 if options.long else 4.0)
        replayed = np.array([tick["replayed"] for tick in ticks])
        late = replayed > np.median(replayed)
        parts: dict[str, Callable[[dict[str, float]], float]] = {
            "read": lambda t: t["read"] - t["arrive"],
            "estimate": lambda t: t["estimate"],
            "the rest of the decision": lambda t: t["tick"] - t["estimate"] - t["feedback"],
            "write, and the next problem's guess": lambda t: t["write"] - t["leave"] - t["prepare"],
            "record": lambda t: t["record"],
        }
        spent = {name: np.array([part(t) for t in ticks]) for name, part in parts.items()}
        spent["all around the compiled calls"] = sum(spent.values(), np.zeros(len(ticks)))
        for name, took in spent.items():
            rows.append({
                "machine": machine, "part": name, "p50 us": float(np.median(took[~late])),
                "p99": float(np.percentile(took[~late], 99)),
                "late samples: p50 us": float(np.median(took[late])),
            })  # fmt: skip
        goals.append(goal(f"{machine}: p50 [us]", rows[-1]["p50 us"], "<=", most_us))
    table("a tick around its compiled calls", rows)
    finish(rows, goals, options.json)


if __name__ == "__main__":
    sys.exit(main())
