"""Jobs in this process, which has imported carlab; a child process would import it again, for seconds."""

from __future__ import annotations

import contextlib
import importlib
import io
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits

from carlab.jobs.child_jobs import PYTHON, ChildJob, JobEnd, read_files, write_files
from carlab.jobs.child_processes import ChildEnd


class ExecutorHere:
    """Runs jobs ``python -m MODULE ...`` one after the other by the function ``main`` of the module."""

    jobs = 1

    def run(self, job: ChildJob, abandon: Callable[[], bool]) -> JobEnd:
        """Run a job as ``run_job`` does; ``abandon`` is not polled, and the environment does not change."""
        program, flag, module, *arguments = job.command
        assert (program, flag) == (PYTHON, "-m")
        with (
            tempfile.TemporaryDirectory(prefix="job-") as fresh,
            contextlib.chdir(fresh),
            threadpool_limits(1, "blas"),
            pytest.MonkeyPatch.context() as patch,
        ):
            write_files(Path(fresh), job.inputs)
            patch.setattr("sys.stdin", io.StringIO(job.stdin_text))
            patch.setattr("sys.argv", [module, *arguments])
            status = importlib.import_module(module).main()
            outputs = {k: v for name in job.outputs for k, v in read_files(Path(fresh), name).items()}
            return JobEnd(ChildEnd(status, 0.0, "", 0.0), outputs)
