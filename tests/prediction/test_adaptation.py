"""Adaptation to the recent past: estimates of planted changes, causality, and the filter against a closed form."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.core.recording_noise import AdaptationNoise
from carlab.prediction.adaptation import adapt, choose_noise
from carlab.prediction.adaptation_filter import MeasuredWindows, Processes, run_filter
from carlab.prediction.disturbances import DISTURBANCE_NAMES, linearised
from carlab.prediction.errors import final_errors
from carlab.prediction.predict import SimulatorModel, simulate_windows
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from tests.helpers.changing_drives import changing_drive
from tests.helpers.recorded_drives import PERIOD_S, drive

CONFIG = SimulatorConfig(control_period_s=PERIOD_S)
SECONDS = 60.0


def drive_factor(t_s: float) -> float:
    return 1.0 - 0.3 * t_s / SECONDS


def trim_rad(t_s: float) -> float:
    return 0.06 * t_s / SECONDS


def position_rms(model, windows):
    errors = final_errors(model, windows)
    return float(np.sqrt(np.mean(errors[:, 0] ** 2 + errors[:, 1] ** 2)))


@pytest.fixture(scope="module")
def noise() -> AdaptationNoise:
    return choose_noise(CONFIG, segments_of([drive(CONFIG, SECONDS, 1)]))


@pytest.fixture(scope="module")
def changed_segments():
    return segments_of([changing_drive(CONFIG, SECONDS, 2, drive_factor, trim_rad)])


@pytest.fixture(scope="module")
def changed(noise, changed_segments):
    return adapt(CONFIG, changed_segments, noise)


def test_estimates_follow_a_fading_drive_force_and_steering_trim_within_their_band(changed):
    series = changed.series()
    late = series.t_s > 6.0
    true = np.array([[drive_factor(t) - 1.0, trim_rad(t), 0.0, 0.0] for t in series.t_s])
    error = series.mean - true
    assert np.sqrt(np.mean(error[late, 0] ** 2)) < 0.03
    assert np.sqrt(np.mean(error[late, 1] ** 2)) < 0.006
    for k in range(4):
        z = np.abs(error[late, k]) / series.std[late, k]
        assert np.mean(z < 2.5) > 0.85, DISTURBANCE_NAMES[k]
    assert series.std[late, 0].mean() < 0.1  # the band is narrower than the change


def test_adapted_predictions_of_a_changing_car_are_several_times_better(changed, changed_segments):
    windows = cut_windows(changed_segments, 1.0, 0.25)
    late = windows.take(windows.t0_s > 20.0)
    assert position_rms(changed, late) < 0.4 * position_rms(SimulatorModel(CONFIG), late)


def test_adaptation_to_a_car_without_a_change_costs_little(noise):
    segments = segments_of([drive(CONFIG, SECONDS, 3)])
    windows = cut_windows(segments, 1.0, 0.25)
    adapted = adapt(CONFIG, segments, noise)
    assert position_rms(adapted, windows) < 1.15 * position_rms(SimulatorModel(CONFIG), windows)
    mean = adapted.series().mean[-50:].mean(axis=0)
    assert np.all(np.abs(mean) < [0.03, 0.005, 0.05, 0.05])


def test_a_prediction_uses_only_rows_before_its_start(noise):
    """Later rows differ wholly; windows before the change keep their predictions."""
    episode = changing_drive(CONFIG, 20.0, 4, drive_factor, trim_rad)
    row = 300
    states = episode.states.copy()
    states[row:, :3] += [5.0, -3.0, 1.0]
    states[row:, 3:] += [1.0, 0.5, -2.0]
    other = replace(episode, states=states)
    changed_at_s = row * PERIOD_S
    models = [adapt(CONFIG, segments_of([e]), noise) for e in (episode, other)]
    windows = cut_windows(segments_of([episode]), 1.0, 0.1)
    before = windows.take(windows.t0_s < changed_at_s - 0.15)  # the smoothing of other windows uses the changed rows
    first, second = (m.predict(before.take(before.t0_s > changed_at_s - 1.0)) for m in models)
    assert np.array_equal(first, second)
    after = windows.take(windows.t0_s > changed_at_s + 1.0)
    assert not np.allclose(models[0].predict(after), models[1].predict(after))


def test_each_recording_starts_without_a_change(noise, changed_segments):
    again = [replace(t, recording=1) for t in changed_segments]
    model = adapt(CONFIG, [*changed_segments, *again], noise)
    recording, t_s = np.array([0, 1]), np.array([50.0, 50.0])
    found = model.disturbances(recording, t_s)
    assert np.allclose(found[:, 0], found[:, 1], atol=1e-9)
    assert np.all(model.disturbances(np.array([1]), np.array([0.2])) == 0.0)


def test_filter_is_the_gaussian_process_posterior():
    """With normal errors the last estimate is the posterior mean of a process with exponential covariance."""
    rng = np.random.default_rng(0)
    count, size, tau, std = 12, 2, 3.0, np.array([0.5, 2.0])
    end_s = np.cumsum(rng.uniform(0.2, 1.0, count))
    jacobian = rng.normal(size=(count, 6, size))
    error = rng.normal(size=(count, 6))
    error_std = rng.uniform(0.5, 1.5, 6)
    windows = MeasuredWindows(
        np.zeros(count, dtype=int), end_s, error[None], jacobian[None], np.zeros((1, count, size))
    )
    processes = Processes(std[None], np.array([tau]), error_std[None], np.zeros((1, size)), dof=1e9)
    found = run_filter(windows, processes)
    prior = np.kron(np.exp(-np.abs(end_s[:, None] - end_s) / tau), np.diag(std**2))
    observe = np.zeros((6 * count, size * count))
    for k in range(count):
        observe[6 * k : 6 * k + 6, size * k : size * k + size] = jacobian[k]
    total = observe @ prior @ observe.T + np.diag(np.tile(error_std**2, count))
    gain = np.linalg.solve(total, observe @ prior).T
    mean = gain @ -error.ravel()
    covariance = prior - gain @ observe @ prior
    assert np.allclose(found.mean[0, -1], mean[-size:], atol=1e-6)
    assert np.allclose(found.covariance[0, -1], covariance[-size:, -size:], atol=1e-6)
    sign, logdet = np.linalg.slogdet(2 * np.pi * total)
    quadratic = error.ravel() @ np.linalg.solve(total, error.ravel())
    assert sign > 0
    assert found.nll[0].sum() == pytest.approx(0.5 * (logdet + quadratic), rel=1e-4)


def test_an_outlier_moves_the_estimate_little():
    jacobian = np.repeat(np.eye(6, 1)[None], 20, axis=0)[None]
    error = np.random.default_rng(0).normal(size=(1, 20, 6))
    processes = Processes(np.ones((1, 1)), np.array([100.0]), np.ones((1, 6)), np.zeros((1, 1)), dof=4.0)

    def last(outlier):
        moved = error.copy()
        moved[0, 10, 0] += outlier
        windows = MeasuredWindows(np.zeros(20, dtype=int), np.arange(20.0), moved, jacobian, np.zeros((1, 20, 1)))
        return run_filter(windows, processes).mean[0, -1, 0]

    assert abs(last(1000.0) - last(0.0)) < 0.1


def test_jacobian_and_values_of_each_window_equal_single_simulations():
    windows = cut_windows(segments_of([drive(CONFIG, 8.0, 5)]), 0.3, 0.6)
    values = np.linspace(-0.2, 0.2, len(windows))
    together = simulate_windows(windows, CONFIG, {DISTURBANCE_NAMES[0]: values[None]})[0]
    for k in range(0, len(windows), 4):
        alone = simulate_windows(
            windows.take(np.array([k])), CONFIG.with_values({DISTURBANCE_NAMES[0]: float(values[k])})
        )
        assert np.allclose(together[k], alone[0, 0], atol=1e-5)
    at = np.zeros((1, len(windows), 4))
    measured = linearised(windows, CONFIG, at)
    at[..., 1] = 0.02
    moved = linearised(windows, CONFIG, at)
    change = moved.error - measured.error
    assert np.allclose(change, 0.02 * measured.jacobian[..., 1], atol=0.15 * np.abs(change).max())
