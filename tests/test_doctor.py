"""The margin that follows from measurements, and what becomes of the config."""

from pathlib import Path

import numpy as np
import pytest

from headway.cli.doctor import POLL_US, SEND_US, safe_margin_us
from headway.cli.main import main
from headway.cli.measure import Measured
from headway.configs.load import load_config
from headway.devices.session import Session
from headway.firmware import _core

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
CONFIG = CONFIGS / "arm2.yaml"


def measured(ready_us: float, trip_us: list[float], clock_us: float = 0.0) -> Measured:
    one = np.array([1.0])
    trips = [np.array([trip]) for trip in trip_us]
    return Measured(one, one, np.array([ready_us]), trips, clock_us, 0, 0)


@pytest.mark.parametrize("ready_us", [500.0, 2000.0, 7000.0])
@pytest.mark.parametrize("trips_us", [[4500.0, 4500.0], [4500.0, 12_000.0], [30_000.0, 4000.0]])
def test_a_plan_reaches_the_slowest_device_within_the_margin(
    ready_us: float, trips_us: list[float]
) -> None:
    config = load_config(CONFIG)
    margin_us = safe_margin_us(config, measured(ready_us, trips_us, 200.0))
    arrives_us = ready_us + SEND_US + max(trips_us) - config.sync.to_host_least_us + 200 + POLL_US
    assert arrives_us <= margin_us < arrives_us + config.loop.knot_us
    assert margin_us % config.loop.knot_us == 0


def test_one_in_a_thousand_may_take_longer() -> None:
    config = load_config(CONFIG)
    rare = np.full(10_000, 2000.0)
    rare[:9] = 90_000.0
    calm = measured(2000.0, [5000.0, 5000.0])
    some = Measured(rare, rare, rare, calm.round_trip_us, 0.0, 0, 0)
    assert safe_margin_us(config, some) == safe_margin_us(config, calm)


def test_the_doctor_measures_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In real processes; only the number changes in the file."""
    text = CONFIG.read_text().replace("../models", str(CONFIGS.parent / "models"))
    path = tmp_path / "arm.yaml"
    path.write_text(text)
    words = ["--spawn", "--duration", "0.3", "--realtime-factor", "0.1", "--write"]
    assert main(["doctor", str(path), "--set", "sync.limit_us=5000", *words]) == 0
    told = capsys.readouterr().out
    for what in ("wake-up", "compute", "round trip, q1", "round trip, q2", "smallest safe margin"):
        assert what in told
    margin_us = load_config(path).loop.margin_us
    assert margin_us % 4096 == 0 and f"loop.margin_us is {margin_us}" in told
    assert path.read_text() == text.replace("margin_us: 12288", f"margin_us: {margin_us}")


def test_a_margin_that_no_config_may_have_is_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a computer that stands still for a quarter of a second, say."""
    text = CONFIG.read_text().replace("../models", str(CONFIGS.parent / "models"))
    path = tmp_path / "arm.yaml"
    path.write_text(text)
    slow = measured(250_000.0, [4500.0, 4500.0])
    monkeypatch.setattr("headway.cli.measure.measure", lambda *_: slow)
    assert main(["doctor", str(path), "--spawn", "--write"]) == 3
    told = capsys.readouterr()
    assert "too slow: 253952 us would be needed" in told.err
    assert "must be a whole number from 1024 to 200000" in told.err
    assert path.read_text() == text


def test_frames_that_are_missing_are_counted() -> None:
    """By their counters; what comes out of turn is no longer missing."""
    key, rng = bytes(16), np.random.default_rng(1)
    session = Session(key, rng)
    hello = _core.cobs_decode(session.hello())
    assert hello is not None
    nonce = bytes(16)
    assert session.welcome(_core.welcome(key, hello[2:18], nonce)) == "ok"
    _, _, ours = _core.welcome_open(key, hello[2:18], _core.welcome(key, hello[2:18], nonce))
    assert ours is not None
    device = _core.Session(ours.receive_key, ours.send_key, ours.number, at_device=True)
    packets = [device.seal(_core.FRAME_STATUS, b"") for _ in range(6)]
    expected = {0: 0, 1: 0, 4: 2, 2: 1, 5: 1, 3: 0}
    for which, lost in expected.items():
        assert isinstance(session.open(packets[which]), tuple)
        assert session.lost == lost
