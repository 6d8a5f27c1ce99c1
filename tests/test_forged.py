"""Frames that nobody with a key has sent: none is taken, each is counted, the machine goes on.

`scripts/forged.py --long` throws a million; here are enough of each kind to see that it can tell.
"""

from contextlib import suppress
from typing import Any

import pytest
from scripted import load_script

from headway.controller.tick import DeviceError

forged = load_script("forged")


def test_none_is_taken_and_each_is_counted() -> None:
    said: list[str] = []
    assert forged.besiege(14_000, 5, said.append) == []
    assert len(said) == len(forged.KINDS) + 1
    assert all(int(line.split()[1]) >= 1900 for line in said[: len(forged.KINDS)])


def test_a_flood_of_the_longest_is_a_safe_tail() -> None:
    """Each takes a core half a servo period and more, and too few plans come through: all rest."""
    said: list[str] = []
    assert forged.drown("longest", 3, 2, said.append) == []
    assert "2 of 2 runs stopped" in said[0] and "no plan reached it in time" in said[0]


@pytest.mark.parametrize(("kind", "runs"), [("version", 1), ("forged", 8)])
def test_a_flood_is_stood(kind: str, runs: int) -> None:
    """20,000 frames a second to each device: tracking stays within a tenth."""
    said: list[str] = []
    assert forged.drown(kind, 0, runs, said.append) == []
    assert int(said[0].split(": ")[1].split()[0]) > runs * 2 * 20_000


def test_a_flood_in_which_nothing_else_passes_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The controller's frames get lost after half a second: the machine comes to rest."""
    monkeypatch.setattr(forged, "DURATION_S", 1.0)
    send = forged.Siege.send

    def lost(siege: Any, device: int, packet: bytes, now_us: int) -> None:
        if siege.thrown["junk"] < 20_000:
            send(siege, device, packet, now_us)

    monkeypatch.setattr(forged.Siege, "send", lost)
    broken = forged.drown("junk", 3, 1, lambda said: None)
    assert "junk: the task did not go on" in broken
    assert "junk: no rest" not in broken


def test_a_frame_that_is_taken_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the key the same frames are no forgeries: the campaign notices."""
    siege = forged.Siege(2_000, 1)

    def sealed(packet: bytes, *rest: object) -> bytes:
        remote = siege.world.remotes[0]
        del packet, rest
        return bytes(remote.stamp_packets(siege.now_us())[0])

    monkeypatch.setattr(forged, "reseal", sealed)
    with suppress(DeviceError):  # stamps that lie make a clock doubt
        siege.run()
    assert siege.counted["forged"] < siege.thrown["forged"]
    assert siege.counted["replayed"] == siege.thrown["replayed"]
