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

    Frames with the models-changed flag set ``models_outdated``. Missing frames set ``models_uncertain``, since they may
    have had the flag. A request clears both, and it is repeated until models arrive. A flag that is set after the last
    request causes a further request, since the models that arrive may be older than the change. Requests after missing
    frames do not delay the request after a flag.
    """

    def __init__(self, *, keepalives: bool) -> None:
        self.models_outdated = self.models_uncertain = False
        self._is_change_unanswered = self._is_check_unanswered = False
        self.reconnecting = False
        self._keepalives = keepalives
        self._next_keepalive_s = self._next_echo_s = self._next_models_s = self._next_mode_s = -math.inf
        self._next_check_of_models_s = -math.inf
        self._next_connect_s = math.inf

    def note_frame(self, now_s: float) -> None:
        """Note a frame at ``now_s``."""
        self._next_connect_s = now_s + RECONNECT_PERIOD_S

    def note_models(self) -> None:
        """Note the arrival of models, which answer the last request."""
        self._is_change_unanswered = self._is_check_unanswered = False

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
        if self._is_models_request_due(now_s):
            messages.append(MessageId.REQUEST_MODELDEF)
        if polls_mode and now_s >= self._next_mode_s:
            self._next_mode_s = now_s + MODE_PERIOD_S
            messages.append(MessageId.REQUEST)
        return messages

    def _is_models_request_due(self, now_s: float) -> bool:
        """Whether to request models now; the request counts as sent."""
        has_changed = self.models_outdated or self._is_change_unanswered
        needs_check = self.models_uncertain or self._is_check_unanswered
        if has_changed and now_s >= self._next_models_s:
            self._next_models_s = now_s + MODELS_PERIOD_S
        elif needs_check and now_s >= self._next_check_of_models_s:
            self._next_check_of_models_s = now_s + MODELS_PERIOD_S
        else:
            return False
        self._is_change_unanswered, self._is_check_unanswered = has_changed, needs_check
        self.models_outdated = self.models_uncertain = False
        return True
