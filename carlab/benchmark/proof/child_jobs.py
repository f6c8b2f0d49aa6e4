"""Child processes as jobs: a command, its input files and its output files, on this machine or on a Ray cluster.

A job needs nothing but its files, so it can run on another machine that has the same version of carlab.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from carlab.benchmark.proof.child_processes import ChildEnd, run_child

PYTHON = "python"
"""Program of a job that stands for the Python interpreter of the machine that runs it."""


@dataclass(frozen=True, slots=True)
class ChildJob:
    """A command in a fresh folder.

    Attributes:
        command: program and arguments; the program ``PYTHON`` is the interpreter that runs the job.
        timeout_s: time after which it is killed.
        inputs: contents of files in the folder, by name.
        outputs: files that are read afterwards, relative to the folder; missing ones are left out.
        words_in: standard input.
        environment: changes to the environment.
    """

    command: tuple[str, ...]
    timeout_s: float
    inputs: Mapping[str, bytes] = field(default_factory=dict)
    outputs: tuple[str, ...] = ()
    words_in: str = ""
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class JobEnd:
    """End of a job: that of its process, and its output files by name."""

    end: ChildEnd
    outputs: Mapping[str, bytes] = field(default_factory=dict)

    def write_outputs(self, folder: Path) -> None:
        """Write the output files into a folder, without the folders of the job."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in self.outputs.items():
            (folder / Path(name).name).write_bytes(content)


class Executor(Protocol):
    """Runs jobs. ``jobs`` is the number that may run in parallel; ``run`` waits for the end of one."""

    @property
    def jobs(self) -> int:
        """Number of parallel jobs."""
        ...

    def run(self, job: ChildJob, abandon: Callable[[], bool]) -> JobEnd:
        """Run a job to its end; ``abandon`` is polled, and true kills it."""
        ...


@dataclass(frozen=True, slots=True)
class LocalExecutor:
    """Runs jobs as child processes of this one."""

    jobs: int = 1

    def run(self, job: ChildJob, abandon: Callable[[], bool]) -> JobEnd:
        """Run a job on this machine."""
        return run_job(job, abandon)


def run_job(job: ChildJob, abandon: Callable[[], bool] = lambda: False) -> JobEnd:
    """Run a job in a temporary folder of this machine."""
    program, *arguments = job.command
    command = [sys.executable if program == PYTHON else program, *arguments]
    with tempfile.TemporaryDirectory(prefix="job-") as fresh:
        folder = Path(fresh)
        for name, content in job.inputs.items():
            (folder / name).write_bytes(content)
        end = run_child(
            command, folder, timeout_s=job.timeout_s, words_in=job.words_in, environment=job.environment,
            abandon=abandon,
        )  # fmt: skip
        written = [name for name in job.outputs if (folder / name).is_file()]
        return JobEnd(end, {name: (folder / name).read_bytes() for name in written})


__all__ = ["PYTHON", "ChildJob", "Executor", "JobEnd", "LocalExecutor", "run_job"]
