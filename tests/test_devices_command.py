"""`headway devices` against a plant in another process: what it tells, sets, keeps and restores."""

import json
import os
import re
import zlib
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest
from processes import CONFIG, Machine
from serial.tools.list_ports_common import ListPortInfo

from headway.cli.devices import Room
from headway.cli.main import main
from headway.configs.schema import Links
from headway.devices.discovery import Search
from headway.devices.keys import draw_key, key_path
from headway.devices.places import usb_of
from headway.firmware._core import FRAME_WELCOME, cobs_decode, cobs_encode


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
        assert str(row["port"]).startswith("127.0.0.1:") and row["firmware"] == 1
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
    assert main(["devices", "list", str(CONFIG), "--keys", str(tmp_path), *ports, "--json"]) == 4
    said = capsys.readouterr()
    assert "q2: no device with this key answers at any port" in said.err
    assert "is q1" in said.err and "wrong key" in said.err
    rows = json.loads(said.out)
    assert [row["axis"] for row in rows] == ["q1", "q2"]
    assert rows[0]["name"] == "q1" and rows[1]["state"] == "missing"
    assert main(["devices", "set", str(CONFIG), "--keys", str(tmp_path), *ports]) == 4


def test_nobody_is_there(
    machine: Machine, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr("headway.cli.linked.PATIENCE_S", 0.1)
    where = ["--keys", str(machine.folder / "keys"), "--ports", str(tmp_path)]
    assert main(["devices", "list", str(CONFIG), *where]) == 4
    said = capsys.readouterr()
    assert "there is no port to ask" in said.err
    assert said.out.count("missing") == 2


class OtherVersion:
    """A port at which a device of version 2 answers."""

    name = "other"

    def __init__(self) -> None:
        self._said: list[bytes] = []

    def write(self, packet: bytes) -> bool:
        hello = cobs_decode(packet) or b""
        body = bytes([2, FRAME_WELCOME]) + hello[2:18] + bytes(24)
        self._said.append(cobs_encode(body + zlib.crc32(body).to_bytes(4, "little")))
        return True

    def read(self) -> list[bytes]:
        said, self._said = self._said, []
        return said


def test_a_device_of_another_version_is_refused_in_words() -> None:
    port = OtherVersion()
    search = Search([port], {"q1": bytes(16)}, np.random.default_rng(0))  # type: ignore[list-item]
    search.ask()
    search.listen()
    assert search.missing == ["q1"]
    told = search.verdicts["other"]
    assert "version 2 of the protocol, this program 1" in told and "firmware" in told


BOARD = ListPortInfo("/dev/ttyACM3")
BOARD.vid, BOARD.pid, BOARD.serial_number = 0x2E8A, 0x000A, "E6614C"


def test_usb_identity_of_a_port(monkeypatch: pytest.MonkeyPatch) -> None:
    link, plain = ListPortInfo("/dev/headway-E6614C"), ListPortInfo("/dev/ttyS0")
    link.vid, link.pid, link.serial_number = BOARD.vid, BOARD.pid, BOARD.serial_number
    bare = ListPortInfo("/dev/ttyACM4")
    bare.vid, bare.pid = 0x1209, 0x0001

    def comports(include_links: bool) -> list[ListPortInfo]:
        return [plain, BOARD, bare, *([link] if include_links else [])]

    monkeypatch.setattr("headway.devices.places.list_ports.comports", comports)
    assert usb_of("/dev/ttyACM3") == usb_of("/dev/headway-E6614C") == "2e8a:000a:E6614C"
    assert usb_of("/dev/ttyACM4") == "1209:0001"
    assert usb_of("/dev/ttyS0") == usb_of("127.0.0.1:47001") == usb_of("/dev/pts/3") == ""


def test_the_udev_rule_names_ports_as_the_config_looks_for_them() -> None:
    """One rule, of matches and assignments as udev(7) has them."""
    text = (CONFIG.parents[1] / "devices" / "60-headway.rules").read_text()
    (rule,) = [line for line in text.splitlines() if line and not line.startswith("#")]
    parts = [re.fullmatch(r'([A-Z]+(?:\{\w+\})?)(==|\+=|=)"([^"]*)"', p) for p in rule.split(", ")]
    assert all(parts)
    told = {part[1]: (part[2], part[3]) for part in parts if part is not None}
    assert told["SUBSYSTEM"] == ("==", "tty") and told["SUBSYSTEMS"] == ("==", "usb")
    assert told["ATTRS{manufacturer}"] == ("==", "Headway")
    operator, pattern = told["SYMLINK"]
    assert operator == "+="
    name = "/dev/" + pattern.replace("%s{serial}", BOARD.serial_number)
    assert "%" not in name
    (looked_for,) = Links().serial
    assert fnmatch(name, looked_for)
    assert int(told["MODE"][1], 8) & 0o007 == 0


def position(machine: Machine, capsys: pytest.CaptureFixture[str], axis: int) -> float:
    place = listed(machine, capsys)[axis]["position"]
    assert isinstance(place, float)
    return place


def test_an_axis_is_jogged_and_switched_off(
    machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    q1, q2 = (position(machine, capsys, axis) for axis in (0, 1))
    for speed in (0.3, -0.3):
        assert main(words(machine, "jog", "q2", str(speed), "--seconds", "0.5")) == 0
        moved = position(machine, capsys, 1) - q2
        assert moved == pytest.approx(0.15 if speed > 0 else 0.0, abs=0.08)
        assert listed(machine, capsys)[1]["state"] in ("UNSYNCED", "IDLE")
    assert position(machine, capsys, 0) == pytest.approx(q1, abs=0.02)
    assert main(words(machine, "jog", "q2", "3")) == 2
    assert "q2 jogs at up to 0.75" in capsys.readouterr().err
    assert main(words(machine, "jog", "q3", "0.1")) == 2
    assert "there are q1, q2" in capsys.readouterr().err


def test_ctrl_c_stops_a_jog_and_the_log_tells(
    machine: Machine, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    listen = Room.listen

    def pressed(room: Room, seconds: float) -> None:
        listen(room, min(seconds, 0.3))
        if seconds == 5:
            monkeypatch.setattr(Room, "listen", listen)
            raise KeyboardInterrupt

    monkeypatch.setattr(Room, "listen", pressed)
    assert main(words(machine, "jog", "q2", "0.3", "--seconds", "5")) == 130
    assert listed(machine, capsys)[1]["state"] in ("UNSYNCED", "IDLE")
    assert main(words(machine, "faults", "--json")) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(row["axis"], row["reason"]) for row in rows][-1] == ("q2", "HOST")
    assert rows[-1]["words"] == "the host said stop" and rows[-1]["state"] == "ARMED"
    assert main(words(machine, "faults")) == 0
    assert "the host said stop" in " ".join(capsys.readouterr().out.split())


def test_a_zero_is_kept_by_other_settings(
    machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    before = position(machine, capsys, 0)
    assert main(words(machine, "zero", "q1", "0.3")) == 0
    assert position(machine, capsys, 0) == pytest.approx(0.3, abs=0.01)
    assert main(words(machine, "set", "--set", machine.changes[1])) == 0
    assert position(machine, capsys, 0) == pytest.approx(0.3, abs=0.01)
    assert main(words(machine, "zero", "q1", f"{before}")) == 0
    assert main(words(machine, "zero", "q1", "1e9")) == 2
    assert "beyond what the encoder counts" in capsys.readouterr().err


def test_what_there_is_nothing_of(machine: Machine, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words(machine, "clear")) == 0
    assert "no device is latched" in capsys.readouterr().out
    assert main(words(machine, "clear", "--axis", "q1")) == 4
    assert "q1: NOT_NOW" in capsys.readouterr().out
    assert main(words(machine, "home", "q1")) == 2
    assert "no homing" in capsys.readouterr().err
    assert main(words(machine, "stop")) == 0
