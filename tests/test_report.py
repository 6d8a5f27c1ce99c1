"""`headway report`: what is kept of a run's numbers, what is told of its packets, what is drawn,
what the command does with runs that are not whole. tests/test_report_page.py opens the page."""

import base64
import hashlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from headway.cli.main import main
from headway.cli.page import animation, scene
from headway.cli.page.animation import compress, page_bytes, picture_times
from headway.cli.page.axes import effort, tracking
from headway.cli.page.figures import tables
from headway.cli.page.packets import Statuses, statuses, summed
from headway.cli.page.scene import NoPicture, Scene
from headway.cli.page.shown import Shown
from headway.cli.page.thin import thin
from headway.cli.simulation import Simulation
from headway.configs.load import load_config
from headway.controller.record.reader import NAME, read_run
from headway.controller.tick import DeviceError
from headway.devices.core import STATES
from headway.sim.lockstep import Lockstep

ROOT = Path(__file__).resolve().parents[1]
CONFIGS = ROOT / "configs"
COMMAND = Path(sys.executable).with_name("headway")
RUNNING, COAST, HOLD = (STATES.index(name) for name in ("RUNNING", "COAST", "HOLD"))


def simulated(folder: Path, *changes: str) -> Path:
    """The folder of a finished run of arm2."""
    simulation = Simulation(load_config(CONFIGS / "arm2.yaml", list(changes)), CONFIGS)
    simulation.run()
    folder.mkdir()
    simulation.keep(folder)
    return folder


@pytest.fixture(scope="module")
def lossy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    loss = "sim.to_device.loss=0.1", "sim.to_host.loss=0.1"
    return simulated(tmp_path_factory.mktemp("runs") / "lossy", "duration_s=1", *loss)


@pytest.fixture
def run(lossy: Path, tmp_path: Path) -> Path:
    """A copy of a run, to be spoiled."""
    copy = tmp_path / "run"
    copy.mkdir()
    for name in (NAME, "summary.json"):
        (copy / name).write_bytes((lossy / name).read_bytes())
    return copy


def shown(folder: Path, name: str = "", colour: str = "a") -> Shown:
    summary = json.loads((folder / "summary.json").read_text())
    return Shown(name, colour, read_run(folder), summary)


@pytest.fixture(scope="module")
def _gl() -> None:
    """Something to draw with. On the build server there must be."""
    try:
        scene._context().free()
    except NoPicture as error:
        if os.environ.get("HEADWAY_CI"):
            raise
        pytest.skip(str(error))


# --- fewer points ------------------------------------------------------------------------------

NUMBERS = st.floats(-1e6, 1e6) | st.just(float("nan"))


@st.composite
def columns(draw: st.DrawFn) -> np.ndarray:
    rows, width = draw(st.integers(1, 120)), draw(st.integers(1, 3))
    values = draw(st.lists(NUMBERS, min_size=rows * width, max_size=rows * width))
    return np.array(values).reshape(rows, width)


@given(columns(), st.integers(2, 60), st.integers(0, 2**31))
def test_thinning_keeps_all_extremes(values: np.ndarray, points: int, seed: int) -> None:
    time_s = np.cumsum(np.random.default_rng(seed).uniform(0.1, 1, len(values)))
    kept_s, kept = thin(time_s, values, points)
    if len(values) <= points:
        assert kept_s is time_s
        assert np.array_equal(kept, values, equal_nan=True)
        return
    assert kept.shape == (len(kept_s), values.shape[1]) and len(kept_s) <= points
    assert np.all(np.diff(kept_s) > 0)
    assert set(kept_s) <= set(time_s)
    # Bucket by bucket: the pair of rows is the range of the samples from its first time on.
    begins = kept_s[::2]
    bucket = np.searchsorted(begins, time_s, side="right") - 1
    assert bucket[0] == 0 and bucket[-1] == len(begins) - 1
    for i in range(len(begins)):
        for column, pair in zip(values[bucket == i].T, kept[2 * i : 2 * i + 2].T, strict=True):
            known = column[~np.isnan(column)]
            if not len(known):
                assert np.isnan(pair).all()
                continue
            assert sorted(pair) == [known.min(), known.max()]
            places = [np.flatnonzero(column == value)[0] for value in pair]
            assert places == sorted(places)


@given(st.integers(3, 500), st.integers(2, 60), st.booleans())
def test_thinning_is_exact_where_nothing_turns(rows: int, points: int, falling: bool) -> None:
    time_s = np.arange(rows) * 0.1
    values = np.sqrt(time_s)[:: -1 if falling else 1]
    kept_s, kept = thin(time_s, values[:, None], points)
    assert np.array_equal(kept[:, 0], values[np.searchsorted(time_s, kept_s)])


def test_thinning_shares_the_rows_out_evenly() -> None:
    time_s = np.arange(100_003.0)
    kept_s, _ = thin(time_s, time_s[:, None], 1000)
    assert len(kept_s) == 1000
    assert set(np.diff(kept_s[::2])) <= {200, 201}


# --- packets -----------------------------------------------------------------------------------


class Watched:
    """A run with a bad network whose wires are watched: what of each kind got through."""

    def __init__(self) -> None:
        loss = "sim.to_device.loss=0.2", "sim.to_host.loss=0.2"
        config = load_config(CONFIGS / "arm2.yaml", ["duration_s=1", *loss])
        self.lockstep = Lockstep(config, CONFIGS)
        link = self.lockstep.link
        self.to_device: list[list[bool]] = [[], []]  # by device, in the order of sending
        self.to_host: list[list[bool]] = [[], []]
        for wires, fates in ((link.to_device, self.to_device), (link.to_host, self.to_host)):
            for wire, fate in zip(wires, fates, strict=True):
                wire.carry = self._watched(wire.carry, fate)  # type: ignore[method-assign]
        self.lockstep.run()
        self.arrays = self.lockstep.record.arrays()

    @staticmethod
    def _watched(carry: Any, fate: list[bool]) -> Any:
        def watched(sent_us: int, size_bytes: int) -> list[int]:
            arrivals_us: list[int] = carry(sent_us, size_bytes)
            fate.append(bool(arrivals_us))
            return arrivals_us

        return watched


@pytest.fixture(scope="module")
def watched() -> Watched:
    return Watched()


@pytest.mark.parametrize("device", [0, 1])
def test_losses_are_those_of_the_wires(watched: Watched, device: int) -> None:
    arrays = watched.arrays
    found = statuses(arrays, device, 4096)
    mine = arrays["sent_device"] == device
    arrived = np.array(watched.to_device[device])
    assert len(arrived) == mine.sum()
    plan, number = arrays["sent_plan"][mine], arrays["sent_number"][mine]
    known = (arrays["received_device"] == device) & arrays["received_status"]
    seen = arrays["received_plan_seen"][known]
    first, last = seen[-len(found.time_s)], seen[-1]
    lost = plan & ~arrived & (number > first) & (number <= last)
    assert found.plans_lost[-1] == lost.sum() > 20
    assert np.all(np.diff(found.plans_lost) >= 0)
    # The statuses that were sent from the first that counts to the last that was heard.
    packets = (arrays["received_device"] == device).sum()  # at first some that are no statuses
    heard = np.flatnonzero(watched.to_host[device])[:packets]
    fates = watched.to_host[device][heard[-len(found.time_s)] : heard[-1] + 1]
    assert found.statuses_lost[-1] == fates.count(False) > 20


def test_lead_is_the_time_to_hold() -> None:
    """Nothing reaches the devices any more: each holds when its last lead is over."""
    lockstep = Lockstep(load_config(CONFIGS / "arm2.yaml", ["duration_s=2"]), CONFIGS)

    def cut(done_s: float) -> None:
        if done_s > 0.7:
            lockstep.link.send = lambda *_: None  # type: ignore[method-assign]

    with pytest.raises(DeviceError, match="came to rest and holds"):
        lockstep.run(cut)
    lockstep.record.publish()  # what the last tick had read
    arrays = lockstep.record.arrays()
    start_us = arrays["task_start_us"][0]
    compared = 0
    for device in (0, 1):
        mine = (arrays["received_device"] == device) & arrays["received_status"]
        state = arrays["received_state"][mine]
        sent_s = (arrays["received_sent_us"][mine] - start_us) * 1e-6
        found = statuses(arrays, device, 4096)
        ends_s = found.time_s + found.lead_s
        assert np.isnan(found.lead_s[state[-len(found.lead_s) :] == HOLD]).all()
        coasting = state[-len(found.lead_s) :] == COAST
        assert np.ptp(ends_s[coasting]) < 1e-9  # no plan arrived since
        end_s = ends_s[coasting][0]
        assert sent_s[state == COAST][-1] < end_s
        if (state == HOLD).any():  # the run ends when the first of them is seen to hold
            compared += 1
            assert end_s <= sent_s[state == HOLD][0] < end_s + 4.096e-3
    assert compared


def test_of_a_device_that_is_never_heard() -> None:
    arrays = Lockstep(load_config(CONFIGS / "arm2.yaml", []), CONFIGS).record.arrays()
    arrays["task_start_us"] = np.array([0])
    assert all(len(values) == 0 for values in vars(statuses(arrays, 0, 4096)).values())


def test_a_plan_that_is_not_in_the_record(watched: Watched) -> None:
    arrays = dict(watched.arrays)
    arrays["sent_plan"] = arrays["sent_plan"] & (arrays["sent_number"] > 150)
    found: Statuses = statuses(arrays, 0, 4096)
    assert np.isnan(found.lead_s[0]) and found.lead_s[-1] > 0.1


@given(
    st.lists(
        st.lists(st.tuples(st.integers(0, 40), st.integers(0, 5)), max_size=12),
        min_size=1,
        max_size=4,
    )
)
def test_sum_of_counts(steps: list[list[tuple[int, int]]]) -> None:
    """At each time all that has been counted up to then."""
    times, counts = [], []
    for device in steps:
        own = sorted(dict(device).items())
        times.append(np.array([float(t) for t, _ in own]))
        counts.append(np.cumsum([float(n) for _, n in own]))
    all_s, total = summed(times, counts)
    assert all_s.tolist() == sorted({float(t) for device in steps for t, _ in device})
    for time_s, sum_ in zip(all_s, total, strict=True):
        assert sum_ == sum(n for device in steps for t, n in dict(device).items() if t <= time_s)


# --- pictures ----------------------------------------------------------------------------------


@given(st.floats(-10, 10), st.floats(0.001, 1e4))
def test_times_of_pictures(begin_s: float, duration_s: float) -> None:
    times_s, fps = picture_times(begin_s, begin_s + duration_s)
    assert 1 <= len(times_s) <= animation.PICTURES
    assert animation.FPS_MIN <= fps <= animation.FPS
    assert times_s[0] == begin_s and times_s[-1] <= begin_s + duration_s + 1e-6
    if duration_s <= animation.PICTURES / animation.FPS_MIN:
        assert times_s[-1] > begin_s + duration_s - 2 / fps  # all of it is shown


def number_of(picture: bytes) -> int:
    """The grey in the left half of a picture."""
    image = Image.open(BytesIO(picture)).convert("L")
    width, height = image.size
    return round(float(np.asarray(image)[2 : height - 2, 2 : width // 2 - 2].mean()))


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(6_000, 120_000), st.integers(1, 8), st.integers(0, 2**31))
def test_any_pictures_fit(count: int, budget_bytes: int, plain: int, seed: int) -> None:
    """Noise, which does not compress, and every so often none, so that the first look misleads: the
    budget is kept, and the pictures are in order."""
    rng = np.random.default_rng(seed)

    def draw(number: int, scale: float) -> scene.Picture:
        pixels = rng.integers(0, 256, (round(96 * scale), round(128 * scale), 3), dtype=np.uint8)
        pixels[:, : None if number % plain == 0 else pixels.shape[1] // 2] = 5 * number
        return pixels

    done: list[int] = []
    pictures, every = compress(draw, count, budget_bytes, done.append)
    assert sum(map(page_bytes, pictures)) <= budget_bytes
    assert len(pictures) == len(range(0, count, every))
    assert done[-1] == range(0, count, every)[-1]
    for i, picture in enumerate(pictures):
        assert abs(number_of(picture) - 5 * every * i) <= 6


@pytest.mark.parametrize("size", range(5))
def test_length_in_base64(size: int) -> None:
    assert page_bytes(bytes(size)) == len(base64.b64encode(bytes(size)))


ARM2 = ROOT / "models" / "arm2" / "arm2.xml"
POSES = np.array([[0.1, 0.3], [1.5, 0.4], [0.8, -0.9]])


@pytest.mark.usefixtures("_gl")
class TestScene:
    def test_the_machine_moves_within_the_picture(self) -> None:
        with Scene(ARM2, ["q1", "q2"], POSES) as arm:
            pictures = [arm.picture(pose, None).astype(int) for pose in POSES]
        height, width, _ = pictures[0].shape
        assert (width, height) == (scene.WIDTH, scene.HEIGHT)
        changed = np.any(np.abs(pictures[0] - pictures[1]) > 20, axis=2) | np.any(
            np.abs(pictures[0] - pictures[2]) > 20, axis=2
        )
        assert changed[5:-5, 5:-5].mean() > 0.02
        changed[5:-5, 5:-5] = False
        assert not changed.any()  # nothing reaches the border
        rows = np.flatnonzero(np.any(np.abs(np.diff(pictures[1], axis=0)) > 40, axis=(1, 2)))
        assert np.ptp(rows) > 0.5 * height  # it fills the picture

    def test_a_ghost_shows_where_it_is_apart(self) -> None:
        with Scene(ARM2, ["q1", "q2"], POSES) as arm:
            alone = arm.picture(POSES[0], None)
            assert np.array_equal(arm.picture(POSES[0], POSES[0] + 3e-3), alone)
            assert np.mean(arm.picture(POSES[0], POSES[0] + 0.2) != alone) > 0.01
            assert np.array_equal(arm.picture(POSES[0], None), alone)

    def test_smaller(self) -> None:
        with Scene(ARM2, ["q1", "q2"], POSES) as arm:
            whole, half = arm.picture(POSES[0], None), arm.picture(POSES[0], None, 0.5)
        assert half.shape == (scene.HEIGHT // 2, scene.WIDTH // 2, 3)
        assert np.abs(half.astype(int) - whole[::2, ::2]).mean() < 3

    @pytest.mark.parametrize("name", ["gantry", "scara"])
    def test_models_of_others(self, name: str) -> None:
        """Without a camera, a light or a background; one of them has actuators and keys."""
        joints = {"gantry": ["x", "y", "z"], "scara": ["j1", "j2", "z", "spin"]}[name]
        poses = np.array([[0.1, 0.1, -0.1, 0.0], [-0.2, -0.1, 0.0, 0.5]])[:, : len(joints)]
        with Scene(ROOT / "tests" / "machines" / f"{name}.xml", joints, poses) as machine:
            first, second = (machine.picture(pose, None) for pose in poses)
        assert np.mean(np.any(first != second, axis=2)) > 0.02
        assert first.std() > 15  # it is lit

    def test_a_machine_without_shapes(self, tmp_path: Path) -> None:
        """Such as a URDF with meshes alone: lines from joint to joint."""
        path = tmp_path / "bare.xml"
        inertial = '<inertial pos="0 0 0.3" mass="1" diaginertia="1 1 1"/>'
        path.write_text(
            f"""<mujoco><worldbody><body name="a">{inertial}<joint name="j" axis="0 1 0"/>
            <body name="b" pos="0 0 0.4">{inertial}<joint name="k" axis="0 1 0"/></body></body>
            </worldbody></mujoco>"""
        )
        with Scene(path, ["j", "k"], POSES) as machine:
            first, second = (machine.picture(pose, None) for pose in POSES[:2])
            ghost = machine.picture(POSES[0], POSES[1])
        assert np.mean(np.any(first != second, axis=2)) > 0.01
        assert np.mean(np.any(first != ghost, axis=2)) > 0.01

    def test_joints_that_are_gone(self) -> None:
        with pytest.raises(NoPicture, match=r"arm2.xml has changed, its joints are now q1, q2"):
            Scene(ARM2, ["q1", "q3"], POSES)

    def test_a_camera_that_looks_away(self, tmp_path: Path) -> None:
        path = tmp_path / "away.xml"
        path.write_text(ARM2.read_text().replace('xyaxes="1 0 0 0 0 1"', 'xyaxes="-1 0 0 0 0 1"'))
        with pytest.raises(NoPicture, match="camera looks away"):
            Scene(path, ["q1", "q2"], POSES)

    def test_a_model_that_no_longer_can_be_read(self, tmp_path: Path) -> None:
        path = tmp_path / "cut.xml"
        path.write_text(ARM2.read_text()[:500])
        with pytest.raises(NoPicture, match=r"can no longer be read: .*cut\.xml"):
            Scene(path, ["q1", "q2"], POSES)


# --- numbers -----------------------------------------------------------------------------------


def test_the_tables_have_the_summary(lossy: Path) -> None:
    run = shown(lossy)
    assert run.summary is not None
    by_axis, whole = tables([run])
    cells = {row[0]: row[1:] for row in by_axis.body}
    assert by_axis.head == ["", "q1", "q2"]
    for name, values, factor in (
        ("tracking error, rms [mrad]", run.summary["tracking"]["rms"], 1),
        ("tracking error, max [mrad]", run.summary["tracking"]["max"], 1),
        ("estimate at now, rms [mrad]", run.summary["estimate"]["rms_now"][:2], 1e3),
        ("estimate at commit, rms [mrad]", run.summary["estimate"]["rms_commit"][:2], 1e3),
        ("torque, max [Nm]", run.summary["torque"]["max_abs"], 1),
        ("torque limit [Nm]", run.summary["torque"]["limit"], 1),
        ("torque noise, rms [Nm]", run.summary["torque"]["noise_rms"], 1),
        ("torque clipped [%]", run.summary["torque"]["clipped_share"], 100),
    ):
        assert [float(cell) for cell in cells.pop(name)] == pytest.approx(
            [factor * value for value in values], rel=1e-3
        )
    assert not cells
    told = {row[0]: row[1] for row in whole.body}
    assert told["ticks"] == str(run.summary["solver"]["ticks"])
    assert told["frames lost"] == str(run.summary["frames"]["lost"])
    assert float(told["computing time, max [us]"]) == pytest.approx(
        run.summary["compute_us"]["max"], rel=1e-3
    )


def test_the_tables_of_two_runs_have_the_ratio(lossy: Path) -> None:
    first, second = shown(lossy, "one"), shown(lossy, "two", "b")
    assert first.summary is not None and second.summary is not None
    second.summary["tracking"]["rms"] = [3 * v for v in first.summary["tracking"]["rms"]]
    second.summary["solver"]["iterations_p50"] = None
    by_axis, whole = tables([first, second])
    assert by_axis.head == ["", "one", "two", "ratio"]
    ratios = {row[0]: row[3] for row in (*by_axis.body, *whole.body)}
    assert ratios["tracking error, rms [mrad], q1"] == "3"
    assert ratios["tracking error, max [mrad], q2"] == "1"
    assert ratios["iterations, median"] == "-"
    assert ratios["plans refused"] == "-"  # of zero there is none


def test_units_that_differ_stand_beside_the_values(lossy: Path) -> None:
    run = shown(lossy)
    assert run.summary is not None
    run.summary["tracking"]["unit"] = ["mrad", "mm"]
    row = tables([run])[0].body[0]
    assert row[0] == "tracking error, rms"
    assert row[1].endswith(" mrad") and row[2].endswith(" mm")


def test_figures_beside_the_plots_are_those_of_the_summary(lossy: Path) -> None:
    run = shown(lossy)
    assert run.summary is not None
    of_axis = run.summary["tracking"]
    for i, plot in enumerate(tracking([run]).plots):
        assert plot.figures == [f"rms {of_axis['rms'][i]:.3g}, max {of_axis['max'][i]:.3g} mrad"]
    torque = run.summary["torque"]
    for i, plot in enumerate(effort([run]).plots):
        most, share = torque["max_abs"][i], 100 * torque["clipped_share"][i]
        assert plot.figures == [f"max {most:.3g} Nm, {share:.2g} % clipped"]


# --- the command -------------------------------------------------------------------------------


@pytest.fixture
def _undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes seconds, and most tests do not look at it."""

    def no_picture(*_: object) -> None:
        raise NoPicture("the test draws nothing")

    monkeypatch.setattr(animation, "animate", no_picture)


def told(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    """The exit code of a report, and what stands on standard error."""
    code = main(["report", *map(str, arguments)])
    return code, capsys.readouterr().err


def data_of(page: Path) -> Any:
    found = re.search(r'id="data">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
    assert found
    return json.loads(found[1])


def test_a_report_beside_the_record(run: Path, _gl: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(animation, "FPS", 10.0)
    page = run / "report.html"
    page.write_text("an older one")
    assert main(["report", str(run)]) == 0
    data = data_of(page)
    pictures = data["film"]["pictures"]
    assert len(pictures) > 15 and sum(map(len, pictures)) <= 2e6
    assert Image.open(BytesIO(base64.b64decode(pictures[0]))).size == (640, 480)
    assert page.stat().st_size < 2e6
    assert {path.name for path in run.iterdir()} == {NAME, "summary.json", "report.html"}


@pytest.mark.usefixtures("_undrawn")
class TestCommand:
    def test_into_a_file(self, run: Path, tmp_path: Path) -> None:
        assert main(["report", str(run / NAME), "--out", str(tmp_path / "a" / "b.html")]) == 0
        assert (tmp_path / "a" / "b.html").stat().st_size > 1e5
        assert not (run / "report.html").exists()

    def test_two_runs(self, run: Path, lossy: Path) -> None:
        assert main(["report", str(run), str(lossy)]) == 0
        page = run / "report-vs-lossy.html"
        data = data_of(page)
        labels = [c["label"] for g in data["plots"][0]["groups"] for c in g["curves"]]
        assert "run: true" in labels and "lossy: true" in labels
        assert "<th>ratio</th>" in page.read_text()

    def test_two_runs_of_one_name(self, run: Path, lossy: Path) -> None:
        twin = lossy.parent / "twins" / "run"
        twin.mkdir(parents=True)
        (twin / NAME).write_bytes((lossy / NAME).read_bytes())
        assert main(["report", str(run), str(twin)]) == 0
        text = (run / "report-vs-run.html").read_text()
        assert str(run) in text and str(twin) in text

    def test_the_same_record_gives_the_same_page(self, run: Path) -> None:
        pages = []
        for _ in range(2):
            assert main(["report", str(run)]) == 0
            pages.append((run / "report.html").read_bytes())
        assert pages[0] == pages[1]

    def test_names_cannot_break_the_page(
        self, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        strange = tmp_path / "x\"&'<" / "script><script>alert(1)" / "run"
        strange.mkdir(parents=True)
        (strange / NAME).write_bytes((run / NAME).read_bytes())
        out = tmp_path / "page.html"
        assert told(capsys, run, strange, "--out", out)[0] == 0
        text = out.read_text()
        assert "<script>alert" not in text
        assert text.count("</script>") == 3
        assert any("</script><script>alert(1)" in c["label"] for c in curves_of(data_of(out)))

    def test_a_killed_run_says_so(self, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
        record = run / NAME
        record.write_bytes(record.read_bytes()[: record.stat().st_size * 3 // 4])
        (run / "summary.json").unlink()
        assert told(capsys, run)[0] == 0
        text = (run / "report.html").read_text()
        alarm, film = text.index("The record is incomplete"), text.index("No animation")
        assert alarm < film
        assert "A run without an end has no summary" in text

    def test_what_went_wrong_stands_first(self, run: Path) -> None:
        path = run / "summary.json"
        summary = json.loads(path.read_text())
        summary["limits_violated"] = ["q1: position 2.9 rad above 2.8"]
        summary["at_rest_after_end"] = False
        path.write_text(json.dumps(summary))
        assert main(["report", str(run)]) == 0
        text = (run / "report.html").read_text()
        assert "Not as it should be" in text
        assert "Limit violated: q1: position 2.9 rad above 2.8." in text
        assert "did not come to rest" in text

    def test_without_mpc(self, tmp_path: Path) -> None:
        run = simulated(tmp_path / "pid", "duration_s=0.3", "mpc.enabled=false")
        assert main(["report", str(run)]) == 0
        assert "MPC was off" in (run / "report.html").read_text()

    def test_a_run_of_a_moment(self, tmp_path: Path) -> None:
        """Too short to be judged: figures are missing, plots are there."""
        run = simulated(tmp_path / "short", "duration_s=0.02")
        assert main(["report", str(run)]) == 0
        assert "rms" not in data_of(run / "report.html")["plots"][0]["figures"]

    def test_not_a_run(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        for path in (tmp_path, tmp_path / "none", ARM2):
            code, error = told(capsys, path)
            assert code == 2 and str(path) in error and error.count("\n") == 1

    def test_damaged(self, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
        record = run / NAME
        data = bytearray(record.read_bytes())
        data[len(data) // 2] ^= 0xFF
        record.write_bytes(data)
        code, error = told(capsys, run)
        assert (code, error.count("\n")) == (2, 1)
        assert str(record) in error and "damaged" in error

    def test_over_before_its_task(self, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
        record = run / NAME
        (run / "summary.json").unlink()
        data = record.read_bytes()
        record.write_bytes(data[: len(data) // 8])
        code, error = told(capsys, run)
        assert code == 2 and "ends before its task begins" in error

    def test_other_axes(
        self, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        model = tmp_path / "other.xml"
        model.write_text(ARM2.read_text().replace('"q2"', '"elbow"'))
        changes = f"machine.model={model}", "machine.axes.1.joint=elbow", "duration_s=0.1"
        other = simulated(tmp_path / "other", *changes)
        code, error = told(capsys, run, other)
        assert code == 2
        assert f"{run} has the axes q1, q2, {other} has q1, elbow" in error
        assert not list(run.glob("*.html"))

    def test_a_summary_that_is_none(self, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
        path = run / "summary.json"
        for text, reason in (
            ("{", "cannot be read"),
            ("[]", "cannot be read"),
            ('{"log_sha256": "0"}', "of another run"),
        ):
            path.write_text(text)
            code, error = told(capsys, run)
            assert code == 2 and str(path) in error and reason in error

    def test_a_place_that_cannot_be_written(
        self, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "file").write_text("")
        for out, reason in ((tmp_path, "is a folder"), (tmp_path / "file" / "x", "cannot be")):
            code, error = told(capsys, run, "--out", out)
            assert code == 2 and str(out) in error and reason in error


def curves_of(data: Any) -> Iterator[Any]:
    for plot in data["plots"]:
        for group in plot["groups"]:
            yield from group["curves"]


def test_without_opengl(run: Path) -> None:
    """The page is made all the same, and says what is missing, as does standard error."""
    done = subprocess.run(
        [COMMAND, "report", run],
        env={**os.environ, "MUJOCO_GL": "disable"},
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    text = (run / "report.html").read_text()
    for place in (text, done.stderr):
        assert "apt-get install -y libegl1 libgl1" in place
    assert data_of(run / "report.html")["film"] is None
    assert 'id="film"' not in text


def test_without_the_model(lossy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = tmp_path / "moved.xml"
    model.write_bytes(ARM2.read_bytes())
    run = simulated(tmp_path / "run", f"machine.model={model}", "duration_s=0.1")
    model.unlink()
    code, error = told(capsys, run)
    assert code == 0 and f"put {model} back" in error
    assert f"put {model} back" in (run / "report.html").read_text()


def test_the_vendored_files_are_what_their_readme_says() -> None:
    folder = ROOT / "scripts" / "cli" / "page" / "uplot"
    rows = re.findall(r"^\| (\S+) \| ([0-9a-f]{64}) \|$", (folder / "README.md").read_text(), re.M)
    assert {name for name, _ in rows} == {p.name for p in folder.iterdir()} - {"README.md"}
    for name, digest in rows:
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    assert "MIT License" in (folder / "LICENSE").read_text()
