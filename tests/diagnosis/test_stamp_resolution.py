"""Stamps in whole milliseconds or with jitter: the estimated noise and the period are those of the rows."""

import numpy as np
import pytest

from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.identification.measurement_noise import estimate_noise
from carlab.prediction.windows import cut_windows, segments_of

NOISE = np.array([1e-3, 1e-3, 2e-3, 0.02, 0.02, 0.04])


def recorded(rate_hz: float, resolution_s: float, jitter_s: float = 0.0, seconds: float = 100.0) -> EpisodeData:
    """A car on a wide circle at 1 m/s, with white noise in each channel and rounded stamps."""
    rng = np.random.default_rng(3)
    t_s = np.arange(round(seconds * rate_hz) + 1) / rate_hz
    t_s += jitter_s * np.random.default_rng(4).uniform(-1.0, 1.0, len(t_s))
    yaw = 0.5 * t_s
    one = np.ones_like(t_s)
    clean = np.column_stack([2.0 * np.sin(yaw), -2.0 * np.cos(yaw), yaw, one, 0.0 * one, 0.5 * one])
    commands = np.tile([0.1, 0.3], (len(t_s) - 1, 1))
    stamps = np.round(t_s / resolution_s) * resolution_s if resolution_s else t_s
    states = clean + NOISE * rng.normal(size=clean.shape)
    return EpisodeData(stamps, states, commands, commands, np.zeros(len(commands)))


def noise_of(episode: EpisodeData) -> np.ndarray:
    segments = segments_of([episode])
    return estimate_noise(segments, cut_windows(segments, 0.8, 0.5).curvature_bias).measured


@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 120.0])
def test_noise_of_rows_with_rounded_stamps_is_that_of_the_rows(rate_hz: float) -> None:
    """Interpolation between the rows would lower the noise by a fifth; white noise is the assumption for poses only."""
    rounded, exact = (noise_of(recorded(rate_hz, resolution_s)) for resolution_s in (1e-3, 0.0))
    np.testing.assert_allclose(rounded[:3], NOISE[:3], rtol=0.04)
    np.testing.assert_allclose(rounded, exact, rtol=0.04)


@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 120.0])
def test_noise_of_rows_with_a_jitter_of_a_tenth_of_the_period_is_at_most_a_tenth_too_low(rate_hz: float) -> None:
    """A grid that drifts against the rows would lower it by a fifth to a quarter."""
    found = noise_of(recorded(rate_hz, 0.0, jitter_s=0.1 / rate_hz))
    assert (found[:3] > 0.88 * NOISE[:3]).all()


@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 120.0])
def test_the_period_is_that_of_the_rows(rate_hz: float) -> None:
    (rounded,), (exact,) = (segments_of([recorded(rate_hz, resolution_s)]) for resolution_s in (1e-3, 0.0))
    assert rounded.period_s == pytest.approx(exact.period_s, rel=1e-5)
    assert len(rounded.t_s) == len(exact.t_s)
    np.testing.assert_allclose(rounded.t_s, exact.t_s, atol=1e-3)


def test_rows_with_stamps_in_whole_milliseconds_at_30_hz_are_not_interpolated() -> None:
    episode = recorded(30.0, 1e-3)
    (segment,) = segments_of([episode])
    np.testing.assert_array_equal(segment.states, episode.states)
    np.testing.assert_array_equal(segment.commands[:-1], episode.sent)


@pytest.mark.parametrize("seconds", [99.9, 100.0, 100.1])
def test_jitter_does_not_change_the_distance_of_windows(seconds: float) -> None:
    """A stride of 0.25 s is 7.5 rows at 30 Hz."""
    episode = recorded(30.0, 0.0, jitter_s=1e-5, seconds=seconds)
    windows = cut_windows(segments_of([episode]), 0.8, 0.25)
    assert set(np.round(np.diff(windows.t0_s) * 30.0).astype(int)) == {8}
