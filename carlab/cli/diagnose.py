"""``carlab diagnose``."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from carlab.cli.console import console, fail, progress, table
from carlab.cli.options import required_file
from carlab.cli.recordings import is_csv
from carlab.core.errors import ConfigError

if TYPE_CHECKING:
    from carlab.core.episode_data import EpisodeData
    from carlab.diagnosis.findings import DataFault, Diagnosis, RecordingUse, Verdict

EXIT_INCONCLUSIVE = 5
DATA_FAULTS = (
    *("yaw_wrap_spikes", "outliers", "dropouts", "stale_samples", "clock_drift", "column_shift", "column_scale"),
    *("wrong_unit", "wrong_sign", "wrong_frame", "integration_error"),
)


@dataclass
class Diagnose:
    """Find what a simulator leaves out of recordings: locate it, name it, model it, and show the held-out fit improve.

    Writes report.html, report.json, report.rrd, summary.png and model.toml (the car file with what was found). ^C ends
    the search and reports what was found until then. Exit code 0 with a verdict, 5 where the recordings cannot tell.
    """

    recordings: Positional[tuple[Path, ...]]
    """MCAP or CSV files to fit, or folders of runs: every third episode of a run is held out."""

    car: str = "sim"
    """Simulator to question: a car file, a car that comes along (eth_rc_car, dart_jetracer ...), or sim."""

    holdout: tuple[Path, ...] = ()
    """Recordings that only judge; without any, the last part of each recording is held out."""

    holdout_share: float | None = None
    """How much of each recording that is, above 0 and at most 0.5; 0.3 unless given."""

    out: Path = Path("diagnosis")
    """Folder for the report."""

    effects: tuple[str, ...] = ()
    """Try only these effects of the catalogue."""

    seed: int = 0
    """Written into the report; a diagnosis draws no random numbers."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Diagnose and print the verdict."""
        from carlab.cars import default_car, load_car_file
        from carlab.diagnosis.diagnose import HOLDOUT_SHARE, Inconclusive, diagnose
        from carlab.diagnosis.judge import Texts
        from carlab.diagnosis.report import write_report
        from carlab.diagnosis.report_text import LOOK_ALIKES, effect_sentence, separating_drive
        from carlab.experiment.interrupts import Interrupts
        from sim_backends.effects import EFFECTS

        if not self.recordings:
            raise ConfigError("Name at least one recording to fit, for example carlab diagnose drive.mcap.")
        for name in self.effects:
            if name not in EFFECTS:
                raise ConfigError(f"There is no effect '{name}'; there are: {', '.join(EFFECTS)}.")
        of_runs = [_of_run(path) for path in self.recordings]
        to_fit = tuple(path for fitted, _ in of_runs for path in fitted)
        to_judge = (*self.holdout, *(path for _, held_out in of_runs for path in held_out))
        same = {p.resolve() for p in to_fit} & {p.resolve() for p in to_judge}
        if same:
            raise ConfigError(f"{min(same).name} is both fitted and held out; a judge must not be a witness.")
        if self.holdout_share is not None and to_judge:
            raise ConfigError("--holdout-share counts only where no recording is held out whole; leave it out.")
        car = default_car() if self.car == "sim" else load_car_file(Path(self.car))
        fit, faults, uses = self._load(to_fit, "fit", car.simulator.mocap.latency_s)
        held, more, others = self._load(to_judge, "held out", car.simulator.mocap.latency_s)
        texts = Texts(effect_sentence, separating_drive, LOOK_ALIKES)
        with Interrupts() as interrupts, progress() as bar:
            row = bar.add_task("diagnosis", total=100, note="")
            try:
                outcome = diagnose(
                    fit,
                    held,
                    car.simulator,
                    texts,
                    uses=(*uses, *others),
                    data_faults=(*faults, *more),
                    effects=self.effects or None,
                    holdout_share=HOLDOUT_SHARE if self.holdout_share is None else self.holdout_share,
                    seed=self.seed,
                    progress=lambda what, share: bar.update(row, completed=round(100 * share), note=what),
                    stop=interrupts.requested.is_set,
                )
            except Inconclusive as error:
                known = error.data_faults or (*faults, *more)
                why = str(error)
                if error.verdict == "data":
                    causes = ", ".join(sorted({f.id.replace("_", " ") for f in known}))
                    why = f"The recording is at fault ({causes}), so no physics can be judged: {why}"
                fail(why)
                self._write_undecided(error.verdict, why, known, (*uses, *others), car.simulator)
                return 0 if error.verdict == "data" else EXIT_INCONCLUSIVE
        write_report(outcome.diagnosis, outcome.exhibits, self.out, outcome.model)
        self._print(outcome.diagnosis)
        return 0

    def _load(
        self, paths: tuple[Path, ...], role: str, latency_s: float
    ) -> tuple[list[EpisodeData], list[DataFault], list[RecordingUse]]:
        from carlab.diagnosis.findings import DataFault, RecordingUse
        from carlab.diagnosis.own_recordings import as_captured
        from carlab.recording.audit_report import Severity
        from carlab.recording.forgiving_import import import_mended
        from carlab.recording.mcap_source import read_episode

        episodes, faults, uses = [], [], []
        for path in paths:
            required_file(path, "The recording")
            if is_csv(path):
                read = import_mended(path)
                episodes += list(read.imported.episodes)
                # What is wrong and not repaired is found again, and repaired, from the episodes themselves.
                repaired = [f for f in read.imported.report.findings if f.severity is Severity.REPAIRED]
                faults += [
                    DataFault(f.id, f.channel, f.count or episodes[-1].ticks + 1, f"repaired: {f.sentence}")
                    for f in (*read.mended, *repaired)
                    if f.id in DATA_FAULTS and f.id != "dropouts"
                ]
            else:
                episodes.append(as_captured(read_episode(path), latency_s))
            uses.append(RecordingUse(str(path), hashlib.sha256(path.read_bytes()).hexdigest(), role))
        return episodes, faults, uses

    def _write_undecided(
        self,
        verdict: Verdict,
        why: str,
        faults: tuple[DataFault, ...],
        uses: tuple[RecordingUse, ...],
        simulator: object,
    ) -> None:
        from carlab.diagnosis.findings import Diagnosis, Exhibits
        from carlab.diagnosis.report import write_report
        from sim_backends.car_parameters import SimulatorConfig

        assert isinstance(simulator, SimulatorConfig)
        diagnosis = Diagnosis(verdict, why, (), {}, 1.0, {}, None, faults, uses, self.seed, 0.0, why)
        write_report(diagnosis, Exhibits(), self.out, simulator)

    def _print(self, diagnosis: Diagnosis) -> None:
        from carlab.diagnosis.report_text import verdict_sentence

        console.print(verdict_sentence(diagnosis))
        for effect in diagnosis.effects:
            console.print(f"  {effect.sentence}", markup=False)
        figures = ("position_m", "yaw_rad", "vx", "vy", "yaw_rate")
        rows = [
            [name.replace("_", " "), *(f"{getattr(e, k):.4f}" for k in figures), f"{e.score:.2f}"]
            for name, e in diagnosis.held_out.items()
        ]
        columns = ["held out", "position [m]", "yaw [rad]", "vx [m/s]", "vy [m/s]", "yaw rate [rad/s]", "score"]
        table(f"Error after {diagnosis.horizon_s:.1f} s", columns, rows)
        console.print(f"Read {self.out / 'report.html'}; drive what was found with --car {self.out / 'model.toml'}.")


def _of_run(path: Path) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Recordings to fit and to judge by: of a run's folder its episodes in which something was driven, else itself."""
    if not (path / "episodes").is_dir():
        return (path,), ()
    from carlab.experiment.training import has_ticks

    driven = [recording for recording in sorted((path / "episodes").glob("*.mcap")) if has_ticks(recording)]
    if not driven:
        raise ConfigError(f"{path} has no finished episode yet.")
    held_out = driven[2::3]
    return tuple(p for p in driven if p not in held_out), tuple(held_out)
