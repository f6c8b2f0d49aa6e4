"""What a NatNet client must send to stay served, and when. Pure: times are arguments."""

from __future__ import annotations

import math

from mocap.natnet.models import MessageId

KEEPALIVE_PERIOD_S = 1.0
ECHO_PERIOD_S = 0.25
FIRST_ECHO_PERIOD_S = 0.02
"""Between echoes while the clocks are not aligned yet, or no longer."""
RECONNECT_PERIOD_S = 2.0
"""After so long without a frame the server may have been restarted and know nothing of this client."""
MODELS_PERIOD_S = 1.0


class Upkeep:
    """Timetable of keep-alives, echoes, repeated connects and requests for models that changed.

    ``models_wanted`` is set while frames say that models changed and cleared when models come: a request that is
    lost is sent again, and a change during another one is seen.
    """

    def __init__(self, *, keepalives: bool) -> None:
        self.models_wanted = False
        self.reconnecting = False
        self._keepalives = keepalives
        self._next_keepalive_s = self._next_echo_s = self._next_models_s = -math.inf
        self._next_connect_s = math.inf

    def heard_frame(self, now_s: float) -> None:
        """The server serves."""
        self._next_connect_s = now_s + RECONNECT_PERIOD_S

    def heard_server(self, now_s: float) -> None:
        """The server answered a connect."""
        self.reconnecting = False
        self._next_connect_s = min(self._next_connect_s, now_s + RECONNECT_PERIOD_S)

    def hurry_echo(self, now_s: float) -> None:
        """The clocks look wrong: echo soon."""
        self._next_echo_s = min(self._next_echo_s, now_s + FIRST_ECHO_PERIOD_S)

    def due(self, now_s: float, *, has_clock: bool, settled: bool) -> list[MessageId]:
        """What to send now; it counts as sent. ``settled`` clocks are asked less often."""
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
        if self.models_wanted and now_s >= self._next_models_s:
            self._next_models_s = now_s + MODELS_PERIOD_S
            messages.append(MessageId.REQUEST_MODELDEF)
        return messages
