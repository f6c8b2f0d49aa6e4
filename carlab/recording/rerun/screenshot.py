"""Screenshot of a recording in the rerun viewer, without a window."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from carlab.core.clock import MonotonicClock
from carlab.core.errors import DataError, NotReadyError
from carlab.recording.rerun.viewer import ADDRESS, free_port, rerun_program, wait_until_open
from carlab.recording.sink import writing

_DRIVER_FOLDERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
_CANNOT = "The rerun viewer cannot draw here"
_SETTLE_S, _TIMEOUT_S = 5.0, 60.0
"""Drawing on a processor takes about eight seconds."""
_NO_DRIVER = (
    "no Vulkan driver is installed; install one that needs no graphics card with "
    "'apt-get install mesa-vulkan-drivers libvulkan1'"
)


def has_vulkan_driver() -> bool:
    """Whether a Vulkan driver is registered on this computer (macOS and Windows include one)."""
    if sys.platform != "linux":
        return True
    named = (os.environ.get(name, "") for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"))
    if any(Path(part).is_file() for names in named for part in names.split(os.pathsep) if part):
        return True
    return any(next(Path(folder).glob("*.json"), None) is not None for folder in _DRIVER_FOLDERS)


def save_screenshot(rrd_path: Path | str, png_path: Path | str, *, size: tuple[int, int] = (1600, 1000)) -> None:
    """Open an .rrd in the headless viewer and save its picture once it no longer changes.

    Args:
        rrd_path: The recording.
        png_path: The picture; overwritten.
        size: Width and height of the picture in pixels.

    Raises:
        DataError: The recording does not exist, or the picture cannot be written.
        NotReadyError: The viewer cannot run here; the message names the packages to install.
    """
    rrd_path, png_path = Path(rrd_path), Path(png_path)
    if not rrd_path.is_file():
        raise DataError(f"{rrd_path} does not exist; create it with carlab view RECORDING --save {rrd_path.name}.")
    program = rerun_program()
    if program is None:
        raise NotReadyError(_CANNOT, ["the program 'rerun' is not installed; install rerun-sdk with pip"])
    if not has_vulkan_driver():
        raise NotReadyError(_CANNOT, [_NO_DRIVER])
    port = free_port()
    with tempfile.TemporaryDirectory(prefix="carlab-") as folder, (Path(folder) / "log").open("w+") as log:
        command = [
            *(str(program), str(rrd_path.resolve()), "--headless", "--bind", "127.0.0.1", "--port", str(port)),
            *("--window-size", f"{size[0]}x{size[1]}"),
        ]
        surroundings = {**os.environ, "XDG_RUNTIME_DIR": os.environ.get("XDG_RUNTIME_DIR", folder)}
        viewer = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=log, env=surroundings, start_new_session=True
        )
        try:
            picture = _settled_picture(viewer, port, Path(folder), MonotonicClock().now_s() + _TIMEOUT_S)
        except (RuntimeError, OSError, ConnectionError) as error:
            log.seek(0)
            lines = [line.strip() for line in log if line.strip()]
            reason = f"{error}; the viewer says: {lines[-1]}" if lines else str(error)
            raise NotReadyError(_CANNOT, [f"{reason}; if that is about graphics: {_NO_DRIVER}"]) from error
        finally:
            _end(viewer)
        with writing(png_path):
            png_path.write_bytes(picture)


def _end(viewer: subprocess.Popen[bytes]) -> None:
    """End the viewer with its children: the program on the path is a script that starts the viewer."""
    if sys.platform == "win32":
        viewer.kill()
    else:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(viewer.pid, signal.SIGKILL)
    viewer.wait()


def _settled_picture(viewer: subprocess.Popen[bytes], port: int, folder: Path, give_up_s: float) -> bytes:
    """Bytes of the first picture that equals the previous one, when axis ranges are final and messages have gone."""
    from rerun.experimental import ViewerClient

    wait_until_open(viewer, port, give_up_s)
    clock = MonotonicClock()
    client = ViewerClient(ADDRESS.format(port=port))
    path = folder / "picture.png"
    began_s, before = clock.now_s(), b""
    while True:
        clock.sleep_until(clock.now_s() + 1.5)
        client.save_screenshot(str(path))
        picture = path.read_bytes()
        if (picture == before and clock.now_s() - began_s > _SETTLE_S) or clock.now_s() > give_up_s:
            return picture
        before = picture
