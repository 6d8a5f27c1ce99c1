"""The faults that `scripts/test planted` plants still have their place and their test."""

import re
from pathlib import Path

from scripted import load_script

ROOT = Path(__file__).resolve().parents[1]


def test_every_bug_has_one_place_and_a_test() -> None:
    planted = load_script("planted")
    assert len(planted.BUGS) >= 8
    for bug in planted.BUGS:
        assert (ROOT / bug.file).read_text().count(bug.old) == 1, bug.name
        file, _, test = bug.test.partition("::")
        name = re.escape(test.partition("[")[0])
        assert re.search(rf"^def {name}\(", (ROOT / file).read_text(), re.MULTILINE), bug.name
