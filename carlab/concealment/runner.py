"""A proof from cases to scores: make and seal, diagnose in child processes, open the seal. Resumes where it stopped.

Folder of a proof:

    seal.json            the hash, made known before the first diagnosis
    handed/NAME/         fit.csv, hold.csv, car.toml: all that a diagnosis gets (copied into a fresh folder elsewhere)
    answers/             plan, names, nonce and one answer a case; no child process is told of it
    reports/NAME/        report.json and run.json (exit status, seconds)
    oracle/NAME/         the same, where the tool was told the names
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from carlab.concealment.base_car import BaseCar
from carlab.concealment.measurement import COLUMNS, read_csv, write_csv
from carlab.concealment.proof_set import CaseSpec
from carlab.concealment.seal import check, digest, file_digest, new_name, new_nonce
from carlab.concealment.set_check import CHEAP, indistinguishable
from carlab.core.errors import DataError

Progress = Callable[[str, int, int, str], None]
DIAGNOSE = (sys.executable, "-m", "carlab", "diagnose")
FILES = ("fit.csv", "hold.csv", "car.toml")
_TAIL = 2000


def silent(stage: str, done: int, total: int, note: str) -> None:
    """Report nothing."""


class Proof:
    """One proof on disk.

    Args:
        root: Folder of the proof; made where it is not there.
        specs: The cases. A folder that was begun with other ones is refused.
        command: How a diagnosis is started; ``fit.csv --car car.toml --holdout hold.csv --out out`` is appended, and
            ``--effects ID ...`` where the tool is told the names.
        progress: Called with stage (``make``, ``seal``, ``diagnose``, ``oracle``), done, total and a note.
        timeout_s: A diagnosis that takes longer is ended and counts as failed.
        stop_requested: Asked between cases; True ends the stage early, to be resumed by the next call.
    """

    def __init__(
        self,
        root: Path,
        specs: Sequence[CaseSpec],
        *,
        command: Sequence[str] = DIAGNOSE,
        progress: Progress = silent,
        timeout_s: float = 1800.0,
        stop_requested: Callable[[], bool] = lambda: False,
    ) -> None:
        self.root = root
        self.specs = list(specs)
        self.command = tuple(command)
        self.progress = progress
        self.timeout_s = timeout_s
        self.stop_requested = stop_requested
        self._answers = root / "answers"

    def make(self) -> str | None:
        """Make the cases that are not there yet, then seal. Returns the seal's hash, None where it was stopped."""
        names = self._names()
        for done, (name, spec) in enumerate(zip(names, self.specs, strict=True)):
            if (self._answers / f"{name}.json").exists():
                continue
            if self.stop_requested():
                return None
            self.progress("make", done, len(names), "")
            self._make_one(name, spec)
        return self.seal()

    def seal(self) -> str:
        """Hash the answers, once; the hash is in seal.json and told to ``progress``."""
        path = self.root / "seal.json"
        if not path.exists():
            nonce = new_nonce()
            answers = self._load_answers()
            _write(self._answers / "nonce.json", {"nonce": nonce})
            _write(path, {"sha256": digest(answers, nonce), "cases": len(answers)})
        sealed = str(_read(path)["sha256"])
        self.progress("seal", len(self.specs), len(self.specs), sealed)
        return sealed

    def diagnose(self, *, oracle: bool = False) -> bool:
        """Diagnose every case that has no report yet; with ``oracle`` the single and paired ones, told their names.

        Returns whether all are done. Raises DataError where nothing is sealed yet.
        """
        if not (self.root / "seal.json").exists():
            raise DataError("Seal the answers before the first diagnosis: call make() first.")
        names = sorted(self._names())  # sorted: random names give a random order of kinds
        told: dict[str, tuple[str, ...]] = {}
        if oracle:
            by_name = dict(zip(self._names(), self.specs, strict=True))
            told = {n: by_name[n].effects for n in names if by_name[n].kind in ("single", "pair")}
            names = list(told)
        folder = self.root / ("oracle" if oracle else "reports")
        for done, name in enumerate(names):
            if (folder / name / "run.json").exists():
                continue
            if self.stop_requested():
                return False
            self.progress("oracle" if oracle else "diagnose", done, len(names), name)
            self._diagnose_one(name, folder / name, told.get(name, ()))
        return True

    def open_seal(self) -> dict[str, Any]:
        """The answers by name, after the seal has been checked. Raises DataError where anything was changed."""
        answers = self._load_answers()
        check(answers, str(_read(self._answers / "nonce.json")["nonce"]), str(_read(self.root / "seal.json")["sha256"]))
        for name, answer in answers.items():
            for file, sha in answer["files"].items():
                if file_digest(self.root / "handed" / name / file) != sha:
                    raise DataError(
                        f"The seal is broken: {name}/{file} is not the file that was sealed; the run is void."
                    )
        return answers

    def reports(self, *, oracle: bool = False) -> dict[str, dict[str, Any]]:
        """What the diagnoses left, by name: ``report`` (None where there is none), ``exit_status``, ``seconds``."""
        found = {}
        folder = self.root / ("oracle" if oracle else "reports")
        for run in sorted(folder.glob("*/run.json")):
            report = run.with_name("report.json")
            entry = _read(run)
            try:
                entry["report"] = _read(report) if report.exists() else None
            except ValueError:
                entry["report"] = None
            found[run.parent.name] = entry
        return found

    def same(self, name: str, one: str, other: str) -> bool | None:
        """Whether the generator's own refit cannot tell two effects apart on a case; None where it has no opinion."""
        answer = _read(self._answers / f"{name}.json")
        if answer["fault"] is not None or any(effect not in CHEAP for effect in (one, other)):
            return None
        folder = self.root / "handed" / name
        fit, hold = (read_csv(folder / file) for file in FILES[:2])
        floor = np.array([answer["floor"][channel] for channel in COLUMNS[1:7]])
        return indistinguishable(one, other, BaseCar.read(folder / "car.toml"), fit, hold, floor)

    def _names(self) -> list[str]:
        path = self._answers / "plan.json"
        plan = json.loads(json.dumps([spec.as_dict() for spec in self.specs]))
        if not path.exists():
            self._answers.mkdir(parents=True, exist_ok=True)
            _write(path, {"plan": plan, "names": [new_name() for _ in plan]})
        kept = _read(path)
        if kept["plan"] != plan:
            raise DataError(f"{self.root} was begun with other cases; give it those, or another folder.")
        return list(kept["names"])

    def _make_one(self, name: str, spec: CaseSpec) -> None:
        begin = time.perf_counter()
        case = spec.make()
        folder = self.root / "handed" / name
        folder.mkdir(parents=True, exist_ok=True)
        write_csv(folder / "fit.csv", case.fit)
        write_csv(folder / "hold.csv", case.hold)
        case.nominal.write(folder / "car.toml")
        answer = case.answer()
        answer["files"] = {file: file_digest(folder / file) for file in FILES}
        answer["seconds_to_make"] = round(time.perf_counter() - begin, 3)
        _write(self._answers / f"{name}.json", answer)

    def _load_answers(self) -> dict[str, Any]:
        return {name: _read(self._answers / f"{name}.json") for name in self._names()}

    def _diagnose_one(self, name: str, to: Path, told: tuple[str, ...]) -> None:
        with tempfile.TemporaryDirectory(prefix="diagnosis-") as fresh:
            here = Path(fresh)
            for file in FILES:
                shutil.copyfile(self.root / "handed" / name / file, here / file)
            command = [*self.command, "fit.csv", "--car", "car.toml", "--holdout", "hold.csv", "--out", "out"]
            if told:
                command += ["--effects", *told]
            begin = time.perf_counter()
            status, words = _run(command, here, self.timeout_s)
            seconds = time.perf_counter() - begin
            to.mkdir(parents=True, exist_ok=True)
            for file in ("report.json", "model.toml"):
                if (here / "out" / file).exists():
                    shutil.copyfile(here / "out" / file, to / file)
        _write(to / "run.json", {"exit_status": status, "seconds": round(seconds, 3), "words": words[-_TAIL:]})


def _run(command: Sequence[str], folder: Path, timeout_s: float) -> tuple[int | None, str]:
    environment = {k: v for k, v in os.environ.items() if k != "PWD"}
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True,
            timeout=timeout_s, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return None, f"ended after {timeout_s:g} s"
    return done.returncode, done.stdout[-_TAIL:] + done.stderr[-_TAIL:]


def _read(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text()))


def _write(path: Path, value: dict[str, Any]) -> None:
    """Whole or not at all."""
    draft = path.with_suffix(".partial")
    draft.write_text(json.dumps(value, indent=1, allow_nan=False))
    draft.replace(path)
