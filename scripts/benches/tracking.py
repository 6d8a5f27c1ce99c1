"""arm2 as shipped: RMS against the reference for PID, feed-forward, MPC and the ideal."""

from __future__ import annotations

import itertools
import sys
from concurrent.futures import Executor, ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from _report import arguments, finish, goal, table

from headway.cli.simulation import Simulation
from headway.configs.load import load_config
from headway.controller.record.columns import Arrays
from headway.models.margin import PHASE_MARGIN_MIN_DEG, phase_margin_deg

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
PID = ["mpc.enabled=false", "mpc.feedforward=none", "device.integrate_while_running=true"]
FEEDFORWARD = ["mpc.enabled=false", "device.integrate_while_running=true"]
IDEAL = [
    "mpc.enabled=false",
    "sim.plant={coulomb_Nm_or_N: [0.15, 0.15]}",  # and nothing else differs from the model
    "machine.axes.0.coulomb_Nm=0.15",
    "machine.axes.1.coulomb_Nm=0.15",
    "sim.to_device={delay_us: 0, jitter_us: 0, loss: 0}",
    "sim.to_host={delay_us: 0, jitter_us: 0, loss: 0}",
    *("sync.to_device_least_us=0", "sync.to_host_least_us=0"),
    "sim.compute_us=0",
]
SHIPPED_GAINS = ((120.0, 6.0), (60.0, 2.0))
# For the phase margin of swept gains: back-EMF's damping, the largest inertia of the model about
# each joint (arm stretched), and the lag of sampling: half a hold and half a difference.
EMF_DAMPING = (2.88, 0.72)  # Nm s/rad
INERTIA = (0.251, 0.0332)  # kg m^2
LAG_S = 1e-3


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


def margin_deg(kp: float, kd: float, ki: float) -> float:
    """The smaller of both joints' phase margins, at factors on the shipped gains."""
    margins = []
    for (p, d), emf, inertia in zip(SHIPPED_GAINS, EMF_DAMPING, INERTIA, strict=True):
        margins.append(phase_margin_deg(kp * p, kd * d + emf, ki * kp * p, inertia, LAG_S))
    return min(margins)


def run(job: tuple[str, list[str], int, float]) -> dict[str, Any]:
    """One run: RMS error [mrad] and torque noise [Nm] by axis, as in its summary, and the mean
    times on the way from an encoder to the motor [us]."""
    name, overrides, seed, duration_s = job
    config = load_config(CONFIGS / name, [*overrides, f"seed={seed}", f"duration_s={duration_s}"])
    simulation = Simulation(config, CONFIGS)
    summary = simulation.run()
    split = {part: times["p50"] for part, times in summary["compute_split_us"].items()}
    return {
        "rms": np.array(summary["tracking"]["rms"]),
        "noise": np.array(summary["torque"]["noise_rms"]),
        **{f"{part}_us": np.nan if time is None else time for part, time in split.items()},
        **latencies(simulation.record.arrays(), config.loop.knot_us),
    }


def latencies(record: Arrays, knot_us: int) -> dict[str, float]:
    """Means over the task [us], from the stamps in the record."""
    task = record["received_status"] & (record["received_us"] >= record["task_start_us"][0])
    left_us, arrived_us = record["received_sent_us"], record["received_us"]
    ages = []
    for axis in np.unique(record["received_device"]):
        last_us = 0
        for i in np.flatnonzero(task & (record["received_device"] == axis)):
            told = slice(*record["received_sample_time_us_offsets"][i : i + 2])
            samples_us = record["received_sample_time_us"][told]
            ages.append(left_us[i] - samples_us[samples_us > last_us])
            last_us = samples_us[-1]
    return {
        "sample": float(np.mean(np.concatenate(ages))),
        "wire": float(np.mean((arrived_us - left_us)[task])),
        "wait": float(np.mean(-arrived_us[task] % knot_us)),
        "compute": float(np.mean(record["tick_sent_us"] - record["tick_us"])),
    }


def sweep(pool: Executor, base: list[str], long: bool) -> list[dict[str, Any]]:
    """Every combination of gains, one run each."""
    kps = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0) if long else (1.0, 4.0, 16.0)
    kds = (0.5, 1.0, 2.0) if long else (1.0,)
    kis = (0.0, 10.0)
    grid = list(itertools.product(kps, kds, kis))
    jobs = [("arm2.yaml", base + gains(*g), 0, 4.0) for g in grid]
    rows = []
    for (kp, kd, ki), result in zip(grid, pool.map(run, jobs), strict=True):
        rms, noise = result["rms"], result["noise"]
        rows.append({
            "Kp x": kp, "Kd x": kd, "Ki/Kp 1/s": ki, "phase margin": margin_deg(kp, kd, ki),
            "rms q1 mrad": rms[0], "rms q2 mrad": rms[1],
            "noise q1 Nm": noise[0], "noise q2 Nm": noise[1],
        })  # fmt: skip
    return rows


def best(rows: list[dict[str, Any]], noise: Any = (np.inf, np.inf)) -> list[str]:
    """Gains with the least RMS (sum of both axes) among the rows with a phase margin a drive can
    live with and no more noise than `noise`, give or take 2 %."""
    quiet = [
        row
        for row in rows
        if row["phase margin"] >= PHASE_MARGIN_MIN_DEG
        and row["noise q1 Nm"] <= 1.02 * noise[0]
        and row["noise q2 Nm"] <= 1.02 * noise[1]
    ]
    row = min(quiet, key=lambda r: r["rms q1 mrad"] + r["rms q2 mrad"])
    return gains(row["Kp x"], row["Kd x"], row["Ki/Kp 1/s"])


def latency(config: str, result: dict[str, Any]) -> list[dict[str, Any]]:
    """From an encoder sample to the torque it changes, by stage, in microseconds."""
    c = load_config(CONFIGS / config)
    knot, wire = c.loop.knot_us, c.sim.to_device
    solve = result["solve_us"] + result["encode_us"]
    stages = [
        ("sample: its age when the status leaves", result["sample"], "measured mean"),
        ("wire to the host", result["wire"], "measured mean"),
        ("wait for the tick", result["wait"], "measured mean; ticks lie on knots"),
        ("computing, as simulated", result["compute"], "sim.compute_us, a measured p99.9"),
        ("  of which estimate", result["estimate_us"], "measured median"),
        ("  of which solve, encode", solve, "measured median"),
        ("wire to the device", wire.delay_us, f"as configured, +- {wire.jitter_us}"),
        ("first knot that may change, from the tick", c.loop.margin_us, "the margin"),
        ("effective torque, from there", 2 * knot, "a new point first weighs u^3/6"),
    ]
    return [{"stage": s, "us": float(t), "note": n} for s, t, n in stages]


def main() -> None:
    options = arguments(__doc__ or "")
    seeds, duration_s = (10, 10.0) if options.long else (3, 4.0)
    rows: list[dict[str, Any]] = []
    medians: dict[str, dict[str, Any]] = {}
    with ProcessPoolExecutor(2) as pool:

        def measure(name: str, config: str, overrides: list[str]) -> None:
            print(f"{name} ...", file=sys.stderr)
            jobs = [(config, overrides, seed, duration_s) for seed in range(seeds)]
            results = list(pool.map(run, jobs))
            m = medians[name] = {k: np.median([r[k] for r in results], axis=0) for k in results[0]}
            rows.append({
                "controller": name,
                "rms q1 mrad": m["rms"][0], "rms q2 mrad": m["rms"][1],
                "noise q1 Nm": m["noise"][0], "noise q2 Nm": m["noise"][1],
            })  # fmt: skip

        measure("PID", "arm2.yaml", PID)
        measure("PID + nominal feed-forward", "arm2.yaml", FEEDFORWARD)
        measure("MPC without disturbance estimate", "arm2.yaml", ["estimator.disturbance=false"])
        measure("MPC", "arm2.yaml", [])
        measure("ideal: model known, no delay", "arm2.yaml", IDEAL)
        print("sweeping gains ...", file=sys.stderr)
        pid_rows = sweep(pool, PID, options.long)
        feedforward_rows = sweep(pool, FEEDFORWARD, options.long)
        noise = medians["MPC"]["noise"]
        for name, base, swept_rows in (
            ("PID", PID, pid_rows),
            ("PID + nominal feed-forward", FEEDFORWARD, feedforward_rows),
        ):
            quiet = base + best(swept_rows, noise)
            measure(f"{name}, best gains at MPC's noise", "arm2.yaml", quiet)
            measure(f"{name}, best gains at any noise", "arm2.yaml", base + best(swept_rows))
        stiff = [g for g in best(feedforward_rows) if ".ki_" not in g]
        measure("MPC at those gains", "arm2.yaml", stiff)
        measure("fast: PID + nominal feed-forward", "arm2-fast.yaml", FEEDFORWARD)
        measure("fast: MPC", "arm2-fast.yaml", [])
    table("sweep of PID gains (seed 0)", pid_rows)
    table("sweep of PID gains with nominal feed-forward (seed 0)", feedforward_rows)
    table(f"tracking, medians over {seeds} seeds of {duration_s:g} s", rows)
    table("latency budget", latency("arm2.yaml", medians["MPC"]))

    mpc, feedforward = medians["MPC"], medians["PID + nominal feed-forward"]
    fast, fast_base = medians["fast: MPC"], medians["fast: PID + nominal feed-forward"]
    swept = [medians[name] for name in medians if name.endswith("at MPC's noise")]
    goals = [
        goal("MPC rms q1 mrad", mpc["rms"][0], "<=", 0.45),
        goal("MPC rms q2 mrad", mpc["rms"][1], "<=", 0.75),
        goal("feed-forward / MPC rms q1", feedforward["rms"][0] / mpc["rms"][0], ">=", 10),
        goal("feed-forward / MPC rms q2", feedforward["rms"][1] / mpc["rms"][1], ">=", 10),
    ]
    for axis in (0, 1):
        least = min(s["rms"][axis] for s in swept)
        goals += [
            goal(
                f"MPC / best PID of the sweep with no more noise, rms q{axis + 1}",
                mpc["rms"][axis] / least,
                "<=",
                1,
            ),
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
