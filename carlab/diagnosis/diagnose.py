"""The diagnosis as a whole: recordings and a car file in, a verdict with its evidence and a mended simulator out."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.clock import MonotonicClock
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, DataError
from carlab.diagnosis import data_faults as data_faults_of
from carlab.diagnosis.findings import (
    DataFault,
    Diagnosis,
    Exhibits,
    RecordingUse,
    Verdict,
)
from carlab.diagnosis.judge import HORIZON_S, Judge, Texts
from carlab.diagnosis.measurement_noise import estimate_noise
from carlab.diagnosis.naming import Believed, believed, unexplained
from carlab.diagnosis.scoring import HeldOut, noise_floor
from carlab.diagnosis.search import Progress, Search
from carlab.diagnosis.shots import Shots, Track, cut, tracks_of
from carlab.diagnosis.starts import corrected
from carlab.diagnosis.unexplained import missing_terms
from carlab.diagnosis.velocity_window import smear_s2
from carlab.diagnosis.vibration import find_vibration
from sim_backends.car_parameters import SimulatorConfig

log = logging.getLogger(__name__)

FIT_SHOT_S = 0.8
FIT_STRIDE_S = 0.3
SCORE_STRIDE_S = 0.25
MAX_SHOTS = 600
MAX_SCORED = 1200
MIN_SECONDS = 8.0
HOLDOUT_SHARE, LARGEST_HOLDOUT_SHARE = 0.3, 0.5
MIN_SHARE = 0.1
SPOILT_SHARE = 0.5
"""Faults that leave less of a recording than this have spoilt it."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The answer, the material for its pictures, and the simulator with everything found."""

    diagnosis: Diagnosis
    exhibits: Exhibits
    model: SimulatorConfig


class Inconclusive(DataError):
    """The recording cannot tell; the message says why and what to record.

    ``data_faults`` were found until then; ``verdict`` is "data" where they, and not the drive, leave too little.
    """

    data_faults: tuple[DataFault, ...] = ()
    verdict: Verdict = "inconclusive"


def diagnose(
    fit: Sequence[EpisodeData],
    held_out: Sequence[EpisodeData],
    nominal: SimulatorConfig,
    texts: Texts,
    *,
    uses: Sequence[RecordingUse] = (),
    data_faults: Sequence[DataFault] = (),
    effects: Sequence[str] | None = None,
    holdout_share: float = HOLDOUT_SHARE,
    seed: int = 0,
    progress: Progress = lambda what, share: None,
    stop: Callable[[], bool] = lambda: False,
) -> Outcome:
    """Find what ``nominal`` leaves out of recordings.

    Args:
        fit: recordings to fit.
        held_out: recordings that only judge; without any, the last part of each recording is held out.
        nominal: the simulator of the car file.
        texts: sentences and look-alikes.
        uses: which recording is what, for the report.
        data_faults: what was repaired when the files were read; what is found here is added to it.
        effects: the only effects to try; all of the catalogue unless given. Names that were given are not withdrawn.
        holdout_share: of each recording, its last part, where no recording is held out; above 0 and at most 0.5.
        seed: written into the report; nothing here draws random numbers that depend on it.
        progress: told what is being done and how far it is, in [0, 1].
        stop: once true, the search ends and what it has found is judged and reported.

    Raises:
        Inconclusive: the recordings cannot tell; why, and what to record.
        ConfigError: the simulator cannot integrate, or the share leaves too little.
    """
    if not 0.0 < holdout_share <= LARGEST_HOLDOUT_SHARE:
        raise ConfigError(
            f"--holdout-share {holdout_share:g} leaves too little to fit or to judge by; give one above 0 and at most "
            f"{LARGEST_HOLDOUT_SHARE:g}."
        )
    clock = MonotonicClock()
    began_s = clock.now_s()
    progress("reading", 0.0)
    recorded_s = sum(len(e.times_s) for e in fit) * nominal.control_period_s
    fit, held_out, own_faults = data_faults_of.check(fit, held_out, nominal)
    data_faults = (*data_faults, *own_faults)
    progress("reading", 0.03)
    try:
        fit_tracks, held_tracks = _split(fit, held_out, holdout_share)
        _check_excitation(fit_tracks)
        shots = _thinned(_cut(fit_tracks, FIT_SHOT_S, FIT_STRIDE_S))
        held_shots = _thinned(_cut(held_tracks, HORIZON_S, SCORE_STRIDE_S), MAX_SCORED)
    except Inconclusive as error:
        error.data_faults = tuple(data_faults)
        left_s = sum(len(track.t_s) * track.period_s for track in tracks_of(fit))
        if data_faults and left_s < MIN_SECONDS and left_s < SPOILT_SHARE * recorded_s:
            error.verdict = "data"
        raise
    smear = smear_s2(shots, nominal)
    shots, held_shots = (corrected(replace(s, smear_s2=smear), nominal) for s in (shots, held_shots))
    noise = estimate_noise(fit_tracks, shots.bent)
    floor = np.sqrt(np.mean(noise_floor(shots, noise, nominal)[1:] ** 2, axis=0))
    search = Search(
        nominal,
        shots,
        floor,
        texts.look_alikes,
        effects,
        lambda what, share: progress(what, 0.05 + 0.75 * share),
        stop,
    )
    found = search.run()
    progress("looking for what has no name", 0.8)
    vibration = find_vibration(fit_tracks)
    quiet = noise if vibration is None else estimate_noise(fit_tracks, shots.bent, slowest=True)
    held = HeldOut.of(held_shots, quiet, found.best.config)
    if effects is None:
        what = believed(search, found, held, vibration)
    else:
        what = Believed(found, missing_terms(shots, found.best, found.scale), None, vibration)
    found = what.found
    progress("judging on held-out recordings", 0.82)
    judge = Judge(search, found, held, texts)
    findings = judge.findings(lambda share: progress("taking effects out again", 0.82 + 0.1 * share))
    errors_of = judge.errors
    score = {name: held.score(error) for name, error in errors_of.items()}
    share = _share_left(score)
    rest, model = None, None
    if share >= MIN_SHARE:
        rest, model = unexplained(search, what, share, errors_of["with_effects"], held)
    verdict = judge.verdict(what.something, data_faults)
    progress("drawing", 0.95)
    exhibits = judge.exhibits(held_tracks)
    diagnosis = Diagnosis(
        verdict=verdict,
        sentence="",
        effects=findings if verdict == "mismatch" else (),
        parameters=judge.parameters(),
        horizon_s=HORIZON_S,
        held_out={name: held.summary(error) for name, error in errors_of.items()}
        | {"noise_floor": held.floor_summary()},
        unexplained=rest,
        data_faults=tuple(data_faults),
        recordings=tuple(uses),
        seed=seed,
        seconds=clock.now_s() - began_s,
    )
    return Outcome(diagnosis, exhibits, model or found.best.config)


def _share_left(score: Mapping[str, float]) -> float:
    """Share of the refit's squared excess that the effects leave."""
    excess = score["refit"] ** 2 - 1.0
    return max(score["with_effects"] ** 2 - 1.0, 0.0) / excess if excess > 0.05 else 0.0


def _split(
    fit: Sequence[EpisodeData], held_out: Sequence[EpisodeData], share: float
) -> tuple[list[Track], list[Track]]:
    """Tracks to fit and to judge by; the end of each recording is held out where no recording is."""
    fit_tracks = tracks_of(fit)
    if not fit_tracks:
        raise Inconclusive("No recording has an unbroken stretch of half a second; record without gaps.")
    period_s = fit_tracks[0].period_s
    if held_out:
        held_tracks = tracks_of(held_out, period_s)
        if not held_tracks:
            raise Inconclusive("The held-out recordings have no unbroken stretch; hold out another one.")
        return fit_tracks, held_tracks
    early, late = [], []
    for track in fit_tracks:
        cut_at = round((1.0 - share) * len(track.t_s))
        guard = round((HORIZON_S + 0.5) / period_s)
        early.append(_part(track, slice(0, max(cut_at - guard, 0))))
        late.append(_part(track, slice(cut_at, len(track.t_s))))
    return [t for t in early if len(t.t_s) > guard], [t for t in late if len(t.t_s) > guard]


def _cut(tracks: list[Track], horizon_s: float, stride_s: float) -> Shots:
    """Shots; Inconclusive where there are none."""
    if not tracks:
        raise Inconclusive("Too little is left to judge by when part is held out; record a longer drive (100 s).")
    try:
        return cut(tracks, horizon_s, stride_s)
    except DataError as error:
        raise Inconclusive(str(error)) from error


def _part(track: Track, rows: slice) -> Track:
    return replace(
        track,
        t_s=track.t_s[rows],
        states=track.states[rows],
        smooth=track.smooth[rows],
        bent=track.bent[rows],
        commands=track.commands[rows],
    )


def _thinned(shots: Shots, most: int = MAX_SHOTS) -> Shots:
    """At most so many, evenly taken."""
    if len(shots) <= most:
        return shots
    return shots.take(np.unique(np.linspace(0, len(shots) - 1, most).round().astype(np.int64)))


def _check_excitation(tracks: Sequence[Track]) -> None:
    """Raise Inconclusive where nothing can be learnt, with what to record."""
    seconds = sum(len(t.t_s) * t.period_s for t in tracks)
    if seconds < MIN_SECONDS:
        raise Inconclusive(
            f"The recordings to fit hold {seconds:.1f} s; {MIN_SECONDS:.0f} s at least, better 100 s, "
            "of driving with changing speed and steering are needed (carlab drive --policy steering_steps)."
        )
    speed = np.concatenate([np.hypot(t.smooth[:, 3], t.smooth[:, 4]) for t in tracks])
    if np.quantile(speed, 0.9) < 0.2:
        raise Inconclusive("The car hardly moves in the recordings to fit; record it driving.")
    commands = np.concatenate([t.commands for t in tracks])
    for k, name in enumerate(("steering", "throttle")):
        if commands[:, k].std() < 0.01:
            script = "steering_steps" if name == "steering" else "throttle_steps"
            raise Inconclusive(
                f"The {name} command is constant, so nothing can be said about it; record a drive that varies it, "
                f"for example carlab drive --policy {script}."
            )


__all__ = ["Inconclusive", "Outcome", "Texts", "diagnose"]
