"""Which device is at which port: found out by asking, since a device is known by its key alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from headway.devices.port import Port, PortError
from headway.firmware import _core


def other_version(welcome: bytes) -> str:
    """What to say of a device that has answered in another version of the protocol."""
    header = _core.frame_header(welcome)
    theirs = "another version" if header is None else f"version {header[0]}"
    return (
        f"refused: the device speaks {theirs} of the protocol, this program {_core.FRAME_VERSION}: "
        "give it the firmware of this headway, or use the headway of its firmware"
    )


class Search:
    """Says HELLO at every port and holds each answer against all keys.

    A device answers at most every 20 ms and proves its key with it; nothing begins by that, and one
    that runs goes on.
    """

    def __init__(
        self, ports: Sequence[Port], keys: Mapping[str, bytes], rng: np.random.Generator
    ) -> None:
        """`keys`: by name, of the devices that are looked for. `rng`: see Session."""
        self._ports, self._keys = list(ports), dict(keys)
        self._hello = _core.hello(nonce := rng.bytes(16))
        self._nonce = nonce
        self.found: dict[str, Port] = {}
        self.verdicts: dict[str, str] = {}  # by a port's name: what came of it so far

    @property
    def missing(self) -> list[str]:
        """Names of the devices that have not answered."""
        return [name for name in self._keys if name not in self.found]

    @property
    def silent(self) -> list[Port]:
        """Ports at which no device has been found."""
        taken = list(self.found.values())
        return [port for port in self._ports if port not in taken]

    def ask(self) -> None:
        """Says HELLO at all ports where nobody has been found."""
        for port in self.silent:
            try:
                port.write(self._hello)
            except PortError as error:
                self.verdicts[port.name] = str(error)

    def listen(self) -> None:
        """Takes the answers that have arrived."""
        for port in self.silent:
            try:
                packets = port.read()
            except PortError as error:
                self.verdicts[port.name] = str(error)
                continue
            for packet in packets:
                self._judge(port, packet)

    def _judge(self, port: Port, packet: bytes) -> None:
        for name, key in self._keys.items():
            verdict, *_ = _core.welcome_open(key, self._nonce, packet)
            if verdict == "ok":
                self.found.setdefault(name, port)
                self.verdicts[port.name] = f"is {name}"
                return
            if verdict == "other version":
                self.verdicts[port.name] = other_version(packet)
            elif verdict != "another frame":
                self.verdicts[port.name] = verdict

    def close_others(self) -> None:
        """Closes the ports at which nobody was found."""
        for port in self.silent:
            port.close()
