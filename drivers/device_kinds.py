"""Registry of motor controllers by the values of ``kind`` in ``[hardware.actuator]``."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

from drivers.device import Device


@dataclass(frozen=True, slots=True)
class DeviceKind:
    """A protocol over a kind of link.

    ``factory`` is the import path ``module:function`` of a function from an ActuatorConfig to a Device; only the sender
    process imports it. ``name`` appears in messages and, in lower case, in the names of readings. ``silent_hint`` is
    the remedy if no device answers, ``timeout_hint`` the remedy if its time-out does not stop the motor
    or is long, ``garbage_hint`` the remedy if the bytes that arrive are no valid frames. ``command_bytes``,
    ``request_bytes`` and ``reply_bytes`` are the sizes of the messages of one command, one request of telemetry and one
    reply: of each message on a serial line, or of the data of each frame on a bus. They are empty if they are unknown.
    """

    factory: str
    name: str
    silent_hint: str
    garbage_hint: str = ""
    timeout_hint: str = ""
    is_bus: bool = False
    command_bytes: tuple[int, ...] = ()
    request_bytes: tuple[int, ...] = ()
    reply_bytes: tuple[int, ...] = ()

    def load(self) -> Callable[[Any], Device]:
        """Import the factory."""
        module, _, function = self.factory.partition(":")
        return cast("Callable[[Any], Device]", getattr(importlib.import_module(module), function))


_VESC_TIMEOUT_HINT = "set Timeout in VESC Tool (App Settings, General) to 200 to 300 ms."

DEVICE_KINDS: dict[str, DeviceKind] = {
    "vesc_serial": DeviceKind(
        factory="drivers.vesc.serial_device:make_device",
        name="VESC",
        silent_hint="the port opens but no device answers; switch the VESC on and check that 'port' is the VESC's.",
        garbage_hint="check 'port' and 'baud' in [hardware.actuator].",
        timeout_hint=_VESC_TIMEOUT_HINT,
        command_bytes=(10, 8),
        request_bytes=(10,),
        reply_bytes=(22,),
    ),
    "vesc_can": DeviceKind(
        factory="drivers.vesc.can_device:make_device",
        name="VESC",
        silent_hint="no device answers; check power, termination, the bitrate, and that controller_id in "
        "[hardware.actuator] is the VESC's id and its CAN mode is VESC.",
        timeout_hint=_VESC_TIMEOUT_HINT,
        is_bus=True,
        command_bytes=(4, 5),
        request_bytes=(7,),
        reply_bytes=(8, 8, 4, 6),
    ),
}
"""Device kinds by their name in car files; add a protocol here."""
