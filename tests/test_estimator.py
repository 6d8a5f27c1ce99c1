"""The estimator: independent of the order of arrival, consistent with its own model, robust."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats
from servoed import Servoed

from headway.configs.load import load_config
from headway.configs.schema import Estimator as EstimatorConfig
from headway.controller.estimator import (
    BUNDLE_US,
    REJECTED_IN_A_ROW,
    START_SIGMA,
    START_WALK_S,
    Estimate,
    Estimator,
)
from headway.controller.prediction import Prediction, ServoLaw
from headway.devices._tracks import Sample, Samples
from headway.models.machine import load_machine
from headway.sim.lockstep import Lockstep

ROOT = Path(__file__).resolve().parent.parent
CONFIGS = ROOT / "configs"
PITCH = 2 * np.pi / 40_000  # [rad] one encoder count
WALK = load_config(CONFIGS / "arm2.yaml").estimator.disturbance_noise_Nm_or_N_per_s05
SIGMA = np.array([*np.repeat(START_SIGMA, 2), *[WALK * START_WALK_S**0.5] * 2])  # after a reset

Array = NDArray[np.float64]
Times = NDArray[np.int64]


@cache
def prediction() -> Prediction:
    config = load_config(CONFIGS / "arm2.yaml")
    machine = load_machine(ROOT / "models" / "arm2" / "arm2.xml")
    return Prediction.of(config, machine)


@cache
def servoed() -> Servoed:
    return Servoed(prediction())


def estimator(**changes: float) -> Estimator:
    return Estimator(prediction(), EstimatorConfig(**changes), np.full(2, PITCH))  # type: ignore[arg-type]


START_US = 1_700_000_000_000_100  # within a bundle's cell


class Waves:
    """Tracks: each axis swings, from rest; the torque track carries the arm roughly."""

    amplitude = 0.5

    def at(self, times_us: Times, near: Array | None = None) -> Array:
        t = (np.asarray(times_us) - START_US) * 1e-6
        a, still = self.amplitude, np.ones_like(t)
        position = np.stack([0.5 - a * np.cos(8 * t), 0.3 + a * np.cos(11 * t)], axis=1)
        rate = np.stack([8 * a * np.sin(8 * t), -11 * a * np.sin(11 * t)], axis=1)
        gains = np.tile(prediction().law.feedback, (len(t), 1))
        return np.hstack((position, rate, np.stack([5.0 * still, still], axis=1), gains))

    def start(self) -> Array:
        """Position, where the tracks rest at first."""
        return self.at(np.array([START_US]))[0, :2]


class Still(Waves):
    amplitude = 0.0


# The order of arrival.


@st.composite
def arrivals(draw: st.DrawFn) -> tuple[list[Sample], list[list[Sample]]]:
    """Samples in order, and the same in some order, in batches, some of them twice."""
    keys = draw(
        st.lists(
            st.tuples(st.integers(START_US, START_US + 60_000), st.integers(0, 1)),
            min_size=1,
            max_size=24,
            unique=True,
        )
    )
    noise = draw(st.lists(st.integers(-3, 3), min_size=len(keys), max_size=len(keys)))
    samples = [
        Sample(t, axis, float(Waves().at(np.array([t]))[0, axis]) + counts * PITCH)
        for (t, axis), counts in zip(keys, noise, strict=True)
    ]
    again = draw(st.lists(st.sampled_from(samples), max_size=5))
    shuffled = draw(st.permutations(samples + again))
    cuts = sorted(draw(st.lists(st.integers(0, len(shuffled)), max_size=6)))
    batches = [shuffled[a:b] for a, b in zip([0, *cuts], [*cuts, len(shuffled)], strict=True)]
    return sorted(samples, key=lambda s: (s.time_us, s.axis)), batches


def settled(filter_: Estimator) -> Estimator:
    filter_.reset(START_US, Waves().start())
    return filter_


def as_bytes(estimate: Estimate) -> bytes:
    return estimate.z.tobytes() + estimate.covariance.tobytes()


NOW_US = START_US + 65_000


@settings(deadline=None, max_examples=150)
@given(arrivals())
def test_any_order_and_any_batches_give_the_same_estimate(
    arrived: tuple[list[Sample], list[list[Sample]]],
) -> None:
    ordered, batches = arrived
    expected = settled(estimator()).update(ordered, NOW_US, Waves())
    mixed = settled(estimator())
    for batch in batches[:-1]:
        mixed.update(batch, NOW_US - 1000, Waves())
    got = mixed.update(batches[-1], NOW_US, Waves())
    assert as_bytes(got) == as_bytes(expected)
    assert got.time_us == NOW_US


def test_every_sample_counts() -> None:
    """What the test above can see: one sample of many, one count off."""
    times = range(START_US + 1000, START_US + 20_000, 1000)
    samples = [Sample(t, 0, float(Waves().at(np.array([t]))[0, 0])) for t in times]
    last = samples[-1]
    off = [*samples[:-1], Sample(last.time_us, 0, last.position + PITCH)]
    first = settled(estimator()).update(samples, NOW_US, Waves())
    assert as_bytes(settled(estimator()).update(off, NOW_US, Waves())) != as_bytes(first)
    fewer = settled(estimator()).update(samples[1:], NOW_US, Waves())
    assert as_bytes(fewer) != as_bytes(first)


def test_a_batch_counts_each_sample_once_in_the_statistics() -> None:
    filter_ = settled(estimator())
    times = range(START_US + 1000, START_US + 41_000, 1000)
    samples = [Sample(t, 1, float(Waves().at(np.array([t]))[0, 1])) for t in times]
    filter_.update(samples[::2], NOW_US, Waves())
    filter_.update(samples, NOW_US, Waves())
    filter_.update([], NOW_US + 400_000, Waves())  # by now all but the last are forgotten
    assert filter_.accepted + filter_.outliers == len(samples) - 1


def test_however_few_rows_there_are_at_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """The checkpoints' arrays grow and begin anew; nothing else does. Some samples come late."""
    times = range(START_US + 1000, START_US + 900_000, 1000)
    samples = [Sample(t, k % 2, float(Waves().start()[k % 2])) for k, t in enumerate(times)]
    order = np.argsort(np.arange(len(samples)) + np.random.default_rng(3).uniform(0, 9, len(times)))
    batches = [[samples[i] for i in order[k : k + 5]] for k in range(0, len(order), 5)]

    def estimates(rows: int) -> tuple[list[bytes], int, float]:
        monkeypatch.setattr("headway.controller.estimator.ROWS", rows)
        filter_ = settled(estimator())
        told = [as_bytes(filter_.update(b, max(s.time_us for s in b), Still())) for b in batches]
        return told, filter_.outliers, filter_.nis_sum

    assert estimates(4) == estimates(4096)


def test_predicting_in_steps_is_predicting_along_the_tracks() -> None:
    """predict() stops at each time it is given; the disturbance wanders meanwhile."""
    filter_ = settled(estimator())
    now = filter_.update([Sample(START_US + 500, 0, 0.0)], NOW_US, Waves())
    times = [NOW_US + 4096, NOW_US + 8192]
    twice = filter_.predict(filter_.predict(now, times[:1], Waves()), times[1:], Waves())
    once = filter_.predict(now, times, Waves())
    assert as_bytes(once) == as_bytes(twice) and once.time_us == times[-1]
    walk = EstimatorConfig().disturbance_noise_Nm_or_N_per_s05 ** 2 * 8192e-6
    grown = np.diag(once.covariance - now.covariance)[4:]
    np.testing.assert_allclose(grown, walk, rtol=1e-9)


# The algebra: filterpy's filter (Labbe, Kalman and Bayesian Filters in Python), which is told of
# each sample once and in order, and asked for the state at the end.


@cache
def planar3() -> Prediction:
    machine = load_machine(ROOT / "tests" / "machines" / "planar3.xml")
    kp, kd = np.array([60.0, 30.0, 10.0]), np.array([3.0, 1.0, 0.3])
    law = ServoLaw(kp, kd, 0.1 * kd, np.array([12.0, 6.0, 2.0]), np.full(3, 0.05))
    return Prediction(machine, law, 4, 8)


class Swings:
    """Tracks of any number of axes, each about its own place."""

    def __init__(self, law: ServoLaw) -> None:
        self._law, self._n = law, len(law.kp)

    def at(self, times_us: Times, near: Array | None = None) -> Array:
        t = (np.asarray(times_us)[:, None] - START_US) * 1e-6
        speed = 5.0 + np.arange(self._n)
        place = 0.3 * np.arange(1, self._n + 1)
        r, rate = place + 0.2 * np.cos(speed * t), -0.2 * speed * np.sin(speed * t)
        return np.hstack((r, rate, 0.5 * r, np.tile(self._law.feedback, (len(t), 1))))


class Oracle(ExtendedKalmanFilter):  # type: ignore[misc]
    """Steps as the machine does, to where a sample's bundle is, and reads ahead from there; the
    rest is filterpy's own."""

    def __init__(self, model: Prediction, config: EstimatorConfig, tracks: Swings) -> None:
        n = self._n = model.n
        super().__init__(dim_x=3 * n, dim_z=1)
        self._step, self._config, self._tracks = Servoed(model), config, tracks
        self._time_us, self._rows, self._rate = START_US, [0] * n, np.zeros(n)
        position = tracks.at(np.array([START_US]))[0, :n]
        self.x = np.concatenate((position, np.zeros(2 * n)))  # of this shape, see docs/libraries.md
        walk = config.disturbance_noise_Nm_or_N_per_s05 * START_WALK_S**0.5
        self._start = np.diag([*np.repeat(START_SIGMA, n), *[walk] * n]) ** 2
        self.P = self._start

    def predict_x(self, u: object = 0) -> None:
        n, dt = self._n, self._dt
        after, jacobian = self._step(self.x, self._along, dt)
        self._rate = (after[n:] - self.x[n : 2 * n]) / dt
        self.x = np.concatenate((after, self.x[2 * n :]))
        self.F = np.vstack((jacobian, np.eye(3 * n)[2 * n :]))

    def carry(self, time_us: int) -> None:
        """To a time at most 5 ms on."""
        n, gap_us = self._n, time_us - self._time_us
        assert gap_us <= 5000
        if gap_us > 0:
            dt = self._dt = gap_us * 1e-6
            middle_us = (self._time_us + time_us) // 2
            self._along = self._tracks.at(np.array([self._time_us, middle_us, time_us]))
            white = self._config.acceleration_noise_rad_or_m_per_s15**2
            self.Q = np.diag([self._config.disturbance_noise_Nm_or_N_per_s05**2 * dt] * 3 * n)
            self.Q[: 2 * n, : 2 * n] = np.kron(
                white * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(n)
            )
            self.predict()
        self._time_us = time_us

    def take(self, sample: Sample) -> bool:
        """Returns whether it was an outlier."""
        bundle_us = max(sample.time_us // BUNDLE_US * BUNDLE_US, START_US)
        self.carry(bundle_us)
        dt, axes = (sample.time_us - bundle_us) * 1e-6, np.eye(3 * self._n)
        row = (axes[sample.axis] + dt * axes[self._n + sample.axis])[None]
        bend = self._rate[sample.axis] * dt**2 / 2
        white = self._config.acceleration_noise_rad_or_m_per_s15**2
        variance = (self._config.measurement_noise_counts * PITCH) ** 2 + white * dt**3 / 3
        spread = (row @ self.P @ row.T).item() + variance
        innovation = sample.position - (row @ self.x).item() - bend
        if innovation**2 / spread > self._config.gate_sigma**2:
            self._rows[sample.axis] += 1
            if self._rows[sample.axis] % REJECTED_IN_A_ROW == 0:
                self.P = self.P + self._start
            return True
        self._rows[sample.axis] = 0
        z = np.array([sample.position])
        self.update(z, lambda _: row, lambda x: row @ x + bend, R=variance)
        return False


def swinging_samples(tracks: Swings, n: int, rng: np.random.Generator) -> list[Sample]:
    """In order, some of one stamp, a tenth of them nonsense, and a long row of that on axis 1."""
    samples, time_us = list[Sample](), START_US
    for k in range(400):
        time_us += int(rng.integers(0, 800)) * int(rng.random() < 0.7)
        position = tracks.at(np.array([time_us]))[0, :n] + PITCH * rng.integers(-1, 2, size=n)
        axis = k % n
        if rng.random() < 0.1 or (axis == 1 and 150 < k < 230):
            position += rng.choice([-1, 1]) * rng.uniform(0.5, 1)
        samples.append(Sample(time_us, axis, float(position[axis])))
    once = {(sample.time_us, sample.axis): sample for sample in samples}
    return [once[place] for place in sorted(once)]


@pytest.mark.parametrize("model", [prediction, planar3])
@pytest.mark.parametrize("count", [40, 200, 400])  # before, in and after the row of outliers
@pytest.mark.parametrize("shuffled", [False, True])
def test_the_compiled_filter_is_filterpys(
    model: Callable[[], Prediction], count: int, shuffled: bool
) -> None:
    rng = np.random.default_rng(11)
    n, tracks, config = model().n, Swings(model().law), EstimatorConfig()
    samples = swinging_samples(tracks, n, rng)[:count]
    oracle = Oracle(model(), config, tracks)
    outliers = [oracle.take(sample) for sample in samples]
    now_us = samples[-1].time_us + 3000
    oracle.carry(now_us)

    filter_ = Estimator(model(), config, np.full(n, PITCH))
    filter_.reset(START_US, tracks.at(np.array([START_US]))[0, :n])
    arriving = samples[:]
    if shuffled:  # each up to 30 places late
        late = np.arange(len(samples)) + rng.uniform(0, 30, size=len(samples))
        arriving = [samples[i] for i in np.argsort(late)]
    for k in range(0, len(arriving), 7):
        estimate = filter_.update(arriving[k : k + 7], now_us, tracks)
    assert (filter_.replayed > len(samples)) == shuffled

    scale = np.sqrt(np.diag(oracle.P))  # what z and its covariance are measured by
    np.testing.assert_allclose(estimate.z / scale, oracle.x / scale, rtol=1e-9, atol=1e-9)
    by_scale = np.outer(scale, scale)
    np.testing.assert_allclose(estimate.covariance / by_scale, oracle.P / by_scale, atol=1e-9)
    assert np.array_equal(estimate.covariance, estimate.covariance.T)
    filter_.update([], now_us + 10**6, tracks)
    assert filter_.outliers == sum(outliers[:-1]) > 0
    assert filter_.accepted == len(samples) - 1 - filter_.outliers


# Consistency: worlds made by the filter's own model (Bar-Shalom, Li, Kirubarajan, Estimation with
# Applications, 2001, section 5.4). The errors' squares are then chi-square distributed.

STEP_US, RUN_US, NEES_EVERY_US = 500, 200_000, 50_000
RUNS = 100


def process_noise(config: EstimatorConfig) -> Array:
    """Of one step: white acceleration on each axis, and the disturbance's random walk."""
    dt, noise = STEP_US * 1e-6, np.zeros((6, 6))
    a = config.acceleration_noise_rad_or_m_per_s15**2
    for i in range(2):
        noise[np.ix_([i, 2 + i], [i, 2 + i])] = a * np.array(
            [[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]
        )
        noise[4 + i, 4 + i] = config.disturbance_noise_Nm_or_N_per_s05**2 * dt
    return noise


def model_step(z: Array, tracks: Array) -> Array:
    return np.concatenate((servoed()(z, tracks, STEP_US * 1e-6)[0], z[4:]))


def matched_run(seed: int, tracks: Waves, root: Array, filter_: Estimator) -> list[float]:
    """One world and its filter; returns NEES at fixed times. The filter keeps its own NIS."""
    rng = np.random.default_rng(seed)
    mean = np.concatenate((tracks.start(), np.zeros(4)))
    z = mean + SIGMA * rng.normal(size=6)
    filter_.reset(START_US, mean[:2])
    times = START_US + np.arange(0, RUN_US + 1, STEP_US // 2)
    values = tracks.at(times)
    nees, batch = [], list[Sample]()
    for k in range(1, RUN_US // STEP_US + 1):
        now_us, axis = START_US + k * STEP_US, k % 2  # each axis every ms
        z = model_step(z, values[2 * k - 2 : 2 * k + 1]) + root @ rng.normal(size=6)
        batch.append(Sample(now_us, axis, float(np.rint(z[axis] / PITCH) * PITCH)))
        if k % 10 == 0:
            estimate = filter_.update(batch, now_us, tracks)
            batch = []
        if k * STEP_US % NEES_EVERY_US == 0:
            error = z - estimate.z
            nees.append(float(error @ np.linalg.solve(estimate.covariance, error)))
    filter_.update([], START_US + 10**6, tracks)  # all but the last sample enter the statistics
    return nees


def band(degrees: int, count: int, tests: int = 1) -> tuple[float, float]:
    """95 % of the means of `count` squares of `degrees` degrees of freedom lie in here; and 95 % of
    groups of `tests` such means do with all of them (Bonferroni)."""
    tail = 0.025 / tests
    low, high = stats.chi2.ppf([tail, 1 - tail], degrees * count) / count
    return float(low), float(high)


@cache
def consistency(tracks: Waves) -> tuple[Array, float, int]:
    """NEES (runs, times); mean NIS; number of samples."""
    config = EstimatorConfig()
    root = np.linalg.cholesky(process_noise(config))
    filter_ = estimator()
    nees = [matched_run(seed, tracks, root, filter_) for seed in range(RUNS)]
    assert filter_.outliers == 0
    return np.array(nees), filter_.nis_sum / filter_.accepted, filter_.accepted


WAVES, STILL = Waves(), Still()


@pytest.mark.parametrize("tracks", [WAVES, STILL], ids=["waves", "still"])
def test_the_covariance_is_the_errors(tracks: Waves) -> None:
    """At each of the times, over the runs, which are independent of each other; and in all."""
    nees, _, _ = consistency(tracks)
    assert nees.shape == (RUNS, RUN_US // NEES_EVERY_US)
    low, high = band(6, RUNS, tests=nees.shape[1])
    assert np.all((nees.mean(axis=0) > low) & (nees.mean(axis=0) < high))
    low, high = band(6, nees.size)
    assert low < nees.mean() < high


@pytest.mark.parametrize("tracks", [WAVES, STILL], ids=["waves", "still"])
def test_the_innovations_are_as_large_as_expected(tracks: Waves) -> None:
    """Readings are rounded to whole counts: the config's noise is that of rounding."""
    _, nis, count = consistency(tracks)
    assert count == RUNS * (RUN_US // STEP_US - 1)
    low, high = band(1, count)
    assert high - low < 0.03  # so a hundredth of a count more or less would be seen
    assert low < nis < high


# In the closed loop.


def lockstep(*overrides: str) -> Lockstep:
    return Lockstep(load_config(CONFIGS / "arm2.yaml", list(overrides)), CONFIGS)


def task_rms(values: Array, time_s: Array, lock: Lockstep) -> Array:
    """Over the task after its entry."""
    inside = (time_s > 0.5) & (time_s < lock.config.duration_s)
    mean: Array = np.sqrt(np.mean(values[inside] ** 2, axis=0))
    return mean


@pytest.fixture(scope="module")
def shipped() -> Lockstep:
    lock = lockstep("duration_s=2")
    lock.run()
    return lock


def test_the_state_is_known_to_within_three_counts(shipped: Lockstep) -> None:
    record = shipped.record.arrays()
    error = record["now_estimate"][:, :2] - record["actual_position"]
    assert np.all(task_rms(error, record["tick_s"], shipped) < 3 * PITCH)


def test_no_sample_of_the_shipped_run_is_an_outlier(shipped: Lockstep) -> None:
    filter_ = shipped.loop.estimator
    assert filter_.outliers == 0 and filter_.accepted > 1500
    assert 0.5 < filter_.nis_sum / filter_.accepted < 1.5  # consistent even so


def test_one_percent_of_outliers_costs_at_most_a_tenth() -> None:
    """Over four worlds together: two runs of one world differ by some percent either way."""
    squares = {0.0: 0.0, 0.01: 0.0}
    for share in squares:
        for seed in range(4):
            lock = lockstep("duration_s=4", f"seed={seed}", f"sim.outlier_share={share}")
            lock.run()
            record = lock.record.arrays()
            error = record["truth_position"] - record["truth_reference"]
            squares[share] += float(np.sum(task_rms(error, record["truth_s"], lock) ** 2))
            caught = lock.loop.estimator.outliers
            assert caught > 25 if share else caught == 0
    assert squares[0.01] <= 1.1**2 * squares[0.0]


@pytest.fixture(scope="module")
def calm() -> dict[str, Array]:
    """The same world without the step."""
    lock = lockstep("duration_s=0.8")
    lock.run()
    return lock.record.arrays()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_step_of_the_disturbance_is_found_in_60_ms(
    calm: dict[str, Array], axis: int, sign: int
) -> None:
    """An outside torque on a joint: no bias before, most of it found, with its sign, at 60 ms."""
    lock, step_s, size = lockstep("duration_s=0.8"), 0.7, sign * (2.0, 1.0)[axis]
    advance = lock._advance_to

    def pushed(true_us: int) -> None:
        in_task = lock.loop.start_us > 0
        if in_task and lock.task_s(true_us + lock.epoch_us) >= step_s:
            lock.plant.data.qfrc_applied[axis] = size
        advance(true_us)

    lock._advance_to = pushed  # type: ignore[method-assign]
    lock.run()
    time_s = lock.record.arrays()["tick_s"]
    change = lock.record.arrays()["now_estimate"][:, 4:] - calm["now_estimate"][:, 4:]
    before = time_s < step_s - 0.005
    assert np.all(change[before] == 0)
    at = int(np.searchsorted(time_s, step_s + 0.060))
    assert 0.5 < change[at, axis] / size < 1.5
    assert abs(change[at, 1 - axis]) < 0.5 * abs(size)


# A filter that is wrong.


def resting_samples(position: Array, start_us: int, count: int) -> list[Sample]:
    """A reading a millisecond from each axis of an arm that does not move."""
    return [
        Sample(
            start_us + 1000 * k + 100 * axis, axis, float(np.rint(position[axis] / PITCH) * PITCH)
        )
        for k in range(1, count + 1)
        for axis in range(2)
    ]


def test_twenty_rejected_samples_in_a_row_widen_the_covariance() -> None:
    filter_, truth = estimator(), np.array([0.5, 0.3])
    filter_.reset(0, truth)
    samples = resting_samples(truth, 0, 30)
    filter_.update(samples, 31_000, STILL)
    wrong = [Sample(31_000 + 100 * k, 0, 0.9) for k in range(1, REJECTED_IN_A_ROW)]
    almost = filter_.update(wrong, 31_000 + 100 * REJECTED_IN_A_ROW, STILL)
    assert almost.covariance[0, 0] < 0.01 * SIGMA[0] ** 2
    last = Sample(31_000 + 100 * REJECTED_IN_A_ROW, 0, 0.9)
    widened = filter_.update([last], last.time_us, STILL)
    growth = widened.covariance - almost.covariance
    assert np.all(np.diag(growth) >= 0.99 * SIGMA**2)
    np.testing.assert_array_equal(widened.z, almost.z)  # none of them moved the state


def test_one_good_sample_ends_a_row() -> None:
    filter_, truth = estimator(), np.array([0.5, 0.3])
    filter_.reset(0, truth)
    filter_.update(resting_samples(truth, 0, 30), 31_000, STILL)
    samples = [Sample(31_000 + 100 * k, 0, 0.9) for k in range(1, 40)]
    samples[15] = Sample(samples[15].time_us, 0, filter_.update([], 31_000, STILL).z[0])
    samples = samples[: 15 + REJECTED_IN_A_ROW]  # 15 bad, a good one, 19 bad
    estimate = filter_.update(samples, samples[-1].time_us, STILL)
    assert estimate.covariance[2, 2] < START_SIGMA[1] ** 2


@pytest.mark.parametrize("offset", [(0.1, 0.0), (-0.05, 0.08), (0.0, -0.2)])
def test_a_wrong_start_is_recovered_from(offset: tuple[float, float]) -> None:
    """The arm hangs on its servos, still; the filter was told that it is elsewhere."""
    p, truth = prediction(), np.array([0.5, 0.3])
    # Where the servos hold it under these tracks, found by the model itself.
    z = np.concatenate((truth, np.zeros(4)))
    held = np.tile(STILL.at(np.array([START_US])), (3, 1))
    held[:, :2] = truth
    held[:, 4:6] = p.holding(truth, np.zeros(2))
    np.testing.assert_allclose(model_step(z, held), z, atol=1e-12)

    class Holding(Still):
        def at(self, times_us: Times, near: Array | None = None) -> Array:
            return np.tile(held[0], (len(times_us), 1))

    filter_ = estimator()
    filter_.reset(0, truth + offset)
    for k in range(100):
        estimate = filter_.update(resting_samples(truth, 4000 * k, 4), 4000 * k + 4500, Holding())
    assert filter_.outliers >= REJECTED_IN_A_ROW
    assert np.all(np.abs(estimate.z[:2] - truth) < 3 * PITCH)
    assert np.all(np.abs(estimate.z[2:4]) < 0.1)


@pytest.mark.parametrize("sample_every", [5, 20, 100])
def test_rare_samples_do_not_upset_the_filter(sample_every: int) -> None:
    """Between samples 100 ms apart the stiff servo loops are predicted in many steps."""
    lock = lockstep("duration_s=1", f"device.sample_every={sample_every}")
    lock.run()
    record = lock.record.arrays()
    assert record["tick_accepted"].mean() > 0.98
    error = record["truth_position"] - record["truth_reference"]
    assert np.all(task_rms(error, record["truth_s"], lock) < 5e-3)
    sigma = np.sqrt(record["now_covariance"].reshape(-1, 6, 6).diagonal(axis1=1, axis2=2))
    bound = 4 * sigma[:, :2] + 5e-3  # the wrong mass is more than the noise modelled
    error = record["now_estimate"][:, :2] - record["actual_position"]
    assert np.all(np.abs(error) < bound)


def test_without_a_disturbance_none_is_estimated() -> None:
    filter_ = estimator(disturbance=False)
    filter_.reset(0, np.array([0.5, 0.3]))
    estimate = filter_.update(resting_samples(np.array([0.501, 0.3]), 0, 50), 51_000, STILL)
    assert np.all(estimate.z[4:] == 0) and np.all(estimate.covariance[4:] == 0)


def test_what_is_yet_to_come_stays_in_the_list() -> None:
    """A clock that is ahead stamps such."""
    filter_, samples = settled(estimator()), Samples()
    for at_us in (NOW_US + 1, NOW_US, NOW_US + 7, NOW_US - 300):
        samples.append(Sample(at_us, 0, float(Waves().start()[0])))
    before = filter_.replayed
    filter_.update(samples, NOW_US, Waves())
    assert [sample.time_us for sample in samples] == [NOW_US + 1, NOW_US + 7]
    assert filter_.replayed == before + 2
    with pytest.raises(ValueError, match="an axis that there is not"):
        filter_.update([Sample(NOW_US, 2, 0.0)], NOW_US + 10, Waves())
