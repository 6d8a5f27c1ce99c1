"""The link over ports: arrivals are stamped, what has no room is counted, what has gone is told."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from headway.devices import port_link
from headway.devices.places import serial_place
from headway.devices.port import Port, SerialPort
from headway.devices.port_link import PortLink
from headway.firmware import _core
from headway.sim.outlet import PtyOutlet

PATIENCE_S = 20.0
NAMES = "q1", "q2"
LATER_US = 10**18


def packet(number: int) -> bytes:
    return _core.cobs_encode(number.to_bytes(4, "little"))


def until(done: Callable[[], bool]) -> None:
    """Waits for the link's thread."""
    end = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end
        time.sleep(0.001)


class Count:
    """A clock that goes on by one with each look."""

    def __init__(self) -> None:
        self.us = 0

    def __call__(self) -> int:
        self.us += 1
        return self.us


def test_what_arrives_is_stamped_and_taken_up_to_then(tmp_path: Path) -> None:
    outlets = [PtyOutlet(tmp_path, "arm", name) for name in NAMES]
    ports: list[Port] = [SerialPort(str(serial_place(tmp_path, "arm", n))) for n in NAMES]
    clock = Count()
    link = PortLink(ports, clock)
    for number in range(20):
        outlets[number % 2].write(packet(number))
        until(lambda n=number: link.received == n + 1)  # type: ignore[misc]
    early = link.receive(10)
    late = link.receive(LATER_US)
    assert [at for _, at, _ in early + late] == list(range(1, 21))
    assert [at for _, at, _ in early][-1] == 10
    told = [(device, data) for device, _, data in early + late]
    assert told == [(number % 2, packet(number)) for number in range(20)]
    link.send(1, packet(99), 0)
    until(lambda: outlets[1].read() == [packet(99)])
    assert link.counts() | {"sent": 1, "received": 20} == link.counts()
    link.close()
    for outlet in outlets:
        outlet.close()


def test_what_nobody_takes_is_dropped_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(port_link, "QUEUE_PACKETS", 8)
    outlet = PtyOutlet(tmp_path, "arm", "q1")
    link = PortLink([SerialPort(str(serial_place(tmp_path, "arm", "q1")))], Count())
    for number in range(20):
        outlet.write(packet(number))
    until(lambda: link.received == 20)
    until(lambda: link.counts()["dropped"] == 12)
    assert [data for *_, data in link.receive(LATER_US)] == [packet(n) for n in range(8)]
    link.close()
    outlet.close()


def test_a_port_that_has_gone_is_never_taken_up_again(tmp_path: Path) -> None:
    """A cable is plugged in again, where it was: what the device says there reaches no run that had
    lost it, and nothing of that run's reaches the device. The other one's port goes on."""
    outlets = [PtyOutlet(tmp_path, "arm", name) for name in NAMES]
    ports: list[Port] = [SerialPort(str(serial_place(tmp_path, "arm", n))) for n in NAMES]
    link = PortLink(ports, Count())
    outlets[0].close()
    until(lambda: 0 in link.gone)
    again = PtyOutlet(tmp_path, "arm", "q1")
    again.write(packet(1))
    link.send(0, packet(2), 0)
    outlets[1].write(packet(3))
    until(lambda: link.received == 1)
    assert [(device, data) for device, _, data in link.receive(LATER_US)] == [(1, packet(3))]
    assert again.read() == []
    assert list(link.gone) == [0] and "arm-q1: has gone" in link.gone[0]
    link.close()
    again.close()
    outlets[1].close()
