"""A bounded stream of bytes through memory that two processes share: one pushes, the other pops.

Neither ever waits for the other. Two indices count bytes and only go up; each is written by one
side alone, after the bytes that it stands for were written or read. The other side sees that order
on processors that keep stores in order, as x86-64 does. The memory has no name, so nothing is left
behind, whoever dies first.
"""

from __future__ import annotations

import mmap
import os

HEAD, TAIL = 0, 8  # places in the table of indices, a cache line apart
INDICES_BYTES = 128


class Ring:
    """One end of the stream; both ends are of this class."""

    def __init__(self, file: int, capacity: int) -> None:
        """`file`: descriptor of the shared memory; `capacity` in bytes."""
        self.file, self.capacity = file, capacity
        flags = mmap.MAP_SHARED | mmap.MAP_POPULATE  # no page fault later
        self._memory = mmap.mmap(file, INDICES_BYTES + capacity, flags=flags)
        self._memory.seek(INDICES_BYTES)
        self._indices = memoryview(self._memory)[:INDICES_BYTES].cast("Q")
        self._head = self._tail = 0  # as last seen by this end

    @classmethod
    def create(cls, capacity: int) -> Ring:
        """Makes the memory. Raises OSError."""
        file = os.memfd_create("headway-record")
        os.ftruncate(file, INDICES_BYTES + capacity)
        return cls(file, capacity)

    def push(self, data: bytes) -> bool:
        """Appends all of `data`; False, and nothing of it, if it has no room."""
        head = self._head + len(data)
        if head - self._tail > self.capacity:
            self._tail = self._indices[TAIL]
            if head - self._tail > self.capacity:
                return False
        first = INDICES_BYTES + self.capacity - self._memory.tell()
        self._memory.write(data[:first])
        if first < len(data):
            self._memory.seek(INDICES_BYTES)
            self._memory.write(data[first:])
        self._head = self._indices[HEAD] = head
        return True

    def pop(self) -> bytes:
        """All that has been pushed since the last call."""
        size = self._indices[HEAD] - self._tail
        data = self._memory.read(size)  # less at the memory's end
        if len(data) < size:
            self._memory.seek(INDICES_BYTES)
            data += self._memory.read(size - len(data))
        self._tail += size
        self._indices[TAIL] = self._tail
        return data

    def close(self) -> None:
        """Gives the memory back, as far as this end is concerned."""
        self._indices.release()
        self._memory.close()
        os.close(self.file)
