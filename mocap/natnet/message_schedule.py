"""Schedule of the messages of a connected NatNet client. Pure: times are arguments."""

from __future__ import annotations

import math

from mocap.natnet.models import MessageId

KEEPALIVE_PERIOD_S = 1.0
ECHO_PERIOD_S = 0.25
FIRST_ECHO_PERIOD_S = 0.02
"""Period of echoes until the clocks are aligned, or aligned again [s]."""
RECONNECT_PERIOD_S = 2.0
"""Time without a frame after which the client reconnects, since the server may have been restarted [s]."""
MODELS_PERIOD_S = 1.0
MODE_PERIOD_S = 0.5
"""Period of requests for the server's mode [s]."""


class MessageSchedule:
    """Schedule of keep-alives, echoes, reconnects and requests for the server's mode and for changed models.

    ``models_outdated`` is set by frames with the models-changed flag, ``models_uncertain`` by missing frames, which may
    have had it. Both are cleared when models arrive, so that a lost request is repeated and a further change is
    noticed. Requests after missing frames do not delay the request after a flag.
    """

    def __init__(self, *, keepalives: bool) -> None:
        self.models_outdated = self.models_uncertain = False
        self.reconnecting = False
        self._keepalives = keepalives
        self._next_keepalive_s = self._next_echo_s = self._next_models_s = self._next_mode_s = -math.inf
        self._next_check_of_models_s = -math.inf
        self._next_connect_s = math.inf

    def note_frame(self, now_s: float) -> None:
        """Note a frame at ``now_s``."""
        self._next_connect_s = now_s + RECONNECT_PERIOD_S

    def note_models(self) -> None:
        """Note the arrival of models."""
        self.models_outdated = self.models_uncertain = False

    def note_server_info(self, now_s: float) -> None:
        """Note an answer to CONNECT at ``now_s``."""
        self.reconnecting = False
        self._next_connect_s = min(self._next_connect_s, now_s + RECONNECT_PERIOD_S)

    def advance_echo(self, now_s: float) -> None:
        """Send the next echo soon, since the clocks may be misaligned."""
        self._next_echo_s = min(self._next_echo_s, now_s + FIRST_ECHO_PERIOD_S)

    def due(self, now_s: float, *, has_clock: bool, settled: bool, polls_mode: bool = False) -> list[MessageId]:
        """Messages to send now; they count as sent. Echoes are less frequent if the clock is ``settled``."""
        messages = []
        if self._keepalives and now_s >= self._next_keepalive_s:
            self._next_keepalive_s = now_s + KEEPALIVE_PERIOD_S
            messages.append(MessageId.KEEPALIVE)
        if has_clock and now_s >= self._next_echo_s:
            self._next_echo_s = now_s + (ECHO_PERIOD_S if settled else FIRST_ECHO_PERIOD_S)
            messages.append(MessageId.ECHOREQUEST)
        if now_s >= self._next_connect_s:
            self._next_connect_s = now_s + RECONNECT_PERIOD_S
            self.reconnecting = True
            messages.append(MessageId.CONNECT)
        if self.models_outdated and now_s >= self._next_models_s:
            self._next_models_s = now_s + MODELS_PERIOD_S
            messages.append(MessageId.REQUEST_MODELDEF)
        elif self.models_uncertain and now_s >= self._next_check_of_models_s:
            self._next_check_of_models_s = now_s + MODELS_PERIOD_S
            messages.append(MessageId.REQUEST_MODELDEF)
        if polls_mode and now_s >= self._next_mode_s:
            self._next_mode_s = now_s + MODE_PERIOD_S
            messages.append(MessageId.REQUEST)
        return messages
