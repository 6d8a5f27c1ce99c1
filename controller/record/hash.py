"""The hash by which two runs are compared."""

from __future__ import annotations

import hashlib

from headway.controller.record.channels import Channel


class Hash:
    """SHA-256 over the channel's name, the time and the bytes of every deterministic message."""

    def __init__(self) -> None:
        self._digest = hashlib.sha256()

    def add(self, channel: Channel, time_us: int, message: bytes) -> None:
        """Takes a message, in the order in which they were noted."""
        if channel.deterministic:
            self._digest.update(f"{channel.name} {time_us} {len(message)} ".encode() + message)

    def hex(self) -> str:
        """Of all messages so far."""
        return self._digest.hexdigest()
