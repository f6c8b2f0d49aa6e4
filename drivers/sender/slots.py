"""Newest-value slots in memory shared by two processes: there is no queue, so no old value can be read later.

A slot holds two copies, each with a sequence number and a CRC32; the writer overwrites the older copy. A reader takes
the valid copy with the higher number: an incomplete copy (its writer is busy, or died) fails its CRC, and the other
copy is used. The memory is an anonymous file passed by descriptor: it has no name that could collide or leak, and the
system frees it with the last process.
"""

from __future__ import annotations

import mmap
import os
import struct
import tempfile
import zlib
from typing import Self

_HEAD = struct.Struct("<QI")
_CRC = struct.Struct("<I")
READ_ATTEMPTS = 5


def anonymous_file(name: str) -> int:
    """Descriptor of a new file in memory, which no other program can open; ``name`` is for listings of the system."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create(name)
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


class Slot:
    """One writer, any number of readers. ``create`` makes a slot.

    The other process constructs it with an inherited or duplicated descriptor, which the slot then owns.
    """

    def __init__(self, descriptor: int, capacity: int) -> None:
        self.descriptor = descriptor
        self.capacity = capacity
        self._stride = _HEAD.size + capacity + _CRC.size
        self._memory: mmap.mmap | None = mmap.mmap(descriptor, 2 * self._stride)
        self._sequence = max(self._valid_sequences(), default=0)

    @classmethod
    def create(cls, capacity: int) -> Self:
        """Make a slot for values of at most ``capacity`` bytes."""
        descriptor = anonymous_file("carlab-slot")
        try:
            os.ftruncate(descriptor, 2 * (_HEAD.size + capacity + _CRC.size))
            return cls(descriptor, capacity)
        except BaseException:
            os.close(descriptor)
            raise

    def write(self, value: bytes) -> None:
        """Publish ``value`` atomically for readers. Raises ValueError if it is too long or the slot is closed."""
        memory = self._memory
        if memory is None:
            raise ValueError("The slot is closed.")
        if len(value) > self.capacity:
            raise ValueError(f"A value of {len(value)} bytes does not fit into a slot of {self.capacity}.")
        sequence = self._sequence + 1
        body = _HEAD.pack(sequence, len(value)) + value
        start = sequence % 2 * self._stride
        record = body + _CRC.pack(zlib.crc32(body))
        memory[start : start + len(record)] = record
        self._sequence = sequence

    def read(self) -> tuple[int, bytes] | None:
        """Sequence number and value of the newest valid copy; None if no copy is valid.

        Raises ValueError if the slot is closed.
        """
        for _ in range(READ_ATTEMPTS):
            copies = [copy for half in (0, 1) if (copy := self._read_half(half)) is not None]
            if copies:
                return max(copies)
        return None

    def close(self) -> None:
        """Unmap and close the descriptor; idempotent."""
        memory, self._memory = self._memory, None
        if memory is not None:
            memory.close()
            os.close(self.descriptor)

    def _read_half(self, half: int) -> tuple[int, bytes] | None:
        memory = self._memory  # another thread may close the slot meanwhile
        if memory is None:
            raise ValueError("The slot is closed.")
        start = half * self._stride
        record = memory[start : start + self._stride]
        sequence, length = _HEAD.unpack_from(record)
        if sequence == 0 and length == 0:
            return None
        end = _HEAD.size + length
        if length > self.capacity or zlib.crc32(record[:end]) != _CRC.unpack_from(record, end)[0]:
            return None
        return sequence, record[_HEAD.size : end]

    def _valid_sequences(self) -> list[int]:
        return [copy[0] for half in (0, 1) if (copy := self._read_half(half)) is not None]
