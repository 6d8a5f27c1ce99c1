"""Where a device can be reached: a serial port, or an address to which datagrams go.

Both carry packets, as they are made by the codec: on a serial port with a zero after each, one a
datagram on UDP. Neither ever waits: what finds no room is dropped and counted.
"""

from __future__ import annotations

import errno
import os
import select
import socket
from typing import Protocol

import serial

from headway.devices.stream import END, Splitter

READ_BYTES = 65536  # at most, at once
READ_DATAGRAMS = 64


class PortError(Exception):
    """A port cannot be opened or has gone, told so that the user knows what to do."""


class Port(Protocol):
    """One end of a wire."""

    name: str
    unsent: int  # packets that found no room

    @property
    def overlong(self) -> int:
        """Stretches of bytes that were no packet."""

    def fileno(self) -> int:
        """To wait on until there is something to read."""

    def read(self) -> list[bytes]:
        """The packets that have arrived. Raises PortError when the port has gone."""

    def write(self, packet: bytes) -> bool:
        """Hands a packet over; False if it found no room. Raises PortError."""

    def close(self) -> None: ...


class SerialPort:
    """A serial port: a board's USB port, or the pty of a plant in another process."""

    def __init__(self, path: str) -> None:
        """Opens it for this process alone. Raises PortError."""
        self.name = path
        try:
            self._serial = serial.Serial(path, timeout=0, write_timeout=0, exclusive=True)
            self._serial.reset_input_buffer()  # what came before anybody listened is old
        except (OSError, ValueError) as error:  # pyserial's own are OSErrors, and not all numbered
            number = getattr(error, "errno", None)
            reason = os.strerror(number) if number else " ".join(str(error).split())
            if number in (errno.EAGAIN, errno.EBUSY):
                reason = "another program has it"
            raise PortError(f"{path}: cannot be opened: {reason}") from error
        self._hangup = select.poll()
        self._hangup.register(self._serial, 0)  # hang-ups are told unasked
        self._splitter = Splitter()
        self._broken = True  # the stream may be within a packet: a zero ends that
        self.unsent = 0

    @property
    def overlong(self) -> int:
        return self._splitter.overlong

    def fileno(self) -> int:
        return int(self._serial.fileno())

    # pyserial opens and sets up. It waits in a loop where a port is full, so bytes go past it.
    def read(self) -> list[bytes]:
        try:
            data = os.read(self.fileno(), READ_BYTES)
        except BlockingIOError:
            return []
        except OSError as error:
            raise PortError(f"{self.name}: has gone: {error.strerror}") from error
        if not data and self._hangup.poll(0):  # else there is nothing to read
            raise PortError(f"{self.name}: has gone: its other end is closed")
        return self._splitter.feed(data)

    def write(self, packet: bytes) -> bool:
        data = (END if self._broken else b"") + packet + END
        try:
            written = os.write(self.fileno(), data)
        except BlockingIOError:
            written = 0
        except OSError as error:
            raise PortError(f"{self.name}: has gone: {error.strerror}") from error
        if written:
            self._broken = written < len(data)
        self.unsent += written < len(data)
        return written == len(data)

    def close(self) -> None:
        self._serial.close()


class UdpPort:
    """A device's address. Only what comes from there is read."""

    def __init__(self, address: tuple[str, int]) -> None:
        """Raises PortError."""
        self.name = f"{address[0]}:{address[1]}"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.connect(address)
        except OSError as error:
            self._socket.close()
            raise PortError(f"{self.name}: cannot be reached: {error.strerror}") from error
        self.unsent = 0

    @property
    def overlong(self) -> int:
        return 0  # a datagram is one packet

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> list[bytes]:
        packets = []
        for _ in range(READ_DATAGRAMS):
            try:
                packets.append(self._socket.recv(READ_BYTES))
            except BlockingIOError:
                break
            except ConnectionRefusedError:  # nobody is there now, as after a restart
                continue
            except OSError as error:
                raise PortError(f"{self.name}: has gone: {error.strerror}") from error
        return packets

    def write(self, packet: bytes) -> bool:
        try:
            self._socket.send(packet)
        except ConnectionRefusedError:  # of an earlier one
            return self._again(packet)
        except BlockingIOError:
            self.unsent += 1
            return False
        except OSError as error:
            raise PortError(f"{self.name}: has gone: {error.strerror}") from error
        return True

    def _again(self, packet: bytes) -> bool:
        try:
            self._socket.send(packet)
        except OSError:
            self.unsent += 1
            return False
        return True

    def close(self) -> None:
        self._socket.close()
