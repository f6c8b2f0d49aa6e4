"""Quick check of a simulator against recordings, in seconds instead of the minute of a diagnosis.

It uses the stages of the diagnosis (prediction windows, noise floors, screening, fits) with a fixed amount of work, so
the same recordings give the same result on any machine. It tests candidate causes one at a time. The diagnosis fits
several effects together, tests them against confusable effects, and scores them on held-out recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.json_files import plain
from carlab.core.quantities import STATE_NAMES, STATE_UNITS, FloatArray
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fitter
from carlab.diagnosis.identification.held_out_errors import noise_floor
from carlab.diagnosis.identification.measurement_noise import estimate_noise
from carlab.diagnosis.identification.velocity_window import with_initial_states
from carlab.diagnosis.quick.causes import Cause, find_causes
from carlab.diagnosis.quick.conditions import ErrorCondition, find_conditions
from carlab.diagnosis.recording_faults import find as data_faults
from carlab.diagnosis.settings import QUICK
from carlab.diagnosis.state_alignment import align_states, lost_frames, window_variance_s2, with_known_latency
from carlab.prediction.errors import bounded, simulation_errors
from carlab.prediction.windows import MIN_HISTORY_S, PredictionWindows, cut_windows, segments_of
from sim_backends.car_parameters import SimulatorConfig

SCHEMA = "carlab.light_diagnosis/1"
JSON_KEYS = {"windows": "shots", "with_refit": "beside_numbers", "ties_with_first": "like_the_first"}
"""Keys of the file format that differ from the attributes."""
CheckVerdict = Literal["explains", "left", "undecided"]


@dataclass(frozen=True, slots=True)
class ChannelScore:
    """Error of one channel at the end of windows: root mean square and noise floor, both in ``unit``."""

    channel: str
    rms: float
    floor: float
    unit: str

    @property
    def score(self) -> float:
        """Error in noise floors."""
        return self.rms / self.floor


@dataclass(frozen=True, slots=True)
class QuickCheck:
    """Result of a quick check.

    Attributes:
        verdict: "explains": the simulator explains the recordings; "left": it does not; or "undecided".
        why: reason of "undecided".
        score: root mean square over windows and channels of the error after ``horizon_s``, in noise floors.
        score_std: its standard error; blocks of recordings count as independent.
        channels: the six, the largest error first.
        conditions: in which the worst channel has large errors, the most significant first; may be empty.
        causes: at most three candidate causes, the most likely first; only with "left".
        windows, episodes, seconds: amount of data; seconds of driving.
    """

    verdict: CheckVerdict
    why: str = ""
    score: float = float("nan")
    score_std: float = float("nan")
    horizon_s: float = QUICK.window_s
    channels: tuple[ChannelScore, ...] = ()
    conditions: tuple[ErrorCondition, ...] = ()
    causes: tuple[Cause, ...] = ()
    windows: int = 0
    episodes: int = 0
    seconds: float = 0.0

    @property
    def excess(self) -> float:
        """Score minus 1, the score of a perfect simulator [noise floors]."""
        return self.score - 1.0

    def to_dict(self) -> dict[str, Any]:
        """Plain data for a file; numbers that are not finite become null."""
        return dict(plain({"schema": SCHEMA, **asdict(self), "excess": self.excess}, JSON_KEYS))


def quick_check(episodes: Sequence[EpisodeData], simulator: SimulatorConfig) -> QuickCheck:
    """Check recordings against a simulator.

    Args:
        episodes: recordings as read; states of carlab recordings are aligned to the latency of ``simulator``.
        simulator: with its effects.

    Returns:
        The result; "undecided" if the recordings are not sufficient.
    """
    seconds = sum(e.ticks * e.period_s for e in episodes if e.ticks > 0)
    undecided = QuickCheck("undecided", horizon_s=QUICK.window_s, episodes=len(episodes), seconds=float(seconds))
    usable = [e for e in episodes if e.ticks >= 2]
    if not usable:
        return replace(undecided, why="they contain no commands.")
    captured = [align_states(e, simulator.latency_s()) for e in usable]
    simulator = with_known_latency(simulator, captured)
    repaired, _, faults = data_faults.check(captured, [], simulator)
    unusable = [f for f in faults if f.action.startswith("unusable")]
    if unusable:
        return replace(undecided, why=f"they are faulty ({unusable[0].id} of {unusable[0].channel}).")
    try:
        windows, floor = _windows(repaired, simulator, window_variance_s2(usable))
    except DataError:
        length_s = QUICK.window_s + MIN_HISTORY_S
        why = f"the car moves in no stretch of {length_s:.1f} s without a gap"
        return replace(undecided, why="; ".join(filter(None, (why, lost_frames(captured)[1]))) + ".")
    if len(windows) < QUICK.min_windows:
        return replace(undecided, why=f"the car moves in only {len(windows)} windows of {QUICK.window_s:.1f} s.")
    return _checked(undecided, windows, floor, simulator)


def held_out_loss(episode: EpisodeData, simulators: Sequence[SimulatorConfig]) -> list[float] | None:
    """Huber's loss of an episode's windows by each simulator, in units of the noise floor of the first.

    Args:
        episode: a recording that no simulator was fitted to.
        simulators: to compare.

    Returns:
        One loss for each simulator; None if the car moves in no window.
    """
    first = simulators[0]
    captured = [align_states(episode, first.latency_s())] if episode.ticks >= 2 else []
    repaired, _, _ = data_faults.check(captured, [], with_known_latency(first, captured))
    try:
        windows, floor = _windows(repaired, first, window_variance_s2([episode]))
    except DataError:
        return None
    fitter = Fitter(windows, Scale.of_floor(floor))
    return [float(fitter.loss(each, max_error=QUICK.max_left_out_error).sum()) for each in simulators]


def _checked(
    undecided: QuickCheck,
    windows: PredictionWindows,
    floor: FloatArray,
    simulator: SimulatorConfig,
) -> QuickCheck:
    """Check windows with their noise floor (K + 1, 6)."""
    final = bounded(simulation_errors(windows, simulator)[:, -1] / floor[-1], QUICK.max_error)
    score, score_std, blocks_above = _score(final, windows)
    channels = _channels(final, floor[-1])
    scored = replace(undecided, score=score, score_std=score_std, channels=channels, windows=len(windows))
    if score <= QUICK.score_max:
        return replace(scored, verdict="explains")
    if blocks_above < QUICK.min_blocks:
        why = "the errors exceed the noise in one stretch only, which may be an outlier."
        return replace(scored, why=why)
    worst = STATE_NAMES.index(channels[0].channel)
    return replace(
        scored,
        verdict="left",
        conditions=find_conditions(windows, np.abs(final[:, worst])),
        causes=find_causes(windows, floor, simulator),
    )


def _windows(
    episodes: Sequence[EpisodeData], simulator: SimulatorConfig, window_s2: float | None
) -> tuple[PredictionWindows, FloatArray]:
    """Windows of all recordings, and the noise floor along them (K + 1, 6). Raises DataError without windows."""
    segments = segments_of([e for e in episodes if e.ticks >= 2])
    few = len({t.recording for t in segments}) < QUICK.few_episodes
    block_s = QUICK.short_block_s if few else QUICK.block_s
    windows = cut_windows(segments, QUICK.window_s, QUICK.stride_s, block_s).thinned(QUICK.max_windows)
    (windows,) = with_initial_states((windows,), simulator, window_s2)
    return windows, noise_floor(windows, estimate_noise(segments, windows.curvature_bias), simulator)


def _score(final: FloatArray, windows: PredictionWindows) -> tuple[float, float, int]:
    """Score of errors (S, 6) in noise floors, its jackknife standard error over blocks, and blocks above the limit."""
    squared = np.mean(final**2, axis=1)
    index = np.unique(windows.block, return_inverse=True)[1]
    sums, counts = np.bincount(index, weights=squared), np.bincount(index)
    score, blocks_above = float(np.sqrt(squared.mean())), int(np.sum(np.sqrt(sums / counts) > QUICK.score_max))
    if len(counts) < 2:
        return score, float("inf"), blocks_above
    without = np.sqrt((squared.sum() - sums) / (len(squared) - counts))
    return score, float(np.sqrt((len(counts) - 1) * without.var())), blocks_above


def _channels(final: FloatArray, floor: FloatArray) -> tuple[ChannelScore, ...]:
    rms = np.sqrt(np.mean(final**2, axis=0))
    return tuple(
        ChannelScore(STATE_NAMES[k], float(rms[k] * floor[k]), float(floor[k]), STATE_UNITS[k])
        for k in np.argsort(-rms)
    )
