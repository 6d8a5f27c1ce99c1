"""Everything that can go wrong with arm2, at any phase of its task: do all axes come to rest?"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from _report import arguments, finish, goal, table
from _runs import each, run_through

from headway.configs.load import load_config

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
STILL = 0.1  # rad/s: an axis that is slower from here on has come to rest but for its swinging out
SETTLED_S = 0.25  # after its rest
AFTER_S = 0.5  # of the task after the mishap, at most
# A mishap, what is configured for it, and the time from it to the rest of all axes [s]. A plan
# reaches 213 ms; before it coasts a device waits 5 knots, and 3 more are the margin. A stop by the
# board's own ramp takes its speed over its deceleration (3 rad/s at 25 rad/s^2), or stop_us and the
# brake; the others then coast.
PLAN_S = 0.213 + 8 * 0.0041
MISHAPS: dict[str, tuple[list[str], float]] = {
    "host killed": (["sim.kill_host_at_s={at}"], PLAN_S),
    "device reset": (["sim.mishaps=[{{kind: reset, at_s: {at}, joint: {joint}}}]"], 0.3),
    "axis partitioned": (["sim.mishaps=[{{kind: partition, at_s: {at}, joint: {joint}}}]"], 0.3),
    "encoder stuck": (["sim.mishaps=[{{kind: encoder_stuck, at_s: {at}, joint: {joint}}}]"], 0.6),
    "encoder reversed": (
        ["sim.mishaps=[{{kind: encoder_reversed, at_s: {at}, joint: {joint}}}]"],
        0.6,
    ),
    "emergency stop": (["sim.mishaps=[{{kind: emergency_stop, at_s: {at}}}]"], 0.55),
    "supply sag": (
        ["sim.mishaps=[{{kind: supply_sag, at_s: {at}, joint: {joint}, supply_V: {volts}}}]"],
        0.6,
    ),
    "firmware hangs": (
        ["sim.mishaps=[{{kind: firmware_hangs, at_s: {at}, joint: {joint}, for_s: {hang}}}]"],
        0.45,  # the others' plan, and what the jerk of the brake leaves swinging
    ),
}


# The hung axis itself: late_us, a call of the guard and the brake's time are 20 ms; then it slips
# in its brake while the others pull at it.
HUNG_S = 0.12


def run(job: tuple[str, int]) -> dict[str, Any]:
    """One mishap: when each axis rests [s after it], how near it came to a limit [rad], how far it
    moved once it rested [mrad], and what the host said."""
    name, seed = job
    rng = np.random.default_rng(seed)
    at, joint, volts = rng.uniform(0.4, 2.7), rng.choice(["q1", "q2"]), rng.uniform(5, 30)
    hang = rng.choice([rng.uniform(0.006, 0.06), rng.uniform(0.06, 2)])
    changes = [text.format(at=at, joint=joint, volts=volts, hang=hang) for text in MISHAPS[name][0]]
    config = load_config(
        CONFIGS / "arm2.yaml", [*changes, f"seed={seed}", f"duration_s={at + AFTER_S}"]
    )
    lockstep, arrays, said = run_through(config, CONFIGS)
    after = arrays["truth_s"] >= at
    time_s = arrays["truth_s"][after] - at
    position, velocity = arrays["truth_position"][after], arrays["truth_velocity"][after]
    axes = range(position.shape[1])
    rests = [float(max(time_s[np.abs(velocity[:, a]) > STILL], default=0.0)) for a in axes]
    rested = time_s >= max(rests) + SETTLED_S
    room = min(
        float(min(position[:, a].min() - axis.lowest, axis.highest - position[:, a].max()))
        for a, axis in enumerate(config.machine.axes)
    )
    struck = next((i for i, axis in enumerate(config.machine.axes) if axis.joint == joint), 0)
    return {
        "rest": max(rests),
        "spread": abs(rests[0] - rests[1]),
        "room": room,
        "sag": 1e3 * float(np.ptp(position[rested], axis=0).max()),
        "peer": lockstep.device_states()[1 - struck],
        "struck": rests[struck],
        "said": said,
    }


def main() -> int:
    """Exit code."""
    options = arguments(__doc__ or "")
    seeds = 200 if options.long else 4
    jobs = [(name, seed) for name in MISHAPS for seed in range(seeds)]
    results = each(run, jobs)
    rows, goals = [], []
    for i, (name, (_, bound_s)) in enumerate(MISHAPS.items()):
        mine = results[i * seeds : (i + 1) * seeds]
        rest = [r["rest"] for r in mine]
        rows.append({
            "mishap": name, "runs": seeds,
            "rest, median ms": 1e3 * float(np.median(rest)), "last ms": 1e3 * max(rest),
            "between axes ms": 1e3 * max(r["spread"] for r in mine),
            "nearest to a limit rad": min(r["room"] for r in mine),
            "moved at rest mrad": max(r["sag"] for r in mine),
        })  # fmt: skip
        goals += [
            goal(f"{name}: rest after it [s]", max(rest), "<=", bound_s),
            goal(f"{name}: way to a limit [rad]", min(r["room"] for r in mine), ">", 0.0),
            goal(f"{name}: moved at rest [mrad]", max(r["sag"] for r in mine), "<=", 1.0),
        ]
    hung = [r["struck"] for (name, _), r in zip(jobs, results, strict=True) if "hangs" in name]
    goals.append(goal("firmware hangs: rest of the hung axis [s]", max(hung), "<=", HUNG_S))
    table("mishaps, arm2 as shipped", rows)
    for said in sorted({r["said"] for r in results})[:12]:
        print(f"    {said}")
    finish(rows, goals, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
