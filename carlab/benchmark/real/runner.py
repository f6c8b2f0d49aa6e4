"""Run of a proof on real recordings. A stopped run can resume.

Folder of a proof, in addition to that of ``SealedRun``:

    references/K/        untouched_1.csv ..., car.toml: input of the diagnosis of reference K; out/model.toml
    handed/NAME/         other_1.csv ...: the recordings of a case
    answered/NAME/       the tool's report, run.json (exit status, seconds, peak memory)
"""

from __future__ import annotations

import dataclasses
import hashlib
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import tomli_w

from carlab.benchmark.cases.proof_set import drawn
from carlab.benchmark.cases.seal import file_digest
from carlab.benchmark.effects.data_faults import Table
from carlab.benchmark.proof.sealed_run import SealedRun
from carlab.benchmark.proof.worker import write_json
from carlab.benchmark.real.cases import (
    MAX_PARTS,
    PIECE_S,
    RealCaseSpec,
    case_specs,
    make_real_case,
    parts,
    reference,
    with_full_lock,
    write_tables,
)
from carlab.benchmark.real.kinds import FULL_LOCK, KINDS
from carlab.benchmark.world.measurement import COLUMNS
from carlab.core.errors import ConfigError, DataError
from carlab.core.json_files import read_json
from carlab.jobs.child_jobs import CARLAB, ChildJob
from carlab.jobs.child_processes import ChildEnd

OTHER, CAR, MODEL = "other_{}.csv", "car.toml", "model.toml"
ONE_PROCESS = ("--jobs", "1")
REFERENCE_OPTIONS = ("--effects", "command_delay", "--curves", *ONE_PROCESS)
Tool = Literal["compare", "diagnose"]
CONCEALABLE_EFFECTS = tuple(sorted({name for kind in KINDS for name in kind.names if "." not in name}))


class RealProof(SealedRun):
    """One proof on real recordings on disk.

    Args:
        root: Folder of the proof.
        specs: The cases.
        recordings: Recordings by name, with the columns of ``measurement.COLUMNS``.
        car: TOML file of the car.
        tool: The command that answers. ``compare`` gets the untouched recordings, those of the case and the model of
            the reference; ``diagnose`` does not get the untouched ones, and searches the effects of commands and
            sensors only.
        command: The program, without the name of a command.
        options: As for ``SealedRun``.
    """

    def __init__(
        self,
        root: Path,
        specs: Sequence[RealCaseSpec],
        recordings: Mapping[str, Table],
        car: Path,
        *,
        tool: Tool,
        command: Sequence[str] = CARLAB,
        **options: Any,
    ) -> None:
        super().__init__(root, _plan(specs, recordings, car, tool), **options)
        self.specs = list(specs)
        self.recordings = {name: with_full_lock(table) for name, table in recordings.items()}
        self.car = car
        self.tool = tool
        self.command = tuple(command)
        self.report_file = "compare.json" if tool == "compare" else "report.json"
        self.parts = parts(self.recordings)

    def case_names(self) -> list[str]:
        """Random names of the cases."""
        return self.names()[: len(self.specs)]

    def make(self) -> str:
        """Make the missing cases and the input of the references, then seal. Returns the hash of the seal."""
        for name, spec in zip(self.case_names(), self.specs, strict=True):
            path = self.answers_folder / f"{name}.json"
            if not path.exists():
                number, tables, answer = make_real_case(spec, self.recordings, self.parts)
                folder = self.root / "handed" / name
                files = write_tables(folder, {OTHER.format(k + 1): table for k, table in enumerate(tables)})
                write_json(path, {**answer, "reference": number, "files": files})
        for number, part in enumerate(self.parts):
            folder = self.root / "references" / str(number)
            if not (folder / CAR).exists():
                untouched = reference(self.recordings, part)
                write_tables(folder, {f"untouched_{k + 1}.csv": table for k, table in enumerate(untouched)})
                write_smaller_unit(self.car, folder / CAR)
        return self.seal()

    def diagnose_references(self) -> bool:
        """Diagnose the references that cases need; returns whether all are done.

        Raises:
            DataError: before the answers are sealed, or if a diagnosis fails.
        """
        self.need_seal()
        needed = sorted({str(self._answer(name)["reference"]) for name in self.case_names()})
        folder = self.root / "references"
        return self.stage(
            "references", needed, lambda k: (folder / k / "out" / MODEL).exists(), lambda k: self._reference(folder / k)
        )

    def answer(self) -> bool:
        """Let the tool answer the cases without an answer; returns whether all are done."""
        self.need_seal()
        folder = self.root / "answered"
        names = sorted(self.case_names())  # random names give a random order of kinds
        return self.stage("answer", names, lambda name: (folder / name / "run.json").exists(), self._answer_one)

    def reports(self) -> dict[str, dict[str, Any]]:
        """The tool's report and ``run.json`` by name of the case."""
        return self.results("answered", self.report_file)

    def models(self) -> dict[str, dict[str, Any]]:
        """The model of the reference of each case, parsed."""
        return {name: tomllib.loads(self._model(name).read_text(encoding="utf-8")) for name in self.case_names()}

    def _answer(self, name: str) -> dict[str, Any]:
        return read_json(self.answers_folder / f"{name}.json")

    def _load_answers(self) -> dict[str, Any]:
        return {name: self._answer(name) for name in self.case_names()}

    def _model(self, name: str) -> Path:
        return self.root / "references" / str(self._answer(name)["reference"]) / "out" / MODEL

    def _reference(self, folder: Path) -> ChildEnd:
        inputs = {path.name: path.read_bytes() for path in (*sorted(folder.glob("untouched_*.csv")), folder / CAR)}
        recordings = [name for name in inputs if name != CAR]
        command = (*self.command, "diagnose", *recordings, "--car", CAR, "--out", "out", *REFERENCE_OPTIONS)
        job = ChildJob(command, self.timeout_s, inputs, (f"out/{MODEL}",), environment=self.environment)
        done = self.executor.run(job, self.abandon)
        if not done.end.abandoned:
            if not done.outputs:
                raise DataError(f"The diagnosis of a reference failed: {done.failure or 'it wrote no model.toml'}")
            done.write_outputs(folder / "out")
        return done.end

    def _answer_one(self, name: str) -> ChildEnd:
        untouched = sorted(self._model(name).parents[1].glob("untouched_*.csv"))
        others = sorted((self.root / "handed" / name).glob(OTHER.format("*")))
        changed = [path.name for path in others]
        if self.tool == "compare":
            arguments = [*(path.name for path in untouched), "--with", *changed]
        else:
            arguments = [*changed, "--effects", *CONCEALABLE_EFFECTS, *ONE_PROCESS]
        command = (*self.command, self.tool, *arguments, "--car", MODEL, "--out", "out")
        inputs = {path.name: path.read_bytes() for path in (*untouched, self._model(name), *others)}
        return self.run_tool(command, inputs, (f"out/{self.report_file}",), self.root / "answered" / name)


def write_smaller_unit(car: Path, to: Path) -> None:
    """Write a car file for recordings whose full lock is ``FULL_LOCK``. Raises ConfigError without its max_angle."""
    values = tomllib.loads(car.read_text(encoding="utf-8"))
    try:
        steering = values["steering"]
        angle = steering["max_angle"]
    except KeyError as error:
        raise ConfigError(f"{car} does not state steering.max_angle; add it.") from error
    entry = {k: v / FULL_LOCK for k, v in angle.items()} if isinstance(angle, dict) else angle / FULL_LOCK
    values["steering"] = {**steering, "max_angle": entry}
    to.parent.mkdir(parents=True, exist_ok=True)
    to.write_text(tomli_w.dumps(values), encoding="utf-8")


def drawn_specs(seed: int, limit: int | None, recordings: Mapping[str, Table]) -> tuple[list[RealCaseSpec], list[str]]:
    """Cases of a seed, at most ``limit`` drawn without replacement, and the kinds that no recording allows."""
    in_unit = {name: with_full_lock(table) for name, table in recordings.items()}
    left_out = parts(in_unit)
    usable: list[RealCaseSpec] = []
    refused: set[str] = set()
    for spec in case_specs(seed):
        try:
            make_real_case(spec, in_unit, left_out)
        except DataError:
            refused.update(spec.kinds)
        else:
            usable.append(spec)
    allowed = {name for spec in usable for name in spec.kinds}
    return usable if limit is None else drawn(usable, limit, seed), sorted(refused - allowed)


def _plan(
    specs: Sequence[RealCaseSpec], recordings: Mapping[str, Table], car: Path, tool: Tool
) -> list[dict[str, Any]]:
    rules = {
        "recordings": {name: _digest(table) for name, table in recordings.items()},
        "car": file_digest(car), "tool": tool, "piece_s": PIECE_S, "max_parts": MAX_PARTS,
    }  # fmt: skip
    return [*(dataclasses.asdict(spec) for spec in specs), rules]


def _digest(table: Table) -> str:
    return hashlib.sha256(b"".join(table[name].tobytes() for name in COLUMNS)).hexdigest()
