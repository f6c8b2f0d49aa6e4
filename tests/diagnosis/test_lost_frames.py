"""Lost motion-capture frames: accuracy of the aligned states, and messages that name the lost frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from carlab.api.diagnosis import DiagnosisReport, diagnose
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.diagnosis.comparison.compare import compare
from carlab.diagnosis.quick.quick_check import quick_check
from carlab.diagnosis.state_alignment import align_states, lost_frames
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends.car_parameters import SimulatorConfig

LATENCY_S, PERIOD_S = 0.008, 1.0 / 30.0
NOISE = np.array([3e-4, 3e-4, 2e-3])


def truth(t_s: np.ndarray) -> np.ndarray:
    """States in closed form: a slalom of 0.7 s at a speed of 1 to 2 m/s, with body velocities."""
    w, phase = 9.0, 1.5 * t_s
    yaw, yaw_rate = 0.3 * np.sin(w * t_s), 0.3 * w * np.cos(w * t_s)
    vx_world, vy_world = 1.5 + 0.5 * np.cos(phase), 0.4 * np.sin(w * t_s)
    x, y = 1.5 * t_s + np.sin(phase) / 3.0, -0.4 * np.cos(w * t_s) / w
    vx = np.cos(yaw) * vx_world + np.sin(yaw) * vy_world
    vy = np.cos(yaw) * vy_world - np.sin(yaw) * vx_world
    return np.stack([x, y, yaw, vx, vy, yaw_rate], axis=1)


def recorded(
    lost_share: float,
    seconds: float = 40.0,
    burst: int = 1,
    *,
    frame_hz: float = 120.0,
    period_s: float = PERIOD_S,
    jitter_s: float = 0.0,
) -> tuple[EpisodeData, float]:
    """A recording with noisy poses, of which runs of ``burst`` are lost, and the exact lost share."""
    rng = np.random.default_rng(1)
    captures = np.arange(-30, round(seconds * frame_hz)) / frame_hz + 0.0021
    captures += jitter_s * rng.uniform(-1.0, 1.0, len(captures))
    poses = np.column_stack([captures, truth(captures)[:, :3] + NOISE * rng.normal(size=(len(captures), 3))])
    starts = rng.random(len(captures)) < 1.0 - (1.0 - lost_share) ** (1.0 / burst)
    lost = np.convolve(starts, np.ones(burst))[: len(captures)] > 0
    lost[[0, -1]] = False
    times = np.arange(round(seconds / period_s) + 1) * period_s
    commands = np.stack([np.sin(9.0 * times[:-1]), 0.4 + 0.3 * np.cos(1.5 * times[:-1])], axis=1)
    ages = {"pose_age_s": np.full(len(times), 0.01), "velocity_delay_s": np.full(len(times), np.nan)}
    episode = EpisodeData(
        times, truth(times), commands, commands, np.zeros(len(commands)), poses[~lost], extra=ages
    )  # fmt: skip
    return episode, float(lost.mean())


def rms_errors(aligned: EpisodeData) -> np.ndarray:
    errors = aligned.states - truth(aligned.times_s - LATENCY_S)
    return np.sqrt(np.nanmean(errors**2, axis=0))


@pytest.mark.parametrize(("lost_share", "max_missing_share"), [(0.05, 0.0), (0.1, 0.002), (0.2, 0.02)])
def test_states_with_lost_frames_are_as_accurate_as_without(lost_share: float, max_missing_share: float) -> None:
    complete, broken = (align_states(recorded(share)[0], LATENCY_S) for share in (0.0, lost_share))
    assert np.isnan(broken.states).any(axis=1).mean() <= max_missing_share
    assert (rms_errors(broken) <= 1.05 * rms_errors(complete)).all()


@pytest.mark.parametrize("period_s", [PERIOD_S, 1.0 / 60.0])
@pytest.mark.parametrize(("lost_share", "max_missing_share"), [(0.05, 0.0), (0.1, 0.002), (0.2, 0.03)])
def test_states_with_lost_frames_are_as_accurate_as_without_at_60_hz(
    lost_share: float, max_missing_share: float, period_s: float
) -> None:
    complete, broken = (
        align_states(recorded(share, frame_hz=60.0, period_s=period_s)[0], LATENCY_S) for share in (0.0, lost_share)
    )
    assert np.isnan(broken.states).any(axis=1).mean() <= max_missing_share
    assert (rms_errors(broken) <= 1.05 * rms_errors(complete)).all()


@pytest.mark.parametrize(("frame_hz", "period_s"), [(120.0, PERIOD_S), (60.0, PERIOD_S), (60.0, 1.0 / 60.0)])
def test_a_tenth_of_lost_frames_costs_no_prediction_window(frame_hz: float, period_s: float) -> None:
    complete, broken = (
        cut_windows(segments_of([align_states(episode, LATENCY_S)]), 0.8, 0.25)
        for episode, _ in (recorded(share, frame_hz=frame_hz, period_s=period_s) for share in (0.0, 0.1))
    )
    assert len(broken) == len(complete)


def test_a_jitter_of_100_hz_stamps_does_not_change_the_noise() -> None:
    """The quadratic has seven poses with and without jitter; with five, the velocity noise is larger by half."""
    even, uneven = (align_states(recorded(0.0, frame_hz=100.0, jitter_s=jitter)[0], LATENCY_S) for jitter in (0, 2e-5))
    np.testing.assert_allclose(rms_errors(uneven), rms_errors(even), rtol=0.1)


def test_states_inside_a_long_loss_are_missing() -> None:
    episode, _ = recorded(0.0, 4.0)
    inside = (episode.poses[:, 0] > 2.0) & (episode.poses[:, 0] < 2.12)
    aligned = align_states(replace(episode, poses=episode.poses[~inside]), LATENCY_S)
    missing = aligned.times_s[np.isnan(aligned.states).any(axis=1)] - LATENCY_S
    assert len(missing)
    assert 1.95 < missing.min() < missing.max() < 2.17
    assert np.abs(missing - 2.06).min() < PERIOD_S


def test_three_poses_give_no_cubic() -> None:
    episode, _ = recorded(0.0, 4.0)
    moment_s = float(episode.times_s[60]) - LATENCY_S
    near = np.abs(episode.poses[:, 0] - moment_s) < 0.1
    captures = moment_s + np.array([-0.06, 0.0, 0.06])
    three = np.column_stack([captures, truth(captures)[:, :3]])
    poses = np.vstack([episode.poses[~near], three])
    aligned = align_states(replace(episode, poses=poses[np.argsort(poses[:, 0])]), LATENCY_S)
    assert np.isnan(aligned.states[aligned.times_s == episode.times_s[60]]).all()


@pytest.mark.parametrize("lost_share", [0.1, 0.45, 0.6])
def test_the_share_of_lost_frames_is_that_of_the_recording(lost_share: float) -> None:
    episode, share = recorded(lost_share, burst=6)
    rows, sentence = lost_frames([align_states(episode, LATENCY_S)])
    assert rows > 0
    assert abs(float(sentence.split("%")[0]) - 100.0 * share) <= 1.0


def test_a_recording_without_lost_frames_has_no_sentence_about_them() -> None:
    assert lost_frames([align_states(recorded(0.0, 4.0)[0], LATENCY_S)]) == (0, "")


def test_messages_name_lost_frames_instead_of_a_parked_car() -> None:
    episode, share = recorded(0.45, burst=6)
    simulator = SimulatorConfig.from_preset()
    why = quick_check([episode], simulator).why
    report = diagnose([episode])
    assert isinstance(report, DiagnosisReport)
    with pytest.raises(DataError) as of_comparison:
        compare(*([align_states(episode, LATENCY_S)] for _ in range(2)), simulator)
    for message in (why, report.sentence, str(of_comparison.value)):
        assert f"{share:.0%} of the motion-capture frames are lost" in message
        assert "The car moves in no" not in message
    assert "lost_frames" in [fault.id for fault in report.diagnosis.data_faults]


def test_short_stretches_are_not_called_a_parked_car() -> None:
    episode, _ = recorded(0.0, 20.0)
    cut = replace(episode, extra={"segment": np.arange(601) // 30})
    with pytest.raises(DataError, match=r"longest stretch without a gap has 1\.0 s; a prediction needs 1\.4 s"):
        cut_windows(segments_of([cut]), 0.8, 0.25)
