"""Align the states of carlab recordings to a constant age, as a diagnosis requires.

A control loop uses the newest pose, whose age varies with the phase of motion capture, and velocities of a line through
earlier poses, which are older. Both ages and all poses are recorded. A local quadratic through the poses (a cubic, if
they are far apart) gives the state at the tick minus the simulator's latency of motion capture. Where too many frames
are lost for this polynomial, a local cubic through a wider window is used, if its noise is not larger than that of the
polynomial without lost frames. The difference between a velocity column and the line through its poses (the effect of a
filter after the estimator) is added to the velocity.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from carlab.core.angles import wrap
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.planar import to_body
from carlab.core.quantities import FloatArray
from carlab.core.state_estimator import MIN_SAMPLES, fit_velocity
from carlab.recording.episode_builder import POSE_AGE, VELOCITY_DELAY
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.measurement import LATENCY

HALF_WINDOW_S = 0.0251
"""Half of the quadratic's window: seven poses at 100 Hz and 120 Hz; at least two poses on each side."""
MIN_POSES_PER_SIDE = 2
MAX_QUADRATIC_GAP_S = 0.0251
"""Above this time between poses, as in a CSV with one pose for each row at 30 Hz, a local cubic through five poses
replaces the quadratic: the motion within five poses is not quadratic there, and the cubic has no bias to fourth order.
"""
CUBIC_HALF_WINDOWS_S = (0.075, 0.1, 0.12)
"""Halves of windows of the cubic where frames are lost. The first one with low enough noise has the least bias."""
MAX_LINE_POSES = 64
MAX_AGE_MISMATCH_S = 5e-4
"""The poses of a velocity's line are identified if their mean time matches the recorded age within this."""
STATE_AGE = "state_age_s"
"""Metadata key of an episode that ``align_states`` has aligned."""


def align_states(episode: EpisodeData, latency_s: float) -> EpisodeData:
    """Compute the states ``latency_s`` before each tick from all recorded poses.

    Args:
        episode: as read; returned unchanged if it lacks the ages of its poses and velocities.
        latency_s: latency of motion capture of the simulator.

    Returns:
        The episode without the first and last rows that lack poses on one side. Inner rows with too few poses nearby
        are NaN and split the recording.
    """
    poses = episode.poses[np.unique(episode.poses[:, 0], return_index=True)[1]]
    known = POSE_AGE in episode.extra and VELOCITY_DELAY in episode.extra
    if not known or len(poses) < 2 * MIN_POSES_PER_SIDE + 1:
        return episode
    poses = np.column_stack([poses[:, :3], np.unwrap(poses[:, 3])])
    states = _local_states(poses, episode.times_s - latency_s)
    states[:, 3:] += _filter_offset(episode, poses)
    states[:, 2] = wrap(states[:, 2])
    seen = np.flatnonzero(np.isfinite(states).all(axis=1))
    if len(seen) < MIN_SAMPLES:
        return episode
    first, last = int(seen[0]), int(seen[-1])
    rows, ticks = slice(first, last + 1), slice(first, last)
    return replace(
        episode,
        times_s=episode.times_s[rows],
        states=states[rows],
        requested=episode.requested[ticks],
        sent=episode.sent[ticks],
        rewards=episode.rewards[ticks],
        extra={name: column[rows] for name, column in episode.extra.items()},
        metadata={**episode.metadata, STATE_AGE: repr(latency_s)},
    )


def with_known_latency(config: SimulatorConfig, episodes: Sequence[EpisodeData]) -> SimulatorConfig:
    """Mark the latency as known if ``align_states`` has aligned all episodes to it."""
    known = LATENCY in config.unknown and all(STATE_AGE in e.metadata for e in episodes)
    return replace(config, unknown=config.unknown - {LATENCY}) if known else config


def lost_frames(episodes: Sequence[EpisodeData]) -> tuple[int, str]:
    """Number of rows without a state in aligned recordings, and a sentence with the share of lost frames."""
    cut = [e for e in episodes if STATE_AGE in e.metadata and np.isnan(e.states).any()]
    if not cut:
        return 0, ""
    missing = sum(int(np.isnan(e.states).any(axis=1).sum()) for e in cut)
    counts = [_frame_counts(e.poses[:, 0]) for e in cut]
    share = 1.0 - sum(seen for seen, _ in counts) / sum(total for _, total in counts)
    rows = sum(len(e.times_s) for e in cut)
    return missing, f"{share:.0%} of the motion-capture frames are lost, so {missing} of {rows} rows have no state"


@contextmanager
def naming_lost_frames(episodes: Sequence[EpisodeData]) -> Iterator[None]:
    """Add the share of lost frames to the message of a DataError about aligned recordings."""
    try:
        yield
    except DataError as error:
        if sentence := lost_frames(episodes)[1]:
            error.args = (f"{error} {sentence}; improve the tracking.",)
        raise


def _frame_counts(captures_s: FloatArray) -> tuple[int, int]:
    """Number of recorded frames, and of all frames from the first to the last one."""
    t_s = np.unique(captures_s)
    gaps = np.diff(t_s)
    frame_s = float(np.median(gaps[gaps < 1.5 * np.quantile(gaps, 0.1)]))
    return len(t_s), round(float(t_s[-1] - t_s[0]) / frame_s) + 1


def window_variance_s2(episodes: Sequence[EpisodeData]) -> float | None:
    """Variance [s2] of the window of the differentiation in ``align_states``; None if no recording was aligned.

    A quadratic through evenly spaced poses at t gives v + s2 / 2 d2v/dt2 with s2 = sum(t^4) / (3 sum(t^2)), a cubic v.
    """
    for episode in episodes:
        gaps = np.diff(np.unique(episode.poses[:, 0]))
        if POSE_AGE in episode.extra and VELOCITY_DELAY in episode.extra and len(gaps) >= 2 * MIN_POSES_PER_SIDE:
            gap_s = float(np.median(gaps))
            if _order(gap_s) == 3:
                return 0.0
            t = gap_s * np.arange(1, _half(gap_s) + 1)
            return float(np.sum(t**4) / (3.0 * np.sum(t**2)))
    return None


def _half(gap_s: float) -> int:
    return max(MIN_POSES_PER_SIDE, round(HALF_WINDOW_S / gap_s))


def _order(gap_s: float) -> int:
    return 3 if gap_s > MAX_QUADRATIC_GAP_S else 2


def _local_states(poses: FloatArray, at_s: FloatArray) -> FloatArray:
    """States (n, 6) at times (n,) of local polynomials through poses (P, 4).

    A row is NaN if poses lie on one side only, or if too many frames near it are lost.
    """
    t_s = poses[:, 0]
    gap_s = float(np.median(np.diff(t_s)))
    half, order = _half(gap_s), _order(gap_s)
    widest_s = 2.0 * half * 1.5 * gap_s
    complete = np.zeros((2 * half + 1, 4))
    complete[:, 0] = gap_s * np.arange(-half, half + 1)
    max_gain = 1.001 * _polynomial(complete, 0.0, order)[1]
    states = np.full((len(at_s), 6), np.nan)
    for k, moment_s in enumerate(at_s):
        nearest = int(np.argmin(np.abs(t_s - moment_s)))
        near = poses[max(nearest - half, 0) : nearest + half + 1]
        if _has_both_sides(near, moment_s) and near[-1, 0] - near[0, 0] <= widest_s:
            states[k] = _polynomial(near, moment_s, order)[0]
            continue
        for half_window_s in CUBIC_HALF_WINDOWS_S:
            near = poses[np.abs(t_s - moment_s) <= half_window_s + 1e-6]
            if _has_both_sides(near, moment_s):
                state, gain = _polynomial(near, moment_s, 3)
                if (gain <= max_gain).all():
                    states[k] = state
                    break
    return states


def _has_both_sides(poses: FloatArray, moment_s: float) -> bool:
    t = poses[:, 0] - moment_s
    return bool(min((t <= 1e-6).sum(), (t >= -1e-6).sum()) >= MIN_POSES_PER_SIDE)


def _polynomial(poses: FloatArray, moment_s: float, order: int) -> tuple[FloatArray, FloatArray]:
    """State (6,) of a polynomial through poses (P, 4), and the noise gain (2,) of its pose and of its velocity [1/s].

    The gain is the standard deviation of the estimate for poses with independent errors of standard deviation one.
    """
    t = poses[:, 0] - moment_s
    scale = float(np.abs(t).max())
    estimator = np.linalg.pinv(np.vander(t / scale, order + 1, increasing=True))[:2] / np.array([[1.0], [scale]])
    (x, y, yaw), (vx, vy, rate) = estimator @ poses[:, 1:]
    return np.array([x, y, yaw, *to_body(vx, vy, yaw), rate]), np.linalg.norm(estimator, axis=1)


def _filter_offset(episode: EpisodeData, poses: FloatArray) -> FloatArray:
    """Velocity columns minus the velocities of their lines (n, 3); zero if the line is unknown."""
    difference = np.zeros((len(episode.times_s), 3))
    capture_s = episode.times_s - episode.extra[POSE_AGE]
    mean_s = capture_s - episode.extra[VELOCITY_DELAY]
    for k, (end_s, mean_time_s) in enumerate(zip(capture_s, mean_s, strict=True)):
        end = int(np.searchsorted(poses[:, 0], end_s + 1e-6))
        counts = np.arange(MIN_SAMPLES, min(end, MAX_LINE_POSES) + 1)
        if not np.isfinite(mean_time_s) or not len(counts):
            continue
        sums = np.cumsum(poses[:end, 0][::-1])[counts - 1] / counts
        best = int(np.argmin(np.abs(sums - mean_time_s)))
        if abs(float(sums[best]) - mean_time_s) < MAX_AGE_MISMATCH_S:
            line = fit_velocity(poses[end - counts[best] : end])
            difference[k] = episode.states[k, 3:] - (line.vx_mps, line.vy_mps, line.yaw_rate_radps)
    return np.asarray(difference)
