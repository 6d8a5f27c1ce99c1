"""Axes that turn for ever: positions modulo 2^32 on the wire and the board, angles on the host.

The turntable's encoder has 2^16 counts a turn. So its control points, in 1/1024 of a count, begin
anew every 64 turns, first after 32; its counts every 2^16, first after 2^15.
"""

import json
import math
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from rig import KEY, POSITION, TORQUE, Rig
from ruamel.yaml import YAML
from test_plan_codec import FLAGS, status_layout

from headway.cli.closed_loop import ClosedLoop, ClosedLoopRun
from headway.cli.judge import beyond_limits
from headway.cli.main import main
from headway.cli.rules import Subject, all_rules
from headway.configs import describe
from headway.configs.load import ConfigError, load_config
from headway.configs.save import save_config
from headway.controller.ocp import Limits, Ocp
from headway.controller.reference import Entry, Sines
from headway.devices import core
from headway.devices._tracks import Odometer, Samples
from headway.devices.axis import AxisUnits, position_limits, whole_turns
from headway.devices.settings import device_settings
from headway.devices.widest import fits_a_frame
from headway.firmware import _core
from headway.models.machine import load_machine
from headway.models.stated import stated

FILE = Path(__file__).resolve().parent / "turntable" / "turntable.yaml"
CONFIG = load_config(FILE)
TABLE, ARM = CONFIG.machine.axes
UNITS = AxisUnits.of(TABLE, CONFIG.loop)
TURN = 2 * math.pi
POINTS_TURNS, COUNTS_TURNS = 32, 2**15  # from zero to where int32 ends
FLAG_BITS, FIELDS = 12, 36  # of a status' head
Array = NDArray[np.float64]


# ---- what an axis is


def test_the_turntable_is_sound() -> None:
    rules = all_rules(Subject(CONFIG, FILE.with_name("turntable.xml")))
    assert {str(rule.status) for rule in rules} == {"ok"}


def test_without_ends() -> None:
    assert (TABLE.lowest, TABLE.highest) == (-math.inf, math.inf)
    assert (ARM.lowest, ARM.highest) == (-1.4, 1.4)
    assert TABLE.poses == (-math.pi, math.pi) and ARM.poses == (-1.4, 1.4)
    assert TABLE.following == pytest.approx(TURN / 8)  # an eighth of a turn


def test_a_saved_config_is_still_continuous(tmp_path: Path) -> None:
    save_config(CONFIG, FILE.parent, tmp_path / "saved.yaml")
    again = load_config(tmp_path / "saved.yaml")
    assert again.machine.axes == CONFIG.machine.axes and again.task == CONFIG.task


HOMING = {"mark_rad": 0, "speed_rad_per_s": 1, "torque_Nm": 1, "way_rad": 7}


@pytest.mark.parametrize(
    ("changes", "valid"),
    [
        ({}, True),
        ({"continuous": None}, False),
        ({"continuous": False}, False),
        ({"continuous": False, "position_min_rad": -1, "position_max_rad": 1}, True),
        ({"position_min_rad": -1}, False),
        ({"soft_max_rad": 1}, False),
        ({"homing": {**HOMING, "method": "stop"}}, False),
        ({"homing": {**HOMING, "method": "switch"}}, True),
    ],
)
def test_editors_are_told_the_same(changes: dict[str, Any], valid: bool, tmp_path: Path) -> None:
    tree = YAML(typ="safe").load(FILE.read_text())
    tree["machine"]["model"] = str(FILE.with_name("turntable.xml"))
    tree["task"]["axes"][0].pop("rate_rad_per_s")
    table = tree["machine"]["axes"][0]
    table.update(changes)
    tree["machine"]["axes"][0] = {key: value for key, value in table.items() if value is not None}
    schema = json.loads(describe.FILES["schema"].read_text())
    assert jsonschema.Draft202012Validator(schema).is_valid(tree) is valid
    path = tmp_path / "config.yaml"
    path.write_text(json.dumps(tree))
    if valid:
        load_config(path)
    else:
        with pytest.raises(ConfigError, match=r"machine\.axes\.0"):
            load_config(path)


def test_the_boards_know() -> None:
    for axis, endless in ((TABLE, True), (ARM, False)):
        board = device_settings(axis, CONFIG.device, CONFIG.loop, CONFIG.sync)
        assert board.limits(POSITION).continuous is endless
        assert board.limits(TORQUE).continuous is False
        assert board.monitor.bounded is not endless


def test_the_widest_plan_begins_anew_at_every_knot() -> None:
    """Such a plan takes 5 bytes a point, where within a range it takes 3 of these."""
    limits = position_limits(TABLE, UNITS)
    assert limits.continuous
    size = limits.difference_max, limits.second_difference_max
    ranged = core.GateLimits(limits.point_min, limits.point_max, *size)

    def most(of: core.GateLimits) -> int:
        return max(n for n in range(3, 100) if fits_a_frame(dict.fromkeys(range(5), of), n))

    assert 940 < 5 * 5 * most(limits) <= 950  # of 1000, with 44 for the head
    assert most(ranged) > 1.5 * most(limits)


# ---- from points and counts to angles and back


@given(
    start=st.floats(-1e6, 1e6),
    steps=st.lists(st.floats(-150.0, 150.0), min_size=1, max_size=40),
    off=st.floats(-190.0, 190.0),
)
def test_points_become_the_angles_that_they_were(
    start: float, steps: list[float], off: float
) -> None:
    """Whatever the turn, with a guess of where it begins that is off by up to 30 turns."""
    angles = start + np.cumsum([0.0, *steps])
    points = UNITS.position_points(angles)
    assert points.dtype == np.int32
    again = UNITS.unwrapped(points, start + off) / UNITS.pq_per_unit
    np.testing.assert_allclose(again, angles, rtol=0, atol=0.6 / UNITS.pq_per_unit + 1e-8)
    assert np.array_equal(UNITS.position_points(again), points)


@given(st.lists(st.floats(-1.4, 1.4), min_size=1, max_size=20), st.floats(-1e9, 1e9))
def test_a_bounded_axis_looks_at_no_guess(angles: list[float], near: float) -> None:
    units = AxisUnits.of(ARM, CONFIG.loop)
    points = units.position_points(np.array(angles))
    assert np.array_equal(units.unwrapped(points, near), points)


@given(st.floats(-1e4, 1e4), st.integers(-1000, 1000))
def test_whole_turns_make_no_difference(way: float, turns: int) -> None:
    both = np.array([way + turns * TURN, way])
    found = whole_turns([TABLE, ARM], both)
    assert found[1] == 0
    rest = both[0] - found[0]
    assert abs(rest) <= math.pi + 1e-9
    assert math.cos(rest - way) == pytest.approx(1, abs=1e-9)


def counted(odometer: Odometer, told: list[tuple[int, int]], homed: bool) -> list[tuple[int, int]]:
    """What an odometer of unit counts makes of a status' samples."""
    head = [0] * FIELDS
    head[FLAG_BITS] = homed << FLAGS.index("homed")
    status = _core.status_decode(status_layout(tuple(head), told))
    assert status is not None and status.homed == homed
    samples = Samples()
    odometer.read(status, samples)
    assert all(sample.axis == 3 for sample in samples)
    return [(sample.time_us, round(sample.position)) for sample in samples]


@given(
    st.integers(-(2**31), 2**31 - 1),
    st.lists(st.lists(st.integers(-(2**30), 2**30), max_size=5), max_size=20),
)
def test_an_odometer_goes_on(first: int, way: list[list[int]]) -> None:
    """Samples are told twice, as a device does."""
    odometer, true, before = Odometer(3, 1.0), [first], list[int]()
    assert counted(odometer, [(0, first)], True) == [(0, first)]
    for steps in way:
        new = [true[-1] + sum(steps[: i + 1]) for i in range(len(steps))]
        told = [(i, (c + 2**31) % 2**32 - 2**31) for i, c in enumerate(before[-2:] + new)]
        expected = before[-2:] + new
        if all(abs(b - a) < 2**31 for a, b in zip([true[-1], *expected], expected, strict=False)):
            assert [count for _, count in counted(odometer, told, True)] == expected
            true, before = [*true, *new], new


def test_an_odometer_begins_anew_where_the_mark_was_found() -> None:
    odometer = Odometer(3, 1.0)
    assert counted(odometer, [(0, 2**31 - 1), (1, -(2**31))], False) == [
        (0, -(2**31) - 1),
        (1, -(2**31)),
    ]
    assert counted(odometer, [(2, -(2**31) + 5), (3, 100)], True)[-1] == (3, 100)
    assert counted(odometer, [], False) == []


def test_an_odometer_tells_positions() -> None:
    samples, odometer = Samples(), Odometer(1, 0.25)
    head = [0] * FIELDS
    for count in (-3, 5):
        status = _core.status_decode(status_layout(tuple(head), [(7, count)]))
        assert status is not None
        odometer.read(status, samples)
    assert [(s.time_us, s.axis, s.position) for s in samples] == [(7, 1, -0.75), (7, 1, 1.25)]


# ---- the gate, on both ends


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(("excess", "result"), [(0, "accepted"), (1, "speed")])
def test_both_gates_take_a_plan_across_the_end_of_int32(
    direction: int, excess: int, result: str
) -> None:
    board = device_settings(TABLE, CONFIG.device, CONFIG.loop, CONFIG.sync)
    board.key = KEY
    rig = Rig(settings=board, supply_V=TABLE.motor.supply_V)
    at = direction * (2**21 - 5)  # counts
    rig.encoder = lambda _: at
    rig.sync()
    first = rig.start(8, position=1024 * at)
    limits = board.limits(POSITION)
    faster = list(range(0, limits.difference_max, limits.second_difference_max))
    steps = [0, 0, *faster, limits.difference_max + excess, *faster[::-1], 0, 0]
    ways = 1024 * at + direction * np.cumsum(steps)
    points = ((ways + 2**31) % 2**32 - 2**31).astype(np.int32)
    assert np.ptp(points.astype(np.int64)) > 2**31  # it does go across
    host = core.Track()
    host.write(first, np.full(8, 1024 * at, np.int32))
    begin = first + 8
    assert core.gate_check_track(limits, host, begin, points, rig.knot) == result
    plan = {POSITION: points.tolist(), TORQUE: [0] * len(points)}
    assert rig.give(begin, plan) == result
    if result == "accepted":
        reached = [point[0] for point in rig.setpoints(begin, begin + len(points))]
        assert reached[-1] == points[-1] and min(reached) < -(2**30) < 2**30 < max(reached)


# ---- the plan and the task


def test_only_bounded_axes_have_position_limits_in_the_plan() -> None:
    limits = Limits.of(CONFIG)
    assert limits.soft_min[0] == -math.inf and limits.soft_max[0] == math.inf
    ocp = Ocp(CONFIG, limits)
    n, count = 2, CONFIG.mpc.intervals
    others = 2 * n * (count + 1) + 2 * n + n * (count + 1) + 2 * n * count
    assert ocp.constraints.shape[0] == others + 2 * count
    z = np.zeros(ocp.size)
    z[ocp.states] = np.tile([1.0, 0, 0, 0], count + 1)  # the table, moved
    assert not np.any((ocp.constraints @ z)[others:])
    z[ocp.states] = np.tile([0, 1.0, 0, 0], count + 1)
    assert np.all((ocp.constraints @ z)[others:] != 0)


def test_a_sine_that_turns_on() -> None:
    q, v, a = Sines(CONFIG.task).at(np.array([0.0, 1.0, 1000.0]))
    np.testing.assert_allclose(q[:, 0], [0, 6, 6000], atol=1e-9)
    np.testing.assert_allclose(v[:, 0], 6 + 0.5 * TURN, rtol=1e-9)
    np.testing.assert_allclose(a[:, 0], 0, atol=1e-9)


@pytest.mark.parametrize("turns", [0, 17, -40_000])
def test_a_task_is_entered_at_the_nearest_turn(turns: int) -> None:
    reference = Sines(CONFIG.task)
    start = np.array([0.4 + TURN * turns, 0.1])
    shift = whole_turns(CONFIG.machine.axes, start - reference.at(np.zeros(1))[0][0])
    time_s = np.linspace(0, 1, 500)
    q, v, _ = Entry(reference, start, 0.0, 0.5, shift).at(time_s)
    np.testing.assert_allclose(q[0], start, atol=1e-9)
    np.testing.assert_allclose(v[0], 0, atol=1e-9)
    late = time_s > 0.5
    np.testing.assert_allclose(
        q[late] - reference.at(time_s)[0][late], [[TURN * turns, 0]] * late.sum()
    )
    assert np.abs(v[:, 0]).max() < 15


# ---- closed loop


@pytest.fixture(scope="module")
def loop() -> ClosedLoop:
    made = ClosedLoop(FILE.parent)
    made.folders = (FILE.parent,)
    return made


def turning(loop: ClosedLoop, offset: float, **table: float) -> ClosedLoopRun:
    """The table begins at `offset`."""
    sine = {"amplitude_rad": 0.5, "harmonic": 2, "offset_rad": offset, **table}
    return loop(FILE.name, {"task.axes.0": sine})


def sound(run: ClosedLoopRun) -> None:
    run.assert_within_limits(margin=0.05)
    run.assert_tracks(rms_below_mrad={"table": 0.5, "arm": 1.0}, max_below_mrad=6)
    run.assert_estimates(rms_below_counts=4)
    run.assert_comes_to_rest()
    run.assert_no_plan_refused()
    assert run.summary["solver"]["rejected"] == 0
    assert run.summary["limits_violated"] == []


def crosses(run: ClosedLoopRun, turns: int) -> bool:
    """Whether the table goes from below this angle to above it, or back."""
    way = run.arrays["truth_position"][:, 0] - TURN * turns
    return bool(way.min() < -0.05 and way.max() > 0.05)


def shifted(run: ClosedLoopRun, turns: int) -> dict[str, Array]:
    """Plans and motion as they would be `turns` further back."""
    arrays = run.arrays
    motion = arrays["truth_position"] - [TURN * turns, 0]
    commit = arrays["commit_estimate"][:, :2] - [TURN * turns, 0]
    error = arrays["truth_position"] - arrays["truth_reference"]
    mine = np.repeat(arrays["sent_device"] == 0, np.diff(arrays["sent_position_pq_offsets"]))
    points = arrays["sent_position_pq"].astype(np.int64) - mine * turns * 2**26
    points = (points + 2**31) % 2**32 - 2**31
    return {"motion": motion, "commit": commit, "error": error, "points": points}


TASKS = {
    "upwards": (-0.3, {"rate_rad_per_s": 6.0}),
    "downwards": (0.3, {"rate_rad_per_s": -6.0, "amplitude_rad": -0.5}),
    "to and fro": (-0.15, {}),
}


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("turns", [POINTS_TURNS, -POINTS_TURNS])
def test_where_points_begin_anew_all_is_as_elsewhere(
    loop: ClosedLoop, task: str, turns: int
) -> None:
    """Each plan, point by point, and the motion: until the last bits of float64 have grown by way
    of rounding to whole quanta and counts; from then on, as large errors as elsewhere."""
    offset, sine = TASKS[task]
    here, there = turning(loop, offset, **sine), turning(loop, offset + TURN * turns, **sine)
    assert crosses(there, turns) and not crosses(there, 0)
    sound(here)
    sound(there)
    before, after = shifted(here, 0), shifted(there, turns)
    early = here.arrays["truth_s"] < 0.3
    across = after["motion"][early, 0]
    assert across.min() < 0 < across.max()  # it has gone across by then
    assert np.abs(after["motion"] - before["motion"])[early].max() < 1e-5
    ticks = here.arrays["tick_s"] < 0.3
    assert np.abs(after["commit"] - before["commit"])[ticks].max() < 1e-5
    many = int((here.arrays["sent_s"] < 0.3).sum())
    ends = here.arrays["sent_position_pq_offsets"][many]
    assert np.abs(after["points"] - before["points"])[:ends].max() <= 50  # of 1/1024 of a count
    assert np.abs(after["motion"] - before["motion"]).max() < 5e-3
    rms = [np.sqrt(np.mean(part["error"] ** 2, axis=0)) for part in (before, after)]
    assert np.all(rms[1] < 2 * rms[0])


@pytest.mark.parametrize("sign", [1, -1])
def test_where_counts_begin_anew(loop: ClosedLoop, sign: int) -> None:
    """After 2^31 counts, at speed; float64 still has 3e-11 rad there."""
    turns = sign * COUNTS_TURNS
    run = turning(
        loop, TURN * turns - 0.3 * sign, rate_rad_per_s=6.0 * sign, amplitude_rad=0.5 * sign
    )
    assert crosses(run, turns)
    counts = run.arrays["received_sample_count"].astype(np.int64)
    assert counts.min() < -(2**30) and counts.max() > 2**30
    sound(run)


def test_an_axis_that_has_turned_before_takes_the_short_way(loop: ClosedLoop) -> None:
    """It stands 18 turns and a bit from where its task begins."""
    start = [18 * TURN + 0.3, 0.0]
    run = loop(FILE.name, {"sim.start_rad_or_m": start})
    sound(run)
    assert run.arrays["truth_position"][:, 0].min() > start[0] - 0.1
    way = (run.arrays["truth_position"] - run.arrays["truth_reference"])[:, 0]
    task = (run.arrays["truth_s"] > 0.5) & (run.arrays["truth_s"] < 1.2)
    assert np.abs(way[task] - 18 * TURN).max() < 0.01


def test_the_arm_keeps_its_limits_beside_it(loop: ClosedLoop) -> None:
    run = loop(FILE.name, {"machine.axes.1.soft_max_rad": 0.2})
    assert 0.15 < run.arrays["truth_position"][:, 1].max() < 0.205
    run.assert_tracks(rms_below_mrad={"table": 0.6})


@pytest.mark.parametrize("method", ["index", "switch"])
@pytest.mark.parametrize("turns", [0, -5])
def test_homing(loop: ClosedLoop, method: str, turns: int) -> None:
    """Its switch is on for half of each turn, so that it is found in any of them."""
    homing = {"method": method, "mark_rad": 0.3, "speed_rad_per_s": 0.3, "torque_Nm": 2.0}
    overrides: dict[str, Any] = {
        "machine.axes.0.homing": {**homing, "way_rad": 7.0},
        "sim.start_rad_or_m": [turns * TURN, 0.0],
        "machine.axes.0.motor": {  # no gear: an index once a turn
            **{"gear": 1, "torque_constant_Nm_per_A": 1.2, "resistance_ohm": 2, "supply_V": 48}
        },
    }
    run = loop(FILE.name, {**overrides, "duration_s": 0.8})
    run.assert_estimates(rms_below_counts=10)  # the switch is looked at once a millisecond
    run.assert_tracks(rms_below_mrad={"table": 1.0})
    known = run.arrays["now_estimate"][0, 0] - run.arrays["actual_position"][0, 0]
    assert abs(known + turns * TURN) < 1e-3


def test_gain_tracks_beside_it(loop: ClosedLoop) -> None:
    """Scheduled over one turn; they are no positions, so they never begin anew."""
    offset = TURN * POINTS_TURNS - 0.3
    run = loop(
        FILE.name,
        {
            "loop.gains": "scheduled",
            "task.axes.0": {"offset_rad": offset, "rate_rad_per_s": 6.0, "amplitude_rad": 0.5},
            "mpc.horizon_us": 163840,
            "mpc.intervals": 20,
        },
    )
    assert crosses(run, POINTS_TURNS)
    run.assert_tracks(rms_below_mrad=2)
    run.assert_no_plan_refused()


def test_streaming_the_reference(loop: ClosedLoop) -> None:
    offset = TURN * POINTS_TURNS - 0.3
    sine = {"offset_rad": offset, "rate_rad_per_s": 6.0, "amplitude_rad": 0.5}
    run = loop(FILE.name, {"mpc.enabled": False, "task.axes.0": sine})
    assert crosses(run, POINTS_TURNS)
    run.assert_tracks(rms_below_mrad=20)
    run.assert_no_plan_refused()


# ---- what is judged


def test_no_position_is_too_far_but_a_speed_may_be_too_high(loop: ClosedLoop) -> None:
    run = turning(loop, -0.3, rate_rad_per_s=6.0)
    far = run.arrays["truth_position"] + [1e9, 3.0]
    (told,) = beyond_limits(CONFIG, {**run.arrays, "truth_position": far}, margin=0.1)
    assert told.startswith("arm: position")
    fast = run.arrays["truth_velocity"] * [3.0, 1.0]
    (told,) = beyond_limits(CONFIG, {**run.arrays, "truth_velocity": fast})
    assert told.startswith("table: velocity")


def test_a_page_has_no_limits_of_it(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    assert main(["run", str(FILE), "--duration", "0.6", "--out", str(out), "--json"]) == 0
    assert main(["report", str(out)]) == 0
    assert (out / "report.html").stat().st_size > 10_000
    capfd.readouterr()


# ---- models


URDF = """<robot name="crane"><link name="base"/>
<link name="mast"><inertial><origin xyz="0.2 0 0"/><mass value="4"/>
<inertia ixx="0.1" iyy="0.2" izz="0.3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="jib"><inertial><origin xyz="0.3 0 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.04" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slew" type="continuous"><parent link="base"/><child link="mast"/><axis xyz="0 0 1"/>
{limit}<dynamics damping="0.5"/></joint>
<joint name="luff" type="revolute"><parent link="mast"/><child link="jib"/>
<origin xyz="0.4 0 0"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="30" velocity="5"/>
<dynamics damping="0.2"/></joint></robot>"""
LIMITS = {"none": "", "half": '<limit effort="40" velocity="6"/>'}


@pytest.mark.parametrize("limit", LIMITS)
def test_a_urdfs_continuous_joint_is_an_angle(tmp_path: Path, limit: str) -> None:
    path = tmp_path / "crane.urdf"
    path.write_text(URDF.format(limit=LIMITS[limit]))
    machine = load_machine(path)  # which compares its dynamics with MuJoCo's
    assert machine.joints == ("slew", "luff") and machine.model.nq == machine.model.nv == 2
    slew, luff = stated(path, machine.joints)
    assert (slew.continuous, luff.continuous) == (True, False)
    assert (slew.position, luff.position) == (None, (-1.0, 1.0))
    known = (40.0, 6.0) if limit == "half" else (None, None)
    assert (slew.effort, slew.velocity) == known


def test_init_check_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("crane.urdf").write_text(URDF.format(limit=LIMITS["none"]))
    assert main(["init", "crane.urdf"]) == 0
    text = Path("crane.yaml").read_text()
    assert "      continuous: true\n" in text  # stated, so no guess
    slew, luff = load_config(Path("crane.yaml")).machine.axes
    assert slew.continuous and not luff.continuous
    assert main(["check", "crane.yaml", "--json"]) == 0
    capfd.readouterr()
    turn = "--set=task.axes.0.rate_rad_per_s=1"
    assert main(["run", "crane.yaml", "--duration", "0.8", "--json", "--out", "out", turn]) == 0
    summary = json.loads(capfd.readouterr().out)
    assert summary["limits_violated"] == [] and summary["at_rest_after_end"] is True
    assert max(summary["tracking"]["rms"]) < 2


def test_init_says_how_to_make_a_hinge_continuous(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hinge of an MJCF without a range may turn for ever, or nobody has measured it."""
    monkeypatch.chdir(tmp_path)
    assert main(["init", str(FILE.with_name("turntable.xml"))]) == 0
    lines = Path("turntable.yaml").read_text().splitlines()
    (line,) = [line for line in lines if "continuous: true" in line]
    assert line.startswith("      position_min_rad: -3 ") and "# guessed: the model has no" in line


def test_a_joint_that_ends_is_not_continuous(tmp_path: Path) -> None:
    text = FILE.with_name("turntable.xml").read_text()
    model = tmp_path / "turntable.xml"
    model.write_text(text.replace('axis="0.28 0 0.96"', 'axis="0.28 0 0.96" range="-4 4"'))
    rules = {rule.name: rule for rule in all_rules(Subject(CONFIG, model))}
    rule = rules["range: beyond the model's"]
    assert str(rule.status) == "FAIL" and rule.axis == "table"
    assert "ends at -4 and 4 rad: table is not continuous" in rule.remedy
