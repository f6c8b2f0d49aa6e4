"""State estimator against closed forms: constant velocity, chirp phase, Savitzky-Golay noise."""

import math

import numpy as np
import pytest

from carlab.core.quantities import PoseSample
from carlab.core.state_estimator import StateEstimator


def sample(i, t, x, y, yaw, tracked=True):
    return PoseSample(i, t, t + 0.008, x, y, yaw, tracked=tracked)


def wrapped(yaw):
    return math.remainder(yaw, 2 * math.pi)


def test_constant_velocity_is_exact_through_the_wrap_with_irregular_stamps():
    rng = np.random.default_rng(1)
    estimator = StateEstimator()
    t, speed_x, speed_y, yaw_rate = 100.0, 1.3, -0.7, 6.0
    crossings = 0
    before = None
    for i in range(400):
        t += rng.uniform(0.003, 0.012)
        yaw = 2.9 + yaw_rate * (t - 100.0)
        if before is not None and abs(wrapped(yaw) - before) > math.pi:
            crossings += 1
        before = wrapped(yaw)
        estimator.update(sample(i, t, 3 + speed_x * (t - 100), speed_y * (t - 100), wrapped(yaw)))
        if i < 10:
            continue
        state, delay_s = estimator.estimate()
        middle = yaw - yaw_rate * delay_s
        body_x = math.cos(middle) * speed_x + math.sin(middle) * speed_y
        body_y = -math.sin(middle) * speed_x + math.cos(middle) * speed_y
        assert state.yaw_rate_radps == pytest.approx(yaw_rate, abs=1e-9)
        assert (state.vx_mps, state.vy_mps) == pytest.approx((body_x, body_y), abs=1e-9)
        assert state.x_m == pytest.approx(3 + speed_x * (t - 100), abs=1e-12)
        assert wrapped(state.yaw_rad - yaw) == pytest.approx(0, abs=1e-9)
        assert -math.pi <= state.yaw_rad < math.pi
        assert 0.01 < delay_s < 0.03
    assert crossings >= 2


def test_known_delay_is_the_phase_of_a_chirp():
    rate_hz, estimator = 240.0, StateEstimator(window_s=0.05)
    rows = []
    for i in range(int(8 * rate_hz)):
        t = i / rate_hz
        phase = 2 * math.pi * (0.2 * t + 0.15 * t * t)  # 0.2 to 2.6 Hz
        estimator.update(sample(i, t, 0.3 * math.sin(phase), 0.0, 0.0))
        state, delay_s = estimator.estimate()
        if i > 20:
            rows.append((t, state.vx_mps, delay_s))
    t, vx, delay = np.array(rows).T
    assert np.ptp(delay) < 1e-9
    assert delay[0] == pytest.approx(0.025, abs=1e-9)  # 13 samples over exactly 50 ms

    def truth(at):
        return 0.3 * 2 * math.pi * (0.2 + 0.3 * at) * np.cos(2 * math.pi * (0.2 * at + 0.15 * at * at))

    shifts = np.arange(0.0, 0.05, 0.0005)
    errors = [np.sum((vx - truth(t - shift)) ** 2) for shift in shifts]
    assert shifts[int(np.argmin(errors))] == pytest.approx(delay[0], abs=0.0011)


def test_noise_follows_the_savitzky_golay_formula():
    rng, sigma, rate_hz = np.random.default_rng(5), 0.0005, 120.0
    estimator = StateEstimator(window_s=0.05)
    vx, yaw_rate = [], []
    for i in range(12000):
        x, yaw = rng.normal(0, sigma), rng.normal(0, 4 * sigma)
        estimator.update(sample(i, i / rate_hz, x, 0.0, yaw))
        if i % 8 == 7:  # windows of seven samples, not overlapping
            state, _ = estimator.estimate()
            vx.append(state.vx_mps)
            yaw_rate.append(state.yaw_rate_radps)
    n = 7
    expected = sigma * math.sqrt(12 / (n * (n * n - 1))) * rate_hz
    assert np.std(vx[1:]) == pytest.approx(expected, rel=0.08)
    assert np.std(yaw_rate[1:]) == pytest.approx(4 * expected, rel=0.08)
    assert abs(np.mean(vx)) < 4 * expected / math.sqrt(len(vx))


def test_too_few_samples_give_invalid_zero_velocity():
    estimator = StateEstimator()
    assert estimator.estimate() is None
    for i in range(2):
        estimator.update(sample(i, i / 120, 0.1 * i, 0, 0))
        state, delay_s = estimator.estimate()
        assert not estimator.velocity_valid
        assert (state.x_m, state.vx_mps, delay_s) == (0.1 * i, 0.0, 0.0)
    estimator.update(sample(2, 2 / 120, 0.2, 0, 0))
    assert estimator.velocity_valid
    assert estimator.estimate()[0].vx_mps == pytest.approx(12.0)


def test_repeated_backward_untracked_and_not_finite_samples_change_nothing():
    clean, dirty = StateEstimator(), StateEstimator()
    for i in range(30):
        good = sample(i, i / 120, 0.01 * i, 0.02 * i, 0.03 * i)
        clean.update(good)
        dirty.update(good)
        dirty.update(good)
        dirty.update(sample(i, i / 120 - 0.001, 9.0, 9.0, 3.0))
        dirty.update(sample(i, i / 120 + 0.001, 5.0, 5.0, 1.0, tracked=False))
        dirty.update(sample(i, i / 120 + 0.001, math.nan, 5.0, 1.0))
    assert dirty.estimate() == clean.estimate()
    assert (dirty.dropped, clean.dropped) == (90, 0)


def test_backward_clock_step_starts_a_new_window():
    estimator = StateEstimator()
    for i in range(20):
        estimator.update(sample(i, 1000 + i / 120, 0.0, 0, 0))
    for i in range(20):
        estimator.update(sample(i, i / 120, 2.0 * i / 120, 0, 0))
    state, _ = estimator.estimate()
    assert state.vx_mps == pytest.approx(2.0)
    assert state.x_m == pytest.approx(2.0 * 19 / 120)


def test_slow_motion_capture_uses_three_recent_samples():
    estimator = StateEstimator(window_s=0.05)
    for i in range(5):
        estimator.update(sample(i, i / 30, 1.5 * i / 30, 0, 0))
    state, delay_s = estimator.estimate()
    assert (state.vx_mps, delay_s) == (pytest.approx(1.5), pytest.approx(1 / 30))
    estimator.update(sample(9, 5.0, 0.0, 0, 0))
    assert not estimator.velocity_valid


def test_reset_discards_samples_and_keeps_counts():
    estimator = StateEstimator()
    for i in range(10):
        estimator.update(sample(i, i / 120, 1.0, 0, 0))
    estimator.update(sample(9, 9 / 120, 1.0, 0, 0))
    estimator.reset()
    assert estimator.estimate() is None
    assert estimator.dropped == 1
