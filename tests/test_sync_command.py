"""`headway sync`: what it shows, what it says of those that do not settle, and how it ends."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import Machine

from headway.cli.main import main
from headway.configs.load import load_config
from headway.controller.tick import DeviceError
from headway.devices.keys import draw_key
from headway.sim.lockstep import Lockstep

CONFIG = str(Path(__file__).resolve().parent.parent / "configs" / "arm2.yaml")
QUICK = ["--settled", "0.5", "--timeout", "6"]


def test_settled_clocks_end_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sync", CONFIG, *QUICK]) == 0
    shown = capsys.readouterr().out
    assert "q1" in shown and "q2" in shown and "settled for 0." in shown


def test_the_figures(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sync", CONFIG, "--json", "--seed", "3", *QUICK]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["settled"] is True and 1.4 < told["time_s"] < 3
    assert [device["joint"] for device in told["devices"]] == ["q1", "q2"]
    for device in told["devices"]:
        assert device["settled"] is True and device["excluded"] == 0
        assert -200 < device["least_us"] < 0 < device["most_us"] < 200
        assert device["interval_us"] == pytest.approx(device["most_us"] - device["least_us"])
        assert 4000 <= device["round_trip_us"] < 5000  # twice 2 ms at least
        low, high = device["measured_us"]
        assert low <= device["most_us"] and device["least_us"] <= high
        assert abs(device["offset_us"] - (low + high) / 2) < 0.01


@pytest.mark.parametrize(
    ("change", "who"),
    [
        ("sync.limit_us=10", ["q1: its clock may err by"]),
        (
            "sim.to_host.loss=1",
            ["q1: no answer: is the board", "q2: no answer: is the board"],
        ),
        (
            "sync.to_device_least_us=9000",
            ["q1: its clock has no bound, as", "sync.to_host_least_us"],
        ),
    ],
)
def test_it_says_who_does_not_settle(
    change: str, who: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sync", CONFIG, "--set", change, "--timeout", "2", "--json"]) == 4
    captured = capsys.readouterr()
    assert json.loads(captured.out)["settled"] is False
    assert "not settled within 2 s" in captured.err
    assert all(words in captured.err for words in who)


def test_a_run_waits_for_the_same_and_arms_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    """With nothing known of the least delays the interval is the round trip's, beyond the limit."""
    unknown = ["sync.to_device_least_us=0", "sync.to_host_least_us=0", "sync.limit_us=500"]
    words = [word for change in unknown for word in ("--set", change)]
    assert main(["run", CONFIG, *words]) == 4
    said = capsys.readouterr().err
    assert "not settled within 20 s: " in said
    assert "q1: its clock may err by" in said and "q2: its clock may err by" in said
    lockstep = Lockstep(load_config(Path(CONFIG), unknown), Path(CONFIG).parent)
    with pytest.raises(DeviceError, match="not settled"):
        lockstep.run()
    assert lockstep.device_states() == ["UNSYNCED", "UNSYNCED"]


def test_an_asymmetry_that_nobody_told_stays_hidden(capsys: pytest.CaptureFixture[str]) -> None:
    """A millisecond more one way: half of it is in the host's own figure, and the interval is wide
    enough to say so."""
    changes = ["sync.to_device_least_us=0", "sync.to_host_least_us=0", "sync.limit_us=5000"]
    changes += ["sim.to_device={delay_us: 3000, jitter_us: 0, loss: 0}"]
    changes += ["sim.to_host={delay_us: 2000, jitter_us: 0, loss: 0}"]
    sets = [word for change in changes for word in ("--set", change)]
    assert main(["sync", CONFIG, "--json", *sets, *QUICK]) == 0
    for device in json.loads(capsys.readouterr().out)["devices"]:
        assert device["least_us"] < -2000 and device["most_us"] > 2000


def test_the_plot(tmp_path: Path) -> None:
    path = tmp_path / "clocks.svg"
    assert main(["sync", CONFIG, "--plot", str(path), *QUICK]) == 0
    assert path.read_text().count("<path") > 4


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--settled", "0"], "--settled 0: give seconds"),
        (["--timeout", "4000"], "--timeout 4000: give seconds"),
        (["--set", "sync.limit_us=1"], "sync.limit_us"),
        (["--plot", "clocks.nonsense"], "clocks.nonsense"),
    ],
)
def test_mistakes(
    arguments: list[str], told: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["sync", CONFIG, *arguments]) == 2
    assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


# At ports, without a config.


@pytest.fixture(scope="module", params=["serial", "udp"])
def machine(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Machine]:
    """A plant in another process, slow enough for a computer that is busy."""
    with Machine(tmp_path_factory.mktemp("sync"), request.param, 0.4) as made:
        yield made


def at_ports(machine: Machine, *more: str) -> list[str]:
    """The words for both of a machine's devices, with its keys."""
    while len(ports := sorted(map(str, (machine.folder / "ports").glob("arm2-*")))) < 2:
        assert machine.process.poll() is None
    keys = ["--keys", str(machine.folder / "keys")]
    return ["sync", *ports, *keys, "--realtime-factor", "0.4", *more]


def test_devices_at_ports(machine: Machine, capsys: pytest.CaptureFixture[str]) -> None:
    quick = ["--settled", "0.3", "--timeout", "20"]
    assert main(at_ports(machine, "--json", *quick)) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["settled"] is True
    for name, device in zip(("q1", "q2"), told["devices"], strict=True):
        assert device["joint"].startswith(f"{name} at ") and device["settled"] is True
        assert device["least_us"] < 0 < device["most_us"] and device["round_trip_us"] >= 4000
        if machine.kind == "udp":
            assert " at 127.0.0.1:" in device["joint"]


def test_who_does_not_settle_at_ports(machine: Machine, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(at_ports(machine, "--settled", "5", "--timeout", "1")) == 4
    assert "not settled within 1 s: " in capsys.readouterr().err


def test_a_device_whose_key_is_not_here(
    machine: Machine, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """The keys are those of another machine; and nobody's are no keys."""
    monkeypatch.setattr("headway.cli.at_ports.PATIENCE_S", 1.0)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    words = at_ports(machine, *QUICK)
    words[words.index("--keys") : words.index("--keys") + 2] = []
    assert main(words) == 2
    assert "there is no device's key" in capsys.readouterr().err
    draw_key(tmp_path / "headway" / "keys" / "other", "q1")
    draw_key(tmp_path / "headway" / "keys" / "other", "sync")
    assert main(words) == 4
    told = capsys.readouterr().err
    assert told.count("there is a device, of which no key is here") == 2


def test_keys_of_all_machines(
    machine: Machine, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    home = tmp_path / "headway" / "keys"
    draw_key(home / "other", "q1")
    (home / "arm2").symlink_to(machine.folder / "keys")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    words = at_ports(machine, "--json", "--settled", "0.3", "--timeout", "20")
    words[words.index("--keys") : words.index("--keys") + 2] = []
    assert main(words) == 0
    devices = json.loads(capsys.readouterr().out)["devices"]
    assert [device["joint"].partition(" ")[0] for device in devices] == ["arm2/q1", "arm2/q2"]


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        ([], 2, "name a config, or ports"),
        ([CONFIG, CONFIG], 2, "name one config, or ports alone"),
        (["nowhere"], 4, "nowhere: there is no such port"),
        (["here:99999"], 4, "'here:99999' is no address"),
        (["127.0.0.1:1"], 4, "127.0.0.1:1: no answer"),
        (["127.0.0.1:1", "--link", "udp"], 2, "--link, --spawn, --ports, --set and --seed are for"),
        (["127.0.0.1:1", "--seed", "1"], 2, "leave them out"),
        (["127.0.0.1:1", "--realtime-factor", "0"], 2, "--realtime-factor 0"),
    ],
)
def test_mistakes_at_ports(
    words: list[str], code: int, told: str, tmp_path: Path,
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr("headway.cli.at_ports.PATIENCE_S", 0.5)
    draw_key(tmp_path, "q1")
    assert main(["sync", *words, "--keys", str(tmp_path)]) == code
    assert told in capsys.readouterr().err
