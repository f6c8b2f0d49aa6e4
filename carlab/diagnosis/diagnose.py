"""Diagnosis: from recordings and a car file to a verdict, its evidence, and a corrected simulator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace

from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.curves.support import curve_findings
from carlab.diagnosis.decisions import Decision
from carlab.diagnosis.evidence import (
    ScoredSearch,
    base_estimates,
    effect_findings,
    unexplained_share,
    verdict_of,
)
from carlab.diagnosis.final_models import (
    Request,
    adapted,
    ceiling_by_networks,
    errors_with_events,
    fitted_score,
    measured_curves,
    trained_models,
)
from carlab.diagnosis.findings import (
    DataFault,
    Diagnosis,
    FigureData,
    RecordingUse,
    Unexplained,
    Withdrawal,
    final_model_name,
)
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.identification.held_out_errors import HeldOut, mean_noise_floor
from carlab.diagnosis.identification.measurement_noise import Noise, estimate_noise
from carlab.diagnosis.identification.velocity_filter import VelocityFilter
from carlab.diagnosis.identification.velocity_window import with_initial_states
from carlab.diagnosis.limits import effect_limits
from carlab.diagnosis.measured_filter import FILTER, have_velocity_columns, measured_filter, name_filter, with_filter
from carlab.diagnosis.naming import (
    NamingResult,
    accept_names,
    accept_requested_names,
    describe_unexplained,
    with_fewer_effects,
)
from carlab.diagnosis.recording_faults.find import check, with_unknown_delay
from carlab.diagnosis.recordings import Inconclusive, SplitRecordings, checked_held_out_share, split_recordings
from carlab.diagnosis.report.figure_data import figure_data_of
from carlab.diagnosis.report.next_drive import with_texts
from carlab.diagnosis.search_timer import SearchTimer
from carlab.diagnosis.selection.problem import RunControl, SearchProblem
from carlab.diagnosis.selection.search import search
from carlab.diagnosis.settings import DEFAULT, EVIDENCE, DiagnosisSettings
from carlab.diagnosis.skill import skill_of
from carlab.diagnosis.state_alignment import naming_lost_frames, with_known_latency
from carlab.diagnosis.uncertain_effects import without_uncertain_effects
from carlab.diagnosis.unexplained.vibration import find_vibration
from carlab.diagnosis.withdrawals import withdrawn_effects
from carlab.jobs.function_workers import FunctionWorkers
from carlab.prediction.network_ensemble import EnsembleSettings, check_duration
from carlab.prediction.predict import PredictiveModel
from carlab.prediction.windows import PredictionWindows, segments_of
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE, confusable_effects

Progress = Callable[[str, float], None]
SEARCH_PROGRESS = (0.05, 0.8)
"""Progress at the start and at the end of the search."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The diagnosis, the data of its figures, the corrected simulator, and all models with the held-out windows."""

    diagnosis: Diagnosis
    figure_data: FigureData
    model: SimulatorConfig
    models: Mapping[str, PredictiveModel]
    held_out_windows: PredictionWindows


def diagnose(
    fit: Sequence[EpisodeData],
    held_out: Sequence[EpisodeData],
    nominal: SimulatorConfig,
    *,
    uses: Sequence[RecordingUse] = (),
    data_faults: Sequence[DataFault] = (),
    effects: Sequence[str] | None = None,
    holdout_share: float | None = None,
    seed: int = 0,
    settings: DiagnosisSettings = DEFAULT,
    curves: bool = False,
    ceiling: bool = False,
    discrepancy: bool = False,
    adapt: bool = False,
    keep_events: bool = False,
    budget_s: float | None = None,
    workers: FunctionWorkers | None = None,
    progress: Progress = lambda activity, share: None,
    stop: Callable[[], bool] = lambda: False,
) -> Outcome:
    """Find physics of recordings that the simulator ``nominal`` lacks.

    Args:
        fit: recordings to fit.
        held_out: held-out recordings; if empty, the last part of each recording of ``fit`` is held out.
        nominal: the simulator of the car file.
        uses: role of each recording, for the report.
        data_faults: faults that were found when the files were read; faults found here are added.
        effects: candidate effects, the whole catalogue by default. Physics outside it withdraws no requested effect.
        holdout_share: last share of each recording that is held out without ``held_out``; default: of the settings.
        seed: seed of the black box and of the learned discrepancy; the rest of a diagnosis uses no random numbers.
        settings: thresholds of all stages.
        curves: fit measured curves where named effects leave a residual.
        ceiling: train a black box, and compare with its error.
        discrepancy: train a learned discrepancy of the corrected simulator, and report its error.
        adapt: adapt the corrected simulator along the held-out recordings, and report what changed in the car.
        keep_events: fit and score windows with events (collisions) too; they are listed in any case.
        budget_s: time limit [s] without curves, networks and adaptation; its end cuts the search (``SearchTimer``).
        workers: processes that share the fits; by default this process alone.
        progress: callback with the activity and the completed share in [0, 1].
        stop: callback; if it returns true, the search ends and its result is scored and reported.

    Raises:
        ConfigError: the simulator cannot integrate, or the held-out share or the time limit is out of range.
        DataError: too few commands, or too short for a network; ``Inconclusive``: no verdict, why, what to record.
    """
    share = checked_held_out_share(holdout_share, settings.windows)
    timer = SearchTimer(budget_s, stop, settings.selection.search_time_share)
    known, stages = with_known_latency(nominal, (*fit, *held_out)), (curves, ceiling, discrepancy, adapt, keep_events)
    request = Request(known, uses, data_faults, effects, share, seed, settings, *stages)
    decisions: list[Decision] = []
    with FunctionWorkers() if workers is None else nullcontext(workers) as shared:
        control = RunControl(progress, stop, decisions.append, timer.omit, timer.ends_search, shared)
        recordings, request = _prepare_recordings(fit, held_out, request, progress)
        recordings, noise, measured = _measure(recordings, request)
        accepted, scored, naming = _search_effects(recordings, noise, measured, request, control, timer)
        withdrawn = withdrawn_effects(decisions, accepted, scored.found.possible_effects)
        outcome = _assemble_result(scored, naming, withdrawn, recordings, request, control)
    return _with_run(outcome, timer, effects or (), None if held_out else share, decisions)


def _with_run(
    outcome: Outcome,
    timer: SearchTimer,
    effects: Sequence[str],
    held_out_share: float | None,
    decisions: Sequence[Decision],
) -> Outcome:
    """The outcome with texts, run time, held-out share, and extent and decisions of the search among ``effects``."""
    extent = replace(timer.extent(), effects=tuple(effects))
    diagnosis = replace(outcome.diagnosis, seconds=timer.elapsed_s(), search=extent, held_out_share=held_out_share)
    figure_data = replace(outcome.figure_data, decisions=tuple(decisions))
    return replace(outcome, diagnosis=with_texts(diagnosis), figure_data=figure_data)


def _prepare_recordings(
    fit: Sequence[EpisodeData], held_out: Sequence[EpisodeData], request: Request, progress: Progress
) -> tuple[SplitRecordings, Request]:
    """Repair faults, split the recordings, and cut them into windows; the request has these faults."""
    settings = request.settings.windows
    nominal = request.nominal
    progress("reading", 0.0)
    recorded_s = sum(len(e.times_s) * e.period_s for e in fit if e.ticks)
    repaired_fit, repaired_held_out, own_faults = check(fit, held_out, nominal)
    faults = (*request.data_faults, *own_faults)
    progress("reading", 0.03)
    try:
        with naming_lost_frames((*fit, *held_out)):
            recordings = split_recordings(
                repaired_fit,
                repaired_held_out,
                request.held_out_share,
                nominal,
                request.settings,
                keep_events=request.keep_events,
            )
    except Inconclusive as error:
        error.data_faults = faults
        usable_s = sum(segment.duration_s for segment in segments_of(repaired_fit))
        if faults and usable_s < settings.min_fit_s and usable_s < settings.unusable_share * recorded_s:
            error.verdict = "data"
        raise
    if request.ceiling or request.discrepancy:
        check_duration(recordings.fit_segments, EnsembleSettings())
    return recordings, replace(request, nominal=with_unknown_delay(nominal, faults), data_faults=faults)


def _candidates(request: Request) -> tuple[str, ...]:
    """Effects that may be accepted."""
    return tuple(CATALOGUE) if request.effects is None else tuple(request.effects)


def _measure(recordings: SplitRecordings, request: Request) -> tuple[SplitRecordings, Noise, VelocityFilter | None]:
    """Measure the filter of the velocities, correct the initial states of the windows, and estimate the noise."""
    is_candidate = FILTER in _candidates(request)
    measured = measured_filter(recordings.fit_segments, request.nominal) if is_candidate else None
    fit_windows, held_out_windows, event_windows = with_initial_states(
        (recordings.fit_windows, recordings.held_out_windows, recordings.event_windows),
        with_filter(request.nominal, measured),
    )
    recordings = replace(
        recordings, fit_windows=fit_windows, held_out_windows=held_out_windows, event_windows=event_windows
    )
    return recordings, estimate_noise(recordings.fit_segments, fit_windows.curvature_bias), measured


def _search_effects(
    recordings: SplitRecordings,
    noise: Noise,
    measured: VelocityFilter | None,
    request: Request,
    control: RunControl,
    timer: SearchTimer,
) -> tuple[tuple[str, ...], ScoredSearch, NamingResult]:
    """Search for effects, withdraw spurious ones, and score the result on held-out windows.

    The simulator of the search has the ``measured`` filter of the velocities. The filter is no candidate of the search;
    it is added to the result. Also returns the effects that the search accepted.
    """
    control = replace(control, progress=timer.progress(control.progress))
    windows, nominal = recordings.fit_windows, with_filter(request.nominal, measured)
    floor = mean_noise_floor(windows, noise, nominal)
    candidates = _candidates(request)
    if measured is not None or (request.effects is None and not have_velocity_columns(recordings.fit_segments)):
        candidates = tuple(name for name in candidates if name != FILTER)
    problem = SearchProblem(nominal, windows, floor, noise.measured, confusable_effects(), candidates, request.settings)
    search_control = control.part(*SEARCH_PROGRESS)
    found = search(problem, search_control)
    control.progress("searching for physics outside the catalogue", 0.8)
    vibration = find_vibration(recordings.fit_segments)
    if vibration is not None:
        noise = estimate_noise(recordings.fit_segments, windows.curvature_bias, slowest=True)
    held_out = HeldOut.of(recordings.held_out_windows, noise, nominal)
    if request.effects is None:
        naming = accept_names(problem, found, held_out, vibration, search_control)
    else:
        naming = accept_requested_names(problem, found, held_out, vibration, search_control)
    control.progress("scoring on held-out recordings", 0.82)
    scored = ScoredSearch.of(problem, naming.found, held_out)
    if request.effects is None:
        scored = without_uncertain_effects(scored, search_control)
        if scored.found.effects != naming.found.effects:
            naming = with_fewer_effects(problem, naming, scored.found, search_control)
    if measured is not None:
        problem, naming = name_filter(problem, request.nominal, replace(naming, found=scored.found), measured)
        scored = ScoredSearch.of(problem, naming.found, held_out)
    timer.end_checks()
    return found.effects, scored, naming


def _assemble_result(
    scored: ScoredSearch,
    naming: NamingResult,
    withdrawn: tuple[Withdrawal, ...],
    recordings: SplitRecordings,
    request: Request,
    control: RunControl,
) -> Outcome:
    """Compute evidence, unexplained residual, measured curves, ceiling, verdict and figure data."""
    held_out, progress = scored.held_out, control.progress
    findings = effect_findings(
        scored, request.effects is None, lambda share: progress("refitting without each effect", 0.82 + 0.1 * share)
    )
    unexplained, described = _unexplained(scored, naming)
    verdict = verdict_of(scored, naming.has_unnamed, request.data_faults)
    measured, curve_trial = measured_curves(scored, described, recordings, request, control)
    corrected = scored if described is None else replace(scored, fit=described, is_joint=False)
    corrected = corrected if measured is None else replace(scored, fit=measured.fit)
    adaptation = adapted(corrected, recordings, request, control)
    models = trained_models(scored, described, measured, adaptation, recordings, request, control)
    progress("preparing the report", 0.95)
    final_errors = {name: held_out.final_error(each) for name, each in models.items()}
    held_out_errors = {name: held_out.summary(error) for name, error in final_errors.items()}
    held_out_errors["noise_floor"] = held_out.floor_summary()
    segments, settings = recordings.fit_segments, request.settings.curves
    diagnosis = Diagnosis(
        verdict=verdict,
        sentence="",
        effects=findings if verdict == "mismatch" else (),
        parameters=base_estimates(corrected),
        horizon_s=request.settings.windows.held_out_window_s,
        held_out=held_out_errors,
        unexplained=unexplained,
        data_faults=tuple(request.data_faults),
        recordings=tuple(request.uses),
        seed=request.seed,
        seconds=0.0,
        curves=() if measured is None else curve_findings(measured, request.nominal, segments, settings),
        curve_trial=curve_trial,
        ceiling=ceiling_by_networks(held_out_errors),
        fitted_score=fitted_score(scored, recordings, request),
        skill=skill_of(
            held_out.windows,
            final_errors[final_model_name(final_errors)],
            final_errors["constant_velocity"],
        ),
        drift=() if adaptation is None else adaptation.drift,
        car_file_parameters=_stated_parameters(request.nominal),
        limits=effect_limits(scored, control.workers),
        withdrawn=withdrawn,
        events=recordings.events,
        held_out_with_events=errors_with_events(models, final_errors, held_out, recordings.event_windows),
    )
    figure_data = figure_data_of(scored, recordings)
    noise = replace(held_out.recording_noise, adaptation=None if adaptation is None else adaptation.noise)
    figure_data = replace(figure_data, noise=noise)
    return Outcome(diagnosis, figure_data, corrected.fit.config, models, held_out.windows)


def _unexplained(scored: ScoredSearch, naming: NamingResult) -> tuple[Unexplained | None, Fit | None]:
    """The residual if it is relevant, and the fit with the uncatalogued physics that describes it, if there is one."""
    share = unexplained_share(scored)
    if share < EVIDENCE.unexplained_share_min:
        return None, None
    return describe_unexplained(scored.problem, naming, share, scored.errors["with_effects"], scored.held_out)


def _stated_parameters(nominal: SimulatorConfig) -> dict[str, float]:
    """Values of the car file by dotted name, without those that it states as unknown."""
    return {name: value for name, value in nominal.values().items() if name not in nominal.unknown}
