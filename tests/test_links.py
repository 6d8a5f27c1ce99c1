"""Real processes, real ports, the wall clock: what is exempt from virtual time.

At a twentieth of real time a busy computer's pauses of 20 ms are a millisecond to the machine.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from headway.cli.main import main
from headway.cli.simulation import Simulation
from headway.cli.truth import with_truth
from headway.configs.load import load_config
from headway.controller.record.reader import read_run
from headway.controller.reference import task_reference

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
CONFIG = str(CONFIGS / "arm2.yaml")
HEADWAY = [str(Path(sys.executable).with_name("headway"))]
# In two seconds the error of one seed spreads by 7 % of the mean; in one, by 13.
DURATION_S, FACTOR = 2.0, 0.05
TASK = [CONFIG, "--duration", f"{DURATION_S:g}", "--realtime-factor", f"{FACTOR:g}"]
WORSE = 1.3  # than lockstep
SEEDS = 6
PATIENCE_S = 200  # of a computer that is busy beyond all measure


def start(*words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*HEADWAY, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def lockstep_rms() -> np.ndarray:
    """Of each axis: what lockstep makes of it, over seeds, whose losses come at other times."""
    squares = []
    for seed in range(SEEDS):
        config = load_config(CONFIGS / "arm2.yaml", [f"duration_s={DURATION_S}", f"seed={seed}"])
        rms = Simulation(config, CONFIGS).run()["tracking"]["rms"]
        squares.append(np.square(rms))
    return np.sqrt(np.mean(squares, axis=0))


def tracking_rms(run: Path, plant: Path) -> np.ndarray:
    """From the two records of a run and of the plant that it has controlled."""
    record = read_run(run)
    arrays = with_truth(
        record.arrays, read_run(plant).arrays, task_reference(record.config(), run.parent)
    )
    judged = (arrays["truth_s"] >= 0.5) & (arrays["truth_s"] <= arrays["tick_s"][-1])
    error = 1e3 * (arrays["truth_position"] - arrays["truth_reference"])[judged]
    return np.sqrt(np.mean(error**2, axis=0))


def test_it_tracks_over_real_links_as_in_lockstep(tmp_path: Path) -> None:
    """Over ptys and UDP with a plant of their own, and against one that was there before. All at
    once: they sleep most of the time."""
    keys, ports = ["--keys", str(tmp_path / "keys")], ["--ports", str(tmp_path / "ports")]
    assert main(["keys", CONFIG, *keys]) == 0
    record = tmp_path / "plant.mcap"
    plant = start("plant", *TASK[:1], *TASK[3:], *keys, *ports, "--record", str(record))
    runs = {
        "serial": start("run", *TASK, "--link", "serial", "--spawn", "--json",
                        "--out", str(tmp_path / "serial")),
        "udp": start("run", *TASK, "--link", "udp", "--spawn", "--json",
                     "--out", str(tmp_path / "udp")),
        "apart": start("run", *TASK, "--link", "serial", *keys, *ports,
                       "--out", str(tmp_path / "apart")),
    }  # fmt: skip
    allowed = WORSE * lockstep_rms()
    told = {}
    for name, run in runs.items():
        out, _ = run.communicate(timeout=PATIENCE_S)
        assert run.returncode == 0, name
        told[name] = json.loads((tmp_path / name / "summary.json").read_text())
        assert "at rest after the end: yes" in out or json.loads(out) == told[name]
    plant.terminate()
    out, _ = plant.communicate(timeout=PATIENCE_S)
    assert plant.returncode == 0
    assert f"q1: {tmp_path / 'ports' / 'arm2-q1'}" in out
    for name, summary in told.items():
        assert summary["at_rest_after_end"] and summary["limits_violated"] == [], name
        assert summary["frames"]["late_points"] == summary["frames"]["gate_refused"] == 0, name
        own = record if name == "apart" else tmp_path / name / "plant.mcap"
        rms = tracking_rms(tmp_path / name, own)
        assert np.all(rms <= allowed), (name, rms, allowed)
        if name != "apart":
            assert summary["tracking"]["by"] == "truth"
            np.testing.assert_allclose(summary["tracking"]["rms"], rms, rtol=1e-6)
        else:
            assert summary["tracking"]["by"] == "encoders"
            np.testing.assert_allclose(summary["tracking"]["rms"], rms, rtol=0.3)
    assert list((tmp_path / "ports").iterdir()) == []


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["run", CONFIG, "--spawn"], "add --link serial or --link udp"),
        (["run", CONFIG, "--realtime-factor", "0.5"], "add --link serial or --link udp"),
        (["run", CONFIG, "--link", "udp", "--view"], "--view shows a simulated run"),
        (["run", CONFIG, "--link", "udp", "--realtime-factor", "0"], "give 0.01 to 10"),
        (["plant", CONFIG, "--realtime-factor", "nan"], "give 0.01 to 10"),
        (["run", CONFIG, "--link", "udp", "--spawn", "--keys", "k"], "leave --keys and --ports"),
        (["plant", CONFIG, "--keys", "nowhere"], "headway keys"),
        (["run", CONFIG, "--link", "udp", "--keys", "nowhere"], "headway keys"),
    ],
)
def test_mistakes(
    words: list[str],
    told: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    assert told in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())


def test_a_folder_that_others_may_write_to_is_no_place_for_ports(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, keys = tmp_path / "ports", ["--keys", str(tmp_path / "keys")]
    folder.mkdir()
    folder.chmod(0o777)
    assert main(["keys", CONFIG, *keys]) == 0
    assert main(["plant", CONFIG, *keys, "--ports", str(folder)]) == 2
    assert "others may write there" in capsys.readouterr().err
