"""A light diagnosis: whether, where and how recordings have left a simulator, in seconds instead of a minute.

It uses the parts of the full diagnosis (shots, floors, the screen of candidates, the fits) with a fixed amount of work:
so many shots, candidates and steps, whatever the clock says, so that the same recordings give the same answer. What
it names is a first guess, one cause at a time; the full diagnosis finds several together, questions their names, and
judges on whole recordings that were held out.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.diagnosis import data_faults
from carlab.diagnosis.light_causes import Cause, causes_of
from carlab.diagnosis.light_where import Condition, conditions
from carlab.diagnosis.measurement_noise import estimate_noise
from carlab.diagnosis.own_recordings import as_captured, window_variance_s2
from carlab.diagnosis.prediction import Predictor, errors
from carlab.diagnosis.scoring import noise_floor
from carlab.diagnosis.shots import HISTORY_S, Shots, cut, tracks_of
from carlab.diagnosis.starts import corrected
from carlab.diagnosis.velocity_window import smear_s2
from sim_backends.car_parameters import SimulatorConfig

log = logging.getLogger(__name__)

HORIZON_S = 0.8
STRIDE_S = 0.2
MOST_SHOTS = 100
"""Shots, evenly taken of all recordings: the cost is that of five episodes, however many there are."""
LEAST_SHOTS = 4
LEFT_SCORE = 1.3
"""Score that the simulator of the very recordings hardly ever has (measured in tests/diagnosis/test_light_study.py)."""
REPEATED = 2
"""Stretches (episodes, where there are several) that must have left the simulator, each by itself."""
BLOCK_S = 5.0
SHORT_BLOCK_S = 0.8
FEW_EPISODES = 3
_DISASTER = 100.0
"""Noise floors beyond which an error counts no more."""
SCHEMA = "carlab.light_diagnosis/1"
Verdict = Literal["explains", "left", "undecided"]


@dataclass(frozen=True, slots=True)
class ChannelError:
    """One channel's error at the end of shots: root mean square, its noise floor (both in ``unit``), their ratio."""

    channel: str
    rms: float
    floor: float
    unit: str

    @property
    def score(self) -> float:
        """Error in noise floors."""
        return self.rms / self.floor


@dataclass(frozen=True, slots=True)
class LightDiagnosis:
    """What a light diagnosis says.

    Attributes:
        verdict: the simulator explains the recordings; reality has left it; or the recordings cannot tell.
        why: where they cannot tell, why.
        score: root mean square over shots and channels of the error after ``horizon_s``, in noise floors.
        score_std: its standard error, stretches of recordings taken as independent.
        channels: the six, the worst first.
        conditions: where the worst channel is wrong, the clearest first; empty where it is wrong everywhere alike.
        causes: at most three guesses, the best first; empty unless ``left``.
        shots, episodes, seconds: how much was looked at; seconds of driving.
    """

    verdict: Verdict
    why: str = ""
    score: float = float("nan")
    score_std: float = float("nan")
    horizon_s: float = HORIZON_S
    channels: tuple[ChannelError, ...] = ()
    conditions: tuple[Condition, ...] = ()
    causes: tuple[Cause, ...] = ()
    shots: int = 0
    episodes: int = 0
    seconds: float = 0.0

    @property
    def excess(self) -> float:
        """Noise floors by which the score is above that of a perfect simulator."""
        return self.score - 1.0

    def to_dict(self) -> dict[str, Any]:
        """For a file; what is no number is null."""
        plain: Any = _plain({"schema": SCHEMA, **asdict(self), "excess": self.excess})
        return dict(plain)


def look(episodes: Sequence[EpisodeData], simulator: SimulatorConfig) -> LightDiagnosis:
    """Diagnose recordings against a simulator.

    Args:
        episodes: recordings as read; those of carlab itself are put to the age of pose that the simulator states.
        simulator: that is questioned, its effects included.

    Returns:
        The answer; never an error for recordings that cannot tell.
    """
    seconds = sum(e.ticks * e.period_s for e in episodes if e.ticks > 0)
    told = LightDiagnosis("undecided", episodes=len(episodes), seconds=float(seconds))
    usable = [e for e in episodes if e.ticks >= 2]
    if not usable:
        return replace(told, why="nothing was driven.")
    captured = [as_captured(e, simulator.mocap.latency_s) for e in usable]
    healed, _, faults = data_faults.check(captured, [], simulator)
    spoilt = [f for f in faults if f.action.startswith("unusable")]
    if spoilt:
        return replace(told, why=f"the recordings are at fault ({spoilt[0].id} of {spoilt[0].channel}).")
    try:
        shots, floor = _shots(healed, simulator, window_variance_s2(usable))
    except DataError:
        return replace(told, why=f"no recording has a stretch of {HORIZON_S + HISTORY_S:.1f} s in which the car moves.")
    if len(shots) < LEAST_SHOTS:
        return replace(told, why=f"the car moved too little: {len(shots)} stretches of {HORIZON_S:.1f} s.")
    last = errors(Predictor(shots, simulator)(), shots)[0, :, -1]
    final = np.nan_to_num(last / floor[-1], nan=_DISASTER).clip(-_DISASTER, _DISASTER)
    score, spread = _score(final, shots)
    channels = _channels(final, floor[-1])
    told = replace(told, score=score, score_std=spread, channels=channels, shots=len(shots))
    if score <= LEFT_SCORE:
        return replace(told, verdict="explains")
    if _blocks_beyond(final, shots) < REPEATED:
        return replace(told, why="the errors are larger than the noise in one stretch alone, which may be an accident.")
    worst = STATE_NAMES.index(channels[0].channel)
    return replace(
        told,
        verdict="left",
        conditions=conditions(shots, np.abs(final[:, worst])),
        causes=causes_of(shots, floor, simulator),
    )


def _shots(
    episodes: Sequence[EpisodeData], simulator: SimulatorConfig, window_s2: float | None
) -> tuple[Shots, FloatArray]:
    """Shots of all recordings, and the noise floor along them (K + 1, 6). DataError where there are none."""
    tracks = tracks_of([e for e in episodes if e.ticks >= 2])
    if not tracks:
        raise DataError("No recording has an unbroken stretch of half a second.")
    few = len({t.recording for t in tracks}) < FEW_EPISODES
    shots = cut(tracks, HORIZON_S, STRIDE_S, SHORT_BLOCK_S if few else BLOCK_S)
    if len(shots) > MOST_SHOTS:
        shots = shots.take(np.unique(np.linspace(0, len(shots) - 1, MOST_SHOTS).round().astype(np.int64)))
    smear = smear_s2(shots, simulator) if window_s2 is None else window_s2
    shots = corrected(replace(shots, smear_s2=smear), simulator)
    return shots, noise_floor(shots, estimate_noise(tracks, shots.bent), simulator)


def _score(final: FloatArray, shots: Shots) -> tuple[float, float]:
    """Score of errors (S, 6) in floors, and its standard error by leaving out one block after the other."""
    squared = np.mean(final**2, axis=1)
    blocks, index = np.unique(shots.block, return_inverse=True)
    if len(blocks) < 2:
        return float(np.sqrt(squared.mean())), float("inf")
    sums, counts = np.bincount(index, weights=squared), np.bincount(index)
    without = np.sqrt((squared.sum() - sums) / (len(squared) - counts))
    spread = np.sqrt((len(blocks) - 1) * without.var())
    return float(np.sqrt(squared.mean())), float(spread)


def _blocks_beyond(final: FloatArray, shots: Shots) -> int:
    """How many blocks have a score beyond ``LEFT_SCORE``."""
    _, index = np.unique(shots.block, return_inverse=True)
    squared = np.bincount(index, weights=np.mean(final**2, axis=1)) / np.bincount(index)
    return int(np.sum(np.sqrt(squared) > LEFT_SCORE))


def _channels(final: FloatArray, floor: FloatArray) -> tuple[ChannelError, ...]:
    units = dict(zip(STATE_NAMES, ("m", "m", "rad", "m/s", "m/s", "rad/s"), strict=True))
    rms = np.sqrt(np.mean(final**2, axis=0))
    return tuple(
        ChannelError(STATE_NAMES[k], float(rms[k] * floor[k]), float(floor[k]), units[STATE_NAMES[k]])
        for k in np.argsort(-rms)
    )


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


__all__ = ["SCHEMA", "ChannelError", "LightDiagnosis", "Verdict", "look"]
