"""Configuration of motion capture: the table ``[hardware.mocap]`` of the car file."""

from __future__ import annotations

import ipaddress
import math
from dataclasses import dataclass
from typing import Literal

from carlab.core.errors import ConfigError, ProtocolError
from mocap.natnet.models import NEWEST_BITSTREAM, OLDEST_BITSTREAM, BitstreamVersion

MAX_YAW_OFFSET_RAD = 2.0 * math.pi
MAX_PIVOT_M = 2.0
"""Longest distance along one axis from base_link to the pivot [m]; a model car is shorter."""
MAX_TIMEOUT_S = 600.0
"""Longest wait for a server [s]; a person notices earlier that it does not answer."""


@dataclass(frozen=True, slots=True)
class MocapConfig:
    """Address of a NatNet server (Motive), and the rigid body of the car.

    Raises:
        ConfigError: a value is invalid.
    """

    server_address: str = "127.0.0.1"
    """Address of the computer that runs Motive."""
    local_interface: str = ""
    """Address of this computer's interface to the server; empty for the interface that the system selects."""
    mode: Literal["unicast", "multicast"] = "unicast"
    """Transmission Type in Motive's Data Streaming pane."""
    multicast_group: str = ""
    """Group to join in multicast mode; empty for the server's group, or 239.255.42.99."""
    command_port: int = 1510
    """The server's command port."""
    data_port: int = 0
    """Port of multicast frames; 0 for the server's port, or 1511."""
    bitstream: str = "4.1"
    """Newest bitstream version to request in unicast mode; an older server keeps its version."""
    body: str = ""
    """Name of the rigid body in Motive. If empty and without body_id: the only rigid body."""
    body_id: int | None = None
    """Streaming id of the rigid body, instead of its name."""
    up_axis: Literal["y", "z"] = "y"
    """Up Axis in Motive's Data Streaming pane (its default is Y); frames do not contain it."""
    yaw_offset_rad: float = 0.0
    """Rotation about the vertical from the rigid body to base_link (x forward)."""
    pivot_in_base_link_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the rigid body's pivot on the car: forward, left and up of base_link."""
    timeout_s: float = 2.0
    """Longest wait for the server, for its list of bodies and for its first frame, each [s]; at most 600."""

    def __post_init__(self) -> None:
        if not self.server_address.strip():
            raise ConfigError(
                "'server_address' in [hardware.mocap] (listen: --server) is empty; name the computer that runs Motive."
            )
        for name, choices in (("mode", ("unicast", "multicast")), ("up_axis", ("y", "z"))):
            if getattr(self, name) not in choices:
                raise ConfigError(
                    f"'{name}' in [hardware.mocap] is {getattr(self, name)!r}; choose {' or '.join(choices)}."
                )
        if not all(map(math.isfinite, (self.yaw_offset_rad, *self.pivot_in_base_link_m))):
            raise ConfigError("'yaw_offset_rad' and 'pivot_in_base_link_m' in [hardware.mocap] must be finite numbers.")
        if abs(self.yaw_offset_rad) > MAX_YAW_OFFSET_RAD:
            raise ConfigError(
                f"'yaw_offset_rad' in [hardware.mocap] is {self.yaw_offset_rad:g} rad; it must lie within one turn "
                "(is it in degrees?)."
            )
        if max(map(abs, self.pivot_in_base_link_m)) > MAX_PIVOT_M:
            raise ConfigError(
                f"'pivot_in_base_link_m' in [hardware.mocap] is {list(self.pivot_in_base_link_m)} m; each coordinate "
                f"must be at most {MAX_PIVOT_M:g} m (is it in millimetres?)."
            )
        for name, low, option in (("command_port", 1, " (listen: --command-port)"), ("data_port", 0, "")):
            port = getattr(self, name)
            if not low <= port <= 65535:
                raise ConfigError(
                    f"'{name}' in [hardware.mocap]{option} is {port}; a port is a number from {low} to 65535."
                )
        if not 0.0 < self.timeout_s <= MAX_TIMEOUT_S:
            raise ConfigError(
                f"'timeout_s' in [hardware.mocap] is {self.timeout_s:g} s; it must be above zero, at most "
                f"{MAX_TIMEOUT_S:g} s (is it in milliseconds?)."
            )
        if self.body and self.body_id is not None:
            raise ConfigError(
                "[hardware.mocap] has both 'body' and 'body_id' (listen: --body, --body-id); keep one of them."
            )
        if self.multicast_group:
            check_multicast_group(self.multicast_group, "'multicast_group' in [hardware.mocap]")
        try:
            version = BitstreamVersion.parse(self.bitstream)
        except ProtocolError as error:
            raise ConfigError(f"'bitstream' in [hardware.mocap] (listen: --bitstream): {error}") from error
        if not OLDEST_BITSTREAM <= version <= NEWEST_BITSTREAM:
            raise ConfigError(
                f"'bitstream' in [hardware.mocap] (listen: --bitstream) is {version}; "
                f"carlab reads {OLDEST_BITSTREAM} to {NEWEST_BITSTREAM}."
            )

    @property
    def bitstream_version(self) -> BitstreamVersion:
        """``bitstream`` as a version."""
        return BitstreamVersion.parse(self.bitstream)


def check_multicast_group(group: str, what: str) -> None:
    """Raise ConfigError if ``group`` is no IPv4 multicast address."""
    try:
        valid = ipaddress.IPv4Address(group).is_multicast
    except ValueError:
        valid = False
    if not valid:
        raise ConfigError(f"{what} is {group!r}; it must be an address from 224.0.0.0 to 239.255.255.255.")
