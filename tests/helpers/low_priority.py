"""Run a command at low priority in its own session: ``python low_priority.py COMMAND ARGUMENT ...``.

A session must not mix priorities. Linux divides the processors among sessions (``sched_autogroup``). While a session
mixes priorities, Linux 6.18.44 gives processes of other sessions, such as an emulated car, and the kernel's thread that
transports the bytes of pseudo-terminals, no processor for seconds. Probably 6.18.45 mends it ("sched/fair: Revert
6d71a9c61604"). The command gets the same share as each other session. Without ``sched_autogroup``, it gets the time
that programs of normal priority leave.

A terminal sends ^C only to its own session, so signals are passed on.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from types import FrameType

NICENESS = 19
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PR_SET_PDEATHSIG = 1
"""prctl(2)"""


def run(command: list[str]) -> int:
    """Run a command and return its exit status, or 128 + n after signal n."""
    children: list[subprocess.Popen[bytes]] = []
    received: list[int] = []

    def pass_on(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        for child in children:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, number)

    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, pass_on)
    child = subprocess.Popen(command, start_new_session=True, preexec_fn=_prepare)
    children.append(child)
    if received:  # before the child was known
        pass_on(received[-1], None)
    status = child.wait()
    return status if status >= 0 else 128 - status


def _prepare() -> None:
    """Lower the priority of the command, and let Linux end it if this program is killed."""
    os.nice(NICENESS)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
