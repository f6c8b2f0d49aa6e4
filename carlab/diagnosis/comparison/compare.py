"""Comparison of two groups of recordings by forward selection of the parameters that differ.

The simulator is refitted to both groups together. Each candidate is then fitted in each group with all other parameters
fixed. Physics that the simulator lacks biases both fits alike, so their difference, not the fitted value, is the
change. Its covariance is the sum of both sandwich covariances, clustered by blocks of 10 s (Liang and Zeger 1986).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from carlab.core.clock import MonotonicClock
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.diagnosis.comparison.candidates import (
    ChangeCandidate,
    Group,
    change_candidates,
    fit_in_group,
    unbounded_optimum,
)
from carlab.diagnosis.comparison.result import Change, Comparison, verdict_sentence
from carlab.diagnosis.findings import Estimate
from carlab.diagnosis.identification.fit import Fit, FitParameter, Fitter, Scale, clustered_gain
from carlab.diagnosis.identification.held_out_errors import noise_floor
from carlab.diagnosis.identification.measurement_noise import estimate_noise
from carlab.diagnosis.identification.velocity_window import with_initial_states
from carlab.diagnosis.recording_faults import find as data_faults_of
from carlab.diagnosis.recordings import check_excitation
from carlab.diagnosis.selection.problem import SearchProblem
from carlab.diagnosis.selection.refit import fit_with_scale
from carlab.diagnosis.settings import DEFAULT, ComparisonSettings, DiagnosisSettings
from carlab.diagnosis.state_alignment import with_known_latency
from carlab.prediction.windows import PredictionWindows, Track, cut_windows, tracks_of
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CURVES, confusable_effects
from sim_backends.registry import REGISTRY


@dataclass(frozen=True, slots=True)
class _Tested:
    """A candidate fitted in both groups.

    delta, std   (n,) change of each coordinate and its standard deviation
    dof          degrees of freedom of the standard deviations
    p_value      of no change
    loss         (S,) loss of the second group's unseen blocks with the change
    """

    candidate: ChangeCandidate
    fits: tuple[Fit, Fit]
    delta: FloatArray
    std: FloatArray
    dof: int
    p_value: float
    loss: FloatArray


def compare(
    reference: Sequence[EpisodeData],
    changed: Sequence[EpisodeData],
    nominal: SimulatorConfig,
    *,
    candidates: Sequence[str] | None = None,
    settings: DiagnosisSettings = DEFAULT,
    progress: Callable[[str, float], None] = lambda activity, share: None,
    stop: Callable[[], bool] = lambda: False,
) -> Comparison:
    """Find what changed between two groups of recordings of one car.

    Args:
        reference: recordings of the first group.
        changed: recordings of the second group.
        nominal: the simulator of the car file, best that of a diagnosis; its base parameters are refitted.
        candidates: effects and base parameters that may differ; all by default.
        settings: settings of all stages.
        progress: callback with the activity and the completed share in [0, 1].
        stop: callback; if it returns true, the changes so far are the result.

    Raises:
        DataError: the recordings are too short or too uniform, or have different periods; the message has the remedy.
    """
    began_s = MonotonicClock().now_s()
    progress("refitting the simulator to both groups", 0.0)
    base, groups = _prepare(reference, changed, nominal, settings)
    changes = _select(base, groups, change_candidates(base, candidates), settings.comparison, progress, stop)
    seconds = MonotonicClock().now_s() - began_s
    return Comparison("changed" if changes else "nothing", verdict_sentence(changes), changes, seconds)


def _prepare(
    reference: Sequence[EpisodeData],
    changed: Sequence[EpisodeData],
    nominal: SimulatorConfig,
    settings: DiagnosisSettings,
) -> tuple[SimulatorConfig, tuple[Group, Group]]:
    """The simulator refitted to both groups, and the groups with one error scale."""
    nominal = with_known_latency(nominal, (*reference, *changed))
    reference, changed, _ = data_faults_of.check(reference, changed, nominal)
    tracks = [_checked_tracks(group, k, settings) for k, group in enumerate((reference, changed))]
    periods = [t[0].period_s for t in tracks]
    if max(periods) > settings.comparison.period_ratio_max * min(periods):
        raise DataError(
            f"The groups have periods of {periods[0]:.3f} s and {periods[1]:.3f} s; compare recordings of one car."
        )
    everything = tracks_of((*reference, *changed), periods[0])
    windows = _windows(everything, settings)
    windows, _ = with_initial_states((windows, windows), nominal, settings.identification)
    noise = estimate_noise(everything, windows.curvature_bias, settings=settings.identification)
    per_step = noise_floor(windows, noise, nominal, settings.identification)[1:]
    problem = SearchProblem(nominal, windows, np.sqrt(np.mean(per_step**2, axis=0)), confusable_effects(), (), settings)
    curves = tuple(f"effects.{curve.id}." for curve in CURVES)
    free = tuple(f for f in problem.free_parameters(()) if not f.name.startswith(curves))  # measured curves stay
    model = fit_with_scale(problem, (), nominal, free, problem.nominal_coordinates(free))
    is_first = windows.recording < len(reference)
    groups = [_group(windows.take(rows), model.scale, settings) for rows in (is_first, ~is_first)]
    return model.fit.config, (groups[0], groups[1])


def _checked_tracks(episodes: Sequence[EpisodeData], k: int, settings: DiagnosisSettings) -> list[Track]:
    """Tracks of a group. Raises DataError if it is too short or too uniform."""
    which = ("first", "second")[k]
    tracks = tracks_of(episodes)
    seconds = sum(track.duration_s for track in tracks)
    needed_s = settings.comparison.block_s * settings.comparison.min_blocks
    if seconds < needed_s:
        raise DataError(
            f"The {which} group has {seconds:.0f} s of driving; a comparison needs {needed_s:.0f} s in each group."
        )
    check_excitation(tracks, settings.windows)
    return tracks


def _windows(tracks: Sequence[Track], settings: DiagnosisSettings) -> PredictionWindows:
    cut = cut_windows(tracks, settings.windows.fit_window_s, settings.windows.fit_stride_s, settings.comparison.block_s)
    return cut.thinned(2 * settings.comparison.max_windows)


def _group(windows: PredictionWindows, scale: Scale, settings: DiagnosisSettings) -> Group:
    blocks = np.unique(windows.block)
    if len(blocks) < settings.comparison.min_blocks:
        raise DataError("The car moves too little in one group; record at least one minute of driving.")
    folds = np.searchsorted(blocks, windows.block) % min(settings.selection.folds, len(blocks))
    return Group(Fitter(windows, scale, settings.identification), np.asarray(folds))


def _select(
    base: SimulatorConfig,
    groups: tuple[Group, Group],
    candidates: Sequence[ChangeCandidate],
    settings: ComparisonSettings,
    progress: Callable[[str, float], None],
    stop: Callable[[], bool],
) -> tuple[Change, ...]:
    """Forward selection: the change with the smallest loss on unseen blocks of the second group comes first."""
    configs = [base, base]
    found: list[Change] = []
    first_gain = 0.0
    while len(found) < settings.max_changes and not stop():
        known = {c.id for c in found}
        tested = []
        for k, candidate in enumerate(candidates):
            if candidate.id not in known and not stop():
                progress(f"change {len(found) + 1}: {candidate.id}", k / len(candidates))
                tested.append(_test(candidate, configs, groups, settings))
        before = groups[1].fitter.loss(configs[1], max_error=DEFAULT.selection.max_unseen_error)
        significant = [t for t in tested if _is_significant(t, before, groups[1], len(candidates), settings)]
        if not significant:
            break
        best = min(significant, key=lambda t: float(t.loss.sum()))
        gain, error = clustered_gain(before, best.loss, groups[1].fitter.windows)
        share = gain / float(before.sum())
        if share < settings.min_unseen_share or gain < settings.min_share_of_first * first_gain:
            break
        first_gain = first_gain or gain
        ties = _ties(best, significant, groups[1], settings)
        found.append(_change(best, ties, len(candidates), share, gain / error))
        configs = [fit.config for fit in best.fits]
    return tuple(found)


def _test(
    candidate: ChangeCandidate,
    configs: Sequence[SimulatorConfig],
    groups: tuple[Group, Group],
    settings: ComparisonSettings,
) -> _Tested:
    """Fit a candidate in both groups; Hotelling's test of the difference with clustered covariances."""
    first, second = (fit_in_group(g, c, candidate, settings) for g, c in zip(groups, configs, strict=True))
    assert first.covariance is not None
    assert second.covariance is not None
    optima = [unbounded_optimum(g.fitter, fit) for g, fit in zip(groups, (first, second), strict=True)]
    delta = optima[1] - optima[0]
    covariance = first.covariance + second.covariance
    blocks = min(len(np.unique(g.fitter.windows.block)) for g in groups)
    count = len(delta)
    dof = max(blocks - count, 1)
    squared = float(delta @ np.linalg.pinv(covariance) @ delta)
    p_value = float(stats.f.sf(squared * dof / (count * max(blocks - 1, 1)), count, dof))
    loss = groups[1].fitter.leave_fold_out_loss(second, groups[1].folds, DEFAULT.selection.max_unseen_error)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return _Tested(candidate, (first, second), delta, std, dof, p_value, loss)


def _is_significant(
    tested: _Tested, before: FloatArray, group: Group, candidates: int, settings: ComparisonSettings
) -> bool:
    """Whether the parameters differ, and the change lowers the loss on unseen blocks of the second group."""
    gain, error = clustered_gain(before, tested.loss, group.fitter.windows)
    return tested.p_value < settings.p_max / candidates and gain > settings.min_unseen_z * error


def _ties(best: _Tested, tested: Sequence[_Tested], group: Group, settings: ComparisonSettings) -> tuple[str, ...]:
    """Candidates whose loss on unseen blocks is not significantly higher, the closest first, at most two."""
    near = []
    for other in tested:
        if other is not best:
            difference, error = clustered_gain(other.loss, best.loss, group.fitter.windows)
            if difference < settings.tie_z * error:
                near.append((difference, other.candidate.id))
    return tuple(name for _, name in sorted(near)[:2])


def _change(tested: _Tested, ties: tuple[str, ...], candidates: int, share: float, standard_errors: float) -> Change:
    first = tested.fits[0]
    quantile = float(stats.t.ppf(0.95, tested.dof))
    parameters, reference = {}, {}
    for f, z, delta, std in zip(tested.candidate.free, first.z, tested.delta, tested.std, strict=True):
        name = f.name.rpartition(".")[2] if f.name.startswith("effects.") else f.name
        own = float(f.value(np.asarray(z)))
        low, value, high = sorted(_difference(f, float(z), delta + side * quantile * std) for side in (-1.0, 0.0, 1.0))
        parameters[name] = Estimate(value, (high - low) / (2.0 * 1.6449), low, high, REGISTRY[f.name].unit)
        reference[name] = own
    return Change(
        tested.candidate.id, parameters, reference, min(1.0, tested.p_value * candidates), share, standard_errors, ties
    )


def _difference(f: FitParameter, z: float, change: float) -> float:
    """Change of a parameter's value by a change of its coordinate from z, without bounds."""
    if f.logarithmic:
        return f.origin * float(np.exp(f.size * z) * np.expm1(f.size * change))
    return f.size * change


__all__ = ["Comparison", "compare"]
