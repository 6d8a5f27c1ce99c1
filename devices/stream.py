"""Packets on a stream of bytes, where zero ends each of them."""

from __future__ import annotations

from headway.firmware import _core

END = b"\0"


class Splitter:
    """Takes bytes as they come and gives whole packets. What is longer than any packet is dropped
    up to the next zero, and counted: noise cannot make it grow."""

    def __init__(self) -> None:
        self._open = b""
        self._dropping = False
        self.overlong = 0

    def feed(self, data: bytes) -> list[bytes]:
        """The packets that these bytes complete, without their ends."""
        *ended, self._open = (self._open + data).split(END)
        if self._dropping and ended:
            ended, self._dropping = ended[1:], False
        packets = [packet for packet in ended if 0 < len(packet) <= _core.PACKET_MAX]
        self.overlong += sum(len(packet) > _core.PACKET_MAX for packet in ended)
        if len(self._open) > _core.PACKET_MAX:
            self.overlong += not self._dropping
            self._dropping = True
        if self._dropping:
            self._open = b""
        return packets
