"""Data of the report's figures: traces, scores, regimes and correlations of a scored search."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.diagnosis.events import Event
from carlab.diagnosis.evidence import ScoredSearch, scores_by_step
from carlab.diagnosis.findings import FigureData, Trace
from carlab.diagnosis.recordings import SplitRecordings
from carlab.diagnosis.settings import REPORT
from carlab.diagnosis.unexplained.description import REGIMES, start_features
from carlab.prediction.errors import prediction_errors, simulation_errors
from carlab.prediction.predict import predicted_at, simulate_windows
from carlab.prediction.windows import MIN_HISTORY_S, PredictionWindows, RecordingSegment, cut_windows, history_rows
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS

TRACES_TRIED = 6
"""Number of the longest held-out recordings that are searched for traces with motion."""


def figure_data_of(scored: ScoredSearch, recordings: SplitRecordings) -> FigureData:
    """Data of the figures."""
    found = scored.found
    correlation = {
        name: _correlation(scored.problem.windows, found.base.config, EFFECTS[name].command == "throttle")
        for name in found.effects[: REPORT.max_correlations]
    }
    candidates = tuple(
        (c.effect, c.standard_errors if c.is_tested else math.nan, float(c.fit.loss.sum()))
        for c in found.first_candidates
    )
    steps = (*scores_by_step(scored), ("noise floor", 1.0))
    return FigureData(_traces(scored, recordings), steps, _regimes(scored), correlation, candidates)


def _regimes(scored: ScoredSearch) -> dict[str, tuple[FloatArray, FloatArray, FloatArray]]:
    """By feature: centres of its bins, and the errors (noise floors) of the refit and with effects."""
    held_out = scored.held_out
    seen = start_features(held_out.windows)
    size = {name: np.sqrt(np.mean((e / held_out.floor) ** 2, axis=1)) for name, e in scored.errors.items()}
    regimes = {}
    for name, unit, value in REGIMES:
        feature = value(seen)
        edges = np.unique(np.quantile(feature, np.linspace(0, 1, 7)))
        if len(edges) < 3:
            continue
        index = np.clip(np.searchsorted(edges, feature, side="right") - 1, 0, len(edges) - 2)
        bins = [k for k in range(len(edges) - 1) if np.any(index == k)]
        centres = np.array([feature[index == k].mean() for k in bins])
        curves = [
            np.array([np.sqrt(np.mean(size[which][index == k] ** 2)) for k in bins])
            for which in ("refit", "with_effects")
        ]
        regimes[f"{name} [{unit}]" if unit else name] = (centres, curves[0], curves[1])
    return regimes


def _correlation(
    windows: PredictionWindows, config: SimulatorConfig, on_throttle: bool
) -> tuple[FloatArray, FloatArray, float]:
    """Correlation of the missing acceleration with the rate of a command at lags [s], and its 99 % bound."""
    error = simulation_errors(windows, config)
    step = min(max(round(REPORT.correlation_step_s / windows.period_s), 1), windows.steps)
    column = 3 if on_throttle else 5
    missing = -error[:, step, column] / (step * windows.period_s)
    recent = windows.past_commands[:, -history_rows(windows.period_s, MIN_HISTORY_S) :]
    command = recent[:, :, 1 if on_throttle else 0]
    lags = np.arange(0, command.shape[1] - 1)
    values = []
    for lag in lags:
        rate = command[:, -1 - lag] - command[:, -2 - lag]
        values.append(float(np.corrcoef(rate, missing)[0, 1]) if rate.std() > 1e-9 else 0.0)
    blocks = len(np.unique(windows.block))
    return lags * windows.period_s, np.array(values), REPORT.correlation_z / math.sqrt(max(blocks, 1))


def _traces(scored: ScoredSearch, recordings: SplitRecordings) -> tuple[Trace, ...]:
    """Held-out recordings with predictions, and fitted recordings with events without predictions."""
    models = {
        "nominal": scored.problem.nominal,
        "refit": scored.found.base.config,
        "with_effects": scored.found.best.config,
    }
    horizon_s = scored.problem.settings.windows.held_out_window_s
    longest = sorted(recordings.held_out_segments, key=lambda segment: -len(segment.t_s))[:TRACES_TRIED]
    events = recordings.events.found
    traces = [t for segment in longest if (t := _trace(segment, models, horizon_s, events)) is not None]
    fitted = [
        Trace(f"fitted recording {segment.recording + 1}", segment.t_s, segment.states, {}, (), own)
        for segment in recordings.fit_segments
        if (own := _events_in(segment, events, "fit"))
    ]
    return (*traces[: REPORT.max_traces], *fitted[: REPORT.max_traces])


def _events_in(segment: RecordingSegment, events: Sequence[Event], role: str) -> tuple[Event, ...]:
    begin_s, end_s = float(segment.t_s[0]), float(segment.t_s[-1])
    own = [e for e in events if e.role == role and e.recording == segment.recording + 1]
    return tuple(e for e in own if begin_s <= e.to_s and e.from_s <= end_s)


def _trace(
    segment: RecordingSegment,
    models: Mapping[str, SimulatorConfig],
    horizon_s: float,
    events: Sequence[Event],
) -> Trace | None:
    """Predictions along a segment, restarted every horizon; None if the car does not move for a horizon."""
    try:
        windows = cut_windows([segment], horizon_s, horizon_s, with_events=True)
    except DataError:
        return None
    span_s = windows.horizon_s
    predicted = {}
    worst: list[tuple[float, float]] = []
    for name, config in models.items():
        out = simulate_windows(windows, config)
        predicted[name] = predicted_at(segment.t_s, windows, out[0])
        if name == "refit":
            final = np.linalg.norm(prediction_errors(out, windows)[0, :, -1, :2], axis=1)
            order = [k for k in np.argsort(-final) if not windows.in_event[k]][: REPORT.worst_stretches]
            worst = [(float(windows.t0_s[k]), float(windows.t0_s[k] + span_s)) for k in order]
    own = _events_in(segment, events, "held out")
    return Trace(
        f"recording {segment.recording + 1}", segment.t_s, segment.states, predicted, tuple(sorted(worst)), own
    )
