"""Diagnosis of recordings: physics that a simulator lacks."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from carlab.api.arguments import at_least, valid_seed
from carlab.api.cars import load_car
from carlab.api.loaded_recordings import (
    LoadedRecordings,
    RecordingLike,
    as_list,
    assigned,
    check_contents,
    load_recordings,
)
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError
from carlab.core.tables import nearest_name

if TYPE_CHECKING:
    from carlab.cars import CarFile
    from carlab.core.recording_noise import RecordingNoise
    from carlab.diagnosis.diagnose import Outcome
    from carlab.diagnosis.findings import (
        Diagnosis,
        EffectFinding,
        Estimate,
        FigureData,
        FitErrors,
        Verdict,
    )
    from carlab.jobs.function_workers import FunctionWorkers

MIN_SHARED_S = 120.0
"""Recorded time [s] from which several processes share a diagnosis by default; each needs seconds to start."""


@dataclass(frozen=True)
class DiagnosisReport:
    """The result of ``carlab.diagnose``. A notebook displays it as the HTML report.

    Attributes:
        diagnosis: the verdict with its evidence as data (schema ``carlab.diagnosis/1``).
        figure_data: data of the report's pictures.
        model: the car file with the identified parameters and effects; ``model.save("model.toml")`` writes it.
        is_conclusive: False if the recordings are not sufficient for a verdict; ``sentence`` states what to record.
        outcome: all models with the held-out prediction windows; None if the recordings are not sufficient.
        held_out_names: name of the recording of each held-out episode.
    """

    diagnosis: Diagnosis
    figure_data: FigureData = field(repr=False)
    model: CarFile = field(repr=False)
    is_conclusive: bool = True
    outcome: Outcome | None = field(default=None, repr=False)
    held_out_names: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """One of mismatch, parameters, none, data, unexplained, inconclusive."""
        return self.diagnosis.verdict

    @property
    def sentence(self) -> str:
        """The verdict as a sentence."""
        return self.diagnosis.sentence

    @property
    def effects(self) -> dict[str, EffectFinding]:
        """The named effects by id, with parameters (value, std, 90 % interval), evidence, and confusable effects."""
        return {effect.id: effect for effect in self.diagnosis.effects}

    @property
    def parameters(self) -> dict[str, Estimate]:
        """Fitted base parameters by dotted name (``motor.drive_gain``), SI units."""
        return dict(self.diagnosis.parameters)

    @property
    def limits(self) -> dict[str, dict[str, Estimate]]:
        """How large each effect that is not named can be, by id and parameter: linear estimates with 90 % intervals."""
        return {effect: dict(own) for effect, own in self.diagnosis.limits.items()}

    @property
    def withdrawn(self) -> dict[str, str]:
        """Effects that the search accepted and a later test withdrew: the reason by id."""
        return {effect.id: effect.reason for effect in self.diagnosis.withdrawn}

    @property
    def held_out(self) -> dict[str, FitErrors]:
        """Held-out root mean square errors by model, as ``fit.held_out`` of report.json."""
        return dict(self.diagnosis.held_out)

    def save(self, folder: Path | str = "diagnosis") -> Path:
        """Write report.html, report.json, report.rrd, summary.png and model.toml, replacing an existing report.

        Args:
            folder: created if missing.

        Returns:
            The folder.

        Raises:
            DataError: the folder cannot be written.
        """
        from carlab.diagnosis.report.write import write_report

        write_report(self.diagnosis, self.figure_data, Path(folder), self.model.simulator)
        return Path(folder)

    def save_decisions(self, folder: Path | str = "diagnosis") -> Path:
        """Write decisions.json: the statistics and thresholds of each decision about an effect.

        Raises:
            DataError: the file cannot be written.
        """
        from carlab.diagnosis.report.write import write_decisions

        return write_decisions(self.figure_data, Path(folder))

    def to_dict(self) -> dict[str, Any]:
        """The content of report.json."""
        return self.diagnosis.to_dict()

    def to_html(self) -> str:
        """The report as one self-contained HTML page."""
        from carlab.diagnosis.report.html_page import render_page

        return render_page(self.diagnosis, self.figure_data)

    def _repr_html_(self) -> str:
        page = html.escape(self.to_html(), quote=True)
        return f'<iframe srcdoc="{page}" style="width:100%;height:720px;border:0"></iframe>'

    def __repr__(self) -> str:
        """The verdict, and one line for each effect."""
        from carlab.diagnosis.report.effect_lines import effect_lines

        return "\n  ".join([self.sentence, *effect_lines(self.diagnosis)])


def diagnose(
    recordings: RecordingLike | Iterable[RecordingLike], car: str | Path | CarFile = "sim", *,
    held_out: RecordingLike | Iterable[RecordingLike] = (), holdout_share: float | None = None,
    effects: Sequence[str] = (), curves: bool = False, ceiling: bool = False, discrepancy: bool = False,
    adapt: bool = False, keep_events: bool = False, seed: int = 0, jobs: int | None = None, budget_s: float = 300.0,
    out: Path | str | None = None, progress: Callable[[str, float], None] = lambda activity, share: None,
    stop: Callable[[], bool] = lambda: False,
) -> DiagnosisReport:  # fmt: skip
    """Identify physics that recordings show and a simulator lacks, and validate it on held-out recordings.

    Args:
        recordings: one recording or several, to fit: a ``Recording``, an ``EpisodeData``, a path (MCAP, CSV), or a run
            folder, of which every third episode is held out.
        car: simulator to diagnose: a car file, its path, or a name: ``sim`` (the default car) or a preset
            (``eth_rc_car``, ``dart_jetracer`` ...).
        held_out: held-out recordings: no fit uses them. By default the last part of each recording is held out.
        holdout_share: length of the held-out last part as a share of the recording, above 0 and at most 0.5; 0.3 by
            default.
        effects: restrict the search to these effects of the catalogue.
        curves: fit measured curves (drive force, steering, tyres) if the named effects leave more than a tenth of the
            refit's squared excess (error above the noise floor); takes minutes.
        ceiling: train a black box (networks without a simulator), to show how much of the error can be predicted at
            all. Needs 60 s of driving; takes minutes.
        discrepancy: train networks that correct the accelerations of the diagnosed simulator, and report their error.
            Needs 60 s of driving; takes minutes.
        adapt: adapt the corrected simulator along the held-out recordings, and report what changed in the car since the
            fitted recordings; takes a minute.
        keep_events: also fit and score prediction windows with events (collisions, a hand that moves the car). By
            default they are listed and left out.
        seed: seed of the black box and of the learned discrepancy; the rest of a diagnosis draws no random numbers.
        jobs: number of processes that share the fits; the result is the same for each number. By default one for short
            recordings, and one for each core for recordings of two minutes or more.
        budget_s: time limit [s] of the diagnosis without measured curves, networks and adaptation; ``inf``: no limit.
            The search for effects ends at 60 % of the limit. The report then has the effects found so far and says that
            the search was cut short. The checks after such a search can exceed the limit.
        out: folder for the report; ``DiagnosisReport.save`` can write it later.
        progress: called with the current activity and the completed share, in [0, 1].
        stop: once it returns true, the search ends and the report covers the findings so far.

    Returns:
        The report; ``is_conclusive`` is False if the recordings are not sufficient.

    Raises:
        ConfigError: an argument is invalid.
        DataError: a recording cannot be read, or the report cannot be written.
    """
    at_least(1, jobs=jobs)
    valid_seed(seed=seed)
    file = load_car(car)
    effects = _checked_effects(effects)
    fit, validation = _read_recordings(recordings, held_out, holdout_share, file)
    options = {"effects": effects or None, "holdout_share": holdout_share, "curves": curves, "ceiling": ceiling}
    options |= {"discrepancy": discrepancy, "adapt": adapt, "keep_events": keep_events, "budget_s": budget_s}
    report = _diagnosed(fit, validation, file, seed, jobs, options | {"progress": progress, "stop": stop})
    if out is not None:
        report.save(out)
    return report


def _read_recordings(
    recordings: RecordingLike | Iterable[RecordingLike],
    held_out: RecordingLike | Iterable[RecordingLike],
    holdout_share: float | None,
    car: CarFile,
) -> tuple[LoadedRecordings, LoadedRecordings]:
    """Recordings to fit and held-out ones. Raises ConfigError for arguments that exclude each other."""
    to_fit, to_validate = assigned(as_list(recordings), as_list(held_out))
    if holdout_share is not None and to_validate:
        raise ConfigError(
            "--holdout-share has no effect together with held-out recordings (of a run folder, every third episode is "
            "held out); remove the option, or name single recordings."
        )
    latency_s = car.simulator.latency_s()
    fit, validation = load_recordings(to_fit, "fit", latency_s), load_recordings(to_validate, "held out", latency_s)
    check_contents([*fit.uses, *validation.uses])
    return fit, validation


def _workers(jobs: int | None, episodes: Sequence[EpisodeData]) -> FunctionWorkers:
    """Processes that share the fits."""
    from carlab.jobs.function_workers import FunctionWorkers, cores_count

    recorded_s = sum(float(episode.times_s[-1] - episode.times_s[0]) for episode in episodes if len(episode.times_s))
    default = cores_count() if recorded_s > MIN_SHARED_S else 1
    return FunctionWorkers(default if jobs is None else jobs)


def _diagnosed(
    fit: LoadedRecordings,
    validation: LoadedRecordings,
    file: CarFile,
    seed: int,
    jobs: int | None,
    options: Mapping[str, Any],
) -> DiagnosisReport:
    from carlab.diagnosis.diagnose import diagnose as search
    from carlab.diagnosis.findings import Diagnosis, FigureData
    from carlab.diagnosis.recordings import Inconclusive

    uses, faults = (*fit.uses, *validation.uses), (*fit.faults, *validation.faults)
    try:
        with _workers(jobs, fit.episodes) as workers:
            outcome = search(
                fit.episodes,
                validation.episodes,
                file.simulator,
                uses=uses,
                data_faults=faults,
                seed=seed,
                workers=workers,
                **options,
            )
    except Inconclusive as error:
        known = error.data_faults or faults
        why = str(error)
        if error.verdict == "data":
            causes = ", ".join(sorted({f.id.replace("_", " ") for f in known}))
            why = f"The recording is faulty ({causes}), so no physics can be identified: {why}"
        undecided = Diagnosis(error.verdict, why, (), {}, 1.0, {}, None, tuple(known), uses, seed, 0.0, why)
        return DiagnosisReport(undecided, FigureData(), _as_car_file(undecided, file.simulator, file.name), False)
    model = _as_car_file(outcome.diagnosis, outcome.model, file.name, outcome.figure_data.noise)
    names = tuple(validation.names or fit.names)
    return DiagnosisReport(outcome.diagnosis, outcome.figure_data, model, True, outcome, names)


def _as_car_file(diagnosis: Diagnosis, simulator: Any, name: str, noise: RecordingNoise | None = None) -> CarFile:
    from carlab.cars import CarFile
    from carlab.diagnosis.report.model_file import model_toml, with_parameter_std

    text = model_toml(diagnosis, simulator, noise)
    return CarFile(f"{name} (diagnosed)", text, with_parameter_std(diagnosis, simulator), None, noise)


def _checked_effects(effects: Sequence[str]) -> tuple[str, ...]:
    """Names of effects as a tuple; a single string is one name. Raises ConfigError for an unknown one."""
    from sim_backends.effects import CATALOGUE

    names = (effects,) if isinstance(effects, str) else tuple(effects)
    for name in names:
        if name not in CATALOGUE:
            raise ConfigError(f"There is no effect '{name}' in the catalogue; {nearest_name(name, list(CATALOGUE))}")
    return names
