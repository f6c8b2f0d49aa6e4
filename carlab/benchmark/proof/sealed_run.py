"""Cases on disk whose answers are sealed before the first diagnosis; stages that can be stopped and resumed."""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

from carlab.benchmark.cases.seal import check, digest, file_digest
from carlab.benchmark.proof.worker import write_json
from carlab.core.errors import DataError
from carlab.core.json_files import read_json
from carlab.jobs.child_jobs import ChildJob, Executor, LocalExecutor
from carlab.jobs.child_processes import ONE_THREAD, ChildEnd, run_parallel

Progress = Callable[[str, int, int, str], None]
LOCAL = LocalExecutor()


@dataclass
class SealedRun:
    """Folder with ``seal.json``, ``handed/NAME/`` (input of the tool) and ``answers/`` (not accessible to the tool).

    Attributes:
        root: Folder; created if missing.
        plan: The cases as JSON; they must equal those of an existing folder.
        progress: Called with stage, done, total and a note.
        timeout_s: Time-out of a child process.
        stop_requested: Called before each case; True ends the stage after the running cases.
        abandon: Polled; True kills the running cases, which are repeated when the stage is resumed.
        executor: Runs the child processes; with more than one job in parallel, each uses one thread.
    """

    root: Path
    plan: Sequence[Mapping[str, Any]]
    _: KW_ONLY
    progress: Progress = lambda stage, done, total, note: None
    timeout_s: float = 1800.0
    stop_requested: Callable[[], bool] = lambda: False
    abandon: Callable[[], bool] = lambda: False
    executor: Executor = LOCAL

    def __post_init__(self) -> None:
        self.root = self.root.absolute()
        self.answers_folder = self.root / "answers"
        self.plan = json.loads(json.dumps(list(self.plan)))  # as it is read from plan.json

    @property
    def environment(self) -> Mapping[str, str]:
        """Changes to the environment of a diagnosis: one thread if several run in parallel."""
        return ONE_THREAD if self.executor.jobs > 1 else {}

    def names(self) -> list[str]:
        """Random names of the cases, in the order of the plan. Raises DataError if the folder has another plan."""
        path = self.answers_folder / "plan.json"
        if not path.exists():
            foreign = [p.name for p in self.root.iterdir() if p.suffix != ".toml"] if self.root.is_dir() else []
            if foreign:
                raise DataError(f"{self.root} contains other files ({foreign[0]}); name a new folder for the proof.")
            write_json(path, {"plan": self.plan, "names": [secrets.token_hex(8) for _ in self.plan]})
        stored = read_json(path)
        if stored["plan"] != self.plan:
            raise DataError(
                f"{self.root} contains a proof of other cases or files; use the same ones or another folder."
            )
        return list(stored["names"])

    def seal(self) -> str:
        """Hash the answers once; the hash is written to seal.json and passed to ``progress``."""
        path = self.root / "seal.json"
        if not path.exists():
            nonce = secrets.token_hex(32)
            answers = self._load_answers()
            write_json(self.answers_folder / "nonce.json", {"nonce": nonce})
            write_json(path, {"sha256": digest(answers, nonce), "cases": len(answers)})
        sealed = read_json(path)
        self.progress("seal", sealed["cases"], sealed["cases"], sealed["sha256"])
        return str(sealed["sha256"])

    def open_seal(self) -> dict[str, Any]:
        """Check the seal and return the answers by name. Raises DataError if an answer or file was changed."""
        answers = self._load_answers()
        nonce = str(read_json(self.answers_folder / "nonce.json")["nonce"])
        check(answers, nonce, str(read_json(self.root / "seal.json")["sha256"]))
        for name, answer in answers.items():
            for file, sha in answer["files"].items():
                if file_digest(self.root / "handed" / name / file) != sha:
                    raise DataError(
                        f"The seal is broken: {name}/{file} differs from the sealed file; repeat the proof."
                    )
        return answers

    def need_seal(self) -> None:
        """Raise DataError before the answers are sealed."""
        if not (self.root / "seal.json").exists():
            raise DataError("Seal the answers before the first diagnosis: call make() first.")

    def stage(
        self, stage: str, names: Sequence[str], there: Callable[[str], bool], work: Callable[[str], ChildEnd]
    ) -> bool:
        """Do the work of every name that is not there; returns whether all is done."""
        todo = [name for name in names if not there(name)]
        done = len(names) - len(todo)
        self.progress(stage, done, len(names), "")
        stopped = False

        def finished(name: str, end: ChildEnd) -> None:
            nonlocal done, stopped
            if end.abandoned:
                stopped = True
                return
            done += 1
            self.progress(stage, done, len(names), name)

        complete = run_parallel(
            self.executor.jobs,
            todo,
            work,
            stop_requested=lambda: self.stop_requested() or self.abandon(),
            finished=finished,
        )
        return complete and not stopped

    def run_tool(
        self, command: tuple[str, ...], inputs: Mapping[str, bytes], outputs: tuple[str, ...], to: Path
    ) -> ChildEnd:
        """Run the tool on one case; unless it is abandoned, its outputs and ``run.json`` are written into ``to``.

        ``run.json`` has the exit status (None after a time-out or the loss of a worker, which the output states), the
        end of the output, seconds, peak memory, and the number of parallel jobs.
        """
        job = ChildJob(command, self.timeout_s, inputs, outputs, environment=self.environment)
        done = self.executor.run(job, self.abandon)
        end = done.end
        if not end.abandoned:
            done.write_outputs(to)
            run = {"exit_status": end.exit_status, "output": end.output, "jobs": self.executor.jobs}
            times = {"seconds": round(end.seconds, 3), "peak_memory_mib": round(end.peak_memory_mib, 1)}
            write_json(to / "run.json", run | times)
        return end

    def results(self, folder: str, file: str) -> dict[str, dict[str, Any]]:
        """``run.json`` of each case with its ``report`` from another file (None if missing or not JSON)."""
        found = {}
        for run in sorted((self.root / folder).glob("*/run.json")):
            report = run.with_name(file)
            entry = read_json(run)
            try:
                entry["report"] = read_json(report) if report.exists() else None
            except ValueError:
                entry["report"] = None
            found[run.parent.name] = entry
        return found

    def _load_answers(self) -> dict[str, Any]:
        return {name: read_json(self.answers_folder / f"{name}.json") for name in self.names()}
