"""Split recordings into a part to fit and a held-out part, check them, and cut them into prediction windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, DataError
from carlab.diagnosis.events import Event, EventUse, mark_events
from carlab.diagnosis.findings import DataFault, Verdict
from carlab.diagnosis.settings import DiagnosisSettings, WindowSettings
from carlab.prediction.windows import (
    MIN_HISTORY_S,
    PredictionWindows,
    RecordingSegment,
    cut_windows,
    segments_of,
    split_segments,
)
from sim_backends.car_parameters import SimulatorConfig


class Inconclusive(DataError):
    """The recordings do not allow a verdict; the message states why and what to record.

    Attributes:
        data_faults: faults found so far.
        verdict: "data" if faults make most of the recordings unusable.
    """

    exit_code = 5
    data_faults: tuple[DataFault, ...] = ()
    verdict: Verdict = "inconclusive"


@dataclass(frozen=True, slots=True)
class SplitRecordings:
    """Segments and prediction windows to fit, and held-out ones; ``event_windows`` are held-out ones with events."""

    fit_segments: tuple[RecordingSegment, ...]
    held_out_segments: tuple[RecordingSegment, ...]
    fit_windows: PredictionWindows
    held_out_windows: PredictionWindows
    event_windows: PredictionWindows
    events: EventUse


def checked_held_out_share(given: float | None, settings: WindowSettings) -> float:
    """The given held-out share, or the default one; raises ConfigError if it is out of range."""
    share = settings.default_held_out_share if given is None else given
    if not 0.0 < share <= settings.max_held_out_share:
        raise ConfigError(
            f"--holdout-share {share:g} is out of range; give a share above 0 and at most "
            f"{settings.max_held_out_share:g}."
        )
    return share


def split_recordings(
    fit: Sequence[EpisodeData],
    held_out: Sequence[EpisodeData],
    held_out_share: float,
    nominal: SimulatorConfig,
    settings: DiagnosisSettings,
    *,
    keep_events: bool = False,
) -> SplitRecordings:
    """Split recordings without faults, find their events, and cut them into windows without events.

    Args:
        fit: recordings to fit.
        held_out: held-out recordings; if empty, the last part of each recording to fit is held out.
        held_out_share: share of that part.
        nominal: simulator of the car file, for the grip.
        settings: settings of the windows.
        keep_events: whether windows may contain events.

    Raises:
        Inconclusive: too little driving, speed or variation of the commands, or events in all windows.
        DataError: a recording has fewer than two commands.
    """
    has_own = bool(held_out)
    marked_fit, fit_events = mark_events(fit, nominal)
    marked_held_out, held_out_events = mark_events(held_out, nominal)
    if not keep_events:
        fit, held_out = marked_fit, marked_held_out
    cut = settings.windows
    fit_segments, held_out_segments = _split(fit, held_out, held_out_share, cut)
    check_excitation(fit_segments, cut)
    fit_windows, fit_event_windows = _cut(
        fit_segments, "part to fit", cut.fit_window_s, cut.fit_stride_s, cut.max_fit_windows
    )
    held_out_windows, event_windows = _cut(
        held_out_segments, "held-out part", cut.held_out_window_s, cut.held_out_stride_s, cut.max_held_out_windows
    )
    events_to_fit = _with_roles(fit_events, () if has_own else held_out_segments)
    events = (*events_to_fit, *(replace(event, role="held out") for event in held_out_events))
    use = EventUse(events, not keep_events, len(fit_event_windows), len(event_windows))
    return SplitRecordings(
        tuple(fit_segments), tuple(held_out_segments), fit_windows, held_out_windows, event_windows, use
    )


def _with_roles(events: Sequence[Event], held_out_segments: Sequence[RecordingSegment]) -> tuple[Event, ...]:
    """Events of recordings to fit: those in a held-out part of their recording are held out."""

    def is_held_out(event: Event) -> bool:
        own = [segment for segment in held_out_segments if segment.recording == event.recording - 1]
        return any(segment.t_s[0] <= event.to_s and event.from_s <= segment.t_s[-1] for segment in own)

    return tuple(replace(event, role="held out" if is_held_out(event) else "fit") for event in events)


def _split(
    fit: Sequence[EpisodeData], held_out: Sequence[EpisodeData], share: float, settings: WindowSettings
) -> tuple[list[RecordingSegment], list[RecordingSegment]]:
    """Segments to fit and held-out segments; without held-out recordings, the end of each recording is held out."""
    fit_segments = segments_of(fit)
    if not fit_segments:
        raise Inconclusive("No recording has an unbroken stretch of half a second; record without gaps.")
    period_s = fit_segments[0].period_s
    if held_out:
        held_out_segments = segments_of(held_out, period_s)
        if not held_out_segments:
            raise Inconclusive(
                "The held-out recordings have no unbroken stretch of half a second; hold out other recordings."
            )
        return fit_segments, held_out_segments
    _check_duration(fit_segments, settings)
    early, late = split_segments(fit_segments, share, settings.held_out_window_s + settings.split_guard_s)
    recorded_s, remaining_s = (sum(segment.duration_s for segment in part) for part in (fit_segments, early))
    if remaining_s < settings.min_fit_s:
        raise Inconclusive(
            f"The recordings contain {recorded_s:.1f} s of driving, but only {remaining_s:.1f} s without the last part "
            "of each recording, which is held out, and the gap before it. Hold out whole recordings with --held-out, "
            "name the folder of a run (every third episode is held out), or record longer drives."
        )
    return early, late


def _cut(
    segments: Sequence[RecordingSegment], part: str, horizon_s: float, stride_s: float, max_windows: int
) -> tuple[PredictionWindows, PredictionWindows]:
    """Prediction windows without and with events. Raises Inconclusive without windows."""
    if not segments:
        raise Inconclusive("The recording is too short to hold out a part of it; record a longer drive (100 s).")
    try:
        cut = cut_windows(segments, horizon_s, stride_s, with_events=True)
    except DataError as error:
        raise Inconclusive(
            f"In the {part} of the recordings the car moves in no stretch of {horizon_s + MIN_HISTORY_S:.1f} s; record "
            "a longer drive, or name recordings of a moving car to fit and to hold out."
        ) from error
    try:
        return cut.thinned(max_windows).split_at_events()
    except DataError as error:
        raise Inconclusive(str(error)) from error


def _check_duration(segments: Sequence[RecordingSegment], settings: WindowSettings) -> None:
    """Raise Inconclusive if the segments to fit are too short."""
    seconds = sum(segment.duration_s for segment in segments)
    if seconds < settings.min_fit_s:
        raise Inconclusive(
            f"The recordings to fit contain {seconds:.1f} s of driving. A diagnosis needs at least "
            f"{settings.min_fit_s:.0f} s, better 100 s, with changing speed and steering, for example carlab drive "
            "--policy excitation --episodes 2."
        )


def check_excitation(segments: Sequence[RecordingSegment], settings: WindowSettings) -> None:
    """Raise Inconclusive if the excitation is not sufficient; the message states what to record."""
    _check_duration(segments, settings)
    speed = np.concatenate([np.hypot(t.smooth[:, 3], t.smooth[:, 4]) for t in segments])
    if np.quantile(speed, 0.9) < settings.min_speed_mps:
        raise Inconclusive("The car hardly moves in the recordings to fit; record a drive.")
    commands = np.concatenate([t.commands for t in segments])
    for k, name in enumerate(("steering", "throttle")):
        if commands[:, k].std() < settings.min_command_std:
            raise Inconclusive(
                f"The {name} command is constant, so its influence cannot be identified; record a drive that varies "
                f"it, for example carlab drive --policy {name}_steps."
            )
