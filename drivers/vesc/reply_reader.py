"""Replies of a VESC on any link."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

from carlab.core.errors import ProtocolError
from drivers.device import Reply
from drivers.vesc.payloads import FirmwareVersion

Received = TypeVar("Received")


class ReplyReader:
    """Decodes replies, keeps the firmware version, and counts the bytes of invalid replies."""

    def __init__(self) -> None:
        self.version: FirmwareVersion | None = None
        self.garbage_bytes = 0

    def read(
        self,
        received: Iterable[Received],
        decode: Callable[[Received], Reply | None],
        data_of: Callable[[Received], bytes],
    ) -> list[Reply]:
        """Decode frames or payloads; ``decode`` returns None for those that are no reply."""
        replies: list[Reply] = []
        for item in received:
            try:
                reply = decode(item)
            except ProtocolError:
                self.garbage_bytes += len(data_of(item))
                continue
            if isinstance(reply, FirmwareVersion):
                self.version = reply
            if reply is not None:
                replies.append(reply)
        return replies
