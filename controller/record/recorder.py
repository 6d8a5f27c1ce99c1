"""Where the loop and the simulator note what happens, whatever becomes of it."""

from __future__ import annotations

from abc import ABC, abstractmethod

from headway.controller.record.columns import Arrays, Columns
from headway.controller.record.hash import Hash
from headway.controller.record.messages import encode
from headway.controller.record.note import Note, freeze
from headway.controller.record.rows import rows


class Recorder(ABC):
    """Takes notes (see note.py), in batches that are kept or lost as a whole."""

    def __init__(self) -> None:
        self._notes: list[Note] = []

    def add(self, note: Note) -> None:
        """Takes a note. Its values must not change any more."""
        self._notes.append(note)

    @abstractmethod
    def publish(self) -> None:
        """Hands over what was noted since the last call. Never waits."""

    def await_room(self) -> None:  # noqa: B027
        """Waits until the next batches have room, for those who can: a simulator."""

    @abstractmethod
    def arrays(self) -> Arrays:
        """All that was recorded, see Columns."""

    @abstractmethod
    def sha256(self) -> str:
        """Hash of all deterministic messages, see Hash."""


class Memory(Recorder):
    """Keeps the rows in memory."""

    def __init__(self) -> None:
        super().__init__()
        self._batches: list[bytes] = []
        self._arrays: tuple[int, Arrays] = (0, Columns().arrays())  # of so many batches

    def publish(self) -> None:
        self._batches.append(freeze(self._notes))
        self._notes.clear()

    def arrays(self) -> Arrays:
        if self._arrays[0] != len(self._batches):
            columns = Columns()
            for batch in self._batches:
                for row in rows(batch):
                    columns.add(*row)
            self._arrays = len(self._batches), columns.arrays()
        return dict(self._arrays[1])

    def sha256(self) -> str:
        digest = Hash()
        for batch in self._batches:
            for channel, time_us, values in rows(batch):
                digest.add(channel, time_us, encode(channel, values))
        return digest.hex()
