"""Split recordings into a part to fit and a held-out part, check them, and cut them into prediction windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, DataError
from carlab.diagnosis.findings import DataFault, Verdict
from carlab.diagnosis.settings import WindowSettings
from carlab.prediction.windows import PredictionWindows, Track, cut_windows, split_tracks, tracks_of


class Inconclusive(DataError):
    """The recordings do not allow a verdict about the simulator; the message states why and what to record.

    Attributes:
        data_faults: faults found so far.
        verdict: "data" if faults make most of the recordings unusable.
    """

    data_faults: tuple[DataFault, ...] = ()
    verdict: Verdict = "inconclusive"


@dataclass(frozen=True, slots=True)
class SplitRecordings:
    """Tracks and prediction windows to fit, and held-out ones."""

    fit_tracks: tuple[Track, ...]
    held_out_tracks: tuple[Track, ...]
    fit_windows: PredictionWindows
    held_out_windows: PredictionWindows


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
    fit: Sequence[EpisodeData], held_out: Sequence[EpisodeData], held_out_share: float, settings: WindowSettings
) -> SplitRecordings:
    """Split recordings and cut them into windows.

    Raises:
        Inconclusive: too little driving, speed or variation of the commands.
    """
    fit_tracks, held_out_tracks = _split(fit, held_out, held_out_share, settings)
    check_excitation(fit_tracks, settings)
    fit_windows = _cut(fit_tracks, settings.fit_window_s, settings.fit_stride_s).thinned(settings.max_fit_windows)
    held_out_windows = _cut(held_out_tracks, settings.held_out_window_s, settings.held_out_stride_s)
    held_out_windows = held_out_windows.thinned(settings.max_held_out_windows)
    return SplitRecordings(tuple(fit_tracks), tuple(held_out_tracks), fit_windows, held_out_windows)


def _split(
    fit: Sequence[EpisodeData], held_out: Sequence[EpisodeData], share: float, settings: WindowSettings
) -> tuple[list[Track], list[Track]]:
    """Tracks to fit and held-out tracks; without held-out recordings, the end of each recording is held out."""
    fit_tracks = tracks_of(fit)
    if not fit_tracks:
        raise Inconclusive("No recording has an unbroken stretch of half a second; record without gaps.")
    period_s = fit_tracks[0].period_s
    if held_out:
        held_out_tracks = tracks_of(held_out, period_s)
        if not held_out_tracks:
            raise Inconclusive(
                "The held-out recordings have no unbroken stretch of half a second; hold out other recordings."
            )
        return fit_tracks, held_out_tracks
    return split_tracks(fit_tracks, share, settings.held_out_window_s + settings.split_guard_s)


def _cut(tracks: Sequence[Track], horizon_s: float, stride_s: float) -> PredictionWindows:
    """Prediction windows. Raises Inconclusive without windows."""
    if not tracks:
        raise Inconclusive("The recording is too short to hold out a part of it; record a longer drive (100 s).")
    try:
        return cut_windows(tracks, horizon_s, stride_s)
    except DataError as error:
        raise Inconclusive(str(error)) from error


def check_excitation(tracks: Sequence[Track], settings: WindowSettings) -> None:
    """Raise Inconclusive if the excitation is not sufficient; the message states what to record."""
    seconds = sum(track.duration_s for track in tracks)
    if seconds < settings.min_fit_s:
        raise Inconclusive(
            f"The recordings to fit contain {seconds:.1f} s of driving. A diagnosis needs at least "
            f"{settings.min_fit_s:.0f} s, better 100 s, with changing speed and steering "
            "(carlab drive --policy steering_steps)."
        )
    speed = np.concatenate([np.hypot(t.smooth[:, 3], t.smooth[:, 4]) for t in tracks])
    if np.quantile(speed, 0.9) < settings.min_speed_mps:
        raise Inconclusive("The car hardly moves in the recordings to fit; record a drive.")
    commands = np.concatenate([t.commands for t in tracks])
    for k, name in enumerate(("steering", "throttle")):
        if commands[:, k].std() < settings.min_command_std:
            raise Inconclusive(
                f"The {name} command is constant, so its influence cannot be identified; record a drive that varies "
                f"it, for example carlab drive --policy {name}_steps."
            )


__all__ = ["Inconclusive", "SplitRecordings", "check_excitation", "checked_held_out_share", "split_recordings"]
