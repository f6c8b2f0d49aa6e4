"""Motion capture by NatNet: the pose of one rigid body, on the host's clock. Names are imported on first use.

The emulated server is in ``mocap.emulators.natnet_server``, the codec in ``mocap.natnet.codec``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mocap.config import MocapConfig
    from mocap.natnet.discovery import DiscoveredServer, discover
    from mocap.natnet_client import NatNetClient
    from mocap.rigid_body import RigidBodyPoseSource
    from mocap.time_alignment import ClockAlignment

_MODULES = {
    "ClockAlignment": "time_alignment",
    "DiscoveredServer": "natnet.discovery",
    "MocapConfig": "config",
    "NatNetClient": "natnet_client",
    "RigidBodyPoseSource": "rigid_body",
    "discover": "natnet.discovery",
}

__all__ = ["ClockAlignment", "DiscoveredServer", "MocapConfig", "NatNetClient", "RigidBodyPoseSource", "discover"]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'mocap' has no attribute '{name}'")
    return getattr(importlib.import_module(f"mocap.{_MODULES[name]}"), name)
