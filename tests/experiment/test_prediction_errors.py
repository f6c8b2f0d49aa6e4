"""Prediction errors against an integrator that shares nothing with the simulator: scipy on the equations."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.experiment.prediction_errors import BASELINES, prediction_errors
from carlab.recording.foreign_csv import import_csv
from sim_backends import CarParameters, SimulatorConfig

PARAMETERS = CarParameters()
DELAY_S = 0.08
CONFIG = SimulatorConfig(PARAMETERS, control_period_s=1 / 30, command_delay_s=DELAY_S)


def derivative(s, u, p):
    """The base model as its authors write it: single track, Pacejka, slip in each wheel's frame, drive at the rear."""
    psi, vx, vy, r = s[2:]
    d = p.max_angle_rad * u[0]
    length = p.front_axle_m + p.rear_axle_m
    fx = p.drive_gain_n * u[1] - p.damping_nspm * vx
    lat_f = -vx * np.sin(d) + (vy + p.front_axle_m * r) * np.cos(d)
    long_f = vx * np.cos(d) + (vy + p.front_axle_m * r) * np.sin(d)
    a_f = np.arctan2(lat_f, max(abs(long_f), 0.3))
    a_r = np.arctan2(vy - p.rear_axle_m * r, max(abs(vx), 0.3))
    load_f = p.mass_kg * 9.81 * p.rear_axle_m / length
    load_r = p.mass_kg * 9.81 * p.front_axle_m / length
    f_f = -p.front_mu * load_f * np.sin(p.front_c * np.arctan(p.front_b * a_f))
    f_r = -p.rear_mu * load_r * np.sin(p.rear_c * np.arctan(p.rear_b * a_r))
    return [
        vx * np.cos(psi) - vy * np.sin(psi),
        vx * np.sin(psi) + vy * np.cos(psi),
        r,
        (fx - f_f * np.sin(d)) / p.mass_kg + vy * r,
        (f_r + f_f * np.cos(d)) / p.mass_kg - vx * r,
        (p.front_axle_m * f_f * np.cos(d) - p.rear_axle_m * f_r) / p.yaw_inertia_kgm2,
    ]


def integrate(state, start_s, moments_s, issued_s, commands, p, delay_s=DELAY_S):
    """States at ``moments_s`` from ``state`` at ``start_s``, with each command acting from issue + delay on."""
    switches = issued_s + delay_s
    edges = np.unique(
        np.concatenate([[start_s], moments_s, switches[(switches > start_s) & (switches < moments_s[-1])]])
    )
    found = {start_s: np.asarray(state, dtype=float)}
    for a, b in pairwise(edges.tolist()):
        k = np.searchsorted(switches, 0.5 * (a + b)) - 1
        # Before the first recorded command acts, the first one is taken to have been held.
        u = commands[max(k, 0)]
        found[b] = solve_ivp(lambda _, s, u=u: derivative(s, u, p), (a, b), found[a], rtol=1e-9, atol=1e-11).y[:, -1]
    return np.array([found[t] for t in moments_s])


def drive(times_s, p=PARAMETERS):
    rng = np.random.default_rng(3)
    t = times_s[:-1]
    steering = 0.6 * np.sin(1.9 * t) + 0.2 * rng.uniform(-1, 1, len(t))
    throttle = 0.45 + 0.3 * np.sin(0.8 * t) + 0.1 * rng.uniform(-1, 1, len(t))
    commands = np.column_stack([steering, throttle])
    start = np.array([0.3, -0.2, 3.0, 1.2, 0.0, 0.0])
    states = np.vstack([start, integrate(start, times_s[0], times_s[1:], t, commands, p)])
    states[:, 2] = (states[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return EpisodeData(times_s, states, commands, commands, np.full(len(t), np.nan))


@pytest.fixture(scope="module")
def even():
    return drive(np.arange(241) / 30.0)


@pytest.fixture(scope="module")
def uneven():
    rng = np.random.default_rng(4)
    return drive(np.concatenate([[0.0], np.cumsum(rng.uniform(0.006, 0.014, 700))]))


def test_the_right_simulator_predicts_to_integration_accuracy(even):
    result = prediction_errors(even, CONFIG, horizon_s=1.0, stride_s=0.3)
    assert result.shots == 24
    assert result.horizon_s == pytest.approx(1.0)
    assert "Even" in result.note
    np.testing.assert_allclose(result.errors, 0.0, atol=2e-4)
    assert np.sqrt(np.mean(result.baselines["constant velocity"][:, :2] ** 2)) > 0.1


def test_uneven_stamps_are_kept(uneven):
    """Commands that change on no common grid: averaging over 2.5 ms costs millimetres in a second, no centimetres."""
    result = prediction_errors(uneven, CONFIG, horizon_s=1.0, stride_s=0.3)
    assert "Uneven" in result.note
    rms = np.array([row.rms for row in result.summary()])
    assert np.all(rms < [2e-3, 2e-3, 4e-3, 4e-3, 4e-3, 2e-2])
    assert np.all(10 * rms < [row.rms for row in result.summary("constant velocity")])


def test_a_wrong_parameter_gives_the_error_that_scipy_computes(even):
    wrong = replace(PARAMETERS, front_mu=0.3, drive_gain_n=9.5)
    result = prediction_errors(even, replace(CONFIG, parameters=wrong), horizon_s=1.0, stride_s=1.7)
    wanted = []
    for row in result.start_rows:
        t0, start, truth = even.times_s[row], even.states[row], even.states[row + 30]
        assert t0 == pytest.approx(row / 30)
        (end,) = integrate(start, t0, np.array([t0 + 1.0]), even.times_s[:-1], even.sent, wrong)
        dx, dy = end[:2] - truth[:2]
        c, s = np.cos(start[2]), np.sin(start[2])
        turned = (end[2] - truth[2] + np.pi) % (2 * np.pi) - np.pi
        wanted.append([c * dx + s * dy, c * dy - s * dx, turned, *(end[3:] - truth[3:])])
    wanted = np.array(wanted)
    assert np.abs(wanted[:, 0]).max() > 0.1
    np.testing.assert_allclose(result.errors, wanted, atol=5e-4)
    for k, row in enumerate(result.summary()):
        assert row.rms == pytest.approx(np.sqrt(np.mean(wanted[:, k] ** 2)), abs=5e-4)
        assert row.median == pytest.approx(np.median(np.abs(wanted[:, k])), abs=5e-4)
        assert row.bias == pytest.approx(np.mean(wanted[:, k]), abs=5e-4)
        assert row.rms >= abs(row.bias)
    assert [row[0] for row in result.rows()] == ["x", "y", "yaw", "vx", "vy", "yaw_rate"]


def test_history_before_the_start_acts_through_the_delay(even):
    """With the delay left out the same recording is predicted worse by far: the history carries it."""
    right = prediction_errors(even, CONFIG).summary()
    without = prediction_errors(even, replace(CONFIG, command_delay_s=0.0)).summary()
    assert without[5].rms > 50 * right[5].rms


def test_baselines_in_closed_form():
    """A car on a circle of 2 m at 1 m/s: constant velocity is right, no change is one chord and half a radian off."""
    t = np.arange(121) / 30.0
    a = 0.5 * t
    states = np.column_stack([2 * np.sin(a), 2 - 2 * np.cos(a), a, np.ones(121), np.zeros(121), np.full(121, 0.5)])
    episode = EpisodeData(t, states, np.zeros((120, 2)), np.zeros((120, 2)), np.full(120, np.nan))
    result = prediction_errors(episode, CONFIG)
    np.testing.assert_allclose(result.baselines[BASELINES[0]], 0.0, atol=1e-9)
    still = result.baselines[BASELINES[1]]
    np.testing.assert_allclose(np.hypot(still[:, 0], still[:, 1]), 4 * np.sin(0.25), atol=1e-9)
    np.testing.assert_allclose(still[:, 0], -2 * np.sin(0.5), atol=1e-9)
    np.testing.assert_allclose(still[:, 2], -0.5, atol=1e-9)


def test_overlay_restarts_every_horizon(even):
    result = prediction_errors(even, replace(CONFIG, parameters=replace(PARAMETERS, drive_gain_n=9.5)))
    assert result.overlay.shape == even.states.shape
    assert np.isfinite(result.overlay).all()
    away = np.hypot(*(result.overlay - even.states)[:, :2].T)
    np.testing.assert_allclose(away[::30], 0.0, atol=1e-9)
    assert away[29:240:30].min() > 0.02
    first, recorded = result.trajectories[:, 0], even.states[result.start_rows]
    np.testing.assert_allclose(np.delete(first, 2, axis=1), np.delete(recorded, 2, axis=1), atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * first[:, 2]), np.exp(1j * recorded[:, 2]), atol=1e-12)


def test_no_shot_spans_a_break_or_stands_still(even):
    states = even.states.copy()
    states[100, 0] = np.nan
    segment = (np.arange(241) >= 180).astype(float)
    broken = replace(even, states=states, extra={"segment": segment})
    result = prediction_errors(broken, CONFIG, horizon_s=0.5, stride_s=1 / 30)
    for row in result.start_rows:
        assert not row <= 100 <= row + 15
        assert not row < 180 <= row + 15
    assert result.left_out["across a gap, a jump or a missing value"] == 16 + 15
    assert np.isfinite(result.errors).all()
    assert np.isnan(result.overlay[100]).all()
    still = replace(even, states=np.zeros_like(even.states))
    with pytest.raises(DataError, match="without motion"):
        prediction_errors(still, CONFIG)


def test_gap_in_time_ends_a_shot(even):
    times = even.times_s + 0.5 * (np.arange(241) >= 120)
    result = prediction_errors(replace(even, times_s=times), CONFIG, horizon_s=0.5, stride_s=0.1)
    starts, ends = times[result.start_rows], times[result.start_rows] + 0.5
    assert not np.any((starts < times[120]) & (ends > times[119] + 1e-3))


def test_what_cannot_be_predicted_is_said(even):
    with pytest.raises(DataError, match="shorter horizon"):
        prediction_errors(even, CONFIG, horizon_s=60.0)
    with pytest.raises(DataError, match="positive"):
        prediction_errors(even, CONFIG, stride_s=0.0)
    with pytest.raises(DataError, match="no baseline"):
        prediction_errors(even, CONFIG).summary("tea leaves")
    single = EpisodeData(np.zeros(1), np.zeros((1, 6)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    with pytest.raises(DataError, match="no command"):
        prediction_errors(single, CONFIG)


def test_real_recording_is_predicted_better_than_by_doing_nothing(shared):
    """The default car was measured on this kind of car: over a second it must beat both baselines in every channel."""
    episode = import_csv(shared / "data" / "eth_rc_car" / "train_2.csv.gz").episode
    result = prediction_errors(episode, SimulatorConfig.from_preset("rc_car"), stride_s=0.5)
    assert result.shots > 200
    for channel, _, rms, _, _, _, steady, still in result.rows():
        assert rms < min(steady, still), channel
