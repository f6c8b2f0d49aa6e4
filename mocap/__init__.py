"""Motion capture by NatNet: the pose of one rigid body, on the host's clock. Names load on first use.

The emulated server is in ``mocap.emulator``, the codec in ``mocap.natnet_codec``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mocap.discovery import FoundServer, discover
    from mocap.mocap_config import MocapConfig
    from mocap.natnet_client import NatNetClient
    from mocap.rigid_body import RigidBodyPoseSource
    from mocap.time_alignment import ClockAlignment

_HOMES = {
    "ClockAlignment": "time_alignment",
    "FoundServer": "discovery",
    "MocapConfig": "mocap_config",
    "NatNetClient": "natnet_client",
    "RigidBodyPoseSource": "rigid_body",
    "discover": "discovery",
}

__all__ = ["ClockAlignment", "FoundServer", "MocapConfig", "NatNetClient", "RigidBodyPoseSource", "discover"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'mocap' has no attribute '{name}'")
    return getattr(importlib.import_module(f"mocap.{_HOMES[name]}"), name)
