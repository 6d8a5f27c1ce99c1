"""The link over ports: a thread reads them all and stamps what arrives; the loop never waits."""

from __future__ import annotations

import os
import selectors
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from threading import Thread

from headway.devices import interrupts
from headway.devices.port import Port, PortError

QUEUE_PACKETS = 4096  # read and not yet taken: a second of a machine of many axes


class PortLink:
    """Carries packets to and from devices, each at its port (see link.py)."""

    def __init__(self, ports: Sequence[Port], now_us: Callable[[], int]) -> None:
        """`ports`: by device, which become this link's to close. `now_us`: the host's clock."""
        self._ports, self._now_us = list(ports), now_us
        self._arrived: deque[tuple[int, int, bytes]] = deque()
        self.gone: dict[int, str] = {}  # by device: why its port is no more
        self.sent = self.received = 0
        self.dropped = 0  # packets that came faster than the loop took them
        self._over = False
        self._wake = os.eventfd(0)
        self._thread = Thread(target=self._read, name="link", daemon=True)
        with interrupts.held_back():
            self._thread.start()

    def receive(self, now_us: int) -> list[tuple[int, int, bytes]]:
        """(device, received_us, packet) of all that arrived up to `now_us`."""
        taken = []
        while self._arrived and self._arrived[0][1] <= now_us:
            taken.append(self._arrived.popleft())
        return taken

    def send(self, device: int, packet: bytes, now_us: int) -> None:
        """Writes a packet, if there is room."""
        del now_us  # it leaves when it is written
        self.sent += 1
        try:
            self._ports[device].write(packet)
        except PortError as error:
            self.gone.setdefault(device, str(error))

    @property
    def names(self) -> list[str]:
        """Of the ports, by device."""
        return [port.name for port in self._ports]

    def counts(self) -> dict[str, int]:
        """Packets, ever: sent, received, unsent (no room at their port), dropped (came faster than
        they were taken); and overlong, stretches of bytes that were no packet."""
        return {
            "sent": self.sent,
            "received": self.received,
            "unsent": sum(port.unsent for port in self._ports),
            "dropped": self.dropped,
            "overlong": sum(port.overlong for port in self._ports),
        }

    def _read(self) -> None:
        """The thread. A stamp is late by what this thread waits for the interpreter; a late stamp
        proves less about a clock, and nothing false."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._wake, selectors.EVENT_READ)
            for device, port in enumerate(self._ports):
                selector.register(port, selectors.EVENT_READ, device)
            while not self._over:
                for key, _ in selector.select():
                    if key.data is not None and not self._take(key.data):
                        selector.unregister(self._ports[key.data])

    def _take(self, device: int) -> bool:
        """False when the port has gone."""
        try:
            packets = self._ports[device].read()
        except PortError as error:
            self.gone.setdefault(device, str(error))
            return False
        now_us = self._now_us()  # of what came before: a stamp may be late, never early
        self.received += len(packets)
        for packet in packets:
            if len(self._arrived) < QUEUE_PACKETS:
                self._arrived.append((device, now_us, packet))
            else:
                self.dropped += 1
        return True

    def close(self) -> None:
        """Ends the thread and closes all ports."""
        self._over = True
        os.eventfd_write(self._wake, 1)
        self._thread.join()
        os.close(self._wake)
        for port in self._ports:
            with suppress(OSError):
                port.close()
