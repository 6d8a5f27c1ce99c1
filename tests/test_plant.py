"""The plant: its state is all there is, motors and brakes are what they say, time is hidden."""

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from headway.configs.load import load_config
from headway.configs.schema import Plant as PlantConfig
from headway.devices._tracks import Sample
from headway.sim.lockstep import Lockstep
from headway.sim.plant import (
    BRAKE,
    COUNTS_PER_UNIT,
    GEAR,
    RESISTANCE,
    SUPPLY,
    TORQUE_CONSTANT,
    Plant,
)

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION
BRAKE_DEFLECTION = 2.5e-3  # [rad] at the brake's full torque, as plugin.c states it


def lockstep(*overrides: str) -> Lockstep:
    return Lockstep(load_config(CONFIGS / "arm2.yaml", list(overrides)), CONFIGS)


class Cut(Exception):
    """Ends a run where it stands, in mid-motion."""


def run_until(lock: Lockstep, task_s: float) -> Lockstep:
    """The closed loop up to a time of the task."""

    def progress(now_s: float) -> None:
        if now_s >= task_s:
            raise Cut

    with pytest.raises(Cut):
        lock._run_task(progress)  # `run` would go on till all have come to rest
    return lock


@pytest.fixture
def moving() -> Lockstep:
    """Both arms in motion, their devices running tracks; nobody sends any more."""
    lock = run_until(lockstep(), 0.7)
    assert lock.device_states() == ["RUNNING", "RUNNING"]
    assert np.abs(lock.plant.velocity).max() > 0.5
    return lock


# The state is all there is.


def saved(plant: Plant) -> "np.ndarray[tuple[int], np.dtype[np.float64]]":
    state = np.empty(mujoco.mj_stateSize(plant.model, INTEGRATION))
    mujoco.mj_getState(plant.model, plant.data, state, INTEGRATION)
    return state


def footprints(model: mujoco.MjModel, data: mujoco.MjData, steps: int) -> list[bytes]:
    """Motion and all that the devices know, after each step."""
    prints = []
    for _ in range(steps):
        mujoco.mj_step(model, data)
        prints.append(data.qpos.tobytes() + data.qvel.tobytes() + data.plugin_state.tobytes())
    return prints


def test_a_restored_state_resumes_bit_for_bit(moving: Lockstep) -> None:
    model, data = moving.plant.model, moving.plant.data
    state, steps = saved(moving.plant), 250_000 // moving.plant.step_us
    first = footprints(model, data, steps)
    assert moving.device_states() == ["HOLD", "HOLD"]  # it went through all of a plan's end
    assert len(set(first)) == steps
    mujoco.mj_setState(model, data, state, INTEGRATION)
    assert moving.device_states() == ["RUNNING", "RUNNING"]
    assert footprints(model, data, steps) == first
    fresh = mujoco.MjData(model)
    mujoco.mj_setState(model, fresh, state, INTEGRATION)
    assert footprints(model, fresh, steps) == first


def test_a_device_that_differs_in_one_bit_is_another_state(moving: Lockstep) -> None:
    """What the comparison above can see: one unit of one control point."""
    model, data = moving.plant.model, moving.plant.data
    state = saved(moving.plant)
    first = footprints(model, data, 100)
    mujoco.mj_setState(model, data, state, INTEGRATION)
    data.plugin_state.view(np.uint8)[8] ^= 1
    assert footprints(model, data, 100) != first


def test_a_new_data_is_a_plant_at_power_up() -> None:
    lock = lockstep()
    fresh = mujoco.MjData(lock.plant.model)
    mujoco.mj_resetData(lock.plant.model, lock.plant.data)
    assert fresh.plugin_state.tobytes() == lock.plant.data.plugin_state.tobytes()
    assert all(node.brake and node.duty_q15 == 0 for node in lock.plant.nodes)


# mj_step alone runs plant and servos.


def test_after_the_cut_the_arm_follows_its_plan_to_rest(moving: Lockstep) -> None:
    plant = moving.plant
    scale = np.array([a.counts_per_unit for a in moving.config.machine.axes]) * 1024
    start, distance, worst = plant.position, np.zeros(2), np.zeros(2)
    for _ in range(500):
        mujoco.mj_step(plant.model, plant.data, 1000 // plant.step_us)
        system_us = plant.true_us + moving.epoch_us
        setpoint = np.array([node.setpoint(system_us)[0] for node in plant.nodes]) / scale
        distance = np.maximum(distance, np.abs(plant.position - start))
        worst = np.maximum(worst, np.abs(plant.position - setpoint))
    assert distance.max() > 0.05  # it had somewhere to go
    assert worst.max() < 0.02  # the plant is heavier than its model
    assert np.abs(plant.velocity).max() < 0.02
    assert moving.device_states() == ["HOLD", "HOLD"]


def test_one_call_of_many_steps_is_as_many_calls(moving: Lockstep) -> None:
    """No servo tick hangs on Python's."""
    model, data = moving.plant.model, moving.plant.data
    state = saved(moving.plant)
    last = footprints(model, data, 400)[-1]
    mujoco.mj_setState(model, data, state, INTEGRATION)
    mujoco.mj_step(model, data, 399)
    assert footprints(model, data, 1)[-1] == last


# The motor.


def constants(model: mujoco.MjModel, axis: int) -> tuple[float, float, float]:
    """Torque constant at the joint [Nm/A], resistance [ohm], supply [V]."""
    user = model.actuator_user[axis]
    return user[GEAR] * user[TORQUE_CONSTANT], user[RESISTANCE], user[SUPPLY]


def motor_torque(plant: Plant, speed: float) -> "np.ndarray[tuple[int], np.dtype[np.float64]]":
    """Torques at a joint speed under the devices' present duty."""
    plant.data.qvel[:] = speed
    mujoco.mj_forward(plant.model, plant.data)
    return plant.torque.copy()


def test_the_motor_at_stall_and_at_no_load(moving: Lockstep) -> None:
    plant = moving.plant
    stall = motor_torque(plant, 0.0)
    for axis, node in enumerate(plant.nodes):
        constant, resistance, supply = constants(plant.model, axis)
        voltage = node.duty_q15 / 32768 * supply
        assert abs(voltage) > 0.01
        assert stall[axis] == pytest.approx(constant * voltage / resistance, rel=1e-12)
        free = motor_torque(plant, voltage / constant)[axis]
        assert abs(free) < 1e-12 * abs(stall[axis])
        # A straight line between: half the torque at half the speed.
        half = motor_torque(plant, voltage / constant / 2)[axis]
        assert half == pytest.approx(stall[axis] / 2, rel=1e-12)


def test_every_step_of_a_run_obeys_the_motor_equation(moving: Lockstep) -> None:
    """The force of a step comes from the duty and the speed with which the step began."""
    plant = moving.plant
    for _ in range(400):
        duty = [node.duty_q15 / 32768 for node in plant.nodes]
        speed = plant.velocity
        plant.step(1)
        for axis in range(2):
            constant, resistance, supply = constants(plant.model, axis)
            current = (duty[axis] * supply - constant * speed[axis]) / resistance
            assert plant.torque[axis] == pytest.approx(constant * current, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("sign", [1, -1])
def test_no_more_torque_than_the_supply_gives(sign: int) -> None:
    """With 3 V at q1 the bridge saturates before the torque limit does."""
    lock = lockstep("machine.axes.0.motor.supply_V=3", "sim.start_rad_or_m=[1.5707963,0]")
    lock.plant.model.actuator_user[0, SUPPLY] = lock.plant.nodes[0].feed_V = 3
    plant = run_until(lock, 0.05).plant  # the brakes have let go
    constant, resistance, supply = constants(plant.model, 0)
    most = constant * supply / resistance
    assert most < lock.config.machine.axes[0].effort_limit
    place = plant.position[0] - sign * 0.045  # less than what looks like a broken encoder
    for _ in range(160):
        plant.data.qpos[0], plant.data.qvel[:] = place, 0
        plant.step(1)
        assert sign * plant.torque[0] <= most + 1e-9
    assert plant.nodes[0].duty_q15 == sign * 32767
    speed = plant.velocity[0]
    plant.step(1)
    expected = sign * most * 32767 / 32768 - constant**2 / resistance * speed
    assert plant.torque[0] == pytest.approx(expected, rel=1e-12)


def test_the_plants_differences_reach_the_model() -> None:
    config = load_config(CONFIGS / "arm2.yaml")
    path = CONFIGS / config.machine.model
    nominal = Plant(path, config.machine, PlantConfig(), 1000, [0.0, 0.0]).model
    varied = Plant(path, config.machine, config.sim.plant, 1000, [0.0, 0.0]).model
    link2 = nominal.body("link2").id
    assert varied.body_mass[link2] == 1.25 * nominal.body_mass[link2]
    np.testing.assert_array_equal(varied.body_inertia[link2], 1.25 * nominal.body_inertia[link2])
    assert varied.body_mass[link2 - 1] == nominal.body_mass[link2 - 1]
    np.testing.assert_array_equal(varied.dof_damping, 1.6 * nominal.dof_damping)
    np.testing.assert_array_equal(varied.dof_frictionloss, [0.15, 0.15])
    np.testing.assert_array_equal(
        varied.actuator_user[:, TORQUE_CONSTANT], 0.97 * nominal.actuator_user[:, TORQUE_CONSTANT]
    )


# Encoder and brake.


def first_samples(lock: Lockstep) -> list[Sample]:
    """What the host receives in its first quarter second."""
    seen: list[Sample] = []
    loop_read = lock.loop.read

    def read(link: object, now_us: int) -> None:
        loop_read(link, now_us)  # type: ignore[arg-type]
        seen.extend(lock.loop.samples)
        if now_us > lock.epoch_us + 250_000:
            raise Cut

    lock.loop.read = read  # type: ignore[method-assign]
    with pytest.raises(Cut):
        lock.run()
    return seen


@pytest.mark.parametrize("counts", [(0.0, 0.49), (1000.51, -0.49), (-7000.51, 12345.4)])
def test_a_sample_is_the_nearest_count(counts: tuple[float, float]) -> None:
    pitch = 2 * np.pi / 40_000
    lock = lockstep()
    lock.plant.model.opt.gravity[:] = 0  # the brake holds, and nothing pulls
    lock.plant.position = np.array(counts) * pitch
    samples = first_samples(lock)
    for axis in range(2):
        values = {s.position for s in samples if s.axis == axis}
        assert values == {round(counts[axis]) * pitch}


def test_the_models_encoders_are_the_configs() -> None:
    lock = lockstep()
    per_unit = lock.plant.model.actuator_user[:, COUNTS_PER_UNIT]
    counts = [axis.counts_per_unit for axis in lock.config.machine.axes]
    np.testing.assert_allclose(per_unit, counts, rtol=1e-14)


@pytest.fixture
def braked() -> Iterator[Plant]:
    """At power-up: brakes on; without gravity, so that the load is all there is."""
    config = load_config(CONFIGS / "arm2.yaml")
    plant = Plant(CONFIGS / config.machine.model, config.machine, PlantConfig(), 1000, [0.0, 0.0])
    plant.model.opt.gravity[:] = 0
    yield plant
    assert all(node.brake for node in plant.nodes)


def settle(plant: Plant, load: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> None:
    """One second under a load that rises in its first half."""
    for step in range(4000):
        plant.data.qfrc_applied[:] = load * min(1.0, step / 2000)
        plant.step(1)


@pytest.mark.parametrize("share", [0.25, 0.95, -0.95])
def test_a_brake_holds_within_its_stated_deflection(braked: Plant, share: float) -> None:
    strength = braked.model.actuator_user[:, BRAKE]
    settle(braked, share * strength)
    np.testing.assert_allclose(braked.position, share * BRAKE_DEFLECTION, rtol=1e-3)
    np.testing.assert_allclose(braked.torque, -share * strength, rtol=1e-3)


def test_a_brake_gives_way_above_its_strength(braked: Plant) -> None:
    strength = braked.model.actuator_user[:, BRAKE]
    settle(braked, 1.2 * strength)
    assert np.all(braked.position > 10 * BRAKE_DEFLECTION)
    np.testing.assert_allclose(braked.torque, -strength, rtol=1e-12)


def test_the_brake_holds_the_arm_up_at_power_up() -> None:
    lock = lockstep()
    start = lock.plant.position
    lock.plant.step(8000)
    assert lock.plant.nodes[0].brake and lock.plant.nodes[1].brake
    sag = np.abs(lock.plant.position - start)
    assert np.all(sag > 0) and np.all(sag < BRAKE_DEFLECTION)


# Time is an argument: MuJoCo's clock and the simulator's own are nobody's.


@pytest.fixture(scope="module")
def undisturbed() -> str:
    lock = lockstep("duration_s=0.4")
    lock.run()
    return lock.record.sha256()


@pytest.mark.parametrize("poison", [lambda r: r.uniform(-1e9, 1e9), lambda r: np.nan])
def test_nobody_reads_mujocos_clock(
    undisturbed: str, poison: Callable[[np.random.Generator], float]
) -> None:
    lock, rng = lockstep("duration_s=0.4"), np.random.default_rng(5)
    plant = lock.plant

    def step(count: int) -> None:
        for _ in range(count):
            plant.data.time = poison(rng)
            mujoco.mj_step(plant.model, plant.data)

    plant.step = step  # type: ignore[method-assign]
    lock.run()
    assert lock.ticks > 90
    assert lock.record.sha256() == undisturbed


# Counters of 32 bits with drifts in ppb are the same after this much more true time.
ROUND_US = 2**32 * 10**9


def shifted_run(true_us: int, epoch_us: int) -> str:
    """A hash of all motion of a run in which true time starts at `true_us` and the host's epoch is
    moved."""
    lock = lockstep("duration_s=0.4", "sim.clocks.wander_ppm_per_s=0")
    counts = lock.plant.position * 40_000 / (2 * np.pi)
    for node, count in zip(lock.plant.nodes, counts, strict=True):
        node.poll(true_us, round(count))
    assert lock.plant.true_us == true_us
    lock.link.epoch_us += epoch_us
    lock.run()
    arrays = lock.record.arrays()
    channels = "truth_position", "truth_velocity", "servo_torque_tq", "now_estimate", "commit_s"
    return hashlib.sha256(b"".join(arrays[c].tobytes() for c in channels)).hexdigest()


def test_nobody_sees_true_time() -> None:
    """136,000 years later by true time, at the same system time: the same run."""
    assert shifted_run(ROUND_US, -ROUND_US) == shifted_run(0, 0)


def test_a_run_is_the_same_in_another_decade() -> None:
    """All of system time moved by a whole number of knots: only the time differs."""
    assert shifted_run(0, 4096 * 77_777_777_777) == shifted_run(0, 0)


def test_an_oscillator_that_runs_away_is_seen_by_the_run() -> None:
    """What the two tests above can see: devices whose counters differ."""
    assert shifted_run(1_000_000, -1_000_000) != shifted_run(0, 0)
