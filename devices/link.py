"""What a link does, whatever it is made of."""

from __future__ import annotations

from typing import Protocol


class Link(Protocol):
    """Carries packets between the host and its devices, by device index."""

    def receive(self, now_us: int) -> list[tuple[int, int, bytes]]:
        """(device, received_us, packet) of all that arrived up to `now_us`, in order of arrival."""

    def send(self, device: int, packet: bytes, now_us: int) -> None:
        """Hands a packet over at `now_us`; it may never arrive."""
