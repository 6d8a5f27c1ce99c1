"""What simulation costs: the firmware of eight devices at 10 kHz, and arm2 in closed loop.

The firmware is timed alone, as the simulator calls it: eight devices in a row, each with five
tracks, an integral and two logic nodes at work, a servo period of 100 us. Beside it, in the same
run, a step of arm2's plant. Closed loop is all there is: plant, boards, network, host, record.
"""

from __future__ import annotations

import sys
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "cortex"))
from _report import arguments, finish, goal, table
from scene import Scene

from headway.configs.load import load_config
from headway.controller.record.recorder import Memory
from headway.sim.lockstep import Lockstep

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "configs" / "arm2.yaml"
DEVICES, PERIOD_US = 8, 100
MOTION_MS = 180  # of the last plan, which is 242 ms long
STEP_US = 250


def firmware() -> tuple[list[float], list[float]]:
    """Time for each millisecond of motion of all devices [us]: whole, and of the same calls from
    Python where the main loops hang."""
    scenes = [Scene(seed, servo_period_us=PERIOD_US) for seed in range(DEVICES)]
    nodes = [scene.rig.node for scene in scenes]
    times = [scene.rig.now for scene in scenes]
    counts = [[scene.rig.encoder(now + 1000 * ms) for ms in range(MOTION_MS)]
              for scene, now in zip(scenes, times, strict=True)]  # fmt: skip

    def polls(ms: int) -> float:
        begun = perf_counter()
        for node, now, count in zip(nodes, times, counts, strict=True):
            poll, value = node.poll, count[min(ms, MOTION_MS - 1)]
            for us in range(PERIOD_US, 1000 + PERIOD_US, PERIOD_US):
                poll(now + 1000 * ms + us, value)
        took = (perf_counter() - begun) * 1e6
        for node in nodes:
            node.collect()
        return took

    whole = [polls(ms) for ms in range(MOTION_MS)]
    assert all(node.state in (4, 5) for node in nodes), "a device stopped"
    for node in nodes:
        node.hung = True
    return whole, [polls(MOTION_MS + ms) for ms in range(MOTION_MS)]


def plant() -> list[float]:
    """CPU time for a millisecond of arm2's plant, its two boards among it [us]."""
    model = mujoco.MjModel.from_xml_path(str(ROOT / "models" / "arm2" / "arm2.xml"))
    data = mujoco.MjData(model)
    steps = round(1e-3 / model.opt.timestep)
    took = []
    for _ in range(500):
        begun = perf_counter()
        for _ in range(steps):
            mujoco.mj_step(model, data)
        took.append((perf_counter() - begun) * 1e6)
    return took


def loop(duration_s: float, mpc: bool) -> tuple[float, float, float]:
    """How many times faster than real time: the task; all of a run, from power-up to rest; and its
    plant with the boards alone."""
    changes = [f"duration_s={duration_s}", f"mpc.enabled={'true' if mpc else 'false'}"]
    lockstep = Lockstep(load_config(CONFIG, changes), CONFIG.parent, Memory())
    plant, stepping_s = lockstep.plant, 0.0
    step, task = plant.step, list[tuple[float, float]]()  # simulated and processor time

    def timed(count: int) -> None:
        nonlocal stepping_s
        begun = process_time()
        step(count)
        stepping_s += process_time() - begun

    plant.step = timed  # type: ignore[method-assign]
    begun = process_time()
    lockstep.run(lambda _: task.append((plant.true_us * 1e-6, process_time())))
    took_s, simulated_s = process_time() - begun, plant.true_us * 1e-6
    of_task, took_task = np.subtract(task[-1], task[0])
    return of_task / took_task, simulated_s / took_s, simulated_s / stepping_s


def main() -> None:
    options = arguments(__doc__ or "")
    duration_s = 20.0 if options.long else 6.0
    (devices, calls), step = firmware(), plant()
    figures = {
        "eight devices at 10 kHz, called from Python": devices,
        "those calls alone": calls,
        "mj_step of arm2, its boards among it": step,
    }
    rows: list[dict[str, Any]] = [
        {"what [us]": name, "median": float(np.median(took)), "least": float(min(took))}
        for name, took in figures.items()
    ]
    alone = rows[0]["median"] - rows[1]["median"]
    rows.append({"what [us]": "firmware alone", "median": alone,
                 "least": rows[0]["least"] - rows[1]["least"]})  # fmt: skip
    table("for each millisecond of motion", rows)
    speeds = []
    for name, mpc in (("arm2, MPC", True), ("arm2, feed-forward", False)):
        task, whole, boards = loop(duration_s, mpc)
        speeds.append({"what": name, "times real time": task, "from power-up to rest": whole,
                       "plant and boards": boards})  # fmt: skip
    table("closed loop", speeds)
    goals = [
        goal("firmware of eight devices [us/ms]", alone, "<=", 20),
        goal("arm2 with MPC, times real time", speeds[0]["times real time"], ">=", 5),
        goal("arm2 without, times real time", speeds[1]["times real time"], ">=", 50),
    ]
    finish([*rows, *speeds], goals, options.json)


if __name__ == "__main__":
    main()
