"""Adaptation of a simulator to the recent past of a drive.

A car changes: its battery, its steering linkage, the floor. The change is a slowly varying disturbance of a fitted
simulator: a share of the drive force, an angle of the steering, a share of the grip, and a force forward. Filters
estimate it from prediction windows of the past (``adaptation_filter``): all four numbers or a single one, with several
time constants. A prediction that starts at t uses only windows that end before t. It is the mean of the predictions of
these candidates and of the simulator without a change, with weights by their errors in the last seconds (dynamic model
averaging: Raftery, Karny and Ettler 2010, Online prediction under model uncertainty via dynamic model averaging). Where
an error depends on the state of the car, no candidate predicts better than the simulator without a change.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy.special import ndtri

from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.core.recording_noise import AdaptationNoise, FeatureStd, StateStd
from carlab.prediction.adaptation_filter import Filtered, Processes, run_filter
from carlab.prediction.adaptation_settings import ADAPTATION
from carlab.prediction.disturbances import bounded_final_errors, linearised, simulate_disturbed
from carlab.prediction.local_error_model import LocalErrorModel, state_features
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import IndexArray, PredictionWindows, RecordingSegment, cut_windows
from sim_backends.car_parameters import SimulatorConfig

MIN_FEATURE_STD = 0.01
"""Minimum standard deviation of a feature of the state [m/s, rad/s, 1]: a constant command has no unit."""
MIN_STD = 1e-6
"""Minimum standard deviation of an error [m, rad, m/s, rad/s]: keeps noise-free recordings finite."""
MEASUREMENT_SPACING_S = (ADAPTATION.window_s, ADAPTATION.window_s)
"""Length and stride [s] of the windows that measure the disturbances; they follow each other without overlap."""
WEIGHT_SPACING_S = (ADAPTATION.weight_horizon_s, ADAPTATION.weight_stride_s)
"""Length and stride [s] of the windows whose errors give the weights of the candidates."""
SINGLE_AND_ALL = ((True,) * 4, *(tuple(k == own for k in range(4)) for own in range(4)))
"""Which of the four drifting disturbances a candidate has: all, or one."""


@dataclass(frozen=True, slots=True)
class DisturbanceSeries:
    """Estimated disturbances along recordings, from the past of each moment alone.

    Attributes:
        recording: (S,) index of the recording.
        t_s: (S,) time since the first row of the recording.
        mean: (S, n) share of the drive force [1], steering trim [rad], share of the grip [1], force forward per mass
            [m/s2], under the condition that the car changed.
        std: (S, n) standard deviations of the same.
        weights: (S, 1 + C + M) of the simulator without a change, of the candidates and of the error models.
    """

    recording: IndexArray
    t_s: FloatArray
    mean: FloatArray
    std: FloatArray
    weights: FloatArray


@dataclass(frozen=True, slots=True)
class WindowEnds:
    """Ends of windows in the order of recording and time.

    Attributes:
        recording: (S,) index of the recording.
        end_s: (S,) end of the window since the first row of its recording.
    """

    recording: IndexArray
    end_s: FloatArray

    def last_before(self, recording: IndexArray, t_s: FloatArray) -> IndexArray:
        """Index (N,) of the last window of each recording (N,) that ends up to a time (N,); -1 if there is none."""
        found = np.full(len(t_s), -1)
        for name in np.unique(recording):
            own, rows = np.flatnonzero(self.recording == name), recording == name
            if len(own):
                index = np.searchsorted(self.end_s[own], t_s[rows] + 1e-6, side="right") - 1
                found[rows] = np.where(index >= 0, own[np.maximum(index, 0)], -1)
        return found


@dataclass(frozen=True, slots=True)
class AdaptiveModel:
    """A simulator that adapts along recordings; a ``PredictiveModel`` for windows of these recordings.

    Attributes:
        config: the fitted simulator.
        processes: C candidates.
        filter_ends: S ends of the windows that measure the disturbances.
        filtered: estimates of the candidates after each of these windows.
        error_models: M simulators without a change, corrected by their errors in similar states.
        weight_ends: L ends of the windows that weigh the candidates.
        losses: (1 + C + M, L) of the predictions of ``candidates``, summed with forgetting.
        guard_s: minimum time [s] between the end of a used window and the start of a prediction.
    """

    config: SimulatorConfig
    processes: Processes
    filter_ends: WindowEnds
    filtered: Filtered
    error_models: tuple[LocalErrorModel, ...]
    weight_ends: WindowEnds
    losses: FloatArray
    guard_s: float

    def predict(self, windows: PredictionWindows) -> FloatArray:
        """As ``PredictiveModel``: weighted mean (S, K + 1, 6) of the predictions of all candidates."""
        weights = self.weights(windows.recording, windows.t0_s)
        return np.asarray(np.einsum("cs,cskj->skj", weights, self.candidates(windows)))

    def candidates(self, windows: PredictionWindows) -> FloatArray:
        """Predictions (1 + C + M, S, K + 1, 6) without a change, by each candidate and by each error model."""
        drifting = self.disturbances(windows.recording, windows.t0_s)
        unchanged = np.zeros((1, *drifting.shape[1:]))
        predicted = simulate_disturbed(windows, self.config, np.concatenate([unchanged, drifting]))
        corrected = [error_model.corrected(windows, predicted[0]) for error_model in self.error_models]
        return np.concatenate([predicted, np.stack(corrected)]) if corrected else predicted

    def disturbances(self, recording: IndexArray, t_s: FloatArray) -> FloatArray:
        """Estimated disturbances (C, S, n), 0 before the first measured window; in the units of ``DisturbanceSeries``.

        Args:
            recording: (S,) index of the recording.
            t_s: (S,) time since the first row of the recording.
        """
        if not len(self.filter_ends.end_s):
            return np.zeros((len(self.processes.std), len(t_s), self.processes.std.shape[1]))
        index = self.filter_ends.last_before(recording, t_s - self.guard_s)
        age_s = t_s - self.filter_ends.end_s[index]
        decay = np.exp(-np.maximum(age_s, 0.0) / self.processes.time_constant_s[:, None])
        return np.where(index[:, None] >= 0, self.filtered.mean[:, index] * decay[..., None], 0.0)

    def weights(self, recording: IndexArray, t_s: FloatArray) -> FloatArray:
        """Weights (1 + C + M, S) of the predictions of ``candidates``; they add up to 1.

        Args:
            recording: (S,) index of the recording.
            t_s: (S,) time since the first row of the recording.
        """
        logarithm = np.repeat(np.log(self._prior_weights())[:, None], len(t_s), axis=1)
        if len(self.weight_ends.end_s):
            index = self.weight_ends.last_before(recording, t_s - self.guard_s)
            logarithm -= np.where(index >= 0, self.losses[:, index], 0.0)
        weights = np.exp(logarithm - logarithm.max(axis=0))
        return np.asarray(weights / weights.sum(axis=0))

    def _prior_weights(self) -> FloatArray:
        """Weights (1 + C + M,) without past errors, the same for each of the three kinds of predictions."""
        kinds = (1, len(self.processes.std), len(self.error_models))
        return np.concatenate([np.full(count, 1.0 / (len(kinds) * max(count, 1))) for count in kinds])

    def series(self) -> DisturbanceSeries:
        """Mean and standard deviation over the candidates after each measured window."""
        ends = self.filter_ends
        weights = self.weights(ends.recording, ends.end_s + self.guard_s)
        drifting = weights[1 : 1 + len(self.processes.std)]
        shares = drifting / np.maximum(drifting.sum(axis=0), 1e-300)
        mean = np.einsum("cs,csn->sn", shares, self.filtered.mean)
        variance = np.einsum("csnn->csn", self.filtered.covariance) + (self.filtered.mean - mean) ** 2
        std = np.sqrt(np.einsum("cs,csn->sn", shares, variance))
        return DisturbanceSeries(ends.recording, ends.end_s, mean, std, weights.T)


def adapt(
    config: SimulatorConfig,
    segments: Sequence[RecordingSegment],
    noise: AdaptationNoise,
    *,
    time_constants_s: Sequence[float] = ADAPTATION.time_constants_s,
    drifts: Sequence[Sequence[bool]] = SINGLE_AND_ALL,
    fitted: Sequence[RecordingSegment] = (),
    with_error_models: bool = True,
    velocity_window_s2: float = 0.0,
) -> AdaptiveModel:
    """Estimate the disturbances of a simulator along recordings.

    Args:
        config: the fitted simulator.
        segments: all segments of the recordings; an estimate at t uses only their rows before t.
        noise: noise of the filter.
        time_constants_s: of the drifting disturbances.
        drifts: which of the n drifting disturbances may differ from 0, for each group of candidates; a group has one
            candidate for each time constant.
        fitted: segments of earlier recordings, whose errors also correct the simulator.
        with_error_models: also correct the simulator by its errors in similar states of the past.
        velocity_window_s2: variance [s2] of the window over which the recorded velocities were differentiated.

    Raises:
        DataError: the car moves in no window.
    """
    windows = _windows(segments, velocity_window_s2, MEASUREMENT_SPACING_S)
    processes = _processes(noise, time_constants_s, np.array(drifts, dtype=np.float64))
    at = np.zeros((*processes.std.shape[:1], len(windows), processes.std.shape[1]))
    for _ in range(ADAPTATION.linearisations):
        measured = linearised(windows, config, at)
        filtered = run_filter(measured, processes)
        at = filtered.predicted
    error_models = tuple(
        LocalErrorModel(config, segments, earlier, np.array(noise.feature_std), guard_s(windows), velocity_window_s2)
        for earlier in ([(), fitted] if fitted else [()])
        if with_error_models
    )
    none = WindowEnds(np.zeros(0, dtype=np.int64), np.zeros(0))
    model = AdaptiveModel(
        config,
        processes,
        WindowEnds(measured.recording, measured.end_s),
        filtered,
        error_models,
        none,
        np.zeros((1 + len(at) + len(error_models), 0)),
        guard_s(windows),
    )
    return _with_losses(model, segments, noise, velocity_window_s2)


def guard_s(windows: PredictionWindows) -> float:
    """Time [s] after a row at which its velocities are known: a period, and half the width of their window as a box."""
    return windows.period_s + float(np.sqrt(3.0 * windows.velocity_window_s2))


def choose_noise(
    config: SimulatorConfig,
    segments: Sequence[RecordingSegment],
    *,
    velocity_window_s2: float = 0.0,
) -> AdaptationNoise:
    """Choose the noise of the filter by the likelihood of fitted recordings, each window given the earlier ones.

    The unit of the losses is the spread of the errors of the simulator or, if that is smaller, of the adapted one.

    Raises:
        DataError: the car moves in no window.
    """
    settings = ADAPTATION
    windows = _windows(segments, velocity_window_s2, MEASUREMENT_SPACING_S)
    measured = linearised(windows, config, np.zeros((1, len(windows), len(settings.drift_std))))
    calm = np.quantile(np.abs(measured.error[0]), settings.calm_quantile, axis=0)
    calm = np.maximum(calm / ndtri(0.5 + 0.5 * settings.calm_quantile), MIN_STD)
    grid = list(itertools.product(settings.error_shares, settings.white_shares, settings.time_constants_s))
    errors, whites, times = (np.array(column) for column in zip(*grid, strict=True))
    processes = Processes(
        np.tile(settings.drift_std, (len(grid), 1)),
        times,
        errors[:, None] * calm,
        whites[:, None] * np.array(settings.white_std),
        settings.dof,
    )
    best = int(np.argmin(run_filter(measured, processes).nll.sum(axis=1)))
    windows = _windows(segments, velocity_window_s2, WEIGHT_SPACING_S)
    error_std, white_share = _as_std(errors[best] * calm), float(whites[best])
    plain = _spread(simulate_windows(windows, config)[0], windows)
    feature_std = cast(FeatureStd, tuple(np.maximum(state_features(windows).std(axis=0), MIN_FEATURE_STD).tolist()))
    noise = AdaptationNoise(error_std, white_share, _as_std(plain), feature_std)
    adapted = adapt(config, segments, noise, velocity_window_s2=velocity_window_s2).predict(windows)
    return replace(noise, loss_std=_as_std(np.minimum(plain, _spread(adapted, windows))))


def _spread(predicted: FloatArray, windows: PredictionWindows) -> FloatArray:
    """Robust standard deviations (6,) of the errors of predictions (S, K + 1, 6) after the windows."""
    errors = bounded_final_errors(windows, predicted)
    return np.asarray(np.maximum(np.median(np.abs(errors), axis=0) / ndtri(0.75), MIN_STD))


def _as_std(values: FloatArray) -> StateStd:
    return cast(StateStd, tuple(values.tolist()))


def _with_losses(
    model: AdaptiveModel, segments: Sequence[RecordingSegment], noise: AdaptationNoise, velocity_window_s2: float
) -> AdaptiveModel:
    """The model with the losses of all candidates along the segments; without a long enough window the same model."""
    try:
        windows = _windows(segments, velocity_window_s2, WEIGHT_SPACING_S)
    except DataError:
        return model
    errors = bounded_final_errors(windows, model.candidates(windows))
    distance_sq = np.sum((errors / noise.loss_std) ** 2, axis=-1)
    losses = 0.5 * (ADAPTATION.dof + errors.shape[-1]) * np.log1p(distance_sq / ADAPTATION.dof)
    weight_ends = WindowEnds(windows.recording, windows.t0_s + windows.horizon_s)
    return replace(model, weight_ends=weight_ends, losses=_forgetting_sums(losses, weight_ends))


def _forgetting_sums(losses: FloatArray, ends: WindowEnds) -> FloatArray:
    """Sums of losses (C, L) of each recording up to each window, with exponential forgetting."""
    total = losses * min(ADAPTATION.weight_stride_s / ADAPTATION.weight_dependence_s, 1.0)
    for k in range(1, len(ends.end_s)):
        if ends.recording[k] == ends.recording[k - 1]:
            elapsed_s = ends.end_s[k] - ends.end_s[k - 1]
            total[:, k] += np.exp(-elapsed_s / ADAPTATION.weight_memory_s) * total[:, k - 1]
    return total


def _processes(noise: AdaptationNoise, time_constants_s: Sequence[float], drifts: FloatArray) -> Processes:
    """One candidate for each time constant and each row of ``drifts`` (G, n)."""
    times_s = np.tile(time_constants_s, len(drifts))
    count = len(times_s)
    return Processes(
        np.repeat(drifts * ADAPTATION.drift_std, len(time_constants_s), axis=0),
        times_s,
        np.tile(noise.error_std, (count, 1)),
        np.tile(noise.white_share * np.array(ADAPTATION.white_std), (count, 1)),
        ADAPTATION.dof,
    )


def _windows(
    segments: Sequence[RecordingSegment], velocity_window_s2: float, spacing_s: tuple[float, float]
) -> PredictionWindows:
    """Windows in the order of recording and time; ``spacing_s`` is their length and the time between their starts."""
    windows = cut_windows(segments, *spacing_s)
    windows = windows.take(np.lexsort((windows.t0_s, windows.recording)))
    return replace(windows, velocity_window_s2=velocity_window_s2)
