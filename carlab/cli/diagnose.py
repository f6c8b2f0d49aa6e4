"""``carlab diagnose``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from carlab.cli.console import console, fail
from carlab.cli.exit_codes import EXIT_INCONCLUSIVE
from carlab.cli.options import arguments_of, report_folder
from carlab.cli.recordings import print_errors
from carlab.cli.runs import search_callbacks

if TYPE_CHECKING:
    from carlab.diagnosis.findings import Diagnosis


@dataclass
class Diagnose:
    """Identify physics that recordings show and a simulator lacks, and validate it on held-out recordings.

    Writes report.html, report.json, report.rrd, summary.png and model.toml (the car file with the identified effects
    and parameters). ^C ends the search; the report then has the effects found so far. A second ^C ends at once, without
    a report. Exit code 0 with a verdict, 5 if the recordings are not sufficient for a verdict.
    """

    recordings: Positional[tuple[Path, ...]]
    """MCAP or CSV files to fit, or run folders. Every third episode of a run folder is held out."""

    car: str = "sim"
    """Simulator to diagnose: a car file, a preset (eth_rc_car, dart_jetracer ...), or sim (the default car)."""

    held_out: Annotated[tuple[Path, ...], arg(aliases=("--holdout",))] = ()
    """Held-out recordings: no fit uses them. By default the last part of each recording is held out."""

    holdout_share: float | None = None
    """Length of the held-out last part as a share of the recording, above 0 and at most 0.5; 0.3 by default."""

    out: Path = Path("diagnosis")
    """Folder for the report; an earlier report in it is replaced."""

    budget_s: Annotated[float, arg(name="budget")] = 300.0
    """Time limit [s] of the diagnosis without measured curves, networks and adaptation; inf: no limit. The search for
    effects ends at 60 % of the limit. The report then has the effects found so far and says that the search was cut
    short. The checks after such a search can exceed the limit."""

    jobs: int | None = None
    """Number of processes that share the fits; the result is the same for each number. By default one for short
    recordings, and one for each core for recordings of two minutes or more."""

    effects: tuple[str, ...] = ()
    """Restrict the search to these effects of the catalogue."""

    curves: bool = False
    """Fit measured curves (drive force, steering, tyres) if the named effects leave more than a tenth of the refit's
    squared excess (error above the noise floor)."""

    ceiling: bool = False
    """Train a black box (networks without a simulator), to show how much of the error can be predicted at all. Needs 60
    s of driving."""

    adapt: bool = False
    """Adapt the simulator along the held-out recordings, and report what changed in the car since the fitted
    recordings."""

    keep_events: bool = False
    """Also fit and score prediction windows with events (collisions, a hand that moves the car). By default they are
    listed and left out."""

    discrepancy: bool = False
    """Train networks that correct the accelerations of the diagnosed simulator, and report their error. Needs 60 s of
    driving."""

    seed: int = 0
    """Seed of the black box and of the learned discrepancy; the rest of a diagnosis draws no random numbers."""

    decisions: bool = False
    """Also write decisions.json: the statistics and thresholds of each decision about an effect."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Diagnose and print the verdict."""
        from carlab.api import diagnose

        report_folder(self.out)
        with search_callbacks("diagnosis") as callbacks:
            report = diagnose(**arguments_of(self, diagnose), **callbacks)
        if not report.is_conclusive:
            fail(report.sentence)
            return 0 if report.verdict == "data" else EXIT_INCONCLUSIVE
        if self.decisions:
            report.save_decisions(self.out)
        self._print(report.diagnosis)
        return 0

    def _print(self, diagnosis: Diagnosis) -> None:
        from carlab.diagnosis.report.curves import ceiling_sentence, curve_sentences, curves_advice
        from carlab.diagnosis.report.drift import drift_sentences
        from carlab.diagnosis.report.events import diagnosed_event_sentences
        from carlab.diagnosis.report.residual import shown_errors

        if diagnosis.data_faults:
            faults = dict.fromkeys(f"{fault.id.replace('_', ' ')} ({fault.channel})" for fault in diagnosis.data_faults)
            console.print(f"Faults of the recordings (listed in the report): {', '.join(faults)}.")
        console.print(diagnosis.sentence)
        for effect in diagnosis.effects:
            console.print(f"  {effect.sentence}")
        for sentence in (*curve_sentences(diagnosis), ceiling_sentence(diagnosis), *drift_sentences(diagnosis)):
            console.print(f"  {sentence}" if sentence else "", end="\n" if sentence else "")
        for sentence in diagnosed_event_sentences(diagnosis):
            console.print(f"  {sentence}")
        print_errors(f"Error after {diagnosis.horizon_s:.1f} s", "held out", shown_errors(diagnosis))
        if not self.curves and (advice := curves_advice(diagnosis)):
            console.print(advice)
        console.print(
            f"Read {self.out / 'report.html'}; simulate the diagnosed car with --car {self.out / 'model.toml'}."
        )
