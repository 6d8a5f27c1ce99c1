"""`headway play`: the shipped strobe does what its config says, and mistakes are named."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from headway.cli.main import main
from headway.configs.mistakes.mistake import ConfigError
from headway.configs.stage import Node, load_stage, order
from headway.sim.stage import Play

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
    assert played.lost(2) == 0


def test_a_wave_beyond_the_bandwidth_is_put_together(played: Play) -> None:
    from headway.sim.stage import reconstruct

    left, amplitudes = reconstruct(played.readings(2, 1), 493.827)
    assert left < 0.1
    assert amplitudes[0] == pytest.approx(1000, rel=0.02)
    assert amplitudes[1] == pytest.approx(300, rel=0.05)
    wrong, _ = reconstruct(played.readings(2, 1), 500.0)  # by another period there is no wave
    assert wrong > 0.8


def test_the_same_seed_plays_the_same(tmp_path: Path) -> None:
    file = changed(tmp_path, "duration_s: 2.0", "duration_s: 0.3")
    command = [sys.executable, "-c", "from headway.cli.main import main; main()", "play"]
    done = [
        subprocess.run([*command, file, "--json"], capture_output=True, text=True) for _ in range(2)
    ]
    assert done[0].returncode == 0, done[0].stderr
    assert done[0].stdout == done[1].stdout
    figures = json.loads(done[0].stdout)
    assert [row["times"] for row in figures["outputs"]] == [20, 20]


def changed(folder: Path, old: str, new: str) -> Path:
    text = STROBE.read_text()
    assert text.count(old) == 1
    file = folder / "stage.yaml"
    file.write_text(text.replace(old, new))
    return file


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
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, key: str, text: str) -> None:
    file = changed(tmp_path, old, new)
    with pytest.raises(ConfigError) as error:
        load_stage(file)
    said = str(error.value)
    assert key in said and text in said
    assert said.startswith(f"{file}:")


def test_the_command_ends_with_2_for_a_mistake(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["play", str(changed(tmp_path, "a: sweep", "a: swep"))]) == 2
    assert "there is no 'swep'" in capsys.readouterr().err
    assert main(["play", str(tmp_path / "none.yaml")]) == 2


def test_nodes_are_sorted() -> None:
    nodes = {
        name: Node(kind="add", a=a, b=b)
        for name, a, b in (("x", "y", "z"), ("y", "z", "z"), ("z", "error", "error"))
    }
    assert order(nodes) == ["z", "y", "x"]
