"""Real processes, real ports, the wall clock: what is exempt from virtual time.

At a twentieth of real time a busy computer's pauses of 20 ms are a millisecond to the machine.
"""

import json
import os
import shlex
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from headway.cli.linked import Linked
from headway.cli.main import main
from headway.cli.simulation import Simulation
from headway.cli.truth import with_truth
from headway.cli.wall import WallClock
from headway.configs.load import load_config
from headway.controller.record.reader import read_run
from headway.controller.reference import task_reference

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
CONFIG = str(CONFIGS / "arm2.yaml")
HEADWAY = [str(Path(sys.executable).with_name("headway"))]
# In two seconds the error of one seed spreads by 7 % of the mean; in one, by 13.
DURATION_S, FACTOR = 2.0, 0.03
TASK = [CONFIG, "--duration", f"{DURATION_S:g}", "--realtime-factor", f"{FACTOR:g}"]
WORSE = 1.3  # than lockstep
SEEDS = 6
PATIENCE_S = 400  # of a computer that is busy beyond all measure


def start(*words: str, stderr: int | None = None) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*HEADWAY, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, text=True
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
        assert run.returncode == 0, (name, out)
        told[name] = json.loads((tmp_path / name / "summary.json").read_text())
        assert "at rest after the end: yes" in out or json.loads(out) == told[name]
    plant.terminate()
    out, _ = plant.communicate(timeout=PATIENCE_S)
    assert plant.returncode == 0
    assert f"q1: {tmp_path / 'ports' / 'arm2-q1'}" in out
    for name, summary in told.items():
        assert summary["at_rest_after_end"] and summary["limits_violated"] == [], name
        assert summary["frames"]["gate_refused"] == 0, name
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
        (["plant", CONFIG, "--keys", "k", "--port", "47001"], "add --link udp"),
        (
            ["plant", CONFIG, "--keys", "k", "--link", "udp", "--port", "65535"],
            "give 1024 to 65534",
        ),
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


def free_port() -> int:
    """The first of two that were free a moment ago."""
    while True:
        with (
            socket.socket(type=socket.SOCK_DGRAM) as one,
            socket.socket(type=socket.SOCK_DGRAM) as two,
        ):
            one.bind(("127.0.0.2", 0))
            port = int(one.getsockname()[1])
            with suppress(OSError, OverflowError):
                two.bind(("127.0.0.2", port + 1))
                return port


def test_a_plant_prints_what_reaches_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its changes, and where it is not at loopback its addresses: those are enough, without its
    files, on another computer."""
    keys, elsewhere = ["--keys", str(tmp_path / "keys")], str(tmp_path / "elsewhere")
    assert main(["keys", CONFIG, *keys]) == 0
    port = free_port()
    changes = ["--set", "sync.limit_us=1500", "--set", "sim.to_host.delay_us=3500"]
    at = ["--link", "udp", "--bind", "127.0.0.2", "--port", str(port)]
    ports = ["--ports", str(tmp_path / "ports")]
    words = [CONFIG, *at, *keys, *ports, *changes, "--until-eof"]
    plant = start("plant", *words, stderr=subprocess.PIPE)
    assert plant.stdout is not None and plant.stdin is not None and plant.stderr is not None
    assert plant.stderr.readline().startswith("reachable from other computers, at 127.0.0.2: ")
    lines = [plant.stdout.readline() for _ in range(3)]
    assert lines[:2] == [f"q1: 127.0.0.2:{port}\n", f"q2: 127.0.0.2:{port + 1}\n"]
    said = shlex.split(lines[2].removeprefix("to control it: "))
    assert said[:5] == ["headway", "run", CONFIG, "--link", "udp"]
    told = [said[i + 1] for i, word in enumerate(said) if word == "--set"]
    config = load_config(CONFIGS / "arm2.yaml", told)
    assert config.links.udp == [f"127.0.0.2:{port}", f"127.0.0.2:{port + 1}"]
    assert config.sync.limit_us == 1500 and config.sim.to_host.delay_us == 3500
    said[said.index("--ports") + 1] = elsewhere
    capsys.readouterr()
    assert main(["devices", "list", *said[2:], "--json"]) == 0
    assert [row["name"] for row in json.loads(capsys.readouterr().out)] == ["q1", "q2"]
    plant.stdin.close()
    assert plant.wait(PATIENCE_S) == 0


def test_a_plant_of_ones_own_has_keys_of_its_own_and_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each time others, which no machine has; and neither they nor the plant stay."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    config = load_config(CONFIGS / "arm2.yaml")
    drawn = []
    for _ in range(2):
        with Linked("udp", spawn=True).machine(CONFIGS / "arm2.yaml", config, []) as reached:
            with reached.link(WallClock()):
                assert reached.alive()
            drawn += [*reached.keys.devices.values(), reached.keys.sync]
        assert not reached.alive()
        assert list(tmp_path.iterdir()) == []
    assert len(set(drawn)) == len(drawn) == 6


def test_the_keys_of_a_killed_run_do_not_stay(tmp_path: Path) -> None:
    """The plant outlives it, and removes what it has left."""
    (tmp_path / "tmp").mkdir()
    run = subprocess.Popen(
        [*HEADWAY, "run", *TASK, "--link", "udp", "--spawn", "--out", str(tmp_path / "run")],
        env=os.environ | {"TMPDIR": str(tmp_path / "tmp")},
        stdout=subprocess.DEVNULL,
    )
    end = time.monotonic() + PATIENCE_S
    while not list((tmp_path / "tmp").glob("headway-*/ports/*.udp")):  # the plant has the keys
        assert time.monotonic() < end and run.poll() is None
        time.sleep(0.05)
    (home,) = (tmp_path / "tmp").glob("headway-*")
    assert len(list((home / "keys").iterdir())) >= 2
    run.kill()
    run.wait()
    while home.exists():
        assert time.monotonic() < end, sorted(home.rglob("*"))
        time.sleep(0.05)
