"""`headway play`: the shipped strobe does what its config says, and mistakes are named."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from stages import assert_mistake, changed

from headway.cli.main import main
from headway.configs.mistakes.mistake import ConfigError
from headway.configs.stage import Node, load_stage, order
from headway.sim.stage import Play, wave

ROOT = Path(__file__).resolve().parents[1]
STROBE = ROOT / "configs" / "strobe.yaml"


@pytest.fixture(scope="module")
def played() -> Play:
    play = Play(load_stage(STROBE))
    play.run()
    return play


def test_strobe_and_shutter_fire_together(played: Play) -> None:
    strobe, camera = (played.fired[i][0] for i in (0, 1))
    asked = [100_000 + 20_011 * i for i in range(90)]
    assert played.widest_us < 20
    for fired in (strobe, camera):
        assert len(fired) == 90
        assert max(abs(t - a) for t, a in zip(fired, asked, strict=True)) <= played.widest_us + 1
    apart = max(abs(a - b) for a, b in zip(strobe, camera, strict=True))
    assert apart <= 2 * played.widest_us + 2


def test_the_sensor_samples_on_each_edge_in_the_window(played: Play) -> None:
    told = played.readings(2, 0)
    sweep = lambda t: min(t, 2_000_000 - t) / 1000  # noqa: E731
    asked = [t for t in (100_000 + 20_011 * i for i in range(90)) if 250 < sweep(t + 500) < 750]
    assert abs(len(told) - len(asked)) <= 2
    for time_us, _ in told:
        late = min(time_us - a for a in asked if time_us - a > -20)
        assert late <= 1000 + 20  # a servo period, and the clock
    assert [played.signals(i).lost for i in range(3)] == [0, 0, 0]
    assert [played.signals(i).late for i in range(3)] == [0, 0, 0]


def test_a_wave_beyond_the_bandwidth_is_put_together(played: Play) -> None:
    from headway.sim.stage import reconstruct

    left, amplitudes = reconstruct(played.readings(2, 1), 493.827)
    assert left < 0.1
    assert amplitudes[0] == pytest.approx(1000, rel=0.02)
    assert amplitudes[1] == pytest.approx(300, rel=0.05)
    wrong, _ = reconstruct(played.readings(2, 1), 500.0)  # by another period there is no wave
    assert wrong > 0.8


def test_the_same_seed_plays_the_same(tmp_path: Path) -> None:
    file = changed(tmp_path, STROBE.read_text(), "duration_s: 2.0", "duration_s: 0.3")
    command = [sys.executable, "-c", "from headway.cli.main import main; main()", "play"]
    done = [
        subprocess.run([*command, file, "--json"], capture_output=True, text=True) for _ in range(2)
    ]
    assert done[0].returncode == 0, done[0].stderr
    assert done[0].stdout == done[1].stdout
    figures = json.loads(done[0].stdout)
    assert [row["times"] for row in figures["outputs"]] == [20, 20]


@pytest.mark.parametrize(
    ("old", "new", "key", "text"),
    [
        ("a: fire, b: open}", "a: fier, b: open}", "devices.sensor.nodes.shot.a", "there is no"),
        ("a: sweep, low", "a: shot, low", "devices.sensor.nodes.", "reads itself"),
        ("low: 250", "low: 850", "devices.sensor.nodes.open.low", "is above high"),
        ("when: shot}", "when: short}", "devices.sensor.readings.0.when", "there is no 'short'"),
        ("duration_s: 2.0", "duration_s: soon", "duration_s", "valid number"),
        ("every: 7", "evry: 7", "devices.sensor.readings.1.evry", "no such key"),
        ("start_us: 0, end", "end", "tracks.sweep.ramps.0", "the first ramp needs start_us"),
        ("on_us: 1500", "on_us: 20011", "tracks.fire.stream.on_us", "is not below every_us, 20011"),
        (
            "{end_us: 20",
            "{start_us: 2000001, end_us: 20",
            "tracks.sweep.ramps.1.end_us",
            "its star",
        ),
        ("{end_us: 2000000", "{end_us: 1100000000", "tracks.sweep.ramps.1.end_us", "1073741824 us"),
        (
            "start_us: 0, end",
            "start_us: 9, end_us: 9, first: 0, last: 0}\n      - {start_us: 8, end",
            "tracks.sweep.ramps.1.start_us",
            "is before the start of the ramp before it, 9",
        ),
        ("open: {kind", "fire: {kind", "devices.sensor.nodes.fire", "is the name of a track"),
        ("open: {kind", "state: {kind", "devices.sensor.nodes.state", "is the name of an input"),
        ("  sweep:  ", "  position:  ", "tracks.position", "is the name of an input"),
        ("amplitude: 1000", "amplitude: 1e12", "devices.sensor.sensor.amplitude", "50000"),
        (
            "{period_us: 493.827",
            "{period_us: 0.5",
            "devices.sensor.sensor.period_us",
            "equal to 1",
        ),
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, key: str, text: str) -> None:
    assert_mistake(changed(tmp_path, STROBE.read_text(), old, new), key, text)


def test_the_command_ends_with_2_for_a_mistake(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = changed(tmp_path, STROBE.read_text(), "a: sweep", "a: swep")
    assert main(["play", str(file)]) == 2
    assert "there is no 'swep'" in capsys.readouterr().err
    assert main(["play", str(tmp_path / "none.yaml")]) == 2


STAGE = """\
name: small
duration_s: 0.4
wire: {delay_us: 1000, jitter_us: 300, loss: 0}
sync: {to_device_least_us: 700, to_host_least_us: 700, limit_us: 500}
tracks:
  fire: {stream: {start_us: 100000, every_us: EVERY, on_us: ON, times: TIMES}}
  other: {stream: {start_us: 100030, every_us: EVERY, on_us: ON, times: TIMES}}
devices:
  one:
    digital: [fire, fire, other, other]
    readings: [{kind: interval, read: state, every: 5, fold_us: 1000}]
"""


def small(folder: Path, every_us: int, on_us: int, times: int) -> Path:
    file = folder / "small.yaml"
    text = STAGE.replace("EVERY", str(every_us)).replace("ON", str(on_us))
    file.write_text(text.replace("TIMES", str(times)))
    return file


def test_a_stage_that_no_wire_can_bring_is_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["play", str(small(tmp_path, 100, 50, 900))]) == 4
    done = capsys.readouterr()
    assert "pieces came to one after their start" in done.err
    assert "late" in done.out and "refused" in done.out


def test_all_that_changes_is_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of four outputs, more than a board remembers. What does not change has no wave: null."""
    assert main(["play", str(small(tmp_path, 2500, 90, 60)), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert [row["times"] for row in figures["outputs"]] == [60] * 4
    assert all(abs(row["off_us"]) <= 60 for row in figures["outputs"])
    assert figures["readings"][0]["left_over"] is None
    [device] = figures["devices"]
    assert device == {"device": "one", "logic": "good", "settled": True, "refused": 0, "late": 0,
                      "gaps": 0, "readings_lost": 0}  # fmt: skip


def test_what_is_told_of_a_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from headway.cli import play

    good = {"device": "one", "logic": "good", "settled": True, "refused": 0, "late": 0}
    good["gaps"] = 0
    assert play._trouble([good]) == ""
    for key, value, text in (
        ("logic", "node a reads itself", "one has refused its logic: node a reads itself"),
        ("refused", 1, "one has not taken all of its tracks"),
        ("settled", False, "one has not taken all of its tracks"),
        ("late", 7, "7 pieces came to one after their start"),
        ("gaps", 3, "3 gaps were in what other boards fed one"),
    ):
        assert text in play._trouble([good, good | {key: value}])


def test_a_short_interval_loses_no_reading_on_a_good_wire(tmp_path: Path) -> None:
    file = tmp_path / "often.yaml"
    text = STAGE.replace("EVERY", "20000").replace("ON", "900").replace("TIMES", "3")
    text = text.replace("every: 5", "every: 1").replace(
        "name: small", "servo_period_us: 100\nname: small"
    )
    file.write_text(text)
    played = Play(load_stage(file))
    played.run()
    told = played.readings(0, 0)
    assert len(told) > 8000 and np.diff(told[:, 0]).max() <= 102
    assert played.signals(0).lost == 0


@pytest.mark.parametrize("command", ["check", "run"])
def test_other_commands_name_this_one(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, str(STROBE)]) == 2
    done = capsys.readouterr()
    said = f"is a stage, without a machine: try headway play {STROBE}"
    assert said in (done.out if command == "check" else done.err)


def test_what_a_node_of_one_input_does_not_read_is_no_cycle() -> None:
    node = Node(kind="compare", a="error", b="itself")
    assert order({"itself": node}) == ["itself"]


def test_nodes_are_sorted() -> None:
    nodes = {
        name: Node(kind="add", a=a, b=b)
        for name, a, b in (("x", "y", "z"), ("y", "z", "z"), ("z", "error", "error"))
    }
    assert order(nodes) == ["z", "y", "x"]


GEAR = ROOT / "configs" / "gear.yaml"


def test_the_gear_follows_from_board_to_board(capsys: pytest.CaptureFixture[str]) -> None:
    """Against the wave that the wheel's encoder shows, not against what the wheel has told."""
    stage = load_stage(GEAR)
    assert stage.cables == [("wheel", "follower")]
    play = Play(stage)
    play.run()
    sensor = stage.devices["wheel"].sensor
    assert sensor is not None
    feed = stage.devices["wheel"].feeds["turn"]
    begin_us = round(stage.settle_s * 1e6)  # the sensor's wave runs in true time
    speed = 2 * np.pi * (sensor.amplitude + 2 * sensor.second) / sensor.period_us
    bend = (2 * np.pi / sensor.period_us) ** 2 * (sensor.amplitude + 4 * sensor.second)
    line = bend * (feed.every * stage.servo_period_us) ** 2 / 8
    for trigger, share, ago_us in ((0, 1.0, 0), (1, 0.75, 0), (2, 1.0, 40_000)):
        told = play.readings(1, trigger)
        told = told[told[:, 0] >= 0]
        then_us = told[:, 0] - feed.after_us - ago_us + begin_us
        off = told[:, 1] - share * wave(sensor, then_us.astype(float))
        assert len(told) > 100 and np.ptp(told[:, 1]) > 25_000
        assert np.abs(off).max() <= line + speed * (2 * play.widest_us + 4) + 3
    wheel, follower = (np.array(play.fired[i][0]) for i in (0, 1))
    assert len(wheel) == len(follower) >= 3
    late = follower - wheel - stage.devices["wheel"].feeds["passed"].after_us
    assert np.abs(late).max() <= 2 * play.widest_us + 3
    assert [play.signals(i).gaps for i in (0, 1)] == [0, 0]
    assert main(["play", str(GEAR), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["outputs"][1]["off_us"] == np.abs(late).max()
    assert 0 < figures["readings"][1]["apart"] <= 2 * line + speed * (2 * play.widest_us + 4) + 3


@pytest.mark.parametrize(
    ("old", "new", "key", "text"),
    [
        ("a: turn, b: r", "a: trun, b: r", "devices.follower.nodes.geared.a", "turn, passed"),
        ("of: mark", "of: turn", "devices.wheel.feeds.passed.of", "there is no 'turn'"),
        ("digital: [mark]", "digital: [passed]", "devices.wheel.digital.0", "there is no"),
        ("passed: {kind", "ratio: {kind", "devices.wheel.feeds.ratio", "of something else"),
        ("passed: {kind", "geared: {kind", "devices.wheel.feeds.geared", "of something else"),
        ("kind: step, of", "kind: jump, of", "devices.wheel.feeds.passed.kind", "'ramp' or 'step'"),
        ("after_us: 8000", "after_us: 80000", "devices.wheel.feeds.passed.after_us", "65535"),
    ],
)
def test_mistakes_with_feeds_are_named(
    tmp_path: Path, old: str, new: str, key: str, text: str
) -> None:
    assert_mistake(changed(tmp_path, GEAR.read_text(), old, new), key, text)


def test_no_device_has_more_wires_or_feeds_than_room(tmp_path: Path) -> None:
    follower = "{readings: [{kind: interval, read: turn, every: 9}]}"
    whole = GEAR.read_text() + "".join(f"  f{i}: {follower}\n" for i in range(4))
    file = tmp_path / "stage.yaml"
    file.write_text(whole)
    with pytest.raises(ConfigError, match="wired to 5 others by feeds: a board has 4 ports"):
        load_stage(file)
    more = "".join(f"\n      t{i}: {{of: position}}" for i in range(3))
    file.write_text(
        GEAR.read_text().replace("    digital: [mark]", f"{more[1:]}\n    digital: [mark]")
    )
    with pytest.raises(ConfigError, match=r"devices\.wheel\.feeds"):
        load_stage(file)
