"""Align the states of carlab recordings to a constant age, as a diagnosis requires.

A control loop uses the newest pose, whose age varies with the phase of motion capture, and velocities of a line through
earlier poses, which are older. Both ages and all poses are recorded. A local quadratic through the poses gives the
state at the tick minus the simulator's latency of motion capture. The difference between a velocity column and the
line through its poses (the effect of a filter after the estimator) is added to the velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from carlab.core.angles import wrap
from carlab.core.episode_data import EpisodeData
from carlab.core.planar import to_body
from carlab.core.quantities import FloatArray
from carlab.core.state_estimator import MIN_SAMPLES, fit_velocity
from carlab.recording.episode_builder import POSE_AGE, VELOCITY_DELAY
from sim_backends.car_parameters import LATENCY, SimulatorConfig

HALF_WINDOW_S = 0.025
"""Half of the quadratic's window: seven poses at 120 Hz; at least two poses on each side."""
MIN_POSES_PER_SIDE = 2
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
    states = _quadratic(poses, episode.times_s - latency_s)
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


def window_variance_s2(episodes: Sequence[EpisodeData]) -> float | None:
    """Variance [s2] of the window of the differentiation in ``align_states``; None if no recording was aligned.

    A line through evenly spaced poses at t gives v + s2 / 2 d2v/dt2 with s2 = sum(t^4) / (3 sum(t^2)).
    """
    for episode in episodes:
        gaps = np.diff(np.unique(episode.poses[:, 0]))
        if POSE_AGE in episode.extra and VELOCITY_DELAY in episode.extra and len(gaps) >= 2 * MIN_POSES_PER_SIDE:
            gap_s = float(np.median(gaps))
            t = gap_s * np.arange(1, _half(gap_s) + 1)
            return float(np.sum(t**4) / (3.0 * np.sum(t**2)))
    return None


def _half(gap_s: float) -> int:
    return max(MIN_POSES_PER_SIDE, round(HALF_WINDOW_S / gap_s))


def _quadratic(poses: FloatArray, at_s: FloatArray) -> FloatArray:
    """States (n, 6) at times (n,) of local quadratics through poses (P, 4); NaN if poses lie on one side only."""
    t_s = poses[:, 0]
    gap_s = float(np.median(np.diff(t_s)))
    half = _half(gap_s)
    widest_s = 2.0 * half * 1.5 * gap_s
    states = np.full((len(at_s), 6), np.nan)
    for k, moment_s in enumerate(at_s):
        nearest = int(np.argmin(np.abs(t_s - moment_s)))
        window = slice(max(nearest - half, 0), nearest + half + 1)
        t = t_s[window] - moment_s
        if min((t <= 1e-6).sum(), (t >= -1e-6).sum()) < MIN_POSES_PER_SIDE or t[-1] - t[0] > widest_s:
            continue
        scale = float(np.abs(t).max())
        design = np.stack([np.ones_like(t), t / scale, (t / scale) ** 2], axis=1)
        value, slope = (np.linalg.pinv(design) @ poses[window, 1:])[:2]
        x, y, yaw = value
        vx, vy, rate = slope / scale
        states[k] = (x, y, yaw, *to_body(vx, vy, yaw), rate)
    return states


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


__all__ = ["align_states", "window_variance_s2", "with_known_latency"]
