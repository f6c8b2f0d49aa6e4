"""Drift: what changed in the car since the fitted recordings, from its adaptation to held-out recordings.

An adaptation also follows errors of a wrong simulator. So a drift must be slow, and the slow adaptation must predict
held-out windows better than the simulator, than the simulator with the mean disturbance of the fitted recordings, and
than the simulator whose prediction is corrected by the mean error of fitted windows in similar states.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from carlab.core.quantities import FloatArray
from carlab.core.recording_noise import AdaptationNoise
from carlab.diagnosis.findings import Drift, QuantityChange
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.settings import DRIFT
from carlab.prediction.adaptation import MIN_FEATURE_STD, AdaptiveModel, DisturbanceSeries, adapt, choose_noise
from carlab.prediction.adaptation_settings import ADAPTATION
from carlab.prediction.disturbances import DisturbedModel
from carlab.prediction.errors import final_errors
from carlab.prediction.local_error_model import state_features
from carlab.prediction.predict import SimulatorModel
from carlab.prediction.windows import RecordingSegment, cut_windows
from sim_backends.car_parameters import SimulatorConfig

QUANTITIES = (("drive force", "1"), ("steering trim", "rad"), ("grip", "1"), ("force forward", "m/s2"))
"""Names and units of the drifting disturbances."""
Mask = tuple[bool, ...]
EVERYTHING: Mask = (True,) * len(QUANTITIES)
BASELINES = ("model", "fitted mean", "similar states")
"""Predictions that a slow adaptation must improve on."""


@dataclass(frozen=True, slots=True)
class Adaptation:
    """An adapted model of held-out recordings, the noise of its filter, and the drift of each recording."""

    model: AdaptiveModel
    noise: AdaptationNoise
    drift: tuple[Drift, ...]


@dataclass(frozen=True, slots=True)
class _SlowAdaptation:
    """A slow adaptation of some of the quantities with its errors (S, 6) on the held-out windows."""

    model: AdaptiveModel
    errors: FloatArray


def adapt_to_held_out(
    config: SimulatorConfig,
    fit_segments: Sequence[RecordingSegment],
    held_out_segments: Sequence[RecordingSegment],
    held_out: HeldOut,
) -> Adaptation:
    """Adapt a simulator along held-out recordings, and find what changed in the car since the fitted ones.

    Args:
        config: the simulator, fitted to ``fit_segments``.
        fit_segments: fitted recordings; the noise of the filter is chosen on them.
        held_out_segments: held-out recordings.
        held_out: windows of the held-out recordings.
    """
    window_s2 = held_out.windows.velocity_window_s2
    noise = choose_noise(config, fit_segments, velocity_window_s2=window_s2)
    model = adapt(config, held_out_segments, noise, fitted=fit_segments, velocity_window_s2=window_s2)
    slow_s = tuple(t for t in ADAPTATION.time_constants_s if t >= DRIFT.min_time_constant_s)

    def slow(segments: Sequence[RecordingSegment], mask: Mask) -> AdaptiveModel:
        return adapt(
            config, segments, noise, time_constants_s=slow_s, drifts=(mask,), with_error_models=False,
            velocity_window_s2=window_s2,
        )  # fmt: skip

    @cache
    def slowly_adapted(mask: Mask) -> _SlowAdaptation:
        made = slow(held_out_segments, mask)
        return _SlowAdaptation(made, held_out.final_error(made))

    @cache
    def along_fitted(mask: Mask) -> FloatArray:
        return slow(fit_segments, mask).series().mean

    plain = held_out.final_error(config)
    similar = _similar_states(config, fit_segments, held_out, plain)
    constant = DisturbedModel(config, along_fitted(EVERYTHING).mean(axis=0))
    errors = {
        "model": plain,
        "adapted": held_out.final_error(model),
        "fitted mean": held_out.final_error(constant),
        "similar states": similar.errors,
    }
    found = [
        replace(
            _drift_of(number, held_out, errors, slowly_adapted, along_fitted, model.series()),
            similar_share=float(np.mean(similar.is_similar[held_out.windows.recording == number])),
        )
        for number in np.unique(held_out.windows.recording)
    ]
    return Adaptation(model, noise, tuple(found))


def _drift_of(
    number: int,
    held_out: HeldOut,
    errors: dict[str, FloatArray],
    slowly_adapted: Callable[[Mask], _SlowAdaptation],
    along_fitted: Callable[[Mask], FloatArray],
    series: DisturbanceSeries,
) -> Drift:
    """The drift of one recording, without its share of similar states.

    Args:
        number: index of the recording.
        held_out: all held-out windows.
        errors: errors (S, 6) of the simulator ("model"), of the adapted prediction ("adapted"), of the simulator with
            the mean disturbance of the fitted recordings ("fitted mean"), and of the simulator corrected by errors in
            similar states ("similar states").
        slowly_adapted: slow adaptation of some quantities.
        along_fitted: estimates (N, n) of some quantities along the fitted recordings.
        series: estimates of the adapted prediction.
    """
    own = held_out.windows.recording == number
    held_out_part = replace(held_out, windows=held_out.windows.take(own))
    slow = slowly_adapted(EVERYTHING)
    gains = [_gain_z(held_out_part, errors[name][own], slow.errors[own]) for name in BASELINES]
    is_drift = min(gains) >= DRIFT.gain_z_min
    changes: tuple[QuantityChange, ...] = ()
    if is_drift and any(mask := _changed(held_out_part, own, errors["model"], slowly_adapted)):
        changes = _changes(slowly_adapted(mask).model.series(), number, mask, along_fitted(mask))
    shown = np.flatnonzero(series.recording == number)
    shown = shown[:: max(1, -(-len(shown) // DRIFT.series_points))]
    return Drift(
        recording=int(number) + 1,
        is_drift=is_drift,
        changes=changes,
        time_constant_s=_most_likely_time_constant_s(slow.model, number),
        model_m=_position_rms(errors["model"][own]),
        adapted_m=_position_rms(errors["adapted"][own]),
        slow_m=_position_rms(slow.errors[own]),
        similar_states_m=_position_rms(errors["similar states"][own]),
        standard_errors=min(gains),
        similar_share=1.0,
        t_s=series.t_s[shown],
        mean=series.mean[shown],
        std=series.std[shown],
    )


def _gain_z(held_out_part: HeldOut, before: FloatArray, after: FloatArray) -> float:
    """Gain from errors ``before`` to ``after`` (S, 6) [clustered standard errors]; 0 with too few blocks."""
    if len(np.unique(held_out_part.windows.block)) < DRIFT.min_blocks:
        return 0.0
    gain, error = held_out_part.gain(before, after)
    return gain / error


def _changed(
    held_out_part: HeldOut,
    own: NDArray[np.bool_],
    plain: FloatArray,
    slowly_adapted: Callable[[Mask], _SlowAdaptation],
) -> Mask:
    """Which quantities changed: forward selection by the gain on held-out windows."""
    mask: Mask = (False,) * len(QUANTITIES)
    current = plain[own]
    while not all(mask):
        larger = [tuple(old or k == new for k, old in enumerate(mask)) for new in np.flatnonzero(~np.array(mask))]
        gains = [held_out_part.gain(current, slowly_adapted(each).errors[own]) for each in larger]
        best = int(np.argmax([gain for gain, _ in gains]))
        gain, error = gains[best]
        if gain < DRIFT.gain_z_min * error:
            break
        mask = larger[best]
        current = slowly_adapted(mask).errors[own]
    return mask


def _changes(
    series: DisturbanceSeries, number: int, mask: Mask, along_fitted: FloatArray
) -> tuple[QuantityChange, ...]:
    """Significant changes of the quantities in ``mask`` from the fitted recordings, most significant first."""
    own = series.recording == number
    mean, std = series.mean[own], series.std[own]
    first, last = _ends(series.t_s[own])
    found = []
    for k in np.flatnonzero(mask):  # the first estimates are near 0, the prior mean
        before = float(along_fitted[:, k].mean())
        value = float(mean[~first, k].mean()) - before
        spread = float(np.sqrt(np.mean(std[~first, k] ** 2) + np.var(along_fitted[:, k])))
        ends = float(mean[first, k].mean()) - before, float(mean[last, k].mean()) - before
        found.append(QuantityChange(*QUANTITIES[k], value, spread, *ends))
    significant = [c for c in found if max(abs(c.value), abs(c.last - c.first)) >= DRIFT.change_z_min * c.std]
    return tuple(sorted(significant, key=lambda c: -abs(c.value) / c.std))


def changes_along(series: DisturbanceSeries) -> tuple[QuantityChange, ...]:
    """All quantities along one recording or several, whether significant or not."""
    t_s = series.t_s
    first, last = _ends(t_s)
    return tuple(
        QuantityChange(
            name,
            unit,
            float(series.mean[:, k].mean()),
            float(np.sqrt(np.mean(series.std[:, k] ** 2))),
            float(series.mean[first, k].mean()),
            float(series.mean[last, k].mean()),
        )
        for k, (name, unit) in enumerate(QUANTITIES)
    )


def _ends(t_s: FloatArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Rows in the first and in the last share of a recording."""
    start_s, end_s = float(t_s.min()), float(t_s.max())
    part_s = DRIFT.ends_share * (end_s - start_s)
    return t_s <= start_s + part_s, t_s >= end_s - part_s


def _most_likely_time_constant_s(model: AdaptiveModel, number: int) -> float:
    series = model.series()
    weights = series.weights[series.recording == number, 1 : 1 + len(model.processes.std)].mean(axis=0)
    return float(model.processes.time_constant_s[int(np.argmax(weights))])


def _position_rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors[:, 0] ** 2 + errors[:, 1] ** 2)))


@dataclass(frozen=True, slots=True)
class _SimilarStates:
    """What fitted windows in similar states say about the held-out windows.

    errors     (S, 6) errors of the simulator less the mean error of fitted windows in similar states
    is_similar (S,) whether there are fitted windows in a similar state
    """

    errors: FloatArray
    is_similar: NDArray[np.bool_]


def _similar_states(
    config: SimulatorConfig,
    fit_segments: Sequence[RecordingSegment],
    held_out: HeldOut,
    errors: FloatArray,
) -> _SimilarStates:
    windows = held_out.windows
    fitted = cut_windows(fit_segments, windows.horizon_s, DRIFT.fit_stride_s).thinned(DRIFT.max_fit_windows)
    fitted = replace(fitted, velocity_window_s2=windows.velocity_window_s2)
    fit_errors = final_errors(SimulatorModel(config), fitted)
    fit_states, states = state_features(fitted), state_features(windows)
    scale = np.maximum(fit_states.std(axis=0), MIN_FEATURE_STD)
    count = min(DRIFT.neighbours, len(fitted))
    distance, index = cKDTree(fit_states / scale).query(states / scale, k=count)
    mean = fit_errors[index.reshape(len(windows), count)].mean(axis=1)
    other_block = fitted.block[:, None] != fitted.block
    between = np.where(other_block, cdist(fit_states / scale, fit_states / scale), np.inf).min(axis=1)
    limit = np.quantile(between, DRIFT.similar_quantile)
    return _SimilarStates(errors - mean, distance.reshape(len(windows), count)[:, 0] <= limit)
