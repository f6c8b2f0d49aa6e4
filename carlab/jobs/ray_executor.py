"""Jobs on a Ray cluster (https://docs.ray.io): the cores of one machine, or an existing cluster.

Each job is a Ray task of one core. If its worker dies, Ray starts the task again on another one.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import platform
import socket
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from carlab.core.clock import MonotonicClock
from carlab.core.errors import ConfigError, DataError, first_line
from carlab.core.extras import install_hint
from carlab.core.version import VERSION
from carlab.jobs.child_jobs import ChildJob, Executor, JobEnd, LocalExecutor, run_job
from carlab.jobs.child_processes import ChildEnd

LOCAL = "local"
MAX_RETRIES = 3
"""Number of further attempts after the death of a worker."""
POLL_S = 0.2
CONNECT_TIMEOUT_S = 5.0


class RayExecutor:
    """Runs jobs on a Ray cluster, as many as it has cores. Use it as a context manager.

    Args:
        address: ``local`` for the cores of this machine, or the address of a cluster, for example
            ``ray://192.168.0.10:10001`` or ``192.168.0.10:6379``.
        gpu: each job gets one GPU; as many jobs run as the cluster has GPUs.

    Raises:
        ConfigError: Ray is not installed (at construction), no cluster answers, or it has no GPU (at entry).
    """

    def __init__(self, address: str, *, gpu: bool = False) -> None:
        require_ray()
        self.address = address
        self.gpu = gpu
        self.jobs = 1
        self._ray: Any = None
        self._remote: Any = None

    def __enter__(self) -> RayExecutor:
        """Connect to the cluster."""
        self._ray = connect(self.address)
        self._remote = self._ray.remote(num_cpus=1, num_gpus=int(self.gpu), max_retries=MAX_RETRIES)(_run_here)
        resource = "GPU" if self.gpu else "CPU"
        self.jobs = int(self._ray.cluster_resources().get(resource, 0))
        if self.jobs < 1:
            self.__exit__()
            raise ConfigError(
                f"--ray {self.address}: the cluster has no {resource}; add a machine, or use --device cpu."
            )
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect; a local cluster ends."""
        if self._ray is not None:
            self._ray.shutdown()
            self._ray = None

    def run(self, job: ChildJob, abandon: Callable[[], bool]) -> JobEnd:
        """Run a job on the cluster. A job whose workers die ``MAX_RETRIES`` + 1 times counts as failed."""
        clock = MonotonicClock()
        began_s = clock.now_s()
        try:
            reference = self._remote.remote(VERSION, job)
            while not self._ray.wait([reference], timeout=POLL_S)[0]:
                if abandon():
                    self._ray.cancel(reference, force=True)
                    return JobEnd(ChildEnd(None, clock.now_s() - began_s, "abandoned", 0.0, abandoned=True))
            end: JobEnd = self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            if isinstance(cause := getattr(error, "cause", None), ConfigError):
                raise ConfigError(str(cause)) from error
            return JobEnd(ChildEnd(None, clock.now_s() - began_s, f"worker lost: {first_line(error)}", 0.0))
        except ConnectionError as error:
            raise DataError(
                f"The Ray cluster {self.address} does not answer any more ({first_line(error)}); finished cases are "
                "stored, so run the same command again when it is back."
            ) from error
        return end


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


def require_ray() -> None:
    """Raise ConfigError if Ray is not installed."""
    if importlib.util.find_spec("ray") is None:
        raise ConfigError(f"--ray needs Ray, which is not installed; {install_hint('ray')}.")


def connect(address: str) -> Any:
    """Connect this process to a cluster and return the module ``ray``. Raises ConfigError if no cluster answers."""
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray

    quiet: dict[str, Any] = {"include_dashboard": False} if address == LOCAL else {}
    try:
        _require_listener(address)
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **quiet)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        raise ConfigError(
            f"--ray {address}: no Ray cluster answers ({first_line(error)}); start one with 'ray start --head' and the "
            "same RAY_AUTH_TOKEN, or use --ray local."
        ) from error
    return ray


def _require_listener(address: str) -> None:
    """Raise OSError if nothing listens at an address HOST:PORT; Ray itself would try for many minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_TIMEOUT_S).close()


def _run_here(version: str, job: ChildJob) -> JobEnd:
    """Run a job on a machine of the cluster. Raises ConfigError if its version of carlab differs from the sender's."""
    require_same_version(version)
    return run_job(job)


def require_same_version(version: str) -> None:
    """Raise ConfigError if this machine has another version of carlab than the machine that sends work to it."""
    if version != VERSION:
        raise ConfigError(
            f"The machine {platform.node()} of the cluster has carlab {VERSION}, this one {version}; install the same "
            "version on both."
        )
