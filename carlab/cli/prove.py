"""``carlab prove``."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from rich.progress import Progress, TaskID

from carlab.api.arguments import above_zero, at_least, valid_seed
from carlab.cli.console import console, fail, progress, table
from carlab.cli.exit_codes import EXIT_INTERRUPTED
from carlab.core.clock import wall_clock_ns
from carlab.core.errors import ConfigError
from carlab.core.version import VERSION
from carlab.experiment.episodes.interrupts import Interrupts
from carlab.jobs.child_jobs import CARLAB

if TYPE_CHECKING:
    from carlab.benchmark.cases.proof_set import CaseSpec
    from carlab.benchmark.proof.runner import Proof

STAGES = {
    "make": "cases made",
    "diagnose": "cases diagnosed",
    "oracle": "cases diagnosed with the true names",
    "baselines": "cases scored by the baselines",
    "references": "references diagnosed",
    "answer": "cases answered",
}
FOR_RECORDINGS = ("data", "car", "tool")
"""Options of ``--set real`` alone."""
DAY_S = 86400.0
AnyProof = TypeVar("AnyProof")


@dataclass
class Prove:
    """Measure how often a diagnosis is correct, on new recordings with concealed effects and sealed answers.

    Prints a hash of the answers before the first diagnosis. Takes hours (--set short: minutes). ^C ends the proof after
    the running cases, a second ^C at once; the same command continues it. Writes scores.json, confusion.png,
    detection.png and results.md.
    """

    out: Path = Path("proof")
    """Folder of the proof; an unfinished proof with the same options is continued."""

    set: Literal["short", "full", "development", "hard", "hard-development", "real"] = "short"
    """short: five small cases. full: 420 cases of the test set. hard: 308 cases with three to five effects, 30 s of
    recording, a wrong kind of base model, feedback driving only, or jitter in the stamps. development,
    hard-development: as many cases with other seeds, for tuning. real: about 150 cases with effects of commands and
    sensors concealed in recordings of a real car."""

    data: Path | None = None
    """Only --set real: folder with recordings of one car, at least 160 s."""

    car: str = ""
    """Only --set real: car file or preset of that car."""

    tool: Literal["diagnose", "compare"] = "diagnose"
    """Only --set real: the command that is scored. compare also gets the untouched recordings; diagnose gets only their
    model."""

    simulator: Literal["own", "commonroad", "commonroad-drift"] = "own"
    """own: effects concealed by carlab's case generator. commonroad: recordings of an independent simulator, the
    multi-body model of the package commonroad-vehicle-models. commonroad-drift: the single-track drift model of this
    package. The latter two have no seal, and write study.md and study.json."""

    seed: int = 0
    """Seed of the cases."""

    limit: int | None = None
    """Number of cases drawn from the set (of a hard set, equally many of each kind). With --simulator commonroad:
    number of drives, 1 by default."""

    jobs: int = 1
    """Number of parallel cases; with more than one, each case has one thread."""

    ray: str = ""
    """Run the cases on Ray in place of --jobs: local for the cores of this machine, or the address of a cluster with
    the same version of carlab. A case whose worker dies runs again. Needs the extra ray of carlab (see
    "Run on a Ray cluster")."""

    timeout: float = 1800.0
    """Time limit of a diagnosis [s]; a longer diagnosis counts as failed."""

    oracle: bool = True
    """Also diagnose each case with the true names given, for the oracle ratio (the best result that is possible)."""

    baselines: bool = True
    """Also score PySINDy, a Gaussian process, stepwise BIC and cross-correlation on the same cases."""

    calibrate: bool = False
    """Run no case. Print the rates of false and missed names over the range of each decision threshold, from the
    finished diagnoses in the folder. Use it with --set development; never tune thresholds on the test set."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Create and seal the cases, diagnose them, open the seal, and score."""
        from carlab.benchmark.baselines.run import require_studies
        from carlab.benchmark.proof.runner import DIAGNOSE, Proof

        above_zero(jobs=self.jobs, timeout=self.timeout)
        valid_seed(seed=self.seed)
        at_least(1, limit=self.limit)
        self._check_options()
        if self.set == "real":
            return self._real()
        if self.simulator != "own":
            return self._study()
        specs = self._specs()
        if self.calibrate:
            return self._calibrate(Proof(self.out, specs))
        if self.baselines:
            require_studies()
        proof = self._run(partial(Proof, self.out, specs, command=DIAGNOSE), self._stages)
        return EXIT_INTERRUPTED if proof is None else self._score(proof)

    def _run(self, make: Callable[..., AnyProof], stages: Callable[[AnyProof], bool]) -> AnyProof | None:
        """Make a proof with the options of its run, and run its stages; None if it is stopped."""
        from carlab.jobs.ray_executor import chosen_executor

        executor_of_options = chosen_executor(self.ray, self.jobs)
        with Interrupts() as interrupts, executor_of_options as executor, progress(DAY_S) as bar:
            shown = _Bar(bar)
            proof = make(
                progress=shown, timeout_s=self.timeout, executor=executor,
                stop_requested=interrupts.requested.is_set, abandon=interrupts.urgent.is_set,
            )  # fmt: skip
            if stages(proof) and not interrupts.requested.is_set():
                return proof
            fail(f"Stopped with {shown.last}; run the same command to continue.")
            return None

    def _check_options(self) -> None:
        """Raise ConfigError if an option is given that has no effect."""
        use = f"--set {self.set}"
        unused: tuple[str, ...] = ("calibrate",) if self.set == "real" else FOR_RECORDINGS
        if self.simulator != "own":
            use, unused = f"--simulator {self.simulator}", ("set", *FOR_RECORDINGS, "jobs", "ray", "calibrate")
        for option in fields(self):
            if option.name in unused and getattr(self, option.name) != option.default:
                raise ConfigError(f"--{option.name} has no effect with {use}; leave it out.")

    def _real(self) -> int:
        from carlab.benchmark.real.runner import RealProof, drawn_specs
        from carlab.cli.prove_real import car_path, run_stages, score, tables_in

        car, recordings = car_path(self.car, self.out), tables_in(self.data)
        specs, refused = drawn_specs(self.seed, self.limit, recordings)
        if refused:
            console.print(f"Not concealed, because commands would leave [-1, 1]: {', '.join(refused)}.")
        make = partial(RealProof, self.out, specs, recordings, car, tool=self.tool, command=CARLAB)
        if (proof := self._run(make, run_stages)) is None:
            return EXIT_INTERRUPTED
        return score(proof, self.out, lambda runs: self._facts([spec.seed for spec in specs], runs))

    def _study(self) -> int:
        from carlab.benchmark.public_simulators.commonroad import require_public_simulator
        from carlab.benchmark.public_simulators.study import study
        from carlab.benchmark.public_simulators.study_page import TARGET_RATIO

        require_public_simulator()
        seeds = range(self.seed, self.seed + (self.limit or 1))
        with Interrupts() as interrupts:
            rows = study(
                self.out, "multi_body" if self.simulator == "commonroad" else "drift", seeds,
                timeout_s=self.timeout, progress=console.print, abandon=interrupts.requested.is_set,
            )  # fmt: skip
        met = sum(1 for row in rows if row.get("ratio") is not None and row["ratio"] <= TARGET_RATIO)
        console.print(
            f"Held-out error with effects at most {TARGET_RATIO:g} of the refit's: {met} of {len(rows)} drives. "
            f"Read {self.out / 'study.md'}."
        )
        if len(rows) < len(seeds):
            fail(f"Stopped after {len(rows)} of {len(seeds)} drives.")
            return EXIT_INTERRUPTED
        return 0 if all(row["verdict"] for row in rows) else 1

    def _calibrate(self, proof: Proof) -> int:
        from carlab.benchmark.proof.calibration import COLUMNS, calibrate

        decisions = proof.decisions() if (proof.root / "seal.json").exists() else {}
        if not decisions:
            raise ConfigError(
                f"{self.out} has no finished diagnosis with decisions.json; run the same command without --calibrate."
            )
        if not self.set.endswith("development"):
            console.print(f"--set {self.set} is a test set: thresholds must not be chosen on its rates.")
        rates = calibrate(proof.open_seal(), decisions)
        table(f"{len(decisions)} cases; * marks the present value", list(COLUMNS), [r.row() for r in rates])
        return 0

    def _stages(self, proof: Proof) -> bool:
        """Run the stages of a proof until one is stopped; whether all are done."""
        if proof.make() is None or not proof.diagnose():
            return False
        return (not self.oracle or proof.diagnose(oracle=True)) and (not self.baselines or proof.baselines())

    def _specs(self) -> list[CaseSpec]:
        from carlab.benchmark.cases.hard_set import drawn_evenly, hard_set
        from carlab.benchmark.cases.proof_set import MAX_DEVELOPMENT_SEED, MAX_TEST_SEED, drawn, full_set, short_set

        max_seed = MAX_TEST_SEED if self.set in ("full", "short") else MAX_DEVELOPMENT_SEED
        if self.seed > max_seed:
            raise ConfigError(
                f"--seed {self.seed}: --set {self.set} has seeds 0 to {max_seed}; later ones share cases between "
                "development and test."
            )
        if self.set == "short":
            specs = short_set("test", self.seed)
        elif self.set in ("hard", "hard-development"):
            specs = hard_set("test" if self.set == "hard" else "development", self.seed)
            return specs if self.limit is None else drawn_evenly(specs, self.limit, self.seed)
        else:
            specs = full_set("test" if self.set == "full" else "development", self.seed)
        return specs if self.limit is None else drawn(specs, self.limit, self.seed)

    def _score(self, proof: Proof) -> int:
        from carlab.benchmark.baselines.scores import COLUMNS, compare, comparison_rows
        from carlab.benchmark.proof.detection import detection_curves, draw_detection
        from carlab.benchmark.proof.results_page import results_page
        from carlab.benchmark.proof.scores import draw_confusion, score_cases, summarise, table_rows, write_scores

        answers = proof.open_seal()
        console.print("The seal is intact: the answers match the hash.")
        runs = proof.reports()
        with console.status("Scoring"):
            rows = score_cases(answers, runs, proof.reports(oracle=True) if self.oracle else None, proof.same)
        summary = summarise(rows.values())
        comparison = compare(rows, proof.baseline_reports()) if self.baselines else []
        table(f"{len(rows)} cases", ["figure", "value (95 %)", "n", "target"], table_rows(summary))
        if comparison:
            table("Comparison with the baselines, exact names", ["figure", *COLUMNS], comparison_rows(comparison))
        if summary["no_report"]:
            fail(f"{summary['no_report']} diagnoses have no report; results.md lists them with the reasons.")
        write_scores(proof.root / "scores.json", rows, summary, comparison)
        draw_confusion(proof.root / "confusion.png", rows.values())
        draw_detection(proof.root / "detection.png", detection_curves(rows.values()))
        page = results_page(self._facts([spec.seed for spec in proof.specs], runs), rows, runs, summary, comparison)
        (proof.root / "results.md").write_text(page, encoding="utf-8")
        console.print(f"Read {self.out / 'results.md'} and {self.out / 'confusion.png'}; all figures: scores.json.")
        return 0

    def _facts(self, seeds: Sequence[int], runs: Mapping[str, Any]) -> dict[str, str]:
        memory = [run["peak_memory_mib"] for run in runs.values()]
        jobs = sorted({int(run["jobs"]) for run in runs.values()})
        return {
            "date": datetime.fromtimestamp(wall_clock_ns() * 1e-9).astimezone().isoformat(timespec="minutes"),
            "command": f"`{shlex.join(['carlab', *sys.argv[1:]])}`",
            "seeds": f"{min(seeds)} to {max(seeds)} ({len(seeds)} cases)",
            "carlab": f"{VERSION}, {os.cpu_count()} cores, {' and '.join(map(str, jobs))} cases at a time",
            "peak memory of a diagnosis": f"{max(memory, default=0.0):.0f} MiB",
        }


class _Bar:
    """Shows the stages on the console: a bar on a terminal, a line now and then in a file; the seal always."""

    def __init__(self, bar: Progress) -> None:
        self.last = "nothing done"
        self._bar = bar
        self._tasks: dict[str, TaskID] = {}

    def __call__(self, stage: str, done: int, total: int, note: str) -> None:
        """Take one report of the proof."""
        if stage == "seal":
            self._bar.console.print(f"Sealed {total} answers: sha256 {note}", soft_wrap=True)
            return
        self.last = f"{done} of {total} {STAGES[stage]}"
        if stage not in self._tasks:
            self._tasks[stage] = self._bar.add_task(STAGES[stage], total=total, completed=done, note="")
        self._bar.update(self._tasks[stage], completed=done)
        if self._bar.disable and (done == total or done % max(1, total // 20) == 0):
            self._bar.console.print(self.last + self._time_left(stage))

    def _time_left(self, stage: str) -> str:
        remaining_s = next(task.time_remaining for task in self._bar.tasks if task.id == self._tasks[stage])
        return f", about {remaining_s / 60.0:.0f} min left" if remaining_s else ""
