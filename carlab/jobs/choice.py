"""The executor of the options ``--ray`` and ``--jobs``."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

from carlab.core.errors import ConfigError
from carlab.jobs.child_jobs import Executor, LocalExecutor
from carlab.jobs.ray_executor import RayExecutor


def chosen_executor(ray: str, jobs: int, *, gpu: bool = False) -> AbstractContextManager[Executor]:
    """The executor of ``--ray`` and ``--jobs``, as a context manager.

    Args:
        ray: ``local`` or the address of a cluster; empty: child processes of this machine.
        jobs: number of parallel child processes without Ray.
        gpu: each job needs a GPU.

    Raises:
        ConfigError: both are given, or Ray is not installed.
    """
    if not ray:
        return nullcontext(LocalExecutor(jobs))
    if jobs > 1:
        raise ConfigError("--ray replaces --jobs; leave one of them out.")
    return RayExecutor(ray, gpu=gpu)


__all__ = ["chosen_executor"]
