"""Child processes of a run: forks of one server process that imports the modules of training and check only once."""

from __future__ import annotations

import multiprocessing
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

    Unlike a fork of this process, a fork of the server has none of its threads, ports and files.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(_IMPORTED_ONCE))
    return context


__all__ = ["child_context"]
