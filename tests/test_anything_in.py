"""What nobody foresaw: the plan stays feasible, still ends at rest, and the way comes back."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from headway.configs.load import load_config
from headway.controller.loop import Loop
from headway.controller.reference import Target
from headway.controller.tick import DeviceError, Phase
from headway.sim.lockstep import Lockstep

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
BACKENDS = "osqp", "riccati"
TURNS_RAD = 0.7853981633974483 + 0.8  # of the shoulder, see configs/arm2.yaml

Array = NDArray[np.float64]


def run(
    backend: str,
    happen: Callable[[Lockstep, int], None],
    monkeypatch: pytest.MonkeyPatch,
    duration_s: float = 2,
) -> Lockstep:
    """arm2 on its task; `happen` is called before each of its ticks."""
    said = [f"mpc.backend={backend}", f"duration_s={duration_s}"]
    if backend == "osqp":  # which stops at its cap more often with weights as large as arm2's
        said += ["mpc.position_weight=1e6", "mpc.velocity_weight=200"]
    lock = Lockstep(load_config(CONFIGS / "arm2.yaml", said), CONFIGS)
    tick, ticks = Loop.tick, [0]

    def watched(loop: Loop, now_us: int):  # type: ignore[no-untyped-def]
        if loop.phase is Phase.RUN:
            happen(lock, ticks[0])
            ticks[0] += 1
        return tick(loop, now_us)

    with monkeypatch.context() as patch:
        patch.setattr(Loop, "tick", watched)
        stopped = False
        try:
            lock.run()
        except DeviceError:
            stopped = True
    record = lock.record.arrays()
    assert set(lock.device_states()) <= {"HOLD", "FAULT"}
    assert stopped or record["end_plans_refused"].max() == 0
    resting = record["truth_s"] > record["truth_s"].max() - 0.3
    assert np.abs(record["truth_velocity"][resting]).max() < 0.02
    return lock


def jumping(*places: tuple[float, float]) -> Callable[[Lockstep, int], None]:
    """The axes are to be elsewhere at once, each 0.4 s."""

    def jump(lock: Lockstep, tick: int) -> None:
        if tick % 100 == 50 and tick // 100 < len(places):
            lock.loop.task = target = Target(np.array(places[tick // 100]))
            lock.loop._follow(target)

    return jump


@pytest.mark.parametrize("backend", ["hpipm", "riccati"])
def test_the_reference_jumps(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By half a radian, in motion and from rest: every plan is one, also by the device's gate, and
    the machine gets there."""
    record = run(backend, jumping((1.7, 1.5), (1.4, 1.0), (1.6, 1.2)), monkeypatch).record.arrays()
    assert record["tick_accepted"].all()
    late = (record["truth_s"] > 1.7) & (record["truth_s"] < 2)
    assert np.abs(record["truth_position"][late] - [1.6, 1.2]).max() < 0.02


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_jump_that_finds_no_plan_is_entered_from_rest(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over 1.4 rad the elbow would be accelerated beyond what the gate lets through: the old plan
    runs on, and once the machine rests it is led to where it should be."""
    record = run(backend, jumping((0.9, -0.3)), monkeypatch).record.arrays()
    refused = np.flatnonzero(~record["tick_accepted"].astype(bool))
    assert 0 < len(refused) < 250
    late = (record["truth_s"] > 1.7) & (record["truth_s"] < 2)
    assert np.abs(record["truth_position"][late] - [0.9, -0.3]).max() < 0.02


@pytest.mark.parametrize(("backend", "seed"), [("riccati", 0), ("riccati", 4), ("hpipm", 2)])
def test_the_reference_jumps_again_before_the_machine_is_there(
    backend: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By up to 1.4 rad, two to six times a second: a machine whose load is heavier than its model's
    is often too fast to stop within the horizon. It gets a plan each third tick at least, and no
    device has enough of it."""
    rng, due = np.random.default_rng(seed), [50]
    home = np.empty(0)

    def jump(lock: Lockstep, tick: int) -> None:
        nonlocal home
        if tick == 0:
            home = lock.loop.task.at(np.zeros(1))[0][0]
        if tick == due[-1]:
            lock.loop.task = target = Target(home + rng.uniform(-0.7, 0.7, 2))
            lock.loop._follow(target)
            due.append(tick + int(rng.integers(40, 122)))

    lock = run(backend, jump, monkeypatch, duration_s=4)
    record = lock.record.arrays()
    assert lock.device_states() == ["HOLD", "HOLD"] and record["end_plans_refused"].max() == 0
    accepted = record["tick_accepted"].astype(bool)
    assert len(due) > 8 and 10 < np.sum(~accepted) < 0.1 * len(accepted)
    assert np.any(record["refused_share"] > 0)
    assert not np.any(~accepted[2:] & ~accepted[1:-1] & ~accepted[:-2])


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_estimator_begins_anew(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """At full speed it is told that the machine rests, without a word of the disturbance."""

    def forget(lock: Lockstep, tick: int) -> None:
        if tick == 200:
            now_us = lock.epoch_us + lock.plant.true_us
            lock.loop.samples.clear()
            lock.loop.estimator.reset(now_us, lock.plant.position.copy())

    lock = run(backend, forget, monkeypatch)
    record = lock.record.arrays()
    assert record["tick_accepted"].mean() > 0.97
    error = np.abs(record["truth_position"] - record["truth_reference"])
    assert error[(record["truth_s"] > 0.6) & (record["truth_s"] < 2)].max() < 0.15
    late = (record["truth_s"] > 1.5) & (record["truth_s"] < 2)
    assert np.sqrt(np.mean(error[late] ** 2)) < 2e-3


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("before_rad", [0.01, 0.02, 0.035, 0.1, 0.3])
def test_something_is_in_the_way(
    backend: str, before_rad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stop that no model knows of, so far before where the shoulder turns back. A little is
    borne. Where the motor pushes with all it has, no plan may rest in time by a model without a
    stop, or the device has enough of it: all come to rest, and nothing else moves."""

    def stop(lock: Lockstep, tick: int) -> None:
        if tick == 0:
            shoulder = lock.plant.model.joint("q1")
            shoulder.range[:] = -3, TURNS_RAD - before_rad
            lock.plant.model.jnt_limited[shoulder.id] = 1

    record = run(backend, stop, monkeypatch).record.arrays()
    truth = record["truth_position"]
    assert truth[:, 0].max() == pytest.approx(
        TURNS_RAD - before_rad, abs=0.04
    )  # it gives way a little
    assert np.abs(truth[:, 1]).max() < 1.4
    if before_rad < 0.05:
        assert record["tick_accepted"].mean() > (0.97 if before_rad < 0.015 else 0.9)
        late = (record["truth_s"] > 1.5) & (record["truth_s"] < 2)
        error = (record["truth_position"] - record["truth_reference"])[late]
        assert np.sqrt(np.mean(error**2)) < 5e-3
