"""Newest-value slots: readers get complete values only, with a concurrent or killed writer."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.sender.slots import Slot

ROOT = Path(__file__).resolve().parents[2]
WRITER = """
import sys, struct, zlib
from drivers.sender.slots import Slot
slot = Slot(int(sys.argv[1]), 2048)
n = 0
while True:
    n += 1
    slot.write(struct.pack("<Q", n) * 256)
"""


def test_newest_value_is_read_repeatedly() -> None:
    slot = Slot.create(16)
    assert slot.read() is None
    for n in range(1, 6):
        slot.write(bytes((n,)) * n)
        assert slot.read() == slot.read() == (n, bytes((n,)) * n)
    with pytest.raises(ValueError, match="does not fit"):
        slot.write(bytes(17))
    slot.close()
    slot.close()
    with pytest.raises(ValueError, match="closed"):
        slot.write(b"")


@pytest.mark.parametrize("offset", [0, 8, 12, 20, 27])
def test_incomplete_copy_is_ignored_and_the_previous_copy_read(offset: int) -> None:
    """Corrupt one byte of the newest copy, like a writer that died while writing."""
    slot = Slot.create(16)
    slot.write(b"first value 0000")
    slot.write(b"second value 111")
    start = 0  # the second value lies in the first half: its sequence number is even
    before = os.pread(slot.descriptor, 1, start + offset)
    os.pwrite(slot.descriptor, bytes((before[0] ^ 0xFF,)), start + offset)
    assert slot.read() == (1, b"first value 0000")
    slot.close()


def test_attached_writer_continues_the_sequence() -> None:
    slot = Slot.create(16)
    slot.write(b"a")
    other = Slot(os.dup(slot.descriptor), 16)
    other.write(b"b")
    assert slot.read() == (2, b"b")
    other.close()
    slot.close()


def test_no_mixed_value_with_a_concurrent_or_killed_writer() -> None:
    slot = Slot.create(2048)
    command = [sys.executable, "-c", WRITER, str(slot.descriptor)]
    process = subprocess.Popen(command, cwd=ROOT, pass_fds=(slot.descriptor,))
    try:
        sequence_numbers = [0]
        while len(sequence_numbers) < 2000:
            newest = slot.read()
            if newest is None:
                continue
            numbers = struct.unpack("<256Q", newest[1])
            assert set(numbers) == {newest[0]}
            if newest[0] > sequence_numbers[-1]:
                sequence_numbers.append(newest[0])
    finally:
        process.kill()
        process.wait()
    last = slot.read()
    assert last is not None
    assert set(struct.unpack("<256Q", last[1])) == {last[0]}
    slot.close()
