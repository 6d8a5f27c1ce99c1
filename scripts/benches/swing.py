"""The pendulum and the pole, swung up, balanced and pushed: are they up, and do they stay there?"""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from _campaign import Campaign, Journal, Task, campaign_options, fingerprint
from _report import arguments, finish, goal, table
from _runs import run_through

from headway.configs.load import load_config

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
# What its results depend on, beside the firmware.
SOURCES = (
    *("configs/*.yaml", "configs/upright.py", "models/*/*.xml"),
    *(f"{of}/*.[cph]*" for of in ("controller", "models", "devices", "sim")),
)
UP_RAD = 0.1  # from upright: it is up
BACK_S = 5.0  # after a push it is up again
# What each is pushed with for 0.1 s, at most: the pendulum then turns at 6 rad/s, the pole at 4.
PUSH_NM = {"furuta": 0.08, "cartpole": 0.3}


def run(job: tuple[str, int, float]) -> dict[str, Any]:
    """One seed, with three pushes after a third of the time."""
    name, seed, duration_s = job
    rng = np.random.default_rng(seed)
    passive = load_config(CONFIGS / f"{name}.yaml").machine.axes[1].joint
    at = duration_s * np.array([1 / 3, 1 / 2, 2 / 3]) + rng.uniform(-0.5, 0.5, 3)
    efforts = rng.uniform(-1, 1, 3) * PUSH_NM[name]
    pushes = ", ".join(
        f"{{kind: push, joint: {passive}, at_s: {when:.4f}, for_s: 0.1, effort_Nm_or_N: {effort}}}"
        for when, effort in zip(at, efforts, strict=True)
    )
    side = 1 if rng.random() < 0.5 else -1
    start = [side * float(rng.uniform(0.05, 0.15)), float(np.pi + rng.uniform(-0.2, 0.2))]
    config = load_config(
        CONFIGS / f"{name}.yaml",
        [
            f"seed={seed}", f"duration_s={duration_s}", f"sim.mishaps=[{pushes}]",
            f"sim.start_rad_or_m={start}",
        ],
    )  # fmt: skip
    _, arrays, said = run_through(config, CONFIGS)
    task = (arrays["truth_s"] >= 0) & (arrays["truth_s"] <= duration_s)
    time_s, position = arrays["truth_s"][task], arrays["truth_position"][task]
    off = np.abs((position[:, 1] + np.pi) % (2 * np.pi) - np.pi)
    # Down while nobody pushes and it has had its time: it has fallen.
    quiet = time_s > BACK_S
    for when in at:
        quiet &= (time_s < when) | (time_s > when + BACK_S)
    axis = config.machine.axes[0]
    room = min(position[:, 0].min() - axis.lowest, axis.highest - position[:, 0].max())
    down = time_s[off > UP_RAD]
    first = down[down < at[0]]
    return {
        "up_s": float(first[-1]) if len(first) else 0.0,
        "fallen": bool(said) or bool(np.any(off[quiet] > UP_RAD)) or bool(off[-1] > UP_RAD),
        "thrown": int(sum(np.any(off[(time_s > w) & (time_s < w + BACK_S)] > 1.5) for w in at)),
        "still_mrad": float(1e3 * np.sqrt(np.mean(off[quiet] ** 2))),
        "room": float(room),
        "refused": float(1 - np.mean(arrays["tick_accepted"])),
        "said": said,
    }


def main() -> int:
    options = arguments(__doc__ or "", campaign_options)
    seeds, duration_s = (50, 60.0) if options.long else (2, 20.0)
    tasks = [
        Task(f"{name}, {seed}", run, (name, seed, duration_s))
        for seed in range(seeds)
        for name in PUSH_NM
    ]
    journal = Journal(options.results, fingerprint((seeds, duration_s), *SOURCES))
    with ProcessPoolExecutor(options.processes) as pool:
        Campaign(pool, journal, options.minutes).run("runs", tasks)
    rows, goals = [], []
    for name in PUSH_NM:
        mine = [r for key, r in journal.found.items() if key.startswith(f"{name}, ")]
        if not mine:
            continue
        stays = sum(not r["fallen"] for r in mine)
        rows.append({
            "machine": name, "seeds": len(mine), "up and back up": stays,
            "up after, median s": float(np.median([r["up_s"] for r in mine])),
            "last s": max(r["up_s"] for r in mine),
            "pushes that threw it down": sum(r["thrown"] for r in mine),
            "upright within, rms mrad": float(np.median([r["still_mrad"] for r in mine])),
            "plans refused %": 100 * float(np.mean([r["refused"] for r in mine])),
        })  # fmt: skip
        goals += [
            goal(
                f"{name}: seeds of {len(mine)} in which it is up and stays", stays, ">=", len(mine)
            ),
            goal(f"{name}: way to a limit", min(r["room"] for r in mine), ">", 0.0),
        ]
    if rows:
        table(f"swung up, balanced for {duration_s:g} s, pushed three times", rows)
    for said in sorted({r["said"] for r in journal.found.values() if r["said"]}):
        print(f"    {said}")
    finish(rows, goals, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
