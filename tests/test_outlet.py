"""The board's end of a wire: what is said reaches its host, and nobody else turns it elsewhere."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from headway.configs.schema import Links
from headway.devices.discovery import Search
from headway.devices.places import address_of, open_places, serial_place, udp_place
from headway.devices.port import PortError, SerialPort, UdpPort
from headway.devices.session import Session
from headway.firmware import _core
from headway.sim.outlet import PtyOutlet, UdpOutlet

KEY, OTHER = bytes(range(16)), bytes(range(1, 17))
NONCE = bytes(range(50, 66))


@pytest.fixture
def pty_outlet(tmp_path: Path) -> Iterator[PtyOutlet]:
    outlet = PtyOutlet(tmp_path, "arm", "q1")
    yield outlet
    outlet.close()


@pytest.fixture
def udp_outlet(tmp_path: Path) -> Iterator[UdpOutlet]:
    outlet = UdpOutlet(tmp_path, "arm", "q1")
    yield outlet
    outlet.close()


def test_a_pty_carries_packets_both_ways(pty_outlet: PtyOutlet, tmp_path: Path) -> None:
    port = SerialPort(str(serial_place(tmp_path, "arm", "q1")))
    sent = [_core.cobs_encode(bytes([n, 0, 255, 10, 13, 17, 19, 3, 4]) * n) for n in range(1, 40)]
    for packet in sent:
        assert port.write(packet)
        assert pty_outlet.read() == [packet]
        pty_outlet.write(packet)
        assert port.read() == [packet]
    assert port.read() == [] and pty_outlet.read() == []  # no echo
    port.close()


def test_a_full_pty_drops_whole_packets_and_goes_on(pty_outlet: PtyOutlet, tmp_path: Path) -> None:
    port = SerialPort(str(serial_place(tmp_path, "arm", "q1")))
    packet = _core.cobs_encode(b"x" * 1000)
    taken = sum(port.write(packet) for _ in range(500))
    assert taken < 500 and port.unsent == 500 - taken
    got: list[bytes] = []
    while more := pty_outlet.read():
        got += more
    assert got.count(packet) == taken
    assert port.write(_core.cobs_encode(b"after"))
    assert pty_outlet.read()[-1] == _core.cobs_encode(b"after")
    port.close()


def test_a_device_that_nobody_reads_is_not_held_up(pty_outlet: PtyOutlet, tmp_path: Path) -> None:
    for n in range(2000):
        pty_outlet.write(_core.cobs_encode(b"old" * 100 + bytes([n % 256])))
    port = SerialPort(str(serial_place(tmp_path, "arm", "q1")))
    assert port.read() == []  # what came before anybody listened is gone
    pty_outlet.write(_core.cobs_encode(b"new"))
    assert port.read()[-1] == _core.cobs_encode(b"new")
    port.close()


def test_a_serial_port_is_one_hosts(pty_outlet: PtyOutlet, tmp_path: Path) -> None:
    place = str(serial_place(tmp_path, "arm", "q1"))
    port = SerialPort(place)
    with pytest.raises(PortError, match="cannot be opened: another program has it"):
        SerialPort(place)
    port.close()
    SerialPort(place).close()


HOLDER = """
import sys, time
from pathlib import Path
from headway.devices.port import SerialPort
from headway.sim.outlet import PtyOutlet, UdpOutlet
what, where = sys.argv[1:]
kinds = {"pty": PtyOutlet, "udp": UdpOutlet}
held = kinds[what](Path(where), "arm", "q1") if what in kinds else SerialPort(where)
print("held", flush=True)
time.sleep(600)
"""


@contextmanager
def held_elsewhere(what: str, where: Path) -> Iterator[subprocess.Popen[str]]:
    """By another process, which is killed in the end."""
    words = [sys.executable, "-c", HOLDER, what, str(where)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "held\n"
        yield process
    finally:
        process.kill()
        process.wait()


def test_a_serial_port_of_a_killed_host_is_free(pty_outlet: PtyOutlet, tmp_path: Path) -> None:
    place = serial_place(tmp_path, "arm", "q1")
    with (
        held_elsewhere("port", place),
        pytest.raises(PortError, match="cannot be opened: another program has it"),
    ):
        SerialPort(str(place))
    SerialPort(str(place)).close()


@pytest.mark.parametrize("kind", ["pty", "udp"])
def test_a_stable_name_is_one_plants_and_outlives_none(tmp_path: Path, kind: str) -> None:
    """Another plant cannot have it while the first lives. One that was killed leaves its name
    behind, which leads nowhere; the next plant's leads to that."""
    make = {"pty": PtyOutlet, "udp": UdpOutlet}[kind]
    place = (serial_place if kind == "pty" else udp_place)(tmp_path, "arm", "q1")

    def leads_to() -> str:
        return os.readlink(place) if kind == "pty" else place.read_text().strip()

    with held_elsewhere(kind, tmp_path):
        theirs = leads_to()
        with pytest.raises(OSError, match="is another plant's: end that"):
            make(tmp_path, "arm", "q1")
        assert leads_to() == theirs
        make(tmp_path, "arm", "q2").close()
    assert leads_to() == theirs
    outlet = make(tmp_path, "arm", "q1")
    (port,), failed = open_places(tmp_path, Links(serial=[]), kind == "udp")
    assert failed == []
    port.write(b"\1here")
    assert outlet.read()[-1:] == [b"\1here"]
    port.close()
    outlet.close()
    assert list(tmp_path.iterdir()) == []


def test_a_pulled_cable_is_told(tmp_path: Path) -> None:
    outlet = PtyOutlet(tmp_path, "arm", "q1")
    port = SerialPort(str(serial_place(tmp_path, "arm", "q1")))
    outlet.close()
    with pytest.raises(PortError, match="has gone"):
        port.read()
    with pytest.raises(PortError, match="has gone"):
        port.write(b"x")
    port.close()
    assert not serial_place(tmp_path, "arm", "q1").is_symlink()


def socket_to(outlet: UdpOutlet) -> socket.socket:
    host = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    host.settimeout(1)
    host.connect(address_of(outlet.where))
    return host


def test_answers_go_to_who_has_the_key(udp_outlet: UdpOutlet) -> None:
    """A stranger's frames, a copy of a good one among them, turn nothing to him."""
    host, stranger = socket_to(udp_outlet), socket_to(udp_outlet)
    session = _core.Session(KEY, OTHER, 77)
    good = session.seal(_core.FRAME_SYNC, b"")
    host.send(good)
    assert udp_outlet.read() == [good]
    udp_outlet.took(77, 1)  # what the device makes of it
    stranger.send(good)
    stranger.send(_core.Session(OTHER, KEY, 77).seal(_core.FRAME_SYNC, b""))
    stranger.send(b"junk")
    assert len(udp_outlet.read()) == 3
    udp_outlet.took(77, 1)
    udp_outlet.write(b"status")
    assert host.recv(100) == b"status"
    stranger.setblocking(False)
    with pytest.raises(BlockingIOError):
        stranger.recv(100)


def test_a_welcome_goes_to_who_asked(udp_outlet: UdpOutlet) -> None:
    host, other = socket_to(udp_outlet), socket_to(udp_outlet)
    host.send(_core.hello(NONCE))
    other.send(_core.hello(bytes(16)))
    assert len(udp_outlet.read()) == 2
    welcome = _core.welcome(KEY, NONCE, bytes(16))
    udp_outlet.write(welcome)
    assert host.recv(100) == welcome
    other.setblocking(False)
    with pytest.raises(BlockingIOError):
        other.recv(100)


def test_nobody_is_told_before_he_asked(udp_outlet: UdpOutlet) -> None:
    udp_outlet.write(b"status")
    assert udp_outlet.read() == []


def test_a_udp_port_outlives_the_other_end(tmp_path: Path) -> None:
    outlet = UdpOutlet(tmp_path, "arm", "q1")
    port = UdpPort(address_of(udp_place(tmp_path, "arm", "q1").read_text()))
    outlet.close()
    for _ in range(3):
        port.write(b"x")
        assert port.read() == []
    port.close()


@pytest.mark.parametrize("text", ["", "47001", "host:", ":1", "host:0", "host:65536", "host:x"])
def test_no_address(text: str) -> None:
    with pytest.raises(PortError, match="is no address: write HOST:PORT"):
        address_of(text)


@pytest.mark.parametrize("udp", [False, True])
def test_devices_are_found_by_their_keys(tmp_path: Path, udp: bool) -> None:
    """Whatever their ports are called; and a device with another key is told as such."""
    kind = UdpOutlet if udp else PtyOutlet
    outlets = [kind(tmp_path, "arm", name) for name in ("z", "y", "x")]
    keys = [bytes([n]) * 16 for n in range(3)]
    wanted = {"q1": keys[2], "q2": keys[0], "q3": bytes(16)[:15] + b"\1"}
    ports, failed = open_places(tmp_path, Links(serial=[]), udp)
    assert len(ports) == 3 and failed == []
    search = Search(ports, wanted, np.random.default_rng(1))
    search.ask()
    for outlet, key in zip(outlets, keys, strict=True):
        for packet in outlet.read():
            nonce = (_core.cobs_decode(packet) or b"")[2:18]
            outlet.write(_core.welcome(key, nonce, os.urandom(16)))
    for _ in range(3):
        search.listen()
    names = {name: port.name for name, port in search.found.items()}
    where = [str(serial_place(tmp_path, "arm", n)) for n in ("z", "y", "x")]
    if udp:
        where = [outlet.where for outlet in outlets]
    assert names == {"q1": where[2], "q2": where[0]}
    assert search.missing == ["q3"] and search.verdicts[where[1]] == "wrong key"
    search.close_others()
    for port in search.found.values():
        port.close()
    for outlet in outlets:
        outlet.close()


def test_an_announce_that_was_recorded_is_none(tmp_path: Path) -> None:
    """At an address of the config somebody repeats what the device said to an earlier search: its
    key is right, its nonce is not."""
    (tmp_path / "ports").mkdir()
    outlet = UdpOutlet(tmp_path, "arm", "q1")
    links = Links(serial=[], udp=[outlet.where])
    recorded = b""
    for search_seed in (1, 2):
        (port,), _ = open_places(tmp_path / "ports", links, udp=True)
        search = Search([port], {"q1": KEY}, np.random.default_rng(search_seed))
        search.ask()
        (hello,) = outlet.read()
        nonce = (_core.cobs_decode(hello) or b"")[2:18]
        fresh = _core.welcome(KEY, nonce, bytes(16))
        host = outlet._hellos[nonce]
        if recorded:
            outlet._socket.sendto(recorded, host)
            search.listen()
            assert search.missing == ["q1"]
        recorded = fresh
        outlet.write(fresh)
        search.listen()
        assert search.missing == []
        port.close()
    outlet.close()


def test_a_session_begins_over_ports(udp_outlet: UdpOutlet) -> None:
    """What the link carries is the codec's, byte for byte."""
    port = UdpPort(address_of(udp_outlet.where))
    session = Session(KEY, np.random.default_rng(1))
    port.write(session.hello())
    (hello,) = udp_outlet.read()
    nonce = (_core.cobs_decode(hello) or b"")[2:18]
    udp_outlet.write(_core.welcome(KEY, nonce, bytes(16)))
    (welcome,) = port.read()
    assert session.welcome(welcome) == "ok"
    port.close()
