"""^C at the terminal reaches every process of its group; those that compute for a run leave it to the run."""

from __future__ import annotations

import signal
import subprocess
import sys
from multiprocessing import forkserver
from pathlib import Path

import pytest

from carlab.experiment.campaign.child_process import child_context, interrupts_blocked


def test_process_that_is_started_in_the_block_gets_no_interrupt() -> None:
    with interrupts_blocked():
        child = subprocess.Popen(
            [sys.executable, "-c", "print('ready', flush=True); input()"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
    assert child.stdout is not None
    assert child.stdout.readline() == b"ready\n"
    child.send_signal(signal.SIGINT)
    child.communicate(b"end\n", timeout=20.0)
    assert child.returncode == 0


def test_interrupt_during_the_block_arrives_after_it() -> None:
    done = []

    def block() -> None:
        with interrupts_blocked():
            signal.raise_signal(signal.SIGINT)
            done.append("block")

    with pytest.raises(KeyboardInterrupt):
        block()
    assert done == ["block"]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, set())


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_server_of_the_child_processes_imports_without_interrupts() -> None:
    child_context()
    status = Path(f"/proc/{forkserver._forkserver._forkserver_pid}/status").read_text(encoding="ascii")
    (blocked,) = [int(line.split()[1], 16) for line in status.splitlines() if line.startswith("SigBlk:")]
    assert blocked >> (signal.SIGINT - 1) & 1
