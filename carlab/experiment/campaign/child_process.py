"""Child processes of a run: forks of one server process that imports the modules of training and check only once."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import ForkServerContext

_IMPORTED_ONCE = (
    "carlab.diagnosis.quick.quick_check",
    "carlab.experiment.campaign.training",
    "carlab.recording.mcap.source",
    "learning.policy.sac_agent",
    "learning.world.drawn_cars",
    "learning.world.model_env",
    "torch._dynamo",  # torch imports it when the first optimiser is created
)


def child_context() -> ForkServerContext:
    """Context of child processes that compute between two drives; each begins without the 3 s of these imports.

    Unlike a fork of this process, a fork of the server has none of its threads, ports and files. ^C reaches neither the
    server nor its forks, because a traceback of the imports would hide the message of this process.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(_IMPORTED_ONCE))
    resource_tracker.ensure_running()  # Its first start unblocks SIGINT, which the server would inherit.
    with interrupts_blocked():
        forkserver.ensure_running()
    return context


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Block SIGINT in processes that are started in this block; here it arrives after the block."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


__all__ = ["child_context", "interrupts_blocked"]
