"""arm2 as shipped: RMS against the reference for PID, feed-forward, MPC and the ideal."""

from __future__ import annotations

import itertools
import sys
from concurrent.futures import Executor, ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from _report import arguments, finish, goal, table

from headway.configs.load import load_config
from headway.sim.lockstep import Lockstep

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
PID = ["mpc.enabled=false", "mpc.feedforward=none", "device.integrate_while_running=true"]
FEEDFORWARD = ["mpc.enabled=false", "device.integrate_while_running=true"]
IDEAL = [
    "mpc.enabled=false",
    "sim.plant={coulomb_Nm: [0.15, 0.15]}",  # and nothing else differs from the model
    "machine.axes.0.coulomb_Nm=0.15",
    "machine.axes.1.coulomb_Nm=0.15",
    "sim.to_device={delay_us: 0, jitter_us: 0, loss: 0}",
    "sim.to_host={delay_us: 0, jitter_us: 0, loss: 0}",
    "sim.compute_us=0",
]
SHIPPED_GAINS = ((120.0, 6.0), (60.0, 2.0))


def gains(kp: float, kd: float, ki: float) -> list[str]:
    """Factors on the shipped gains; ki in parts of Kp per second."""
    settings = []
    for axis, (shipped_kp, shipped_kd) in enumerate(SHIPPED_GAINS):
        servo = f"machine.axes.{axis}.servo"
        settings += [
            f"{servo}.kp_Nm_per_rad={kp * shipped_kp}",
            f"{servo}.kd_Nm_s_per_rad={kd * shipped_kd}",
            f"{servo}.ki_Nm_per_rad_s={ki * kp * shipped_kp}",
        ]
    return settings


def run(job: tuple[str, list[str], int, float]) -> dict[str, Any]:
    """One run: RMS error [mrad] and torque noise [Nm] by axis, and what the latency table needs."""
    name, overrides, seed, duration_s = job
    config = load_config(CONFIGS / name, [*overrides, f"seed={seed}", f"duration_s={duration_s}"])
    lockstep = Lockstep(config, CONFIGS)
    lockstep.run()
    record = lockstep.record.arrays()
    time_s = record["truth_s"]
    task = (time_s > 0.5) & (time_s < duration_s)
    error = (record["truth_position"] - record["truth_reference"])[task] * 1e3
    result = {
        "rms": np.sqrt(np.mean(error**2, axis=0)),
        # What is faster than the motion, as in the run's summary: second difference over sqrt(6).
        "noise": np.std(np.diff(record["servo_torque_tq"][task] * 1e-6, n=2, axis=0), axis=0)
        / 6**0.5,
        "planned": np.nanmax(record["planned_torque"], axis=0),
    }
    for part in ("estimate_us", "linearize_us", "solve_us", "encode_us", "compute_us"):
        result[part] = np.nanmedian(record[part])
    return result


def sweep(pool: Executor, base: list[str], long: bool) -> tuple[list[str], list[dict[str, Any]]]:
    """The gains with the least RMS (sum of both axes' relative to their goal), and all tried."""
    kps = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0) if long else (1.0, 4.0, 16.0)
    kds = (0.5, 1.0, 2.0) if long else (1.0, 2.0)
    kis = (0.0, 5.0, 15.0) if long else (0.0, 10.0)
    grid = list(itertools.product(kps, kds, kis))
    jobs = [("arm2.yaml", base + gains(*g), 0, 4.0) for g in grid]
    rows = []
    for (kp, kd, ki), result in zip(grid, pool.map(run, jobs), strict=True):
        rms, noise = result["rms"], result["noise"]
        rows.append({
            "Kp x": kp, "Kd x": kd, "Ki/Kp 1/s": ki,
            "rms q1 mrad": rms[0], "rms q2 mrad": rms[1],
            "noise q1 Nm": noise[0], "noise q2 Nm": noise[1],
        })  # fmt: skip
    best = min(range(len(grid)), key=lambda i: rows[i]["rms q1 mrad"] + rows[i]["rms q2 mrad"])
    return base + gains(*grid[best]), rows


def latency(config: str, result: dict[str, Any]) -> list[dict[str, Any]]:
    """From an encoder sample to the torque it changes, by stage, in microseconds."""
    c = load_config(CONFIGS / config)
    knot, sim = c.loop.knot_us, c.sim
    solve = result["linearize_us"] + result["solve_us"] + result["encode_us"]
    wait = c.loop.margin_us
    stages = [
        ("sample: age when a status leaves (mean)", knot / 2, "1 kHz samples, one status a knot"),
        ("wire to the host", sim.to_host.delay_us, f"+- {sim.to_host.jitter_us} jitter"),
        ("wait for the tick (mean)", knot / 2, "ticks lie on knots"),
        ("estimate (within the compute time)", result["estimate_us"], "measured median"),
        ("linearize, solve, encode (within)", solve, "measured median"),
        ("compute, as simulated", sim.compute_us, "sim.compute_us"),
        ("wire to the device", sim.to_device.delay_us, f"+- {sim.to_device.jitter_us} jitter"),
        ("first knot that may change, from the tick", wait, "the margin: covers the three above"),
        (
            "effective torque, from there",
            2 * knot,
            "a new point weighs u^3/6 in its first interval",
        ),
    ]
    return [{"stage": s, "us": float(t), "note": n} for s, t, n in stages]


def main() -> None:
    options = arguments(__doc__ or "")
    seeds, duration_s = (10, 10.0) if options.long else (3, 4.0)
    with ProcessPoolExecutor(2) as pool:
        print("sweeping gains ...", file=sys.stderr)
        best_pid, pid_rows = sweep(pool, PID, options.long)
        best_feedforward, feedforward_rows = sweep(pool, FEEDFORWARD, options.long)
        variants = {
            "PID": ("arm2.yaml", PID),
            "PID + nominal feed-forward": ("arm2.yaml", FEEDFORWARD),
            "PID, best of sweep": ("arm2.yaml", best_pid),
            "PID + nominal feed-forward, best of sweep": ("arm2.yaml", best_feedforward),
            "MPC without disturbance estimate": ("arm2.yaml", ["estimator.disturbance=false"]),
            "MPC": ("arm2.yaml", []),
            "ideal: model known, no delay": ("arm2.yaml", IDEAL),
            "fast: PID + nominal feed-forward": ("arm2-fast.yaml", FEEDFORWARD),
            "fast: MPC": ("arm2-fast.yaml", []),
        }
        rows, medians = [], {}
        for name, (config, overrides) in variants.items():
            print(f"{name} ...", file=sys.stderr)
            jobs = [(config, overrides, seed, duration_s) for seed in range(seeds)]
            results = list(pool.map(run, jobs))
            m = medians[name] = {k: np.median([r[k] for r in results], axis=0) for k in results[0]}
            rows.append({
                "controller": name,
                "rms q1 mrad": m["rms"][0], "rms q2 mrad": m["rms"][1],
                "noise q1 Nm": m["noise"][0], "noise q2 Nm": m["noise"][1],
            })  # fmt: skip
    table("sweep of PID gains (seed 0)", pid_rows)
    table("sweep of PID gains with nominal feed-forward (seed 0)", feedforward_rows)
    table(f"tracking, medians over {seeds} seeds of {duration_s:g} s", rows)
    table("latency budget", latency("arm2.yaml", medians["MPC"]))

    mpc, feedforward = medians["MPC"], medians["PID + nominal feed-forward"]
    fast, fast_base = medians["fast: MPC"], medians["fast: PID + nominal feed-forward"]
    swept = [medians[n] for n in variants if n.endswith("best of sweep")]
    goals = [
        goal("MPC rms q1 mrad", mpc["rms"][0], "<=", 0.45),
        goal("MPC rms q2 mrad", mpc["rms"][1], "<=", 0.75),
        goal("feed-forward / MPC rms q1", feedforward["rms"][0] / mpc["rms"][0], ">=", 10),
        goal("feed-forward / MPC rms q2", feedforward["rms"][1] / mpc["rms"][1], ">=", 10),
    ]
    for axis in (0, 1):
        best = min(s["rms"][axis] for s in swept)
        noise = min(s["noise"][axis] for s in swept)
        goals += [
            goal(f"MPC / best swept PID, rms q{axis + 1}", mpc["rms"][axis] / best, "<=", 1),
            goal(f"MPC / swept PID, noise q{axis + 1}", mpc["noise"][axis] / noise, "<=", 1),
            goal(
                f"fast: MPC / feed-forward, rms q{axis + 1}",
                fast["rms"][axis] / fast_base["rms"][axis],
                "<=",
                0.85,
            ),
        ]
    finish(rows, goals, options.json)


if __name__ == "__main__":
    main()
