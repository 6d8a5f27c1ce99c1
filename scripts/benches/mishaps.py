"""Everything that can go wrong with a machine, at any phase of its task: do all axes come to rest,
and the healthy ones together?"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from _report import arguments, finish, goal, table
from _runs import each, run_through

from headway.configs.load import load_config
from headway.configs.schema import Config
from headway.controller.prediction import ServoLaw
from headway.models.envelope import envelope
from headway.models.machine import load_machine

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
STILL = 0.1  # rad/s: an axis that is slower from here on has come to rest but for its swinging out
SETTLED_S = 0.25  # after its rest
AFTER_S = 0.5  # of the task after the mishap, at most
KNOT_S = 0.004096
# So long a device may have had no plan and not count as one without; rest is seen by milliseconds.
TOGETHER_S = 5 * KNOT_S + 1e-3
# The hung axis itself: late_us, a call of the guard and the brake's time are 20 ms; then it slips
# in its brake while the others pull at it.
HUNG_S = 0.12


@dataclass(frozen=True)
class Mishap:
    """What happens, and by when the healthy axes' setpoints rest [s after it, or after the struck
    board has found out and stopped]: when their plans end, if it is not said."""

    change: str  # of the config
    setpoints_s: float | None = None
    strikes_one: bool = True  # that stops in another way; else all axes do alike
    found_out: bool = False  # by the struck board, sooner or later: till then the others go on


def to_one(kind: str, more: str = "") -> str:
    return f"sim.mishaps=[{{{{kind: {kind}, at_s: {{at}}, joint: {{joint}}{more}}}}}]"


MISHAPS = {
    "host killed": Mishap("sim.kill_host_at_s={at}", strikes_one=False),
    "device reset": Mishap(to_one("reset")),
    "axis partitioned": Mishap(to_one("partition"), strikes_one=False),
    # Found out once the setpoint has moved by 128 counts, or the error has grown to its limit:
    # where the axis turns round that takes its time.
    "encoder stuck": Mishap(to_one("encoder_stuck"), found_out=True),
    "encoder reversed": Mishap(to_one("encoder_reversed"), found_out=True),
    # Each board ramps by itself; after stop_us it brakes.
    "emergency stop": Mishap("sim.mishaps=[{{kind: emergency_stop, at_s: {at}}}]", 0.5, False),
    "supply sag": Mishap(to_one("supply_sag", ", supply_V: {volts}")),
    "firmware hangs": Mishap(to_one("firmware_hangs", ", for_s: {hang}")),
}
APART = ("emergency stop",)  # where the healthy need not rest together
MACHINES = {"arm2": tuple(MISHAPS), "arm6": ("device reset", "axis partitioned", "encoder stuck")}


def decay_s(config: Config) -> float:
    """Time constant of the slowest motion about resting setpoints: of the plant's masses under the
    servos' linear loops, in the worst posture."""
    axes = config.machine.axes
    law, n = ServoLaw.of(axes), len(axes)
    machine = load_machine((CONFIGS / config.machine.model).resolve(), config.machine.coupling)
    model = machine.model
    for body, factor in config.sim.plant.mass_scale.items():
        joint = model.frames[model.getBodyId(body)].parentJoint
        known = model.inertias[joint]
        model.inertias[joint] = pin.Inertia(
            known.mass * factor, known.lever, known.inertia * factor
        )
    low, high = np.array([(axis.lowest, axis.highest) for axis in axes]).T
    over = envelope(machine, low, high)
    loop = np.zeros((len(over.mobility), 2 * n, 2 * n))
    loop[:, :n, n:] = np.eye(n)
    loop[:, n:, :n] = -over.mobility @ (np.diag(law.kp) + over.gravity_stiffness)
    loop[:, n:, n:] = -over.mobility @ np.diag(law.kd + law.emf)
    return -1 / float(np.linalg.eigvals(loop).real.max())


def run(job: tuple[str, str, int]) -> dict[str, Any]:
    """One mishap: when each axis and its setpoint rest [s after it], how fast they were, how near
    one came to a limit [rad], how far it moved once it rested [mrad], and what the host said."""
    machine, name, seed = job
    mishap, path = MISHAPS[name], CONFIGS / f"{machine}.yaml"
    rng = np.random.default_rng(seed)
    at, volts = rng.uniform(0.4, 2.7), rng.uniform(5, 30)
    hang = rng.choice([rng.uniform(0.006, 0.06), rng.uniform(0.06, 2)])
    joints = [axis.joint for axis in load_config(path, []).machine.axes]
    struck = int(rng.integers(len(joints)))
    change = mishap.change.format(at=at, joint=joints[struck], volts=volts, hang=hang)
    config = load_config(path, [change, f"seed={seed}", f"duration_s={at + AFTER_S}"])
    _, arrays, said = run_through(config, CONFIGS)

    def last(kind: str, moves: Any) -> list[float]:
        after = arrays[f"{kind}_s"] >= at
        time_s = arrays[f"{kind}_s"][after] - at
        return [float(max(time_s[moving], default=0.0)) for moving in moves[after].T]

    setpoints = last("servo", arrays["servo_setpoint_rate_pq"] != 0)
    rests = last("truth", np.abs(arrays["truth_velocity"]) > STILL)
    healthy = [i for i in range(len(joints)) if not (mishap.strikes_one and i == struck)]
    told = [setpoints[i] for i in healthy]
    time_s, position = arrays["truth_s"] - at, arrays["truth_position"]
    rested = time_s >= max(rests) + SETTLED_S
    position = position[time_s >= 0]
    return {
        "found_out": setpoints[struck] if mishap.found_out else 0.0,
        "setpoints": max(told),
        "spread": max(told) - min(told),
        "rest": max(rests),
        "speed": float(np.abs(arrays["truth_velocity"][np.argmax(time_s >= 0)]).max()),
        "room": min(
            float(min(position[:, a].min() - axis.lowest, axis.highest - position[:, a].max()))
            for a, axis in enumerate(config.machine.axes)
        ),
        "sag": 1e3 * float(np.ptp(arrays["truth_position"][rested], axis=0).max()),
        "struck": rests[struck],
        "said": said,
    }


def main() -> int:
    """Exit code."""
    options = arguments(__doc__ or "")
    seeds = {"arm2": 200, "arm6": 25} if options.long else {"arm2": 4, "arm6": 1}
    jobs = [
        (machine, name, seed)
        for machine, names in MACHINES.items()
        for name in names
        for seed in range(seeds[machine])
    ]
    results = dict(zip(jobs, each(run, jobs), strict=True))
    rows, goals = [], []
    for machine, names in MACHINES.items():
        config = load_config(CONFIGS / f"{machine}.yaml", [])
        decay = decay_s(config)
        # Before it coasts a device waits 5 knots, and 3 more are the margin.
        plan_s = config.mpc.horizon_us * 1e-6 + 8 * KNOT_S
        for name in names:
            mine = [results[machine, name, seed] for seed in range(seeds[machine])]
            bound = MISHAPS[name].setpoints_s or plan_s
            found, told, spread = (
                max(r[key] for r in mine) for key in ("found_out", "setpoints", "spread")
            )
            after = max(r["setpoints"] - r["found_out"] for r in mine)
            swings = [decay * np.log(max(r["speed"] / STILL, 1)) for r in mine]
            room, sag = min(r["room"] for r in mine), max(r["sag"] for r in mine)
            rows.append({
                "machine": machine, "mishap": name, "runs": len(mine),
                "found out ms": 1e3 * found,
                "setpoints at rest, last ms": 1e3 * told, "apart ms": 1e3 * spread,
                "rest, median ms": 1e3 * float(np.median([r["rest"] for r in mine])),
                "last ms": 1e3 * max(r["rest"] for r in mine),
                "nearest to a limit rad": room, "moved at rest mrad": sag,
            })  # fmt: skip
            late = max(
                r["rest"] - r["found_out"] - bound - swing
                for r, swing in zip(mine, swings, strict=True)
            )
            label = f"{machine}, {name}"
            goals += [
                goal(f"{label}: healthy setpoints at rest [s]", after, "<=", bound),
                goal(f"{label}: rest, beyond that and swinging out [s]", late, "<=", 0.0),
                goal(f"{label}: way to a limit [rad]", room, ">", 0.0),
                goal(f"{label}: moved at rest [mrad]", sag, "<=", 1.0),
            ]
            if name not in APART:
                goals.append(goal(f"{label}: healthy ones apart [s]", spread, "<=", TOGETHER_S))
        print(f"{machine}: what swings about a resting setpoint decays in {1e3 * decay:.0f} ms")
    hung = [r["struck"] for (_, name, _), r in results.items() if "hangs" in name]
    goals.append(goal("firmware hangs: rest of the hung axis [s]", max(hung), "<=", HUNG_S))
    table("mishaps, machines as shipped", rows)
    for said in sorted({r["said"] for r in results.values()})[:12]:
        print(f"    {said}")
    finish(rows, goals, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
