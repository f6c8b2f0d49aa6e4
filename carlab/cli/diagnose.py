"""``carlab diagnose``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from carlab.api.diagnosis import diagnose
from carlab.api.loaded_recordings import INCOMPLETE_FILE
from carlab.cli.console import console, fail
from carlab.cli.exit_codes import EXIT_INCONCLUSIVE
from carlab.cli.options import ARGUMENT_DEFAULT, arguments_of, check_folder, options_of
from carlab.cli.recordings import print_errors
from carlab.cli.runs import search_callbacks
from carlab.core.errors import ConfigError

if TYPE_CHECKING:
    from carlab.diagnosis.findings import Diagnosis


@dataclass
@options_of(diagnose)
class Diagnose:
    """Identify physics that recordings show and a simulator lacks, and validate it on held-out recordings.

    Writes report.html, report.json, report.rrd, summary.png and model.toml (the car file with the identified effects
    and parameters). ^C ends the search; the report then has the effects found so far. A second ^C ends at once, without
    a report. Exit code 0 with a verdict, 5 if the recordings are not sufficient for a verdict.
    """

    recordings: Positional[tuple[Path, ...]]
    """MCAP or CSV files to fit, or run folders. Every third episode of a run folder is held out."""

    car: str = ARGUMENT_DEFAULT
    held_out: Annotated[tuple[Path, ...] | None, arg(aliases=("--holdout",))] = None
    holdout_share: float | None = ARGUMENT_DEFAULT

    out: Path = Path("diagnosis")
    """Folder for the report; an earlier report in it is replaced."""

    budget_s: Annotated[float, arg(name="budget")] = ARGUMENT_DEFAULT
    jobs: int | None = ARGUMENT_DEFAULT
    effects: tuple[str, ...] = ARGUMENT_DEFAULT
    curves: bool = ARGUMENT_DEFAULT
    ceiling: bool = ARGUMENT_DEFAULT
    adapt: bool = ARGUMENT_DEFAULT
    keep_events: bool = ARGUMENT_DEFAULT
    discrepancy: bool = ARGUMENT_DEFAULT
    seed: int = ARGUMENT_DEFAULT

    decisions: bool = False
    """Also write decisions.json: the statistics and thresholds of each decision about an effect."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Diagnose and print the verdict."""
        if self.held_out == ():
            raise ConfigError("--held-out names no recording; name one or more after it, or remove the option.")
        check_folder(self.out, f"--out {self.out}")
        arguments = arguments_of(self, diagnose) | {"held_out": self.held_out or ()}
        with search_callbacks("diagnosis") as callbacks:
            report = diagnose(**arguments, **callbacks)
        for fault in report.diagnosis.data_faults:
            if fault.id == INCOMPLETE_FILE:
                console.print(f"{fault.channel}: {fault.action}", style="yellow", soft_wrap=True)
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
        from carlab.diagnosis.report.effect_lines import effect_lines
        from carlab.diagnosis.report.events import diagnosed_event_sentences
        from carlab.diagnosis.report.numbers import percent
        from carlab.diagnosis.report.residual import shown_errors
        from carlab.diagnosis.report.sentences import withdrawal_sentences

        others = [fault for fault in diagnosis.data_faults if fault.id != INCOMPLETE_FILE]
        if others:
            faults = dict.fromkeys(f"{fault.id.replace('_', ' ')} ({fault.channel})" for fault in others)
            console.print(f"Faults of the recordings (listed in the report): {', '.join(faults)}.")
        console.print(diagnosis.sentence)
        sentences = effect_lines(diagnosis) + curve_sentences(diagnosis)
        sentences += [ceiling_sentence(diagnosis), *drift_sentences(diagnosis), *diagnosed_event_sentences(diagnosis)]
        sentences += withdrawal_sentences(diagnosis)
        for sentence in filter(None, sentences):
            console.print(f"  {sentence}")
        share = diagnosis.held_out_share
        part = "" if share is None else f" in the last {percent(share)} of each recording, which no fit uses"
        print_errors(f"Error after {diagnosis.horizon_s:.1f} s{part}", "held out", shown_errors(diagnosis))
        if not self.curves and (advice := curves_advice(diagnosis)):
            console.print(advice)
        console.print(
            f"Read {self.out / 'report.html'}; simulate the diagnosed car with --car {self.out / 'model.toml'}."
        )
