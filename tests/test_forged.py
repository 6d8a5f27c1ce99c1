"""Frames that nobody with a key has sent: none is taken, each is counted, the machine goes on.

`scripts/forged.py --long` throws a million; here are enough of each kind to see that it can tell.
"""

from contextlib import suppress

import pytest
from scripted import load_script

from headway.controller.tick import DeviceError

forged = load_script("forged")


def test_none_is_taken_and_each_is_counted() -> None:
    said: list[str] = []
    assert forged.besiege(14_000, 5, said.append) == []
    assert len(said) == len(forged.KINDS) + 1
    assert all(int(line.split()[1]) >= 1900 for line in said[: len(forged.KINDS)])


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
