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

from carlab.core.errors import DataError
from carlab.jobs.child_processes import ChildEnd, run_child

PYTHON = "python"
"""Program of a job that stands for the Python interpreter of the machine that runs it."""
CARLAB = (PYTHON, "-m", "carlab")


@dataclass(frozen=True, slots=True)
class ChildJob:
    """A command in a fresh folder.

    Attributes:
        command: program and arguments; the program ``PYTHON`` is the interpreter that runs the job.
        timeout_s: time after which it is killed.
        inputs: contents of files in the folder, by relative path.
        outputs: files that are read afterwards, relative to the folder, or folders, of which all files are read;
            missing ones are left out.
        stdin_text: standard input.
        environment: changes to the environment.
    """

    command: tuple[str, ...]
    timeout_s: float
    inputs: Mapping[str, bytes] = field(default_factory=dict)
    outputs: tuple[str, ...] = ()
    stdin_text: str = ""
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class JobEnd:
    """End of a job: that of its process, and its output files by relative path."""

    end: ChildEnd
    outputs: Mapping[str, bytes] = field(default_factory=dict)

    def write_outputs(self, folder: Path) -> None:
        """Write the output files into a folder, without the folders of the job."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in self.outputs.items():
            (folder / Path(name).name).write_bytes(content)

    @property
    def failure(self) -> str:
        """Reason of a failed job: the last printed line, or the exit status; empty for a job that succeeded."""
        if self.end.exit_status == 0:
            return ""
        return (self.end.output.strip().splitlines() or [f"exit status {self.end.exit_status}"])[-1]


class Executor(Protocol):
    """Runs jobs. ``jobs`` is the number that may run in parallel; ``run`` waits for the end of one."""

    @property
    def jobs(self) -> int:
        """Number of parallel jobs."""

    def run(self, job: ChildJob, abandon: Callable[[], bool]) -> JobEnd:
        """Run a job to its end; ``abandon`` is polled, and true kills it."""


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
        write_files(folder, job.inputs)
        end = run_child(
            command, folder, timeout_s=job.timeout_s, stdin_text=job.stdin_text, environment=job.environment,
            abandon=abandon,
        )  # fmt: skip
        return JobEnd(end, {k: v for name in job.outputs for k, v in read_files(folder, name).items()})


def read_files(folder: Path, name: str) -> dict[str, bytes]:
    """Contents of a file, or of all files below a folder, by path relative to ``folder``; empty if it is missing."""
    path = folder / name
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files if file.is_file()}


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files by relative path. Raises DataError if a path leads out of the folder; no file is written then."""
    root = folder.resolve()
    for name in files:
        if Path(name).is_absolute() or not (root / name).resolve().is_relative_to(root):
            raise DataError(f"'{name}' is not a path within the folder of a job; nothing was written.")
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
