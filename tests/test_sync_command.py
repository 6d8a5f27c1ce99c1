"""`headway sync`: what it shows, what it says of those that do not settle, and how it ends."""

import json
from pathlib import Path

import pytest

from headway.cli.main import main

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
            ["q1: its clock has no bound yet", "q2: its clock has no bound yet"],
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
