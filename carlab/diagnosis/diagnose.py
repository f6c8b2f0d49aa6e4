"""The whole diagnosis: from recordings and a car file to a verdict, its evidence, and a corrected simulator."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.clock import MonotonicClock
from carlab.core.episode_data import EpisodeData
from carlab.core.quantities import FloatArray
from carlab.diagnosis.decisions import Decision
from carlab.diagnosis.evidence import (
    ScoredSearch,
    Texts,
    base_estimates,
    effect_findings,
    unexplained_share,
    verdict_of,
)
from carlab.diagnosis.findings import DataFault, Diagnosis, Exhibits, RecordingUse
from carlab.diagnosis.identification.held_out_errors import HeldOut, noise_floor
from carlab.diagnosis.identification.measurement_noise import Noise, estimate_noise
from carlab.diagnosis.identification.velocity_window import with_initial_states
from carlab.diagnosis.naming import NamingResult, accept_names, describe_unexplained, residual_of
from carlab.diagnosis.own_recordings import with_known_latency
from carlab.diagnosis.recording_faults import find as data_faults_of
from carlab.diagnosis.recordings import Inconclusive, SplitRecordings, check_held_out_share, split_recordings
from carlab.diagnosis.report.exhibits import exhibits_of
from carlab.diagnosis.selection.problem import RunControl, SearchProblem
from carlab.diagnosis.selection.search import search
from carlab.diagnosis.settings import DEFAULT, DiagnosisSettings, IdentificationSettings
from carlab.diagnosis.unexplained.vibration import find_vibration
from carlab.prediction.predict import ConstantVelocity
from carlab.prediction.windows import tracks_of
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE

log = logging.getLogger(__name__)

Progress = Callable[[str, float], None]
SEARCH_PROGRESS = (0.05, 0.75)
"""Progress at which the search begins, and its share of the whole."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The answer, the material for its pictures, and the corrected simulator."""

    diagnosis: Diagnosis
    exhibits: Exhibits
    model: SimulatorConfig


@dataclass(frozen=True, slots=True)
class Request:
    """What a diagnosis is asked for; see ``diagnose``."""

    nominal: SimulatorConfig
    texts: Texts
    uses: Sequence[RecordingUse]
    data_faults: Sequence[DataFault]
    effects: Sequence[str] | None
    held_out_share: float
    seed: int
    settings: DiagnosisSettings


def diagnose(
    fit: Sequence[EpisodeData],
    held_out: Sequence[EpisodeData],
    nominal: SimulatorConfig,
    texts: Texts,
    *,
    uses: Sequence[RecordingUse] = (),
    data_faults: Sequence[DataFault] = (),
    effects: Sequence[str] | None = None,
    holdout_share: float | None = None,
    seed: int = 0,
    settings: DiagnosisSettings = DEFAULT,
    progress: Progress = lambda activity, share: None,
    stop: Callable[[], bool] = lambda: False,
) -> Outcome:
    """Find what ``nominal`` leaves out of recordings.

    Args:
        fit: recordings to fit.
        held_out: recordings for the score only; without any, the last part of each recording is held out.
        nominal: the simulator of the car file.
        texts: functions that phrase the report, and the confusable effects.
        uses: role of each recording, for the report.
        data_faults: repaired when the files were read; those found here are added.
        effects: the only effects to try; the whole catalogue unless given. Effects that are given are not withdrawn.
        holdout_share: last share of each recording that is held out where no recording is; above 0 and at most
            0.5; that of the settings unless given.
        seed: written into the report; a diagnosis draws no random numbers.
        settings: thresholds and sizes of all stages.
        progress: called with the activity and the share that is done, in [0, 1].
        stop: once true, the search ends, and what it found is scored and reported.

    Raises:
        Inconclusive: the recordings do not allow a verdict; why, and what to record.
        ConfigError: the simulator cannot integrate, or the share leaves too little.
    """
    if holdout_share is None:
        holdout_share = settings.windows.default_held_out_share
    check_held_out_share(holdout_share, settings.windows)
    began_s = MonotonicClock().now_s()
    nominal = with_known_latency(nominal, (*fit, *held_out))
    request = Request(nominal, texts, uses, data_faults, effects, holdout_share, seed, settings)
    decisions: list[Decision] = []
    control = RunControl(progress, stop, decisions.append)
    recordings, faults = _repaired(fit, held_out, request, progress)
    recordings, noise = _noise(recordings, nominal, settings.identification)
    scored, naming = _named(recordings, noise, request, control)
    outcome = _reported(scored, naming, recordings, replace(request, data_faults=faults), progress)
    seconds = MonotonicClock().now_s() - began_s
    exhibits = replace(outcome.exhibits, decisions=tuple(decisions))
    return Outcome(replace(outcome.diagnosis, seconds=seconds), exhibits, outcome.model)


def _repaired(
    fit: Sequence[EpisodeData], held_out: Sequence[EpisodeData], request: Request, progress: Progress
) -> tuple[SplitRecordings, tuple[DataFault, ...]]:
    """Recordings with their faults repaired, split and cut into windows."""
    settings = request.settings.windows
    progress("reading", 0.0)
    recorded_s = sum(len(e.times_s) for e in fit) * request.nominal.control_period_s
    fit, held_out, own_faults = data_faults_of.check(fit, held_out, request.nominal)
    faults = (*request.data_faults, *own_faults)
    progress("reading", 0.03)
    try:
        return split_recordings(fit, held_out, request.held_out_share, settings), faults
    except Inconclusive as error:
        error.data_faults = faults
        usable_s = sum(track.duration_s for track in tracks_of(fit))
        if faults and usable_s < settings.min_fit_s and usable_s < settings.unusable_share * recorded_s:
            error.verdict = "data"
        raise


def _noise(
    recordings: SplitRecordings, nominal: SimulatorConfig, settings: IdentificationSettings
) -> tuple[SplitRecordings, Noise]:
    """Windows with their initial states corrected, and the noise of the recordings."""
    fit_windows, held_out_windows = with_initial_states(
        (recordings.fit_windows, recordings.held_out_windows), nominal, settings
    )
    recordings = replace(recordings, fit_windows=fit_windows, held_out_windows=held_out_windows)
    return recordings, estimate_noise(recordings.fit_tracks, fit_windows.curvature_bias, settings=settings)


def _named(
    recordings: SplitRecordings, noise: Noise, request: Request, control: RunControl
) -> tuple[ScoredSearch, NamingResult]:
    """Search for effects, withdraw spurious names, and score what is left on held-out windows."""
    windows, nominal = recordings.fit_windows, request.nominal
    identification = request.settings.identification
    floor: FloatArray = np.sqrt(np.mean(noise_floor(windows, noise, nominal, identification)[1:] ** 2, axis=0))
    candidates = tuple(CATALOGUE) if request.effects is None else tuple(request.effects)
    problem = SearchProblem(nominal, windows, floor, request.texts.look_alikes, candidates, request.settings)
    first, share_of_all = SEARCH_PROGRESS

    def search_progress(activity: str, share: float) -> None:
        control.progress(activity, first + share_of_all * share)

    searching = replace(control, progress=search_progress)
    found = search(problem, searching)
    control.progress("looking for physics without a name", 0.8)
    vibration = find_vibration(recordings.fit_tracks, request.settings.unexplained)
    if vibration is not None:
        noise = estimate_noise(recordings.fit_tracks, windows.curvature_bias, slowest=True, settings=identification)
    held_out = HeldOut.of(recordings.held_out_windows, noise, found.best.config, identification)
    if request.effects is None:
        naming = accept_names(problem, found, held_out, vibration, searching)
    else:
        naming = NamingResult(found, residual_of(problem, found), None, vibration)
    control.progress("scoring on held-out recordings", 0.82)
    return ScoredSearch.of(problem, naming.found, held_out), naming


def _reported(
    scored: ScoredSearch, naming: NamingResult, recordings: SplitRecordings, request: Request, progress: Progress
) -> Outcome:
    """Evidence, what stays unexplained, the verdict, and the material for the pictures."""
    held_out = scored.held_out
    findings = effect_findings(
        scored, request.texts, lambda share: progress("removing each effect again", 0.82 + 0.1 * share)
    )
    share = unexplained_share(scored)
    unexplained, model = None, None
    if share >= request.settings.evidence.unexplained_share_min:
        error = scored.errors["with_effects"]
        unexplained, model = describe_unexplained(scored.problem, naming, share, error, held_out)
    verdict = verdict_of(scored, naming.has_unnamed, request.data_faults)
    progress("drawing", 0.95)
    held_out_errors = {name: held_out.summary(error) for name, error in scored.errors.items()} | {
        "constant_velocity": held_out.summary(held_out.final_error(ConstantVelocity())),
        "noise_floor": held_out.floor_summary(),
    }
    diagnosis = Diagnosis(
        verdict=verdict,
        sentence="",
        effects=findings if verdict == "mismatch" else (),
        parameters=base_estimates(scored),
        horizon_s=request.settings.windows.held_out_window_s,
        held_out=held_out_errors,
        unexplained=unexplained,
        data_faults=tuple(request.data_faults),
        recordings=tuple(request.uses),
        seed=request.seed,
        seconds=0.0,
    )
    exhibits = exhibits_of(scored, recordings.held_out_tracks)
    return Outcome(diagnosis, exhibits, model or scored.found.best.config)


__all__ = ["Inconclusive", "Outcome", "Texts", "diagnose"]
