"""Gain tracks: bandwidth that stays, gains that the gate takes, a prediction that knows of them."""

import importlib.metadata
import itertools
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import BSpline

from headway.configs.load import load_config
from headway.configs.mistakes.mistake import ConfigError
from headway.configs.schema import Config
from headway.controller.equations import COULOMB_SPEED
from headway.controller.gains import Gains, Schedule
from headway.controller.loop import plan_points
from headway.controller.motion import Motion
from headway.controller.prediction import Prediction, ServoLaw
from headway.controller.tracks import Encoder
from headway.devices import core, packet
from headway.devices.axis import AxisUnits, position_limits, torque_limits
from headway.devices.remote import Points
from headway.devices.settings import device_settings
from headway.devices.widest import fits_a_frame
from headway.models.machine import Machine, load_machine
from headway.models.source import read_spec
from headway.sim.lockstep import Lockstep

ROOT = Path(__file__).resolve().parent.parent
CONFIGS, MACHINES = ROOT / "configs", ROOT / "tests" / "machines"
ROBOTS = Path(
    str(
        importlib.metadata.distribution("example-robot-data").locate_file(
            "cmeel.prefix/share/example-robot-data/robots"
        )
    )
)
MODELS = {
    "arm2": ROOT / "models" / "arm2" / "arm2.xml",
    "planar3": MACHINES / "planar3.xml",
    "scara": MACHINES / "scara.xml",
    "gantry": MACHINES / "gantry.xml",
    "ur5": ROBOTS / "ur_description" / "urdf" / "ur5_joint_limited_robot.urdf",
}
GAINS = (core.TRACK_KP, core.TRACK_KI, core.TRACK_KD)
MODES = ("off", "fixed", "scheduled")

Array = NDArray[np.float64]


# The schedule. Oracle: MuJoCo's mass matrix, and the linear system of joints and servos.


class Case:
    """A machine with servos at random and its schedule."""

    def __init__(self, name: str, seed: int) -> None:
        machine, self._plant = models(name)
        rng = np.random.default_rng(seed)
        n = self.n = len(machine.joints)
        ranges = self._plant.jnt_range.copy()
        ranges[~self._plant.jnt_limited.astype(bool)] = -np.pi, np.pi
        self.low, self.high = ranges.T
        heaviest = np.max([self.mass(q).diagonal() for q in self.postures(rng, 300)], axis=0)
        frequency, damping = rng.uniform(10, 60, n), rng.uniform(0.5, 1.5, n)
        total = 2 * damping * frequency * heaviest
        emf = rng.uniform(0.0, 0.4, n) * total
        kp = heaviest * frequency**2
        self.law = ServoLaw(kp, total - emf, emf, np.full(n, 1e6), np.zeros(n))
        self.schedule = Schedule(machine, self.law, self.low, self.high)

    def postures(self, rng: np.random.Generator, count: int) -> Array:
        return rng.uniform(self.low, self.high, (count, self.n))

    def mass(self, q: Array) -> Array:
        data, mass = mujoco.MjData(self._plant), np.zeros((self.n, self.n))
        data.qpos[:] = q
        mujoco.mj_fwdPosition(self._plant, data)
        mujoco.mj_fullM(self._plant, data, mass)
        return mass

    def gains(self, q: Array) -> tuple[Array, Array]:
        """Kp and Kd + c at a posture, with the Kd that a servo can have."""
        share, law = self.schedule(q[None])[0], self.law
        return law.kp * share, np.maximum((law.kd + law.emf) * share, law.emf)


@cache
def models(name: str) -> tuple[Machine, mujoco.MjModel]:
    machine, plant = load_machine(MODELS[name]), read_spec(MODELS[name]).compile()
    assert machine.joints == tuple(plant.joint(j).name for j in range(plant.njnt))
    return machine, plant


@cache
def case_of(name: str, seed: int) -> Case:
    return Case(name, seed)


cases = st.builds(case_of, st.sampled_from(sorted(MODELS)), st.integers(0, 3))


def poles(inertia: float, kp: float, damping: float) -> Array:
    roots: Array = np.linalg.eigvals(np.array([[0, 1], [-kp / inertia, -damping / inertia]]))
    return roots


@given(cases, st.integers(0, 2**32))
def test_a_joint_alone_keeps_its_frequency_and_its_damping(case: Case, seed: int) -> None:
    """The slowest joint, the others locked: the eigenvalues are the same at any posture."""
    slowest = int(np.argmin(case.schedule.crossover))
    rng = np.random.default_rng(seed)
    found = []
    for q in case.postures(rng, 4):
        kp, damping = (gain[slowest] for gain in case.gains(q))
        if damping > case.law.emf[slowest]:  # else Kd is at zero: the motor alone damps more
            found.append(poles(case.mass(q)[slowest, slowest], kp, damping))
    for roots in found[1:]:
        np.testing.assert_allclose(np.abs(roots), np.abs(found[0]), rtol=1e-6)
        np.testing.assert_allclose(roots.real, found[0].real, rtol=1e-6)


@given(cases)
def test_frequency_and_damping_are_those_of_the_config_at_the_largest_inertia(case: Case) -> None:
    slowest, law = int(np.argmin(case.schedule.crossover)), case.law
    postures = case.postures(np.random.default_rng(1), 300)
    heaviest = max(case.mass(q)[slowest, slowest] for q in postures)
    configured = poles(heaviest, law.kp[slowest], law.kd[slowest] + law.emf[slowest])
    kp, damping = (gain[slowest] for gain in case.gains(postures[0]))
    if damping > law.emf[slowest]:
        roots = poles(case.mass(postures[0])[slowest, slowest], kp, damping)
        np.testing.assert_allclose(np.abs(roots), np.abs(configured), rtol=0.06)


def loop_gain(case: Case, q: Array, joint: int) -> float:
    """|servo x machine| of one joint at its crossover, the slower joints on their servos, the
    faster ones locked: from the state-space form."""
    crossover = case.schedule.crossover
    moving = [j for j in range(case.n) if crossover[j] < crossover[joint]] + [joint]
    kp, damping = case.gains(q)
    open_loop = np.array([1.0] * (len(moving) - 1) + [0.0])
    inverse = np.linalg.inv(case.mass(q)[np.ix_(moving, moving)])
    m, eye = len(moving), np.eye(len(moving))
    a = np.block(
        [
            [np.zeros((m, m)), eye],
            [-inverse * (kp[moving] * open_loop), -inverse * (damping[moving] * open_loop)],
        ]
    )
    b = np.concatenate((np.zeros(m), inverse[:, -1]))
    s = 1j * crossover[joint]
    state = np.linalg.solve(s * np.eye(2 * m) - a, b)
    return float(abs((kp[joint] + damping[joint] * s) * state[m - 1]))


@given(cases, st.integers(0, 2**32))
def test_every_loop_has_the_same_gain_at_its_crossover_in_any_posture(
    case: Case, seed: int
) -> None:
    """In the machine with all of its slower servos."""
    rng = np.random.default_rng(seed)
    for joint in range(case.n):
        found = []
        for q in case.postures(rng, 3):
            share = case.schedule(q[None])[0, joint]
            if share < 1 and case.gains(q)[1][joint] > case.law.emf[joint]:
                found.append(loop_gain(case, q, joint))
        np.testing.assert_allclose(found, found[:1] * len(found), rtol=1e-6)


@given(cases, st.integers(0, 2**32))
def test_shares_are_above_zero_and_at_most_one(case: Case, seed: int) -> None:
    rng = np.random.default_rng(seed)
    share = case.schedule(case.postures(rng, 20))
    assert np.all(share > 0) and np.all(share <= 1)


@pytest.mark.parametrize("name", sorted(MODELS))
def test_some_posture_has_all_of_the_configured_gain(name: str) -> None:
    case = case_of(name, 0)
    share = case.schedule(case.postures(np.random.default_rng(2), 2000))
    assert np.all(share.max(axis=0) > 0.9)


def test_fixed_gains_would_not_keep_the_frequency() -> None:
    """What the properties above can see."""
    case = case_of("arm2", 0)
    postures = case.postures(np.random.default_rng(3), 50)
    inertia = np.array([case.mass(q).diagonal() for q in postures])
    assert inertia[:, 0].max() / inertia[:, 0].min() > 2
    assert np.ptp(case.schedule(postures), axis=0).min() > 0.3


# The tracks.


def config_of(*overrides: str) -> Config:
    return load_config(CONFIGS / "arm2.yaml", list(overrides))


KI = [f"machine.axes.{axis}.servo.ki_Nm_per_rad_s={ki}" for axis, ki in ((0, 300), (1, 90))]
SCHEDULED = config_of("loop.gains=scheduled", *KI)
AXES, LOOP = SCHEDULED.machine.axes, SCHEDULED.loop
KNOT_S = LOOP.knot_us * 1e-6
HORIZON = SCHEDULED.mpc.horizon_us // LOOP.knot_us
KNOTS = np.arange(HORIZON + 1)
UNITS = [AxisUnits.of(axis, LOOP) for axis in AXES]
LIMITS = [device_settings(axis, SCHEDULED.device, LOOP, SCHEDULED.sync) for axis in AXES]


@cache
def gains(mode: str) -> Gains:
    config = SCHEDULED.model_copy(update={"loop": LOOP.model_copy(update={"gains": mode})})
    return Gains(config, models("arm2")[0], plan_points(config))


@cache
def prediction() -> Prediction:
    return Prediction(models("arm2")[0], ServoLaw.of(AXES), SCHEDULED.mpc.intervals, HORIZON)


@cache
def encoder(mode: str) -> Encoder:
    return Encoder(prediction(), UNITS, gains(mode), LOOP)


class Held:
    """A device as far as the encoder asks: its tracks."""

    def __init__(self, axis: int, position: Array, mode: str) -> None:
        place = UNITS[axis].position_points(np.full(40, position[axis]))
        self._tracks = [core.Track() for _ in range(5)]
        self._tracks[core.TRACK_POSITION].write(-20, place)
        self._tracks[core.TRACK_TORQUE].write(-20, np.zeros(40, dtype=np.int32))
        self.write(-20, gains(mode).still(position, 40)[axis])

    def track(self, sink: int) -> core.Track:
        return self._tracks[sink]

    def write(self, first: int, points: Points) -> None:
        for sink, values in zip(GAINS, points, strict=True):
            self._tracks[sink].write(first, values)


def motions(seed: int, wild: bool) -> list[Motion]:
    """Plans in a row: smooth ones, each going on from the last; or wild ones, each from anywhere
    to anywhere within one plan."""
    rng = np.random.default_rng(seed)
    low = np.array([axis.position_min for axis in AXES])
    high = np.array([axis.position_max for axis in AXES])
    if wild:
        shape = 12, HORIZON + 1, 2
        positions = low + (high - low) * rng.uniform(0, 1, shape).round(rng.integers(0, 3))
    else:
        phase, rate = rng.uniform(0, 2 * np.pi, 2), rng.uniform(1, 8, 2)
        times = (np.arange(12)[:, None] + KNOTS) * KNOT_S
        positions = (low + high) / 2 + (high - low) / 2 * np.sin(times[..., None] * rate + phase)
    zeros = np.zeros((HORIZON + 1, 2))
    return [Motion.of(q, zeros, zeros) for q in positions]


def value(points: NDArray[np.int32]) -> Array:
    """A track at many times, by de Boor's algorithm."""
    knots = np.arange(len(points) + 4) - 3.0
    fine: Array = BSpline(knots, points.astype(float), 3)(np.linspace(0, HORIZON, 8 * HORIZON))
    return fine


@settings(max_examples=40)
@given(st.sampled_from(MODES[1:]), st.integers(0, 2**32), st.booleans())
def test_gain_tracks_continue_rest_at_the_end_and_pass_the_gate(
    mode: str, seed: int, wild: bool
) -> None:
    plans = motions(seed, wild)
    remotes: Any = [Held(axis, plans[0].position[0], mode) for axis in range(2)]
    for knot, motion in enumerate(plans):
        points = encoder(mode).gain_points(motion.position, remotes, knot)
        for remote, plan, settings_, axis in zip(remotes, points, LIMITS, AXES, strict=True):
            for sink, row, scale in zip(
                GAINS,
                plan,
                (settings_.servo.kp_tq, settings_.servo.ki_tq, settings_.servo.kd_tq),
                strict=True,
            ):
                track, limits = remote.track(sink), settings_.limits(sink)
                assert row[:3].tobytes() == track.points(knot - 1, 3).tobytes()
                assert len(set(row[-3:].tolist())) == 1
                result = core.gate_check_track(limits, track, knot - 1, row, knot - 1)
                assert result == "accepted", (axis.joint, sink)
                mantissa = value(row) / 256
                assert mantissa.min() >= 0 and mantissa.max() <= scale.mantissa * (1 + 1e-12)
                if mode == "fixed":
                    assert np.all(row == scale.mantissa * 256)
            remote.write(knot - 1, plan)


def test_smooth_gain_tracks_say_the_schedule_and_take_two_bytes_a_point() -> None:
    """To 2 % of the configured gain, once the committed points are past and before the end, where
    these motions stop dead."""
    plans = motions(5, wild=False)
    remotes: Any = [Held(axis, plans[0].position[0], "scheduled") for axis in range(2)]
    for knot, motion in enumerate(plans):
        wanted = by_sink(gains("scheduled").points(motion.position))
        points = encoder("scheduled").gain_points(motion.position, remotes, knot)
        for axis, plan in enumerate(points):
            for sink, row in zip(GAINS, plan, strict=True):
                at_knots = np.convolve(row, [1 / 6, 4 / 6, 1 / 6], "valid")
                error = np.abs(at_knots - wanted[sink][:, axis])[5:-10]
                assert error.max() < 0.02 * LIMITS[axis].limits(sink).point_max
            frame = core_bytes(dict(zip(GAINS, plan, strict=True)))
            assert frame <= 50 + 3 * 2.3 * (HORIZON + 3)
            remotes[axis].write(knot - 1, plan)


def by_sink(points: Array) -> dict[int, Array]:
    return dict(zip(GAINS, np.hsplit(points, 3), strict=True))


def core_bytes(points: dict[int, NDArray[np.int32]]) -> int:
    from headway.firmware import _core

    return len(_core.plan_encode((0, 0, 0), 1, 0, 0, points))


def test_the_schedule_of_the_config_is_that_of_its_axes() -> None:
    """Kp, Ki and Kd + c fall together; Kd stops at zero."""
    position = np.array([[0.3, 0.0], [0.3, 1.5], [0.3, 2.4]])
    points = by_sink(gains("scheduled").points(position))
    law = ServoLaw.of(AXES)
    share = (
        np.stack([points[sink] for sink in GAINS])
        / np.array([[LIMITS[axis].limits(sink).point_max for axis in range(2)] for sink in GAINS])[
            :, None
        ]
    )
    low = np.array([axis.position_min for axis in AXES])
    expected = Schedule(models("arm2")[0], law, low, -low)(position)
    np.testing.assert_allclose(share[0], expected)
    np.testing.assert_allclose(share[1], expected)
    damping = share[2] * law.kd + law.emf
    np.testing.assert_allclose(damping, np.maximum((law.kd + law.emf) * expected, law.emf))


def test_where_the_motor_alone_damps_too_much_kd_is_zero() -> None:
    """With next to no Kd of its own a loop cannot follow all the way."""
    kd = [f"machine.axes.{axis}.servo.kd_Nm_s_per_rad={kd}" for axis, kd in ((0, 0.2), (1, 0))]
    config = config_of("loop.gains=scheduled", *kd)
    at = np.array([[0.0, 2.4], [0.0, 0.0]])
    points = by_sink(Gains(config, models("arm2")[0], 54).points(at))
    assert points[core.TRACK_KD][0, 0] == 0
    assert points[core.TRACK_KD][1, 0] > 0
    assert np.all(points[core.TRACK_KD][:, 1] == 0)
    assert np.all(points[core.TRACK_KP] > 0)


# The prediction.


def stride(offset: float) -> Motion:
    """From folded to half stretched within a plan, by the model."""
    s, duration_s = np.clip(KNOTS / 40, 0, 1)[:, None], 40 * KNOT_S
    way = np.array([0.1, 0.6])
    q = np.array([0.4, -1.8]) + offset + way * s**3 * (10 - 15 * s + 6 * s * s)
    v = way * 30 * s**2 * (1 - s) ** 2 / duration_s
    a = way * 60 * s * (1 - s) * (1 - 2 * s) / duration_s**2
    return Motion.of(q, v, prediction().inverse_dynamics(q, v, a))


def test_a_roll_out_follows_gains_that_vary() -> None:
    """Against an adaptive integrator with the servo law and the tracks written out again."""
    model = models("arm2")[0].model
    data, law = model.createData(), ServoLaw.of(AXES)
    motion = stride(0.0)
    start = np.array([0.4, -1.8, 0.0, 0.0])
    remotes: Any = [Held(axis, start[:2], "scheduled") for axis in range(2)]
    points, rolled = encoder("scheduled").plan(motion, remotes, 0, start, np.zeros(2))
    factor = [
        {
            sink: gain / LIMITS[axis].limits(sink).point_max
            for sink, gain in ((core.TRACK_KP, law.kp[axis]), (core.TRACK_KD, law.kd[axis]))
        }
        for axis in range(2)
    ]
    knots = np.arange(HORIZON + 7) - 3.0
    splines = [[BSpline(knots, row.astype(float), 3) for row in p] for p in points]
    assert all(np.ptp(p[core.TRACK_KP]) * factor[a][core.TRACK_KP] > 0.1 * law.kp[a]
               for a, p in enumerate(points))  # fmt: skip

    def derivative(time_s: float, x: Array, share: float = 1.0) -> Array:
        k, motor = time_s / KNOT_S, np.empty(2)
        for axis, of in enumerate(splines):
            r = of[core.TRACK_POSITION](k) / UNITS[axis].pq_per_unit
            rate = of[core.TRACK_POSITION](k, 1) / KNOT_S / UNITS[axis].pq_per_unit
            kp = of[core.TRACK_KP](k) * factor[axis][core.TRACK_KP] * share
            kd = of[core.TRACK_KD](k) * factor[axis][core.TRACK_KD] * share
            motor[axis] = of[core.TRACK_TORQUE](k) / UNITS[axis].tq_per_effort
            motor[axis] += kp * (r - x[axis]) + (kd + law.emf[axis]) * (rate - x[2 + axis])
        motor = np.clip(motor, -law.limit, law.limit) - model.damping * x[2:]
        motor -= law.coulomb * np.tanh(x[2:] / COULOMB_SPEED)
        return np.concatenate((x[2:], pin.aba(model, data, x[:2], x[2:], motor)))

    end = HORIZON * KNOT_S
    times = np.minimum(KNOTS * KNOT_S, end)
    options: dict[str, Any] = {"t_eval": times, "rtol": 1e-9, "atol": 1e-10, "max_step": KNOT_S / 2}
    exact = solve_ivp(derivative, (0, end), start, **options).y.T
    assert np.ptp(exact[:, 1]) > 0.5
    error = np.abs(rolled.position - exact[:, :2]).max()
    assert error < 1e-4
    # Were the gains 2 % off, it would show.
    off = solve_ivp(derivative, (0, end), start, args=(0.98,), **options).y.T
    assert np.abs(off[:, :2] - exact[:, :2]).max() > 4 * error


def test_the_torque_track_counts_on_the_gains_that_are_sent() -> None:
    """On the plan, tracks and gains together give the planned torque."""
    motion = stride(0.02)  # off the committed position, so that the feedback has much to say
    remotes: Any = [Held(axis, np.array([0.4, -1.8]), "scheduled") for axis in range(2)]
    start = np.array([0.4, -1.8, 0.0, 0.0])
    right, _ = encoder("scheduled").plan(motion, remotes, 0, start, np.zeros(2))
    assert np.abs(encoder("scheduled").departure()[5:]).max() < 0.05
    # A torque track that counts on other gains is another one.
    wrong, _ = encoder("fixed").plan(motion, remotes, 0, start, np.zeros(2))
    sink, per_nm = core.TRACK_TORQUE, np.array([units.tq_per_effort for units in UNITS])
    change = [a[sink] - b[sink] for a, b in zip(right, wrong, strict=True)]
    assert np.abs(change / per_nm[:, None])[:, 6:].max() > 0.2


# A frame.


@pytest.mark.parametrize("name", ["arm2.yaml", "arm2-fast.yaml"])
def test_five_tracks_of_the_shipped_machines_fit_a_frame(name: str) -> None:
    """Even with an integral, and with every point at the gate's limits."""
    config = load_config(CONFIGS / name, ["loop.gains=scheduled", *KI])
    Gains(config, models("arm2")[0], plan_points(config))


def test_a_plan_that_might_not_fit_is_refused_at_the_start() -> None:
    config = config_of("loop.gains=fixed", "mpc.horizon_us=344064")
    with pytest.raises(ValueError, match=r"loop\.gains is fixed: a plan of 87 points .*horizon_us"):
        Lockstep(config, CONFIGS)
    Lockstep(config_of("mpc.horizon_us=344064"), CONFIGS)


@given(st.integers(3, 128), st.integers(0, 2**32))
def test_what_is_said_to_fit_fits(count: int, seed: int) -> None:
    """No plan that the gate takes is larger than the widest one."""
    settings_, axis, units = LIMITS[0], AXES[0], UNITS[0]
    limits = {
        core.TRACK_POSITION: position_limits(axis, units),
        core.TRACK_TORQUE: torque_limits(axis, units),
        **{sink: settings_.limits(sink) for sink in GAINS},
    }
    rng = np.random.default_rng(seed)
    points = {}
    for sink, of in limits.items():
        steps = rng.integers(-1, 2, count) * (of.second_difference_max // 2)
        walk = np.clip(np.cumsum(steps) // 2, of.point_min, of.point_max).astype(np.int32)
        walk[-3:] = walk[-3]
        points[sink] = walk
    fresh = core.Track()
    legal = all(
        core.gate_check_track(limits[s], fresh, 10, p, 0) == "accepted" for s, p in points.items()
    )
    if legal and fits_a_frame(limits, count):
        assert core_bytes(points) <= 1000


# The loop.


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("config", ["arm2.yaml", "arm2-fast.yaml"])
def test_a_run_ends_well(mode: str, config: str) -> None:
    overrides = [f"loop.gains={mode}", "duration_s=1.2"]
    lock = Lockstep(load_config(CONFIGS / config, overrides), CONFIGS)
    lock.run()
    record = lock.record.arrays()
    assert record["tick_accepted"].mean() > 0.99
    assert record["end_plans_refused"][0] == record["end_plans_late"][0] == 0
    assert lock.device_states() == ["HOLD", "HOLD"]
    task = (record["truth_s"] > 0.5) & (record["truth_s"] < 1.2)
    error = (record["truth_position"] - record["truth_reference"])[task]
    assert np.abs(error).max() < (0.02 if config == "arm2.yaml" else 0.1)
    sinks = (core.TRACK_POSITION, core.TRACK_TORQUE, *(GAINS if mode != "off" else ()))
    ends, packets = record["sent_packet_offsets"], record["sent_packet"]
    frames = [packets[a:b].tobytes() for a, b in itertools.pairwise(ends)]
    plans = [
        packet.plan(f) for f, is_plan in zip(frames, record["sent_plan"], strict=True) if is_plan
    ]
    assert len(plans) > 500
    for plan in plans:
        assert plan is not None and tuple(sorted(plan[2])) == sinks


def test_the_estimate_knows_the_gains() -> None:
    """What the filter predicts with is what is on the wire, in SI, at any time."""
    lock = Lockstep(config_of("loop.gains=scheduled", "duration_s=0.6"), CONFIGS)
    lock.run()
    record = lock.record.arrays()
    at = record["end_us"][0] - 2_000_000 + np.arange(0, 400_000, 3_000)
    tracks = [[remote.track(sink) for sink in range(5)] for remote in lock.remotes]
    course = Gains(lock.config, models("arm2")[0], 54).course(tracks, UNITS)
    seen = course.at(at, np.zeros(2))[:, 6:]
    law = ServoLaw.of(lock.config.machine.axes)
    for axis in range(2):
        config = lock.config
        settings_ = device_settings(
            config.machine.axes[axis], config.device, config.loop, config.sync
        )
        for column, sink, gain, more in (
            (axis, core.TRACK_KP, law.kp[axis], 0.0),
            (2 + axis, core.TRACK_KD, law.kd[axis], law.emf[axis]),
        ):
            points = lock.remotes[axis].track(sink).evaluate(at, lock.config.loop.knot_shift)[0]
            expected = points / settings_.limits(sink).point_max * gain + more
            np.testing.assert_allclose(seen[:, column], expected, rtol=2e-4)


@pytest.mark.parametrize("given_", ["on", "[1]", "Scheduled"])
def test_any_other_word_is_a_mistake(given_: str) -> None:
    with pytest.raises(ConfigError, match=r"loop\.gains"):
        config_of(f"loop.gains={given_}")
