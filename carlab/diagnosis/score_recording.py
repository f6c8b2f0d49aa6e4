"""Prediction errors of a simulator on a recording, computed like the held-out errors of a diagnosis.

Faults of the recording are repaired; the initial states are estimated, and the velocity window and the noise unless a
``model.toml`` states them. A ``model.toml`` therefore has the error that its report states, up to the initial states:
the report corrects them by the car file, a replay by the model itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, DataError
from carlab.core.quantities import FloatArray
from carlab.core.recording_noise import RecordingNoise
from carlab.diagnosis.events import EventUse, mark_events
from carlab.diagnosis.findings import DataFault, FitErrors
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.identification.measurement_noise import Noise, estimate_noise
from carlab.diagnosis.identification.velocity_window import with_initial_states
from carlab.diagnosis.recording_faults import find as recording_faults
from carlab.diagnosis.recordings import checked_held_out_share
from carlab.diagnosis.settings import DEFAULT
from carlab.diagnosis.unexplained.vibration import find_vibration
from carlab.prediction.adaptation import AdaptiveModel, choose_noise
from carlab.prediction.adaptation import adapt as adapt_along
from carlab.prediction.errors import final_errors
from carlab.prediction.predict import ConstantVelocity, NoChange, PredictiveModel, SimulatorModel, predicted_at
from carlab.prediction.windows import PredictionWindows, RecordingSegment, cut_windows, segments_of, split_segments
from sim_backends.car_parameters import SimulatorConfig

MODEL, ADAPTED, CONSTANT_VELOCITY, NO_CHANGE = "model", "adapted", "constant velocity", "no change"
_GUARD_S = DEFAULT.windows.held_out_window_s + DEFAULT.windows.split_guard_s
"""Gap between the first and the last part of a recording [s]."""


@dataclass(frozen=True, slots=True)
class PartScore:
    """Errors after the horizon in one part of a recording.

    Attributes:
        part: "whole recording" or "last 30 %".
        held_out: S windows and their noise floor.
        errors: (S, 6) of the model and of the baselines, by name, in SI units.
        event_windows: E windows that events left out.
        event_errors: (E, 6) of the same models.
    """

    part: str
    held_out: HeldOut
    errors: Mapping[str, FloatArray]
    event_windows: PredictionWindows
    event_errors: Mapping[str, FloatArray]

    def summaries(self, *, with_events: bool = False) -> dict[str, FitErrors]:
        """Root mean square errors of each model, and the noise floor."""
        errors = self.errors
        if with_events:
            errors = {name: np.concatenate([e, self.event_errors[name]]) for name, e in errors.items()}
        found = {name: self.held_out.summary(e) for name, e in errors.items()}
        return found | {"noise floor": self.held_out.floor_summary()}


@dataclass(frozen=True, slots=True)
class RecordingScore:
    """Errors of a simulator on a recording.

    Attributes:
        horizon_s: prediction horizon, a whole number of steps.
        whole: errors in the whole recording.
        last: errors in the part that a diagnosis of this recording alone holds out; None if it is too short.
        episodes: the recording, repaired.
        overlays: predictions (T + 1, 6) in SI units at the stamps of each episode, restarted every horizon; NaN
            without a prediction.
        faults: faults of the recording.
        adaptation: the simulator adapted along the recording; None if that was not wanted.
        events: events of the recording.
    """

    horizon_s: float
    whole: PartScore
    last: PartScore | None
    episodes: tuple[EpisodeData, ...]
    overlays: tuple[FloatArray, ...]
    faults: tuple[DataFault, ...]
    adaptation: AdaptiveModel | None = None
    events: EventUse = field(default_factory=EventUse)


def score_recording(
    episodes: Sequence[EpisodeData],
    config: SimulatorConfig,
    *,
    noise: RecordingNoise | None = None,
    horizon_s: float = DEFAULT.windows.held_out_window_s,
    stride_s: float = DEFAULT.windows.held_out_stride_s,
    holdout_share: float = DEFAULT.windows.default_held_out_share,
    adapt: bool = False,
    keep_events: bool = False,
) -> RecordingScore:
    """Predict a recording from many initial states along it.

    Args:
        episodes: the recording as read.
        config: the simulator, observation effects included.
        noise: noise and velocity window of the diagnosis of the simulator; estimated from the recording if absent.
        horizon_s: prediction horizon.
        stride_s: time between initial states.
        holdout_share: share of the last part, which is scored separately, above 0 and at most 0.5.
        adapt: also predict with adaptation to the recent past. ``noise`` states the noise of its filter; if absent, it
            is chosen on this recording.
        keep_events: score windows with events (collisions) too; they are listed in any case.

    Raises:
        DataError: the recording has too few commands, no window of that length in which the car moves, or an event in
            each of these windows.
        ConfigError: horizon, stride or share is out of range.
    """
    checked_held_out_share(holdout_share, DEFAULT.windows)
    if not all(isinstance(v, (int, float)) and 0.0 < v < math.inf for v in (horizon_s, stride_s)):
        raise ConfigError(f"Horizon {horizon_s} s and stride {stride_s} s must be finite numbers above zero.")
    if not any(episode.ticks for episode in episodes):
        raise DataError("The recording contains no command; give a recording of a drive.")
    repaired, _, faults = recording_faults.check(episodes, [], config)
    marked, events = mark_events(repaired, config)
    segments = segments_of(repaired if keep_events else marked)
    if not segments:
        raise DataError("The recording has no unbroken stretch of half a second; record without gaps.")
    whole = _score("whole recording", segments, segments, config, noise, horizon_s, stride_s)
    early, late = split_segments(segments, holdout_share, _GUARD_S)
    try:
        last = _score(f"last {100.0 * holdout_share:g} %", early, late, config, noise, horizon_s, stride_s)
    except DataError:
        last = None
    adaptation = None
    if adapt:
        adaptation = _adapted(segments, config, noise, whole.held_out.windows.velocity_window_s2)
        whole = _with_model(whole, adaptation)
        last = None if last is None else _with_model(last, adaptation)
    return RecordingScore(
        whole.held_out.windows.horizon_s,
        whole,
        last,
        tuple(repaired),
        _overlays(repaired, segments, config, horizon_s),
        tuple(faults),
        adaptation,
        EventUse(events, not keep_events, 0, len(whole.event_windows)),
    )


def _adapted(
    segments: list[RecordingSegment], config: SimulatorConfig, known: RecordingNoise | None, window_s2: float
) -> AdaptiveModel:
    """The simulator adapted along the recording."""
    noise = None if known is None else known.adaptation
    if noise is None:
        noise = choose_noise(config, segments, velocity_window_s2=window_s2)
    return adapt_along(config, segments, noise, velocity_window_s2=window_s2)


def _with_model(part: PartScore, adaptation: AdaptiveModel) -> PartScore:
    """The part with the errors of the adapted simulator."""
    both = [
        {MODEL: errors[MODEL], ADAPTED: final_errors(adaptation, windows), **errors}
        for errors, windows in ((part.errors, part.held_out.windows), (part.event_errors, part.event_windows))
    ]
    return replace(part, errors=both[0], event_errors=both[1])


def _score(
    part: str,
    fit_segments: list[RecordingSegment],
    segments: list[RecordingSegment],
    config: SimulatorConfig,
    known: RecordingNoise | None,
    horizon_s: float,
    stride_s: float,
) -> PartScore:
    """Errors on ``segments``; velocity window and noise are known or those of ``fit_segments``.

    Raises DataError without windows.
    """
    if not fit_segments or not segments:
        raise DataError("The part is too short.")
    settings = DEFAULT.windows
    fit_windows = cut_windows(fit_segments, min(settings.fit_window_s, horizon_s), settings.fit_stride_s)
    fit_windows = fit_windows.thinned(settings.max_fit_windows)
    cut = cut_windows(segments, horizon_s, stride_s, with_events=True).thinned(settings.max_held_out_windows)
    windows, event_windows = cut.split_at_events()
    window_s2 = None if known is None else known.velocity_window_s2
    fit_windows, windows, event_windows = with_initial_states(
        (fit_windows, windows, event_windows), config, variance_s2=window_s2
    )
    if known is None:
        vibrates = find_vibration(fit_segments) is not None
        noise = estimate_noise(fit_segments, fit_windows.curvature_bias, slowest=vibrates)
    else:
        noise = Noise.of(known)
    floor = None if known is None else known.floor_after(windows.horizon_s)
    held_out = HeldOut.of(windows, noise, config) if floor is None else HeldOut(windows, np.array(floor), noise)
    models: dict[str, PredictiveModel] = {
        MODEL: SimulatorModel(config),
        CONSTANT_VELOCITY: ConstantVelocity(),
        NO_CHANGE: NoChange(),
    }
    errors, event_errors = (
        {name: final_errors(model, w) for name, model in models.items()} for w in (windows, event_windows)
    )
    return PartScore(part, held_out, errors, event_windows, event_errors)


def _overlays(
    episodes: Sequence[EpisodeData], segments: Sequence[RecordingSegment], config: SimulatorConfig, horizon_s: float
) -> tuple[FloatArray, ...]:
    windows = cut_windows(segments, horizon_s, horizon_s, with_events=True)
    predicted = SimulatorModel(config).predict(windows)
    found = []
    for index, episode in enumerate(episodes):
        own = windows.recording == index
        found.append(predicted_at(episode.times_s - episode.times_s[0], windows.take(own), predicted[own]))
    return tuple(found)


def describe_windows(score: PartScore) -> str:
    """Name of a part with number and time span of its windows."""
    windows = score.held_out.windows
    first_s, last_s = float(np.min(windows.t0_s)), float(np.max(windows.t0_s)) + windows.horizon_s
    return f"{score.part} ({len(windows)} windows from {first_s:.1f} to {last_s:.1f} s)"
