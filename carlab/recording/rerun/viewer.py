"""The program of the rerun viewer."""

from __future__ import annotations

import contextlib
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import rerun as rr

from carlab.core.clock import MonotonicClock
from carlab.core.errors import ConfigError, DataError, NotReadyError

ADDRESS = "rerun+http://127.0.0.1:{port}/proxy"
DEFAULT_PORT = 9876
_CONNECT_TIMEOUT_S = 3.0
_START_TIMEOUT_S = 30.0
_FIRST_BYTES = b"RRF"
"""First bytes of a rerun recording of any version."""


def rerun_program() -> Path | None:
    """The rerun program that belongs to this Python, or one on the search path."""
    beside = Path(sys.executable).with_name("rerun")
    if beside.exists():
        return beside
    found = shutil.which("rerun")
    return Path(found) if found else None


def check_rerun_file(path: Path) -> None:
    """Check that a file is a rerun recording. Raises DataError if it is none, and OSError if it cannot be read."""
    with path.open("rb") as file:
        if file.read(len(_FIRST_BYTES)) != _FIRST_BYTES:
            raise DataError(f"{path} is not a rerun recording; name another file, or write it again.")


def free_port() -> int:
    """A free TCP port of this computer."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_until_open(viewer: subprocess.Popen[bytes], port: int, give_up_s: float) -> None:
    """Wait until a viewer listens on its port. Raises RuntimeError if it ends, or at a time of the monotonic clock."""
    clock = MonotonicClock()
    while True:
        if viewer.poll() is not None:
            raise RuntimeError(f"the viewer ended with code {viewer.returncode}")
        if clock.now_s() > give_up_s:
            raise RuntimeError("the viewer did not start in time")
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
            return
        clock.sleep_until(clock.now_s() + 0.1)


def open_viewer(stream: rr.RecordingStream, program: Path) -> None:
    """Open a viewer that outlives this process, and connect a stream to it.

    Raises:
        NotReadyError: it does not start.
    """
    port = free_port()
    viewer = subprocess.Popen(
        [str(program), "--bind", "127.0.0.1", "--port", str(port)],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        wait_until_open(viewer, port, MonotonicClock().now_s() + _START_TIMEOUT_S)
    except RuntimeError as error:
        raise NotReadyError("The viewer", [f"{error}; run 'rerun' in a terminal to see why."]) from error
    stream.connect_grpc(ADDRESS.format(port=port))


def check_viewer(address: str) -> None:
    """Check that a viewer listens at an address such as rerun+http://HOST:9876/proxy.

    Raises:
        ConfigError: it is no address of a viewer.
        NotReadyError: no program listens there.
    """
    try:
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port or DEFAULT_PORT
        is_valid = parts.scheme in ("rerun", "rerun+http", "rerun+https") and parts.path == "/proxy"
    except (ValueError, AttributeError, TypeError):
        is_valid, host = False, None
    if not is_valid or host is None:
        raise ConfigError(f"--viewer {address}: give the address of a viewer, rerun+http://HOST:9876/proxy.")
    try:
        socket.create_connection((host, port), timeout=_CONNECT_TIMEOUT_S).close()
    except OSError as error:
        reason = f"no viewer listens at {host}:{port} ({error}); open it there with 'rerun', or remove --viewer."
        raise NotReadyError("The viewer", [reason]) from error
