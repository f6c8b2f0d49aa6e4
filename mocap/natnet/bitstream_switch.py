"""Decoding during a change of the bitstream version. Pure."""

from __future__ import annotations

import contextlib

from carlab.core.errors import ProtocolError
from mocap.natnet.descriptions import decode_model_def
from mocap.natnet.frames import decode_frame, explain_frame_error
from mocap.natnet.models import FRAME_BITSTREAM_CHANGED, BitstreamVersion, Description, Frame, check_readable

_SIZED = BitstreamVersion(4, 1)


class BitstreamSwitch:
    """Decoder for ``version``, and also for ``pending`` during a change to it.

    Frames in flight still have the old syntax when the server accepts a change. The change is complete when a frame
    is valid in the new syntax; if both versions have the same layout, when a frame has the bitstream-changed flag.
    """

    def __init__(self, version: BitstreamVersion, pending: BitstreamVersion | None = None) -> None:
        self.version = version
        self.pending = pending

    def decode_frame(self, payload: bytes) -> Frame:
        """Decode a frame. Raises ProtocolError, which names a bitstream version that fits the frame, if any."""
        if self.pending is not None:
            with contextlib.suppress(ProtocolError):  # still the old syntax, or garbage: the old decoder decides
                frame = decode_frame(payload, self.pending)
                alike = (self.pending < _SIZED) == (self.version < _SIZED)
                if not alike or frame.params & FRAME_BITSTREAM_CHANGED:
                    self.version, self.pending = self.pending, None
                return frame
        check_readable(self.version)
        try:
            return decode_frame(payload, self.version)
        except ProtocolError as error:
            raise explain_frame_error(payload, self.version, error) from error

    def decode_models(self, payload: bytes) -> tuple[Description, ...]:
        """Decode model definitions, which change together with the frames. Raises ProtocolError."""
        if self.pending is not None:
            with contextlib.suppress(ProtocolError):  # as above
                return decode_model_def(payload, self.pending)
        return decode_model_def(payload, self.version)
