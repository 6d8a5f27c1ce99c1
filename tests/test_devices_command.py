"""`headway devices` against a plant in another process: what it tells, sets, keeps and restores."""

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import CONFIG, Machine

from headway.cli.main import main
from headway.devices.keys import draw_key, key_path


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    with Machine(tmp_path_factory.mktemp("devices"), "udp", 1.0) as made:
        yield made


def words(machine: Machine, command: str, *more: str) -> list[str]:
    folder = machine.folder
    where = ["--link", "udp", "--keys", str(folder / "keys"), "--ports", str(folder / "ports")]
    return ["devices", command, str(CONFIG), *more, *where]


def listed(machine: Machine, capsys: pytest.CaptureFixture[str]) -> list[dict[str, object]]:
    capsys.readouterr()
    assert main(words(machine, "list", "--json")) == 0
    rows: list[dict[str, object]] = json.loads(capsys.readouterr().out)
    return rows


def test_the_list(machine: Machine, capsys: pytest.CaptureFixture[str]) -> None:
    rows = listed(machine, capsys)
    assert [row["axis"] for row in rows] == [row["name"] for row in rows] == ["q1", "q2"]
    for row in rows:
        assert str(row["port"]).startswith("127.0.0.1:") and row["protocol"] == 1
        assert row["state"] in ("UNSYNCED", "IDLE") and row["faults"] == []
        assert row["frames_bad_there"] == 0
        assert row["frames_bad_here"] in (0, 1, 2)  # a late answer to the search for ports
    assert main(words(machine, "list")) == 0
    assert "q1" in capsys.readouterr().out


def test_settings_are_set_kept_and_restored(
    machine: Machine, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    first, second, third = (str(tmp_path / name) for name in ("1.json", "2.json", "3.json"))
    assert main(words(machine, "save", "--out", first)) == 0
    kp = ["--set", "machine.axes.0.servo.kp_Nm_per_rad=90", "--set", machine.changes[1]]
    assert main(words(machine, "set", *kp)) == 0
    assert main(words(machine, "save", "--out", second)) == 0
    assert main([*words(machine, "restore", first)]) == 0
    assert main(words(machine, "save", "--out", third)) == 0
    copies = [json.loads(Path(path).read_text()) for path in (first, second, third)]
    assert copies[0] == copies[2] != copies[1]
    assert copies[0]["q2"] == copies[1]["q2"]
    keys = [path.read_text().strip() for path in (machine.folder / "keys").iterdir()]
    assert not any(key in text for key in keys for text in copies[0].values())
    capsys.readouterr()
    assert main(words(machine, "save", "--out", first)) == 2
    assert "File exists" in capsys.readouterr().err
    assert main(words(machine, "restore", str(CONFIG))) == 2
    assert "is no copy of the settings" in capsys.readouterr().err


def test_a_device_with_another_key_is_told_as_such(
    machine: Machine, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr("headway.cli.linked.PATIENCE_S", 0.1)
    for name in ("q1", "sync"):
        os.link(key_path(machine.folder / "keys", name), key_path(tmp_path, name))
    draw_key(tmp_path, "q2")
    ports = ["--link", "udp", "--ports", str(machine.folder / "ports")]
    assert main(["devices", "list", str(CONFIG), "--keys", str(tmp_path), *ports]) == 4
    told = capsys.readouterr().err
    assert "q2: no device with this key answers at any port" in told
    assert "is q1" in told and "wrong key" in told


def test_nobody_is_there(
    machine: Machine, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr("headway.cli.linked.PATIENCE_S", 0.1)
    where = ["--keys", str(machine.folder / "keys"), "--ports", str(tmp_path)]
    assert main(["devices", "list", str(CONFIG), *where]) == 4
    assert "there is no port to ask" in capsys.readouterr().err
