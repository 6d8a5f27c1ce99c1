"""A number written into a config file: everything else stays, byte for byte."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from headway.configs.edit import edit_number
from headway.configs.mistakes.mistake import ConfigError

KEY = ("loop", "margin_us")
BEFORE = "# a comment\r\nname: é\nloop:\n  knot_us: 4096\n  margin_us: "
AFTER = "    # aligned\n\ntask: {a: 12288}\n"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "machine.yaml"


@given(old=st.integers(-(10**9), 10**9), new=st.integers(0, 10**9))
def test_only_the_number_changes(
    old: int, new: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("edit") / "machine.yaml"
    path.write_bytes(f"{BEFORE}{old}{AFTER}".encode())
    edit_number(path, KEY, new)
    assert path.read_bytes() == f"{BEFORE}{new}{AFTER}".encode()
    assert list(path.parent.iterdir()) == [path]


def test_within_braces(path: Path) -> None:
    path.write_text("loop: {margin_us: 12288, knot_us: 4096}\n")
    edit_number(path, KEY, 8192)
    assert path.read_text() == "loop: {margin_us: 8192, knot_us: 4096}\n"


def test_in_the_place_of_an_alias(path: Path) -> None:
    path.write_text("late_us: &margin 12288\nloop:\n  margin_us: *margin # as late\n")
    edit_number(path, KEY, 8192)
    assert path.read_text() == "late_us: &margin 12288\nloop:\n  margin_us: 8192 # as late\n"


@pytest.mark.parametrize(
    "text",
    [
        "loop:\n  margin_us: &margin 12288\n  late_us: *margin\n",
        "base: &base {margin_us: 12288}\nloop:\n  <<: *base\n",
        "base: &base {margin_us: 12288}\nloop: *base\n",
        "loop:\n  margin_us: 12 ms\n",
        'loop:\n  margin_us: "12288"\n',
        "loop:\n  knot_us: 4096\n",
        "loop: 12288\n",
        "name: arm\n",
    ],
)
def test_what_would_change_more_stays(path: Path, text: str) -> None:
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"machine\.yaml.*: loop\.margin_us: .*write 8192 there"):
        edit_number(path, KEY, 8192)
    assert path.read_text() == text
