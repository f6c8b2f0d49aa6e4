"""Run of a proof: make and seal cases, diagnose them in child processes, open the seal. A stopped run can resume.

Folder of a proof:

    seal.json            hash, published before the first diagnosis
    handed/NAME/         fit.csv, hold.csv, car.toml: input of a diagnosis (copied into a temporary folder)
    answers/             plan, names, nonce and one answer per case; not accessible to a diagnosis
    reports/NAME/        report.json, decisions.json and run.json (exit status, seconds, peak memory)
    oracle/NAME/         the same for a diagnosis with the true names given
    baselines/NAME.json  results of the baselines
    checks/NAME.json     whether the generator's refit distinguishes the effects of a reported set
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from carlab.benchmark.cases.proof_set import CaseSpec
from carlab.benchmark.cases.set_check import COMMAND_EFFECTS, indistinguishable
from carlab.benchmark.proof.sealed_run import SealedRun
from carlab.benchmark.proof.worker import ANSWER, FILES, SCORES, write_json
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.measurement import COLUMNS, read_csv
from carlab.core.errors import DataError
from carlab.core.json_files import read_json
from carlab.jobs.child_jobs import PYTHON, ChildJob, JobEnd
from carlab.jobs.child_processes import ONE_THREAD, ChildEnd

DIAGNOSE = (PYTHON, "-m", "carlab", "diagnose", "--decisions", "--jobs", "1")
COMPARED = ("single", "multiple", "null", "parameters", "outside")
WITH_EFFECTS = ("single", "pair", "multiple")
WORKER = (PYTHON, "-m", "carlab.benchmark.proof.worker")


class Proof(SealedRun):
    """One proof on disk.

    Args:
        root: Folder of the proof; created if missing.
        specs: The cases; they must equal those of an existing folder.
        command: Command of a diagnosis; ``fit.csv --car car.toml --holdout hold.csv --out out`` is appended, and
            ``--effects ID ...`` if the true names are given.
        options: As for ``SealedRun``; the stages are ``make``, ``seal``, ``diagnose``, ``oracle`` and ``baselines``.
    """

    def __init__(
        self, root: Path, specs: Sequence[CaseSpec], *, command: Sequence[str] = DIAGNOSE, **options: Any
    ) -> None:
        super().__init__(root, [spec.as_dict() for spec in specs], **options)
        self.specs = list(specs)
        self.command = tuple(command)

    def make(self) -> str | None:
        """Make the missing cases, then seal. Returns the hash of the seal, or None if stopped.

        Raises:
            DataError: a case cannot be made.
        """
        specs = dict(zip(self.names(), self.specs, strict=True))

        def make_one(name: str) -> ChildEnd:
            made = self._work("make", {"spec": specs[name].as_dict()}, {}, (*FILES, ANSWER))
            if not made.end.abandoned:
                files = dict(made.outputs)
                answer = json.loads(files.pop(ANSWER))
                JobEnd(made.end, files).write_outputs(self.root / "handed" / name)
                write_json(self.answers_folder / f"{name}.json", answer)
            return made.end

        if not self.stage("make", list(specs), lambda name: (self.answers_folder / f"{name}.json").exists(), make_one):
            return None
        return self.seal()

    def diagnose(self, *, oracle: bool = False) -> bool:
        """Diagnose the cases without a report; with ``oracle`` those with effects, with the true names given.

        Returns whether all are done. Raises DataError before the answers are sealed.
        """
        self.need_seal()
        names = sorted(self.names())  # sorted: random names give a random order of kinds
        true_effects: dict[str, tuple[str, ...]] = {}
        if oracle:
            by_name = dict(zip(self.names(), self.specs, strict=True))
            true_effects = {n: by_name[n].effects for n in names if by_name[n].kind in WITH_EFFECTS}
            names = list(true_effects)
        folder = self.root / ("oracle" if oracle else "reports")
        return self.stage(
            "oracle" if oracle else "diagnose",
            names,
            lambda name: (folder / name / "run.json").exists(),
            lambda name: self._diagnose_one(name, folder / name, true_effects.get(name, ())),
        )

    def baselines(self) -> bool:
        """Run the baselines on cases of the kinds COMPARED, with the same files and the true noise floor.

        Returns whether all are done. Raises DataError before the answers are sealed, or if a baseline fails.
        """
        self.need_seal()
        folder = self.root / "baselines"

        def run_one(name: str) -> ChildEnd:
            floor = read_json(self.answers_folder / f"{name}.json")["floor"]
            scored = self._work("baselines", {"floor": floor}, self._handed(name), (SCORES,))
            if not scored.end.abandoned:
                write_json(folder / f"{name}.json", json.loads(scored.outputs[SCORES]))
            return scored.end

        names = sorted(n for n, spec in zip(self.names(), self.specs, strict=True) if spec.kind in COMPARED)
        return self.stage("baselines", names, lambda name: (folder / f"{name}.json").exists(), run_one)

    def reports(self, *, oracle: bool = False) -> dict[str, dict[str, Any]]:
        """Results of the diagnoses by name: ``report`` (None if missing), ``exit_status``, ``seconds``."""
        return self.results("oracle" if oracle else "reports", "report.json")

    def decisions(self) -> dict[str, dict[str, Any]]:
        """Recorded decisions about effects with their statistics, by name of the case."""
        paths = sorted((self.root / "reports").glob("*/decisions.json"))
        return {path.parent.name: read_json(path) for path in paths}

    def baseline_reports(self) -> dict[str, dict[str, Any]]:
        """Results of the baselines by name of the case."""
        return {path.stem: read_json(path) for path in sorted((self.root / "baselines").glob("*.json"))}

    def same(self, name: str, one: str, other: str) -> bool | None:
        """Whether the generator's refit does not distinguish two effects on a case; None if it does not cover them.

        It covers neither recordings with a fault or delayed stamps nor a wrong base model.
        """
        answer = read_json(self.answers_folder / f"{name}.json")
        unlike = set(answer.get("conditions", ())) - {"short recording", "feedback only"}
        if answer["fault"] is not None or unlike or any(effect not in COMMAND_EFFECTS for effect in (one, other)):
            return None
        path = self.root / "checks" / f"{name}.json"
        known = read_json(path) if path.exists() else {}
        key = " ".join(sorted((one, other)))
        if key not in known:
            folder = self.root / "handed" / name
            fit, hold = (read_csv(folder / file) for file in FILES[:2])
            floor = np.array([answer["floor"][channel] for channel in COLUMNS[1:7]])
            known[key] = indistinguishable(one, other, BaseCar.read(folder / "car.toml"), fit, hold, floor)
            write_json(path, known)
        return None if known[key] is None else bool(known[key])

    def _handed(self, name: str) -> dict[str, bytes]:
        """Contents of the input files of a case."""
        return {file: (self.root / "handed" / name / file).read_bytes() for file in FILES}

    def _work(self, what: str, order: dict[str, Any], inputs: Mapping[str, bytes], outputs: tuple[str, ...]) -> JobEnd:
        job = ChildJob((*WORKER, what), self.timeout_s, inputs, outputs, json.dumps(order), ONE_THREAD)
        done = self.executor.run(job, self.abandon)
        if done.failure and not done.end.abandoned:
            raise DataError(f"A case of the proof failed ({what}): {done.failure}")
        return done

    def _diagnose_one(self, name: str, to: Path, true_effects: tuple[str, ...]) -> ChildEnd:
        command = (*self.command, "fit.csv", "--car", "car.toml", "--holdout", "hold.csv", "--out", "out")
        if true_effects:
            command += ("--effects", *true_effects)
        outputs = ("out/report.json", "out/decisions.json", "out/model.toml")
        return self.run_tool(command, self._handed(name), outputs, to)
