"""The board's end of a real wire: a pty or a UDP socket in front of a simulated board."""

from __future__ import annotations

import errno
import fcntl
import os
import pty
import socket
import tty
from collections import OrderedDict
from pathlib import Path
from typing import Any, Protocol

from headway.devices.places import serial_place, udp_place
from headway.devices.stream import END, Splitter
from headway.firmware import _core

READ_BYTES = 65536
READ_DATAGRAMS = 256
ASKING = 64  # hosts, or frames of one, that an outlet remembers the address of
LOOPBACK = "127.0.0.1"

Address = tuple[str, int]


class Outlet(Protocol):
    """Where one device can be reached."""

    where: str  # what to connect to

    def fileno(self) -> int: ...

    def read(self) -> list[bytes]:
        """The packets that have arrived."""

    def write(self, packet: bytes) -> None:
        """Sends a packet to the host; what has no room is lost, as on any wire."""

    def took(self, session: int | None, counter: int) -> None:
        """The device's session, and the highest counter that it has taken in it."""

    def close(self) -> None: ...


class PtyOutlet:
    """A pty under a stable name. Whoever opens it writes to the device and reads what it says."""

    def __init__(self, folder: Path, machine: str, device: str) -> None:
        """Raises OSError."""
        self._place = serial_place(folder, machine, device)
        self._held = _Held(self._place)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)  # no echo, even before a host has opened it
        os.set_blocking(self._master, False)
        _replace_link(self._place, os.ttyname(self._slave))
        self.where = str(self._place)
        self._splitter = Splitter()
        self._broken = True

    def fileno(self) -> int:
        return self._master

    def read(self) -> list[bytes]:
        try:
            return self._splitter.feed(os.read(self._master, READ_BYTES))
        except BlockingIOError:
            return []

    def write(self, packet: bytes) -> None:
        data = (END if self._broken else b"") + packet + END
        try:
            written = os.write(self._master, data)
        except BlockingIOError:  # nobody reads
            return
        self._broken = written < len(data)

    def took(self, session: int | None, counter: int) -> None:
        """Of no use where there is one wire."""

    def close(self) -> None:
        self._place.unlink(missing_ok=True)
        self._held.release()
        os.close(self._master)
        os.close(self._slave)


class UdpOutlet:
    """A UDP port, whose number is in a file under a stable name.

    A WELCOME goes to where its HELLO came from; everything else to where the last authentic frame
    did, so that nobody without a key can turn the device's statuses elsewhere.
    """

    def __init__(
        self, folder: Path, machine: str, device: str, bind: Address = (LOOPBACK, 0)
    ) -> None:
        """`bind`: the address of this computer at which it can be reached, and the port; 0: any
        that is free. Raises OSError."""
        self._place = udp_place(folder, machine, device)
        self._held = _Held(self._place)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(bind)
        except OSError:
            self._socket.close()
            self._held.release()
            raise
        self._socket.setblocking(False)
        host, port = self._socket.getsockname()
        self.where = f"{host}:{port}"
        unfinished = self._place.with_name(f".{self._place.name}")
        unfinished.write_text(self.where + "\n")
        unfinished.replace(self._place)
        self._hellos: OrderedDict[bytes, Address] = OrderedDict()  # by nonce
        self._frames: OrderedDict[tuple[int, int], Address] = OrderedDict()  # by session, counter
        self._host: Address | None = None

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> list[bytes]:
        packets = []
        for _ in range(READ_DATAGRAMS):
            try:
                packet, address = self._socket.recvfrom(_core.PACKET_MAX + 1)
            except BlockingIOError:
                break
            except ConnectionError:  # of a host that has gone
                continue
            if len(packet) <= _core.PACKET_MAX:
                self._note(packet, address)
                packets.append(packet)
        return packets

    def _note(self, packet: bytes, address: Address) -> None:
        header = _core.frame_header(packet)
        if header is None:
            return
        _, kind, session, counter = header
        if kind == _core.FRAME_HELLO:
            _remember(self._hellos, _nonce(packet), address)
        else:
            _remember(self._frames, (session, counter), address)

    def took(self, session: int | None, counter: int) -> None:
        if session is not None:
            self._host = self._frames.get((session, counter), self._host)

    def write(self, packet: bytes) -> None:
        header = _core.frame_header(packet)
        host = self._host
        if header is not None and header[1] == _core.FRAME_WELCOME:
            host = self._hellos.get(_nonce(packet))
        if host is None:
            return
        try:
            self._socket.sendto(packet, host)
        except (BlockingIOError, ConnectionError):
            return

    def close(self) -> None:
        self._place.unlink(missing_ok=True)
        self._held.release()
        self._socket.close()


class _Held:
    """A stable name that is this process' as long as it lives, however it ends."""

    def __init__(self, place: Path) -> None:
        """Raises OSError if another process has it."""
        self._path = place.with_name(f".{place.name}.lock")
        while True:
            self._file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600)
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                os.close(self._file)
                reason = f"{place} is another plant's: end that, or name another --ports"
                raise OSError(errno.EADDRINUSE, reason) from error
            if self._path.exists() and os.path.samestat(os.fstat(self._file), self._path.stat()):
                return
            os.close(self._file)  # whoever had it has just removed it

    def release(self) -> None:
        self._path.unlink(missing_ok=True)
        os.close(self._file)


def _nonce(packet: bytes) -> bytes:
    """The host's nonce in a HELLO or a WELCOME."""
    frame = _core.cobs_decode(packet) or b""
    return frame[2:18]


def _remember(table: OrderedDict[Any, Address], key: object, address: Address) -> None:
    """The first to say something is who said it: a copy from elsewhere changes nothing."""
    if key not in table:
        table[key] = address
        if len(table) > ASKING:
            table.popitem(last=False)


def _replace_link(place: Path, target: str) -> None:
    unfinished = place.with_name(f".{place.name}")
    unfinished.unlink(missing_ok=True)
    unfinished.symlink_to(target)
    unfinished.replace(place)
