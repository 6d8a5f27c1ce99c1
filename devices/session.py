"""The host's end of a session with a device: the handshake, then sealed and opened frames.

HELLO is repeated, with the same nonce, until the device has answered in the session that both have
derived; then the session stands. Until then a newer WELCOME replaces an older one: the first may
have come too late, or the device may have been busy. See firmware/handshake.h for the method.
"""

from __future__ import annotations

import numpy as np

from headway.firmware import _core

WELCOME = _core.FRAME_WELCOME


class Session:
    """One device's session. It begins with `hello` and `welcome`."""

    def __init__(self, key: bytes, rng: np.random.Generator) -> None:
        """`key`: the device's long-term key, 16 bytes. `rng` draws the nonces: on a machine one
        that nobody can foresee, seeded by the operating system."""
        self._key, self._rng = key, rng
        self._nonce = rng.bytes(16)
        self._last = (-1, -1)  # boot and number of the last device's nonce that was taken
        self._session: _core.Session | None = None
        # Whether the device has answered in the session, so that HELLO need not be repeated.
        self.established = False
        # Whether the frame opened last was sent before another one that was opened earlier.
        self.overtaken = False
        self._opened = 0

    @property
    def welcomed(self) -> bool:
        """Whether there are keys to seal with."""
        return self._session is not None

    @property
    def lost(self) -> int:
        """Frames of the device's that are missing so far, by their counters."""
        return 0 if self._session is None else self._session.received - self._opened

    def renew(self) -> None:
        """Asks for a new session, as when the device has booted. The old one ends."""
        self._nonce = self._rng.bytes(16)
        self._session, self.established, self._opened = None, False, 0

    def hello(self) -> bytes:
        """The packet that asks for a session, the same one until `renew`."""
        return _core.hello(self._nonce)

    def welcome(self, packet: bytes) -> str:
        """Takes a device's answer.

        Returns "ok" if there are keys now, or why not: "wrong key", "line noise" (a damaged
        packet), "stale" (not the answer to this HELLO, or an older one), "other version" or
        "another frame".
        """
        verdict, nonce, session = _core.welcome_open(self._key, self._nonce, packet)
        if session is None or nonce is None:
            return verdict
        number = (int.from_bytes(nonce[:4], "little"), int.from_bytes(nonce[4:8], "little"))
        if number == self._last and self._session is not None:
            return "ok"  # the same answer again: its counters go on
        if self.established or number <= self._last:
            return "stale"
        self._last, self._session, self._opened = number, session, 0
        return "ok"

    def seal(self, type: int, payload: bytes) -> bytes:
        """A packet in the session.

        Raises ValueError for a payload that is too long, or before a welcome; OverflowError when
        the session's counters are used up.
        """
        return self._sealing().seal(type, payload)

    def seal_group(self, group: _core.Session) -> bytes:
        """A packet that gives the device the group's key. Raises as `seal`."""
        return self._sealing().seal_group(group)

    def _sealing(self) -> _core.Session:
        if self._session is None:
            raise ValueError("there is no session yet: first hello, then welcome")
        return self._session

    def open(self, packet: bytes) -> tuple[int, bytes] | str:
        """A frame's type and payload, or why it was not opened."""
        if self._session is None:
            return "no session"
        session = self._session
        newest, opened = session.received, session.open(packet)
        if type(opened) is tuple:
            self.established, self.overtaken = True, session.received == newest
            self._opened += 1
        return opened


def draw_group(rng: np.random.Generator) -> _core.Session:
    """The host's end of a new group of devices: one packet of it reaches them all.

    Each of them gets the key by `Session.seal_group`. A device whose own session has the group's
    number, one in 4e9, does not join; its status says so, and another group has to be drawn.
    """
    key = rng.bytes(16)
    return _core.Session(key, key, int(rng.integers(2**32)))
