"""Jobs with short fits in forks of a process that has imported carlab, which spares each job seconds of imports."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from short_fits import shorten_identification, shorten_inference

from carlab.cli import run
from carlab.experiment.campaign.child_process import child_context
from carlab.jobs.child_jobs import PYTHON, ChildJob, JobEnd, read_files, write_files
from carlab.jobs.child_processes import ChildEnd


def run_forked_job(job: ChildJob, abandon: Callable[[], bool] = lambda: False) -> JobEnd:
    """Run a job of the command ``carlab`` as ``run_job`` does, but in a fork; ``abandon`` is not polled."""
    assert job.command[:3] == (PYTHON, "-m", "carlab")
    with tempfile.TemporaryDirectory(prefix="job-") as fresh:
        folder = Path(fresh)
        write_files(folder, job.inputs)
        child = child_context().Process(target=_carlab, args=(job.command[3:], folder, dict(job.environment)))
        child.start()
        child.join()
        end = ChildEnd(child.exitcode, 0.0, "", 0.0)
        return JobEnd(end, {k: v for name in job.outputs for k, v in read_files(folder, name).items()})


def _carlab(arguments: tuple[str, ...], folder: Path, environment: dict[str, str]) -> None:
    shorten_inference(pytest.MonkeyPatch())
    shorten_identification(pytest.MonkeyPatch())
    os.chdir(folder)
    os.environ.update(environment)
    with open(os.devnull, "w") as nowhere:
        sys.stdout = sys.stderr = nowhere
        code = run(arguments)
    sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__
    sys.exit(code)
