"""Servers on free ports of the loopback interface, closed after each test."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from mocap.config import MocapConfig
from mocap.emulators.natnet_server import NatNetServer
from mocap.emulators.scene import RigidBodySample

Serve = Callable[..., NatNetServer]
Configure = Callable[..., MocapConfig]


def clock_poses(t_s: float) -> list[RigidBodySample | None]:
    """One body whose x [m] is the time of exposure [s] modulo 16 s, 3 ms before the frame is due."""
    t_capture_s = t_s - 0.003
    return [RigidBodySample.planar(t_capture_s, t_capture_s % 16.0, -0.5, 0.75, 0.25)]


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Open a server; by default on free ports, with one body moved by ``clock_poses``."""
    with ExitStack() as stack:

        def open_server(poses: Any = clock_poses, *, kind: type[NatNetServer] = NatNetServer, **options: Any) -> Any:
            ports = {"command_port": 0, "data_port": 0}
            return stack.enter_context(kind(poses, **(ports | options)))

        yield open_server


@pytest.fixture
def configure() -> Configure:
    """Configuration for a server."""

    def config(server: NatNetServer, **changes: Any) -> MocapConfig:
        common = {
            "server_address": "127.0.0.1",
            "command_port": server.command_port,
            "mode": server.mode,
            "timeout_s": 10.0,
        }
        return MocapConfig(**(common | changes))

    return config
