"""From plans to control points and back: the fit, the encoder, what the devices then execute."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicHermiteSpline

from headway.configs.load import load_config
from headway.configs.schema import Config
from headway.controller import tracks
from headway.controller.gains import Gains
from headway.controller.motion import Motion
from headway.controller.mpc import Mpc, Solution
from headway.controller.prediction import Prediction, ServoLaw
from headway.controller.tick import Outbox, Phase, Tick
from headway.controller.tracks import Encoder, Fit
from headway.devices import core
from headway.devices.axis import AxisUnits
from headway.devices.remote import Points, Remote
from headway.models.machine import load_machine
from headway.sim.lockstep import Lockstep

ROOT = Path(__file__).resolve().parent.parent
CONFIGS = ROOT / "configs"
PITCH = 2 * np.pi / 40_000  # [rad] one encoder count
PQ_PER_RAD, TQ_PER_NM = 1024 / PITCH, 1e6
FREE = 5  # index, from the commit knot, after the committed points and the first three free knots

Array = NDArray[np.float64]


def config_of(*overrides: str) -> Config:
    return load_config(CONFIGS / "arm2.yaml", list(overrides))


CONFIG = config_of()
KNOT_S = CONFIG.loop.knot_us * 1e-6
HORIZON = CONFIG.mpc.horizon_us // CONFIG.loop.knot_us
UNITS = [AxisUnits.of(axis, CONFIG.loop) for axis in CONFIG.machine.axes]


@cache
def prediction() -> Prediction:
    machine = load_machine(ROOT / "models" / "arm2" / "arm2.xml")
    return Prediction(machine, ServoLaw.of(CONFIG.machine.axes), CONFIG.mpc.intervals, HORIZON)


@cache
def gains() -> Gains:
    return Gains(CONFIG, load_machine(ROOT / "models" / "arm2" / "arm2.xml"), HORIZON)


@cache
def encoder() -> Encoder:
    return Encoder(prediction(), UNITS, gains(), CONFIG.loop)


def spline(points: Array) -> BSpline:
    """Control points c[-1], c[0], .. as a function of the knot's number, by de Boor's algorithm."""
    return BSpline(np.arange(len(points) + 4) - 3.0, points, 3)


KNOTS = np.arange(HORIZON + 1)


# The fit.

WEIGHTS = [0.0, tracks.TORQUE_CURVATURE_WEIGHT, tracks.POSITION_CURVATURE_WEIGHT]


@cache
def fit(weight: float) -> Fit:
    return Fit(HORIZON, weight)


def fitted(weight: float, samples: Array, committed: Array) -> Array:
    points: Array = fit(weight).of_samples @ samples + fit(weight).of_committed @ committed
    return points


@given(st.sampled_from(WEIGHTS), st.integers(0, 2**32))
def test_points_begin_with_the_committed_and_end_in_three_equal(weight: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    samples = np.cumsum(rng.normal(0, 0.01, (HORIZON + 1, 2)), axis=0)
    committed = rng.normal(0, 1, (3, 2))
    points = fitted(weight, samples, committed)
    assert points.shape == (HORIZON + 3, 2)
    assert points[:3].tobytes() == committed.tobytes()
    assert points[-3:].tobytes() == np.tile(samples[-1], (3, 1)).tobytes()


@given(st.integers(0, 2**32))
def test_without_a_penalty_what_a_track_can_say_is_said_exactly(seed: int) -> None:
    """Control points at random, sampled at the knots by another program, come back."""
    rng = np.random.default_rng(seed)
    points = np.cumsum(rng.normal(0, 0.01, (HORIZON + 3, 2)), axis=0)
    points[-3:] = points[-3]
    got = fitted(0.0, spline(points)(KNOTS), points[:3])
    np.testing.assert_allclose(got, points, atol=1e-9)


@given(
    st.sampled_from(WEIGHTS),
    st.floats(0.1, 0.17),
    st.floats(0, 0.5),
    st.floats(-25, 25).filter(lambda a: abs(a) > 1),
)
def test_a_smooth_motion_is_said_to_within_a_count(
    weight: float, duration_s: float, begun: float, peak: float
) -> None:
    """A quintic to rest, of an acceleration that the machine has, from somewhere along its way."""
    amplitude = peak * duration_s**2 / 5.7735
    through = begun + np.arange(-1, HORIZON + 2) * KNOT_S / duration_s
    u = np.clip(through, 0, 1)
    points = (amplitude * u**3 * (10 - 15 * u + 6 * u * u))[:, None]
    points[-3:] = points[-3]
    got = fitted(weight, spline(points)(KNOTS), points[:3])
    assert np.abs(got - points).max() < PITCH


def test_a_fit_closes_in_on_the_motion_without_ringing() -> None:
    """From a committed offset of one: gone within ten knots, a twentieth at most beyond."""
    for weight in WEIGHTS[1:]:
        points = fitted(weight, np.zeros((HORIZON + 1, 1)), np.ones((3, 1)))
        track = spline(points)(KNOTS)[:, 0]
        assert np.abs(track[10:]).max() < 0.06
        assert np.abs(track).max() <= 1 + 1e-12


# The encoder, tick after tick on one smooth motion.


class Held:
    """A device as far as the encoder asks: its tracks."""

    def __init__(self, position: int, torque: int) -> None:
        self._tracks = {sink: core.Track() for sink in (core.TRACK_POSITION, core.TRACK_TORQUE)}
        self.write(-20, np.full((2, 40), [[position], [torque]], np.int32))

    def track(self, sink: int) -> core.Track:
        return self._tracks[sink]

    def write(self, first: int, points: Points) -> None:
        for sink, values in enumerate(points):
            self._tracks[sink].write(first, values)


def at_rest(position: Array) -> list[Held]:
    """Devices that hold the machine still."""
    hold = prediction().holding(position, np.zeros(2))
    return [
        Held(round(q * PQ_PER_RAD), round(t * TQ_PER_NM))
        for q, t in zip(position, hold, strict=True)
    ]


def quintic(first_knot: int) -> Motion:
    """From rest to rest in 160 ms, with up to 12 and -20 rad/s^2, as seen from a knot on."""
    duration_s, peak = 0.160, np.array([12.0, -20.0])
    amplitude, start = peak * duration_s**2 / 5.7735, np.array([0.9, 0.6])
    u = np.clip((first_knot + KNOTS) * KNOT_S / duration_s, 0, 1)[:, None]
    q = start + amplitude * u**3 * (10 - 15 * u + 6 * u * u)
    v = amplitude * 30 * u**2 * (1 - u) ** 2 / duration_s
    a = amplitude * 60 * u * (1 - u) * (1 - 2 * u) / duration_s**2
    return Motion.of(q, v, prediction().inverse_dynamics(q, v, a))


def encoded(points: Points) -> tuple[BSpline, BSpline]:
    """Position [rad] and torque [Nm] tracks of both axes over the knots from the commit knot."""
    r = points[:, core.TRACK_POSITION].T / PQ_PER_RAD
    f = points[:, core.TRACK_TORQUE].T / TQ_PER_NM
    return spline(r), spline(f)


def torque_error(motion: Motion, points: Points) -> Array:
    """|f + Kp (r - q*) + (Kd + c)(r' - q*') - tau*| at the knots, on the plan: (knots, axes)."""
    position, torque = encoded(points)
    axes = CONFIG.machine.axes
    kp = np.array([a.servo.kp for a in axes])
    kd = np.array([a.servo.kd for a in axes])
    constant = np.array([a.motor.gear * a.motor.torque_constant_Nm_per_A for a in axes])
    emf = constant**2 / np.array([a.motor.resistance_ohm for a in axes])
    rate = position(KNOTS, 1) / KNOT_S
    total = torque(KNOTS) + kp * (position(KNOTS) - motion.position)
    error: Array = np.abs(total + (kd + emf) * (rate - motion.velocity) - motion.torque)
    return error


def encode(encoder: Encoder, motion: Motion, remotes: Any, knot: int) -> tuple[Points, Motion]:
    """From the motion's own start, without a disturbance."""
    start = np.concatenate((motion.position[0], motion.velocity[0]))
    return encoder.plan(motion, remotes, knot, start, np.zeros(2))


@cache
def chain() -> list[tuple[Motion, Points]]:
    """The motion encoded at every knot from its start, each time upon what was committed before."""
    remotes, result = at_rest(quintic(0).position[0]), []
    for knot in range(HORIZON):
        motion = quintic(knot)
        points, _ = encode(encoder(), motion, remotes, knot)
        for remote, plan in zip(remotes, points, strict=True):
            for sink in range(len(plan)):
                before = remote.track(sink).points(knot - 1, 3)
                assert plan[sink][:3].tobytes() == before.tobytes()
                assert len(set(plan[sink][-3:].tolist())) == 1
            remote.write(knot - 1, plan)
        result.append((motion, points))
    return result


def test_encoding_a_smooth_motion_errs_by_less_than_a_count() -> None:
    """At any tick and at any knot: no error builds up from tick to tick."""
    for motion, points in chain():
        position, _ = encoded(points)
        assert np.abs(position(KNOTS) - motion.position).max() < PITCH


def test_encoding_a_smooth_motion_gives_its_torque() -> None:
    assert max(torque_error(*encoding)[FREE:].max() for encoding in chain()) <= 0.01


def test_a_plan_ends_at_rest_in_the_holding_torque() -> None:
    for motion, points in chain():
        position, torque = encoded(points)
        for derivative in (1, 2):
            np.testing.assert_allclose(position(HORIZON, derivative), 0, atol=1e-12)
        hold = prediction().holding(motion.position[-1], np.zeros(2))
        np.testing.assert_allclose(torque(HORIZON), hold, atol=1e-5)


def test_rolling_out_an_encoded_motion_gives_the_motion() -> None:
    motion = quintic(0)
    points, rolled = encode(encoder(), motion, at_rest(motion.position[0]), 0)
    assert np.abs(rolled.position - motion.position).max() < 3 * PITCH
    # The roll-out's torque is the servo law's at the knots of the tracks, on the motion it gives.
    position, torque = encoded(points)
    law, rate = prediction().law, position(KNOTS, 1) / KNOT_S
    expected = torque(KNOTS) + law.kp * (position(KNOTS) - rolled.position)
    expected += (law.kd + law.emf) * (rate - rolled.velocity)
    np.testing.assert_allclose(rolled.torque, expected, atol=1e-6)


# In the closed loop.


@dataclass
class Encoding:
    """What came of one tick's problem."""

    knot: int
    motion: Motion
    points: Points
    rolled: Motion


def planned(of: Encoder) -> Motion:
    """The motion that was encoded last."""
    return Motion.of(*(of.pool[name].T.copy() for name in ("position", "velocity", "torque")))


def collect(lock: Lockstep, monkeypatch: pytest.MonkeyPatch) -> list[Encoding]:
    """Runs, and gathers all that is encoded."""
    seen: list[Encoding] = []
    solve = Mpc.solve

    def solve_seen(
        self: Mpc,
        start: Array,
        disturbance: Array,
        reference: Array,
        torque: Array,
        remotes: list[Remote],
        knot: int,
        ending: Array,
    ) -> Solution:
        solution = solve(self, start, disturbance, reference, torque, remotes, knot, ending)
        if solution.plan is not None:
            points, rolled = solution.plan
            seen.append(Encoding(knot, planned(self.encoder), points, rolled))
            for axis, remote in enumerate(remotes):
                for sink in range(points.shape[1]):
                    before = remote.track(sink).points(knot - 1, 3)
                    assert points[axis][sink][:3].tobytes() == before.tobytes()
        return solution

    with monkeypatch.context() as patch:
        patch.setattr(Mpc, "solve", solve_seen)
        lock.run()
    return seen


@pytest.fixture(scope="module")
def shipped() -> tuple[Lockstep, list[Encoding]]:
    """Two seconds of the shipped machine, with all its losses, delays and mismatch."""
    lock = Lockstep(config_of("duration_s=2"), CONFIGS)
    return lock, collect(lock, pytest.MonkeyPatch())


def test_the_tracks_of_a_run_give_the_planned_torque(
    shipped: tuple[Lockstep, list[Encoding]],
) -> None:
    seen = shipped[1]
    assert len(seen) > 480
    worst = np.array([torque_error(e.motion, e.points)[FREE:].max(axis=0) for e in seen])
    assert worst.max() <= 0.05


def test_all_tracks_of_a_run_end_in_three_equal_points(
    shipped: tuple[Lockstep, list[Encoding]],
) -> None:
    for encoding in shipped[1]:
        assert np.all(encoding.points[:, :, -3:] == encoding.points[:, :, -1:])


def test_the_encoded_motion_is_the_planned_to_about_a_count_rms(
    shipped: tuple[Lockstep, list[Encoding]],
) -> None:
    """By the roll-out, which knows what the committed points still do in the first knots: 0.75 and
    1.00 counts, give or take 0.05 from seed to seed."""
    errors = [(e.rolled.position - e.motion.position)[FREE:] for e in shipped[1]]
    assert np.all(np.sqrt(np.mean(np.array(errors) ** 2, axis=(0, 1))) < 1.1 * PITCH)


def test_what_the_host_takes_for_committed_is_what_the_devices_execute() -> None:
    """At each tick, over the knot that has passed and the one that begins, to the last bit."""
    lock = Lockstep(config_of("duration_s=2"), CONFIGS)
    tracks = [[remote.track(sink) for sink in range(2)] for remote in lock.remotes]
    committed = gains().course(tracks, UNITS)
    tick, compared = lock.loop.tick, 0
    quanta = np.array(
        [PQ_PER_RAD, PQ_PER_RAD, PQ_PER_RAD * KNOT_S, PQ_PER_RAD * KNOT_S, TQ_PER_NM, TQ_PER_NM]
    )

    def compare(now_us: int) -> tuple[Tick, Outbox]:
        nonlocal compared
        if lock.loop.phase is Phase.RUN:
            times_us = np.arange(now_us - 4096, now_us + 4096, 256)
            values = committed.at(times_us, lock.plant.position)[:, :6] * quanta
            for time_us, value in zip(times_us.tolist(), values, strict=True):
                setpoints = np.array([node.setpoint(time_us) for node in lock.plant.nodes])
                np.testing.assert_allclose(value, setpoints.T.ravel(), rtol=1e-12, atol=1e-9)
                compared += 1
        return tick(now_us)

    lock.loop.tick = compare  # type: ignore[method-assign]
    lock.run()
    assert sum(w.lost for w in lock.link.to_device) > 0  # although some plans never arrived
    assert compared > 480 * 32


QUIET = "{delay_us: 0, jitter_us: 0, loss: 0}"


@pytest.fixture(scope="module")
def nominal() -> tuple[Lockstep, list[Encoding]]:
    """The machine is its model, and nothing is late; the host dies after a second."""
    lock = Lockstep(
        config_of(
            *("duration_s=1.2", "sim.plant={}", "sim.kill_host_at_s=1.0", "sim.compute_us=0"),
            *(f"sim.to_device={QUIET}", f"sim.to_host={QUIET}"),
            *("sync.to_device_least_us=0", "sync.to_host_least_us=0"),
        ),
        CONFIGS,
    )
    return lock, collect(lock, pytest.MonkeyPatch())


def roll_out(points: Points, start: Array) -> Array:
    """Positions at the knots that the prediction makes of encoded points."""
    law = prediction().law

    def tracks(times: Array) -> Array:
        position, torque = encoded(points)
        rate = position(times, 1) / KNOT_S
        gains = np.tile(law.feedback, (len(times), 1))
        return np.hstack((position(times), rate, torque(times), gains)).T

    call = prediction().call("rollout")
    begin = KNOTS[:-1]
    for target, value in zip(
        call.inputs,
        (start[:, None], 0, tracks(begin), tracks(begin + 0.5), tracks(begin + 1), KNOT_S),
        strict=True,
    ):
        target[...] = value
    return np.vstack((start[:2], call.run()[0][:2].T))


def deviation(lock: Lockstep, encoding: Encoding, knots: int) -> Array:
    """|truth - roll-out| over the first knots, from the true state at the commit knot."""
    record = lock.record.arrays()
    truth = CubicHermiteSpline(
        record["truth_s"], record["truth_position"], record["truth_velocity"]
    )
    knot_us = (encoding.knot + KNOTS) * lock.config.loop.knot_us
    time_s = (knot_us - lock.loop.start_us) * 1e-6
    start = np.concatenate((truth(time_s[0]), truth(time_s[0], 1)))
    rolled = roll_out(encoding.points, start)
    error: Array = np.abs(truth(time_s) - rolled)[: knots + 1]
    return error


def test_a_roll_out_is_what_the_plant_does_over_the_committed_knots(
    nominal: tuple[Lockstep, list[Encoding]],
) -> None:
    """Later plans change the track from two knots after the commit knot on at the earliest."""
    lock, seen = nominal
    errors = np.array([deviation(lock, encoding, 2) for encoding in seen[::4]])
    assert len(errors) > 50
    assert errors.max() < 1e-3
    assert errors[:, 1:].max() > 0


def test_a_roll_out_is_what_the_plant_does_until_it_rests(
    nominal: tuple[Lockstep, list[Encoding]],
) -> None:
    """The last plan before the host died was executed to its end."""
    lock, seen = nominal
    assert np.ptp(seen[-1].motion.position, axis=0).max() > 0.1
    assert deviation(lock, seen[-1], HORIZON).max() < 1e-3
