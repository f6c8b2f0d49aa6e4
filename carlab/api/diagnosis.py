"""Diagnosis of recordings: effects that a simulator does not model."""

from __future__ import annotations

import hashlib
import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from carlab.api.cars import load_car
from carlab.api.recordings import Recording, is_csv, required_file

if TYPE_CHECKING:
    from carlab.cars import CarFile
    from carlab.core.episode_data import EpisodeData
    from carlab.core.recording_noise import RecordingNoise
    from carlab.diagnosis.diagnose import Outcome
    from carlab.diagnosis.findings import (
        DataFault,
        Diagnosis,
        EffectFinding,
        Estimate,
        Exhibits,
        FitErrors,
        RecordingUse,
        Verdict,
    )
    from carlab.jobs.function_workers import FunctionWorkers

RecordingLike = Any
"""A Recording, an EpisodeData, or the path of an MCAP, a CSV or a run's folder."""
MIN_SHARED_S = 120.0
"""Recorded time [s] from which several processes share a diagnosis by default; each needs seconds to start."""
REPORTED_FAULTS = (
    *("yaw_wrap_spikes", "outliers", "stale_samples", "clock_drift", "column_shift", "column_scale"),
    *("wrong_unit", "wrong_sign", "wrong_frame", "integration_error"),
)
"""Findings of the CSV audit that the report lists as data faults if they were repaired."""


@dataclass(frozen=True)
class DiagnosisReport:
    """The result of ``carlab.diagnose``. A notebook displays it as the HTML report.

    Attributes:
        diagnosis: the verdict with its evidence as data (schema ``carlab.diagnosis/1``).
        exhibits: data of the report's pictures.
        model: the car file with the identified parameters and effects; ``model.save("model.toml")`` writes it.
        is_conclusive: False if the recordings are not sufficient for a verdict; ``sentence`` states what to record.
        outcome: all models with the held-out prediction windows; None if the recordings are not sufficient.
        held_out_names: name of the recording of each held-out episode.
    """

    diagnosis: Diagnosis
    exhibits: Exhibits = field(repr=False)
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

        write_report(self.diagnosis, self.exhibits, Path(folder), self.model.simulator)
        return Path(folder)

    def save_decisions(self, folder: Path | str = "diagnosis") -> Path:
        """Write decisions.json: the statistics and thresholds of each decision about an effect.

        Raises:
            DataError: the file cannot be written.
        """
        from carlab.diagnosis.report.write import write_decisions

        return write_decisions(self.exhibits, Path(folder))

    def to_dict(self) -> dict[str, Any]:
        """The content of report.json."""
        return self.diagnosis.to_dict()

    def to_html(self) -> str:
        """The report as one self-contained HTML page."""
        from carlab.diagnosis.report.html_page import render_page

        return render_page(self.diagnosis, self.exhibits)

    def _repr_html_(self) -> str:
        page = html.escape(self.to_html(), quote=True)
        return f'<iframe srcdoc="{page}" style="width:100%;height:720px;border:0"></iframe>'

    def __str__(self) -> str:
        """The verdict, and one sentence for each effect."""
        return "\n  ".join([self.sentence, *(effect.sentence for effect in self.diagnosis.effects)])


@dataclass(slots=True)
class Material:
    """Episodes with the names of their recordings and data faults; ``notes`` are sentences about conversions."""

    episodes: list[EpisodeData] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    faults: list[DataFault] = field(default_factory=list)
    uses: list[RecordingUse] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def diagnose(
    recordings: RecordingLike | Iterable[RecordingLike],
    car: str | Path | CarFile = "sim",
    *,
    held_out: RecordingLike | Iterable[RecordingLike] = (),
    holdout_share: float | None = None,
    effects: Sequence[str] = (),
    curves: bool = False,
    ceiling: bool = False,
    discrepancy: bool = False,
    adapt: bool = False,
    keep_events: bool = False,
    seed: int = 0,
    jobs: int | None = None,
    budget_s: float = 300.0,
    out: Path | str | None = None,
    progress: Callable[[str, float], None] = lambda activity, share: None,
    stop: Callable[[], bool] = lambda: False,
) -> DiagnosisReport:
    """Identify effects in recordings that a simulator does not model, and validate them on held-out data.

    Args:
        recordings: one recording or several, to fit: a ``Recording``, an ``EpisodeData``, a path (MCAP, CSV), or the
            folder of a run, of which every third episode is held out.
        car: the simulator to check: a car file, its path, or a name (``sim``, ``eth_rc_car`` ...).
        held_out: recordings for validation only; by default the last part of each recording is held out.
        holdout_share: size of that part, above 0 and at most 0.5; 0.3 by default.
        effects: restrict the search to these effects of the catalogue.
        curves: fit measured curves where named effects leave more than a tenth of the error; takes minutes.
        ceiling: train a black box, to show how much of the error can be explained at all; takes minutes.
        discrepancy: train networks that correct the diagnosed simulator, and report their error; takes minutes.
        adapt: adapt the corrected simulator along the held-out recordings, and report what changed; takes a minute.
        keep_events: fit and score windows with events (collisions, a hand) too; the report lists them in any case.
        seed: seed of the black box and of the learned discrepancy; the rest of a diagnosis draws no random numbers.
        jobs: number of processes that share the fits; the result is the same for each number. By default one for short
            recordings, and one for each core for recordings of two minutes or more.
        budget_s: time limit [s] without curves, networks and adaptation; its end cuts the search. ``inf`` for none.
        out: folder for the report; ``DiagnosisReport.save`` can write it later.
        progress: called with the current activity and the completed share, in [0, 1].
        stop: once it returns true, the search ends and the report covers the findings so far.

    Returns:
        The report; ``is_conclusive`` is False if the recordings are not sufficient.

    Raises:
        ConfigError: an argument is invalid.
        DataError: a recording cannot be read, or the report cannot be written.
    """
    file = load_car(car)
    to_fit, to_validate = _assigned(as_list(recordings), as_list(held_out))
    effects = _checked_effects(effects)
    _check_share(holdout_share, to_validate)
    roles = (to_fit, "fit"), (to_validate, "held out")
    fit, validation = (read_material(items, role, file.simulator.mocap.latency_s) for items, role in roles)
    options = {"effects": effects or None, "holdout_share": holdout_share, "curves": curves, "ceiling": ceiling}
    options |= {"discrepancy": discrepancy, "adapt": adapt, "keep_events": keep_events, "budget_s": budget_s}
    with _workers(jobs, fit.episodes) as workers:
        report = _diagnosed(
            fit, validation, file, seed, {**options, "workers": workers, "progress": progress, "stop": stop}
        )
    if out is not None:
        report.save(out)
    return report


def _workers(jobs: int | None, episodes: Sequence[EpisodeData]) -> FunctionWorkers:
    """Processes that share the fits. Raises ConfigError for a number below one."""
    from carlab.core.errors import ConfigError
    from carlab.jobs.function_workers import FunctionWorkers, cores_count

    if jobs is not None and jobs < 1:
        raise ConfigError(f"--jobs {jobs}: give the number of processes, at least 1.")
    recorded_s = sum(float(episode.times_s[-1] - episode.times_s[0]) for episode in episodes if len(episode.times_s))
    default = cores_count() if recorded_s > MIN_SHARED_S else 1
    return FunctionWorkers(default if jobs is None else jobs)


def _diagnosed(
    fit: Material, validation: Material, file: CarFile, seed: int, options: Mapping[str, Any]
) -> DiagnosisReport:
    from carlab.diagnosis.diagnose import Inconclusive
    from carlab.diagnosis.diagnose import diagnose as search
    from carlab.diagnosis.evidence import Texts
    from carlab.diagnosis.findings import Diagnosis, Exhibits
    from carlab.diagnosis.report.sentences import effect_sentence, separating_drive
    from carlab.diagnosis.report.write import completed
    from sim_backends.effects import confusable_effects

    uses, faults = (*fit.uses, *validation.uses), (*fit.faults, *validation.faults)
    try:
        outcome = search(
            fit.episodes,
            validation.episodes,
            file.simulator,
            Texts(effect_sentence, separating_drive, confusable_effects()),
            uses=uses,
            data_faults=faults,
            seed=seed,
            **options,
        )
    except Inconclusive as error:
        known = error.data_faults or faults
        why = str(error)
        if error.verdict == "data":
            causes = ", ".join(sorted({f.id.replace("_", " ") for f in known}))
            why = f"The recording is faulty ({causes}), so no physics can be identified: {why}"
        undecided = Diagnosis(error.verdict, why, (), {}, 1.0, {}, None, tuple(known), uses, seed, 0.0, why)
        return DiagnosisReport(undecided, Exhibits(), _as_car_file(undecided, file.simulator, file.name), False)
    model = _as_car_file(outcome.diagnosis, outcome.model, file.name, outcome.exhibits.noise)
    names = tuple(validation.names or fit.names)
    return DiagnosisReport(completed(outcome.diagnosis), outcome.exhibits, model, True, outcome, names)


def _as_car_file(diagnosis: Diagnosis, simulator: Any, name: str, noise: RecordingNoise | None = None) -> CarFile:
    from carlab.cars import CarFile
    from carlab.diagnosis.report.write import completed, model_toml, with_parameter_std

    worded = completed(diagnosis)
    text = model_toml(worded, simulator, noise)
    return CarFile(f"{name} (diagnosed)", text, with_parameter_std(worded, simulator), None, noise)


def _check_share(holdout_share: float | None, held_out: Sequence[RecordingLike]) -> None:
    from carlab.core.errors import ConfigError

    if holdout_share is not None and held_out:
        raise ConfigError(
            "--holdout-share has no effect together with held-out recordings (of a run folder, every third episode is "
            "held out); remove the option, or name single recordings."
        )


def _checked_effects(effects: Sequence[str]) -> tuple[str, ...]:
    """Names of effects as a tuple; a single string is one name. Raises ConfigError for an unknown one."""
    from carlab.core.errors import ConfigError
    from carlab.core.tables import nearest_name
    from sim_backends.effects import CATALOGUE

    names = (effects,) if isinstance(effects, str) else tuple(effects)
    for name in names:
        if name not in CATALOGUE:
            raise ConfigError(f"There is no effect '{name}' in the catalogue; {nearest_name(name, list(CATALOGUE))}")
    return names


def as_list(given: RecordingLike | Iterable[RecordingLike]) -> list[RecordingLike]:
    """Recordings as a list, with strings converted to paths."""
    from carlab.core.episode_data import EpisodeData

    single = isinstance(given, (str, Path, Recording, EpisodeData))
    return [Path(item) if isinstance(item, str) else item for item in ([given] if single else given)]


def _assigned(
    recordings: list[RecordingLike], held_out: list[RecordingLike]
) -> tuple[list[RecordingLike], list[RecordingLike]]:
    """Recordings to fit and to hold out, with run folders resolved. Raises ConfigError if one is both."""
    from carlab.core.errors import ConfigError

    if not recordings:
        raise ConfigError("Name at least one recording to fit, for example carlab diagnose drive.mcap.")
    to_fit: list[RecordingLike] = []
    to_validate = list(held_out)
    for item in recordings:
        fitted, validated = _episodes_of_run(item) if isinstance(item, Path) else ([item], [])
        to_fit += fitted
        to_validate += validated
    if same := _paths_of(to_fit) & _paths_of(to_validate):
        raise ConfigError(f"{min(same).name} is both fitted and held out; remove it from one of the lists.")
    _check_repetition([*to_fit, *to_validate])
    return to_fit, to_validate


def recordings_of_runs(
    first: list[RecordingLike], second: list[RecordingLike]
) -> tuple[list[RecordingLike], list[RecordingLike]]:
    """Two groups with run folders replaced by their episodes. Raises ConfigError if a recording is in both."""
    from carlab.core.errors import ConfigError

    groups: list[list[RecordingLike]] = []
    for items in (first, second):
        resolved = [_episodes_of_run(item) if isinstance(item, Path) else ([item], []) for item in items]
        groups.append([recording for fitted, validated in resolved for recording in (*fitted, *validated)])
    if same := _paths_of(groups[0]) & _paths_of(groups[1]):
        raise ConfigError(f"{min(same).name} is in both groups; remove it from one of them.")
    for group in groups:
        _check_repetition(group)
    return groups[0], groups[1]


def _check_repetition(items: Iterable[RecordingLike]) -> None:
    """Raise ConfigError if a file is given twice, for example by itself and by its run folder."""
    from carlab.core.errors import ConfigError

    known: set[Path] = set()
    for path in (_path_of(item) for item in items):
        if path is not None and path.resolve() in known:
            raise ConfigError(f"{path} is given twice; name it once.")
        known |= {path.resolve()} if path is not None else set()


def _paths_of(items: Iterable[RecordingLike]) -> set[Path]:
    return {path.resolve() for item in items if (path := _path_of(item))}


def _episodes_of_run(path: Path) -> tuple[list[Path], list[Path]]:
    """Episodes of a run folder to fit and to hold out (every third); for other paths the path itself, to fit."""
    if not (path / "episodes").is_dir():
        return [path], []
    from carlab.core.errors import ConfigError
    from carlab.recording.mcap.source import has_ticks

    driven = [recording for recording in sorted((path / "episodes").glob("*.mcap")) if has_ticks(recording)]
    if not driven:
        raise ConfigError(f"{path} has no finished episode; drive one first.")
    return [p for k, p in enumerate(driven) if k % 3 != 2], driven[2::3]


def _path_of(item: RecordingLike) -> Path | None:
    return item.path if isinstance(item, Recording) else item if isinstance(item, Path) else None


def read_material(items: list[RecordingLike], role: str, latency_s: float) -> Material:
    """Read episodes for a diagnosis: CSV files are repaired, states of MCAP files get one known age."""
    material = Material()
    for item in items:
        material.uses.append(_read_item(item, role, latency_s, material))
        material.names += [material.uses[-1].path] * (len(material.episodes) - len(material.names))
    return material


def _read_item(item: RecordingLike, role: str, latency_s: float, material: Material) -> RecordingUse:
    """Add the episodes of one recording."""
    from carlab.api.recordings import load
    from carlab.diagnosis.findings import RecordingUse
    from carlab.diagnosis.state_alignment import align_states

    path = _path_of(item)
    if path is None:
        material.episodes.append(align_states(item, latency_s))
        digest = hashlib.sha256(item.times_s.tobytes() + item.states.tobytes()).hexdigest()
        return RecordingUse(str(item.metadata.get("source", "episode")), digest, role)
    if is_csv(required_file(path)):
        _read_csv(path, item.mapping if isinstance(item, Recording) else None, material)
    else:
        read = item if isinstance(item, Recording) else load(path)
        material.episodes += [align_states(episode, latency_s) for episode in read.episodes]
        if read.is_recovered:
            ticks = read.episode.ticks
            material.notes.append(f"{path} is an incomplete recording; {ticks} complete ticks were recovered.")
    return RecordingUse(str(path), hashlib.sha256(path.read_bytes()).hexdigest(), role)


def _read_csv(path: Path, mapping: Any, material: Material) -> None:
    """Add a CSV's episodes and its repaired data faults; the diagnosis detects faults without repair itself."""
    from carlab.diagnosis.findings import DataFault
    from carlab.recording.audit.report import Severity
    from carlab.recording.csv.repairing_import import import_repaired

    read = import_repaired(path, mapping=mapping)
    material.episodes += list(read.imported.episodes)
    material.notes.append(read.imported.announcement)
    repaired = [f for f in read.imported.report.findings if f.severity is Severity.REPAIRED]
    rows = read.imported.episodes[-1].ticks + 1
    material.faults += [
        DataFault(f.id, f.channel, f.count or rows, f"repaired: {f.sentence}")
        for f in (*read.repaired, *repaired)
        if f.id in REPORTED_FAULTS
    ]
