"""Adaptation of a simulator to the recent past of a drive.

A car changes: its battery, its steering linkage, the floor. The change is a slowly varying disturbance of a fitted
simulator: a share of the drive force, an angle of the steering, a share of the grip, and a force forward. A filter
estimates it from prediction windows of the past (``adaptation_filter``), once for each of several time constants. A
prediction that starts at t uses only windows that end before t. It is the mean of the predictions of all candidates and
of the simulator without a change, with weights by their errors in the last seconds (dynamic model averaging: Raftery,
Karny and Ettler 2010, Online prediction under model uncertainty via dynamic model averaging). Where an error depends on
the state of the car, no candidate predicts better than the simulator, and the simulator has nearly all the weight.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.prediction.adaptation_filter import Filtered, MeasuredWindows, Processes, run_filter
from carlab.prediction.adaptation_settings import AdaptationSettings
from carlab.prediction.errors import prediction_errors
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import IndexArray, PredictionWindows, Track, cut_windows
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import DRIFTING, PUSHING

DISTURBANCES = (*DRIFTING, *PUSHING)
"""Dotted names of the m disturbances; the first n of them drift."""
NORMAL_QUARTILE = 0.6745
ALL_DRIFTS = (True, True, True, True)


@dataclass(frozen=True, slots=True)
class AdaptationNoise:
    """Noise of the filter, chosen on fitted recordings.

    Attributes:
        error_std: (6,) error after a window in calm driving: x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s].
        white_share: size of the white noise on the disturbances, in units of the settings.
        loss_std: (6,) robust spread of the simulator's errors after ``horizon_s``, the unit of the candidates' losses.
        horizon_s: horizon of the errors that weigh the candidates [s].
    """

    error_std: FloatArray
    white_share: float
    loss_std: FloatArray
    horizon_s: float


@dataclass(frozen=True, slots=True)
class DisturbanceSeries:
    """Estimated disturbances along recordings, from the past of each moment alone.

    Attributes:
        recording: (S,) index of the recording.
        t_s: (S,) since the first row of the recording.
        mean: (S, n) share of the drive force [1], steering trim [rad], share of the grip [1], force forward per mass
            [m/s2], under the condition that the car changed.
        std: (S, n) standard deviations of the same.
        weights: (S, C + 1) of the simulator without a change and of the C candidates, largest where errors of the last
            seconds are smallest.
    """

    recording: IndexArray
    t_s: FloatArray
    mean: FloatArray
    std: FloatArray
    weights: FloatArray


@dataclass(frozen=True, slots=True)
class AdaptiveModel:
    """A simulator that adapts along recordings; a ``PredictiveModel`` for windows of these recordings.

    Attributes:
        config: the fitted simulator.
        processes: C candidates.
        filtered: their estimates after each measured window.
        recording, end_s: (S,) recording and end of the measured windows.
        loss_end_s, loss_recording: (L,) end and recording of the windows that weigh the candidates.
        losses: (C + 1, L) of the simulator without a change and of the candidates.
        guard_s: minimum time [s] between the end of a used window and the start of a prediction.
        settings: settings of the adaptation.
    """

    config: SimulatorConfig
    processes: Processes
    filtered: Filtered
    recording: IndexArray
    end_s: FloatArray
    loss_recording: IndexArray
    loss_end_s: FloatArray
    losses: FloatArray
    guard_s: float
    settings: AdaptationSettings

    def predict(self, windows: PredictionWindows) -> FloatArray:
        """As ``PredictiveModel``: weighted mean of the predictions of all candidates."""
        return np.einsum("cs,cskj->skj", self.weights(windows.recording, windows.t0_s), self.candidates(windows))

    def candidates(self, windows: PredictionWindows) -> FloatArray:
        """Predictions (C + 1, S, K + 1, 6) without a change and by each candidate."""
        drifting = self.disturbances(windows.recording, windows.t0_s)
        unchanged = np.zeros((1, *drifting.shape[1:]))
        return simulate_disturbed(windows, self.config, np.concatenate([unchanged, drifting]), self.settings)

    def disturbances(self, recording: IndexArray, t_s: FloatArray) -> FloatArray:
        """Estimated disturbances (C, S, n) at times of recordings, 0 before the first measured window."""
        index = self._last_before(self.recording, self.end_s, recording, t_s)
        age_s = t_s - self.end_s[np.maximum(index, 0)]
        decay = np.exp(-age_s / self.processes.time_constant_s[:, None])
        return np.where(index[:, None] >= 0, self.filtered.mean[:, np.maximum(index, 0)] * decay[..., None], 0.0)

    def weights(self, recording: IndexArray, t_s: FloatArray) -> FloatArray:
        """Weights (C + 1, S) of the simulator without a change and of the candidates at times of recordings."""
        index = self._last_before(self.loss_recording, self.loss_end_s, recording, t_s)
        logarithm = np.where(index >= 0, -self._remembered_losses()[:, np.maximum(index, 0)], 0.0)
        weights = np.exp(logarithm - logarithm.max(axis=0))
        return np.asarray(weights / weights.sum(axis=0))

    def series(self) -> DisturbanceSeries:
        """Mean and standard deviation over the candidates after each measured window."""
        weights = self.weights(self.recording, self.end_s + self.guard_s)
        shares = weights[1:] / np.maximum(weights[1:].sum(axis=0), 1e-300)
        mean = np.einsum("cs,csn->sn", shares, self.filtered.mean)
        variance = np.einsum("csnn->csn", self.filtered.covariance) + (self.filtered.mean - mean) ** 2
        std = np.sqrt(np.einsum("cs,csn->sn", shares, variance))
        return DisturbanceSeries(self.recording, self.end_s, mean, std, weights.T)

    def _remembered_losses(self) -> FloatArray:
        """Sums (C + 1, L) of the losses up to each window, with exponential forgetting."""
        settings = self.settings
        share = settings.weight_stride_s / max(settings.weight_horizon_s, settings.weight_stride_s)  # overlap
        total = np.zeros_like(self.losses)
        for k in range(self.losses.shape[1]):
            total[:, k] = share * self.losses[:, k]
            if k and self.loss_recording[k] == self.loss_recording[k - 1]:
                elapsed_s = self.loss_end_s[k] - self.loss_end_s[k - 1]
                total[:, k] += np.exp(-elapsed_s / settings.weight_memory_s) * total[:, k - 1]
        return total

    def _last_before(
        self, recordings: IndexArray, ends_s: FloatArray, recording: IndexArray, t_s: FloatArray
    ) -> IndexArray:
        """Index (S,) of the last window that ended before each time; -1 if there is none."""
        found = np.full(len(t_s), -1)
        for name in np.unique(recording):
            own, asked = np.flatnonzero(recordings == name), recording == name
            if len(own):
                index = np.searchsorted(ends_s[own], t_s[asked] - self.guard_s + 1e-6, side="right") - 1
                found[asked] = np.where(index >= 0, own[np.maximum(index, 0)], -1)
        return found


def adapt(
    config: SimulatorConfig,
    tracks: Sequence[Track],
    noise: AdaptationNoise,
    settings: AdaptationSettings | None = None,
    *,
    drifts: Sequence[bool] = ALL_DRIFTS,
    velocity_window_s2: float = 0.0,
) -> AdaptiveModel:
    """Estimate the disturbances of a simulator along recordings.

    Args:
        config: the fitted simulator.
        tracks: all tracks of the recordings; an estimate at t uses only their rows before t.
        noise: noise of the filter.
        settings: settings of the adaptation.
        drifts: which of the n drifting disturbances may differ from 0.
        velocity_window_s2: variance [s2] of the window over which the recorded velocities were differentiated.

    Raises:
        DataError: the car moves in no window.
    """
    settings = settings or AdaptationSettings()
    windows = _windows(tracks, settings.window_s, settings.window_s, velocity_window_s2)
    processes = _processes(noise, settings, np.array(drifts, dtype=np.float64))
    at = np.zeros((len(settings.time_constants_s), len(windows), len(settings.drift_std)))
    for _ in range(settings.linearisations):
        measured = linearised(windows, config, at, settings)
        filtered = run_filter(measured, processes)
        at = filtered.predicted
    model = AdaptiveModel(
        config,
        processes,
        filtered,
        windows.recording,
        measured.end_s,
        np.zeros(0, dtype=np.int64),
        np.zeros(0),
        np.zeros((len(at) + 1, 0)),
        guard_s(windows),
        settings,
    )
    return _with_losses(model, tracks, noise, velocity_window_s2)


def guard_s(windows: PredictionWindows) -> float:
    """Time [s] after a row at which its velocities are known: a period, and half the width of their window as a box."""
    return windows.period_s + float(np.sqrt(3.0 * windows.velocity_window_s2))


def choose_noise(
    config: SimulatorConfig,
    tracks: Sequence[Track],
    settings: AdaptationSettings | None = None,
    *,
    velocity_window_s2: float = 0.0,
) -> AdaptationNoise:
    """Choose the noise of the filter by the likelihood of fitted recordings, each window given the earlier ones.

    Raises:
        DataError: the car moves in no window.
    """
    settings = settings or AdaptationSettings()
    windows = _windows(tracks, settings.window_s, settings.window_s, velocity_window_s2)
    measured = linearised(windows, config, np.zeros((1, len(windows), len(settings.drift_std))), settings)
    calm = np.quantile(np.abs(measured.error[0]), settings.calm_quantile, axis=0)
    calm = np.maximum(calm * NORMAL_QUARTILE / _normal_quantile(settings.calm_quantile) / NORMAL_QUARTILE, 1e-6)
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
    loss_windows = _windows(tracks, settings.weight_horizon_s, settings.weight_stride_s, velocity_window_s2)
    final = _final_errors(loss_windows, simulate_windows(loss_windows, config), settings)[0]
    spread = np.maximum(np.median(np.abs(final), axis=0) / NORMAL_QUARTILE, 1e-6)
    return AdaptationNoise(errors[best] * calm, float(whites[best]), spread, settings.weight_horizon_s)


def linearised(
    windows: PredictionWindows, config: SimulatorConfig, at: FloatArray, settings: AdaptationSettings
) -> MeasuredWindows:
    """Errors after S windows with disturbances ``at`` (C, S, n), and their Jacobian by all m disturbances."""
    candidates, count, size = at.shape
    total = len(DISTURBANCES)
    full = np.zeros((candidates, count, total))
    full[..., :size] = np.clip(at, -np.array(settings.limits[:size]), settings.limits[:size])
    steps = np.array(settings.steps)
    moved = full[:, None] + np.concatenate([np.zeros((1, total)), np.diag(steps)])[None, :, None, :]
    predicted = simulate_disturbed(windows, config, moved.reshape(-1, count, total), settings)
    error = _final_errors(windows, predicted, settings).reshape(candidates, total + 1, count, 6)
    jacobian = (error[:, 1:] - error[:, :1]) / steps[None, :, None, None]
    end_s = windows.t0_s + windows.horizon_s
    return MeasuredWindows(windows.recording, end_s, error[:, 0], np.moveaxis(jacobian, 1, -1), full)


def simulate_disturbed(
    windows: PredictionWindows, config: SimulatorConfig, disturbances: FloatArray, settings: AdaptationSettings
) -> FloatArray:
    """Predict S windows with C sets of disturbances (C, S, n or m) [1, rad, 1, m/s2, m/s2, rad/s2].

    Returns:
        (C, S, K + 1, 6) as ``simulate_windows``.
    """
    parameters, size = config.parameters, disturbances.shape[-1]
    mass_kg, inertia_kgm2 = parameters.mass_kg, parameters.yaw_inertia_kgm2
    unit = np.array([1.0, 1.0, 1.0, mass_kg, mass_kg, inertia_kgm2])[:size]
    limits = np.array(settings.limits[:size])
    given = np.clip(disturbances, -limits, limits) * unit
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a diverged simulation has bounded errors
        return simulate_windows(windows, config, {name: given[..., k] for k, name in enumerate(DISTURBANCES[:size])})


def _with_losses(
    model: AdaptiveModel, tracks: Sequence[Track], noise: AdaptationNoise, velocity_window_s2: float
) -> AdaptiveModel:
    """The model with the losses of all candidates along the tracks; without a long enough window the same model."""
    settings = model.settings
    try:
        windows = _windows(tracks, noise.horizon_s, settings.weight_stride_s, velocity_window_s2)
    except DataError:
        return model
    errors = _final_errors(windows, model.candidates(windows), settings)
    distance_sq = np.sum((errors / noise.loss_std) ** 2, axis=-1)
    losses = 0.5 * (settings.dof + errors.shape[-1]) * np.log1p(distance_sq / settings.dof)
    end_s = windows.t0_s + windows.horizon_s
    return replace(model, loss_recording=windows.recording, loss_end_s=end_s, losses=losses)


def _processes(noise: AdaptationNoise, settings: AdaptationSettings, drifts: FloatArray) -> Processes:
    count = len(settings.time_constants_s)
    return Processes(
        np.tile(drifts * settings.drift_std, (count, 1)),
        np.array(settings.time_constants_s),
        np.tile(noise.error_std, (count, 1)),
        np.tile(noise.white_share * np.array(settings.white_std), (count, 1)),
        settings.dof,
    )


def _windows(
    tracks: Sequence[Track], horizon_s: float, stride_s: float, velocity_window_s2: float
) -> PredictionWindows:
    """Windows in the order of recording and time."""
    windows = cut_windows(tracks, horizon_s, stride_s)
    windows = windows.take(np.lexsort((windows.t0_s, windows.recording)))
    return replace(windows, velocity_window_s2=velocity_window_s2)


def _final_errors(windows: PredictionWindows, predicted: FloatArray, settings: AdaptationSettings) -> FloatArray:
    """Errors (..., S, 6) after the windows, finite and bounded."""
    bound = settings.max_error
    error = prediction_errors(predicted[..., -1:, :], replace(windows, measured=windows.measured[:, -1:]))[..., 0, :]
    return np.nan_to_num(error, nan=bound, posinf=bound, neginf=-bound).clip(-bound, bound)
