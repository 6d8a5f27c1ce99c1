"""docs/device.md against the firmware: every code and every setting."""

import re
from pathlib import Path

from headway.firmware import _core

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "device.md").read_text()
SECRET = {"key", "peer_key"}  # never on the wire
SECTIONS = ("servo", "monitor", "home", "sync")


def rows(head: str) -> list[list[str]]:
    """Cells of the table under a head line."""
    lines = PAGE[PAGE.index(head) :].splitlines()[2:]
    table = lines[: next(i for i, line in enumerate(lines) if not line.startswith("|"))]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table]


def fields(of: object) -> set[str]:
    return {n for n in dir(of) if not n.startswith("_") and not callable(getattr(of, n))}


def test_every_fault_has_its_code_and_the_units_of_its_numbers() -> None:
    codes = rows("| code | reason | value | limit |")
    assert [(int(code), reason) for code, reason, *_ in codes] == list(enumerate(_core.REASONS))
    assert {r for _, r, value, limit in codes if not value or not limit} == {
        "NONE", "HOST", "SETTINGS"
    }  # fmt: skip


def test_every_setting_is_told_with_its_unit() -> None:
    settings = _core.DeviceSettings()
    told: set[str] = set()
    for names, unit, what in rows("| setting | unit | what |"):
        section, dot, rest = names.rpartition(".")
        told |= {f"{section}{dot}{name.strip()}" for name in rest.split(",")}
        assert unit and what
        if names == "sync.average":
            told |= {f"sync.{name}" for name in re.findall(r"\w+_\w+", unit)} - {"sync.average"}
    expected = fields(settings) - SECRET - {"valid", *SECTIONS}
    for section in SECTIONS:
        expected |= {f"{section}.{name}" for name in fields(getattr(settings, section))}
    assert expected - told == set()
    assert told - expected == {"limits", "gap_policy", "sync.average"}


def test_every_verdict_of_the_gate_is_told() -> None:
    gate = PAGE[PAGE.index("## The gate") : PAGE.index("## The monitors")]
    names = {name.upper() for name in _core.GATE_RESULTS} - {"ACCEPTED"}
    assert {name for name in names if name not in gate} == set()


def test_every_state_command_and_policy_is_told() -> None:
    for name in (*_core.STATES, *_core.COMMANDS, *_core.COMMAND_RESULTS):
        assert re.search(rf"\b{name}\b", PAGE), name
