"""Key files: only their owner's, drawn once, told apart from what is none."""

import os
import stat
from pathlib import Path

import pytest

from headway.cli.main import main
from headway.devices.keys import SYNC, KeyFileError, draw_keys, key_path, read_key, read_keys

CONFIG = str(Path(__file__).resolve().parent.parent / "configs" / "arm2.yaml")


def test_keys_differ_and_are_their_owners(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    os.umask(old := os.umask(0))
    draw_keys(folder, ["q1", "q2"])
    os.umask(old)
    keys = read_keys(folder, ["q1", "q2"])
    assert len({*keys.devices.values(), keys.sync}) == 3
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    for path in folder.iterdir():
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert keys.devices["q1"].hex() not in repr(keys)


def test_a_key_is_never_drawn_again(tmp_path: Path) -> None:
    draw_keys(tmp_path, ["q1"])
    key = read_key(tmp_path, "q1")
    with pytest.raises(KeyFileError, match="there is a key already"):
        draw_keys(tmp_path, ["q1"])
    assert read_key(tmp_path, "q1") == key


@pytest.mark.parametrize(
    ("text", "mode", "told"),
    [
        ("ab" * 16, 0o640, "others may read or change it"),
        ("ab" * 16, 0o602, "others may read or change it"),
        ("ab" * 15, 0o600, "is no key, which is 32 hexadecimal digits"),
        ("ab" * 17, 0o600, "is no key"),
        ("nonsense", 0o600, "is no key"),
        ("\udcff", 0o600, "is no key"),
        (None, 0o600, "cannot be read: No such file"),
    ],
)
def test_what_is_no_good_key(tmp_path: Path, text: str | None, mode: int, told: str) -> None:
    path = key_path(tmp_path, "q1")
    if text is not None:
        path.write_bytes(text.encode(errors="surrogateescape"))
        path.chmod(mode)
    with pytest.raises(KeyFileError, match=told) as caught:
        read_key(tmp_path, "q1")
    assert str(path) in str(caught.value)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "keys"
    assert main(["keys", CONFIG, "--keys", str(folder)]) == 0
    told = capsys.readouterr().out
    assert [line.split(": ")[1] for line in told.splitlines()] == ["drawn"] * 3
    before = read_keys(folder, ["q1", "q2"])
    key_path(folder, "q2").unlink()
    assert main(["keys", CONFIG, "--keys", str(folder)]) == 0
    told = capsys.readouterr().out
    assert [line.split(": ")[1] for line in told.splitlines()] == ["kept", "drawn", "kept"]
    after = read_keys(folder, ["q1", "q2"])
    assert after.devices["q1"] == before.devices["q1"] and after.sync == before.sync
    assert after.devices["q2"] != before.devices["q2"]
    assert key_path(folder, SYNC).exists()
    assert before.devices["q1"].hex() not in told
