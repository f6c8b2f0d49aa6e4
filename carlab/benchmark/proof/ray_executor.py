"""Jobs on a Ray cluster (https://docs.ray.io): the cores of one machine, or an existing cluster.

Each job is a Ray task of one core. If its worker dies, Ray starts the task again on another one.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from types import TracebackType
from typing import Any

from carlab.benchmark.proof.child_jobs import ChildJob, JobEnd, run_job
from carlab.benchmark.proof.child_processes import ChildEnd
from carlab.core.clock import MonotonicClock
from carlab.core.errors import ConfigError

LOCAL = "local"
MAX_RETRIES = 3
"""Number of further attempts after the death of a worker."""
POLL_S = 0.2


class RayExecutor:
    """Runs jobs on a Ray cluster, as many as it has cores. Use it as a context manager.

    Args:
        address: ``local`` for the cores of this machine, or the address of a cluster, for example
            ``ray://192.168.0.10:10001`` or ``192.168.0.10:6379``.

    Raises:
        ConfigError: Ray is not installed (at construction), or no cluster answers (at entry).
    """

    def __init__(self, address: str) -> None:
        if importlib.util.find_spec("ray") is None:
            raise ConfigError("--ray needs Ray, which is not installed; run: pip install 'carlab[ray]'.")
        self.address = address
        self.jobs = 1
        self._ray: Any = None
        self._remote: Any = None

    def __enter__(self) -> RayExecutor:
        """Connect to the cluster."""
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        import ray

        quiet: dict[str, Any] = {"include_dashboard": False} if self.address == LOCAL else {}
        try:
            ray.init(address=self.address, log_to_driver=False, logging_level="error", **quiet)
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            first = str(error).strip().splitlines()[:1] or [type(error).__name__]
            raise ConfigError(
                f"--ray {self.address}: no Ray cluster answers ({first[0]}); start one with 'ray start --head', "
                "or use --ray local."
            ) from error
        self._ray = ray
        self._remote = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(run_job)
        self.jobs = max(1, int(ray.cluster_resources().get("CPU", 1)))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Disconnect; a local cluster ends."""
        if self._ray is not None:
            self._ray.shutdown()
            self._ray = None

    def run(self, job: ChildJob, abandon: Callable[[], bool]) -> JobEnd:
        """Run a job on the cluster. A job whose workers die ``MAX_RETRIES`` + 1 times counts as failed."""
        clock = MonotonicClock()
        began_s = clock.now_s()
        reference = self._remote.remote(job)
        while True:
            done, _ = self._ray.wait([reference], timeout=POLL_S)
            if done:
                break
            if abandon():
                self._ray.cancel(reference, force=True)
                return JobEnd(ChildEnd(None, clock.now_s() - began_s, "abandoned", 0.0, abandoned=True))
        try:
            end: JobEnd = self._ray.get(reference)
        except (self._ray.exceptions.RayTaskError, self._ray.exceptions.RayError) as error:
            first = str(error).strip().splitlines()[:1] or [type(error).__name__]
            return JobEnd(ChildEnd(None, clock.now_s() - began_s, f"worker lost: {first[0]}", 0.0))
        return end


__all__ = ["LOCAL", "RayExecutor"]
