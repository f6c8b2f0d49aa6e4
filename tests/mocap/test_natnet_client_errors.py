"""Error messages and closing of client and server, and the configuration."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from carlab.core.errors import ConfigError, NotOpenError, NotReadyError
from mocap.config import MocapConfig
from mocap.emulators.faults import ServerFaults
from mocap.emulators.natnet_server import NatNetServer
from mocap.natnet.models import BitstreamVersion
from mocap.natnet_client import NatNetClient
from tests.helpers.waiting import until

Serve = Callable[..., NatNetServer]
Configure = Callable[..., MocapConfig]
V40, V42 = BitstreamVersion(4, 0), BitstreamVersion(4, 2)


def reason(config: MocapConfig) -> str:
    with pytest.raises(NotReadyError) as caught:
        NatNetClient(config).open()
    assert len(caught.value.reasons) == 1
    return caught.value.reasons[0]


def test_missing_connection_is_reported_with_the_reason(serve: Serve, configure: Configure) -> None:
    silent_server = serve(faults=ServerFaults(no_answers=True))
    text = reason(configure(silent_server, timeout_s=0.3))
    assert f"127.0.0.1:{silent_server.command_port}" in text
    assert "Motive" in text
    text = reason(configure(serve(mode="multicast"), mode="unicast"))
    assert 'set mode = "multicast" in [hardware.mocap] (listen: --mode multicast)' in text
    text = reason(configure(serve(mode="unicast"), mode="multicast"))
    assert 'set mode = "unicast" in [hardware.mocap] (listen: --mode unicast)' in text
    newer_server = serve(mode="multicast", faults=ServerFaults(no_frames=True))
    newer_server.version = V42
    text = reason(configure(newer_server))
    for word in ("4.2", "2.6 to 4.1", "Transmission Type", "Unicast"):
        assert word in text
    for host in ("no-such-host.invalid", "two..dots", "::1"):
        text = reason(MocapConfig(server_address=host))
        assert host in text
        assert "server_address" in text
    text = reason(MocapConfig(server_address="127.0.0.1", local_interface="203.0.113.7"))
    assert "203.0.113.7" in text
    assert "local_interface" in text


def test_host_names_are_resolved(serve: Serve, configure: Configure) -> None:
    server = serve(host="localhost", mode="multicast")
    config = configure(server, server_address="localhost", local_interface="localhost")
    with NatNetClient(config) as client:
        until(lambda: client.statistics()["frames"] > 0.0)


def test_no_open_files_or_threads_remain_after_close(serve: Serve, configure: Configure) -> None:
    folder = "/proc/self/fd"
    if not os.path.isdir(folder):
        pytest.skip("open files cannot be counted without /proc")
    server = serve(mode="multicast")
    threads, files = threading.active_count(), len(os.listdir(folder))
    for _ in range(3):
        client = NatNetClient(configure(server))
        client.open()
        client.open()
        client.close()
        client.close()
    failing_client = NatNetClient(configure(server, mode="unicast"))
    with pytest.raises(NotReadyError):
        failing_client.open()
    failing_client.close()
    assert (threading.active_count(), len(os.listdir(folder))) == (threads, files)
    server.close()
    server.close()
    assert (threading.active_count(), len(os.listdir(folder))) == (threads - 1, files - 2)
    with pytest.raises(NotOpenError, match="open"):
        server.step(time.monotonic())


def test_port_in_use_is_reported(serve: Serve) -> None:
    used_port = serve().command_port
    with pytest.raises(NotReadyError, match=f"{used_port} cannot be used .*close the program"):
        serve(command_port=used_port)


def test_error_in_the_poses_ends_the_server_and_is_stored(serve: Serve) -> None:
    def poses(t_s: float) -> list[None]:
        raise RuntimeError("no physics")

    server = serve(poses)
    until(lambda: server.failure is not None)
    assert str(server.failure) == "no physics"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"version": "2.9"}, "bitstream 2.9"),
        ({"rate_hz": 0.0}, "rate"),
        ({"mode": "broadcast"}, "unicast or multicast"),
        ({"multicast_group": "10.0.0.1"}, "224.0.0.0"),
    ],
)
def test_invalid_server_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        NatNetServer(lambda t_s: [None], **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"server_address": " "}, "server_address"),
        ({"command_port": 0}, "command_port"),
        ({"data_port": 70000}, "data_port"),
        ({"mode": "broadcast"}, "unicast or multicast"),
        ({"up_axis": "x"}, "y or z"),
        ({"timeout_s": 0.0}, "timeout_s"),
        ({"timeout_s": 2000.0}, "'timeout_s' .* is 2000 s; .* at most 600 s"),
        ({"timeout_s": float("inf")}, "'timeout_s' .* is inf s"),
        ({"body": "car", "body_id": 1}, "body_id"),
        ({"multicast_group": "127.0.0.1"}, "224.0.0.0"),
        ({"multicast_group": "group"}, "224.0.0.0"),
        ({"bitstream": "four"}, "4.1"),
        ({"bitstream": "4.3"}, "2.6 to 4.1"),
        ({"yaw_offset_rad": float("inf")}, "yaw_offset_rad"),
        ({"yaw_offset_rad": -90.0}, "'yaw_offset_rad' .* is -90 rad; .*degrees"),
        ({"pivot_in_base_link_m": (120.0, 0.0, 15.0)}, "at most 2 m .is it in millimetres"),
        ({"pivot_in_base_link_m": (0.0, float("nan"), 0.0)}, "pivot_in_base_link_m"),
    ],
)
def test_invalid_configurations_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        MocapConfig(**options)
