"""The process of the link, as seen by the process of the run."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
from collections.abc import Sequence

from carlab.core.clock import MonotonicClock
from carlab.experiment.cluster.link_protocol import LinkEvent, LinkRequest

READ_BYTES = 1 << 16
PROGRAM = (sys.executable, "-m", "carlab.experiment.cluster.link")
END_TIMEOUT_S = 4.0


class LinkProcess:
    """The link as a process with its own session, so that ^C reaches only the run.

    Address of the cluster, name of the training service and device of the training are the arguments of ``program``.
    """

    def __init__(self, address: str, name: str, device: str, program: Sequence[str] = PROGRAM) -> None:
        self._command = (*program, address, name, device)
        self._process: subprocess.Popen[bytes] | None = None
        self._text = b""

    @property
    def pid(self) -> int | None:
        """Number of the process; None if the link is closed."""
        return None if self._process is None else self._process.pid

    def send(self, request: LinkRequest | None) -> None:
        """Open the link unless it is open, and send a request if one is given."""
        if self._process is None:
            self._text = b""
            self._process = subprocess.Popen(
                self._command,
                start_new_session=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        if request is not None:
            assert self._process.stdin is not None
            with contextlib.suppress(BrokenPipeError):  # ``poll`` reports the end of the process.
                self._process.stdin.write(request.to_line().encode())
                self._process.stdin.flush()

    def poll(self, timeout_s: float) -> LinkEvent | None:
        """The next event; None if there is none within ``timeout_s``."""
        clock = MonotonicClock()
        end_s = clock.now_s() + timeout_s
        while b"\n" not in self._text:
            if self._process is None or self._process.stdout is None:
                clock.sleep_until(end_s)
                return None
            readable, _, _ = select.select([self._process.stdout], [], [], max(0.0, end_s - clock.now_s()))
            if not readable:
                return None
            chunk = os.read(self._process.stdout.fileno(), READ_BYTES)
            if not chunk:
                self.cut()
                return LinkEvent("unreachable", "the process of the link ended")
            self._text += chunk
        line, _, self._text = self._text.partition(b"\n")
        try:
            return LinkEvent.from_line(line.decode())
        except (ValueError, KeyError, TypeError) as error:
            self.cut()
            return LinkEvent("unreachable", f"the process of the link printed {error!r}")

    def cut(self) -> None:
        """Close the link at once; a training on the cluster continues."""
        if (process := self._process) is None:
            return
        self._process, self._text = None, b""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with contextlib.suppress(BrokenPipeError):
                    stream.close()

    def close(self) -> None:
        """End the training on the cluster, and close the link."""
        if (process := self._process) is None:
            return
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(END_TIMEOUT_S)
        self.cut()
