"""Bounds-checked reader of NatNet payloads; invalid bytes raise a ProtocolError with their position."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from struct import Struct
from typing import Any

from carlab.core.errors import ProtocolError

INT32 = Struct("<i")
PAIR = Struct("<ii")
VECTOR = Struct("<3f")
UINT16_PAIR = Struct("<HH")


class Reader:
    """Reader with a position in a payload. ``section`` names the current section in error messages."""

    __slots__ = ("data", "end", "pos", "section", "sized", "what")

    def __init__(self, data: bytes, what: str, *, sized: bool = False) -> None:
        self.data = data
        self.pos = 0
        self.end = len(data)
        self.section = "start"
        self.sized = sized
        self.what = what

    def error(self, problem: str) -> ProtocolError:
        """A ProtocolError that names the message, the byte and the section."""
        return ProtocolError(f"{self.what}: {problem} at byte {self.pos} of {len(self.data)}, in {self.section}.")

    def take(self, layout: Struct) -> tuple[Any, ...]:
        """Read one record."""
        start = self.pos
        if start + layout.size > self.end:
            raise self.error(
                f"{layout.size} bytes are expected, {self.end - start} are left; the message is truncated or corrupt,"
            )
        self.pos = start + layout.size
        return layout.unpack_from(self.data, start)

    def integer(self) -> int:
        """Read one int32."""
        value: int = self.take(INT32)[0]
        return value

    def count(self, smallest_bytes: int) -> int:
        """Read a count of entries of at least ``smallest_bytes`` each; raises ProtocolError if they do not fit."""
        number = self.integer()
        if number < 0 or number * smallest_bytes > self.end - self.pos:
            self.pos -= INT32.size
            raise self.error(f"a count of {number} does not fit into the {self.end - self.pos - 4} bytes that follow")
        return number

    def section_count(self, section: str, smallest_bytes: int) -> int:
        """Read the head of a frame's section: a count and, where sections are sized (4.1), the size in bytes.

        A size beyond the payload raises ProtocolError. Otherwise the size is ignored: the content gives the end of the
        section, and the end-of-data tag and the payload's length are checked at the end.
        """
        self.section = section
        number = self.count(smallest_bytes)
        if self.sized:
            size = self.integer()
            if size < 0 or size > self.end - self.pos:
                self.pos -= INT32.size
                raise self.error(f"a section of {size} bytes does not fit into the {self.end - self.pos - 4} left")
            if number * smallest_bytes > self.end - self.pos:
                raise self.error(f"{number} entries do not fit into the {self.end - self.pos} bytes left")
        return number

    def records(self, layout: Struct, number: int) -> Iterator[tuple[Any, ...]]:
        """Read ``number`` records."""
        start = self.pos
        stop = start + number * layout.size
        if stop > self.end:
            raise self.error(
                f"{number} entries of {layout.size} bytes do not fit into the {self.end - start} bytes left"
            )
        self.pos = stop
        return layout.iter_unpack(self.data[start:stop])

    def text(self) -> str:
        """Read a NUL-terminated UTF-8 string; invalid bytes become U+FFFD, so that the poses can still be decoded."""
        stop = self.data.find(b"\0", self.pos, self.end)
        if stop < 0:
            raise self.error("a name has no terminating NUL")
        value = self.data[self.pos : stop].decode("utf-8", "replace")
        self.pos = stop + 1
        return value

    def texts(self, number: int) -> tuple[str, ...]:
        """Read ``number`` strings."""
        return tuple([self.text() for _ in range(number)])

    def finish(self) -> None:
        """Raise ProtocolError if unread bytes remain."""
        if self.pos != self.end:
            raise self.error(f"{self.end - self.pos} bytes are left over")


def encode_text(text: str) -> bytes:
    """Encode a NUL-terminated UTF-8 string. Raises ProtocolError for a NUL inside."""
    if "\0" in text:
        raise ProtocolError(f"The name {text!r} contains a NUL, which would end it on the wire; choose another name.")
    return text.encode("utf-8") + b"\0"


def encode_counted(chunks: Iterable[bytes]) -> bytes:
    """Encode the number of entries, and the entries."""
    parts = list(chunks)
    return INT32.pack(len(parts)) + b"".join(parts)
