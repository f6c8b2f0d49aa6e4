"""Test prediction errors against scipy's integration of the equations, independent of the simulator."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.observation import decode_state, encode
from carlab.prediction.errors import channel_errors, final_errors, prediction_errors
from carlab.prediction.initial_states import as_recorded, without_curvature_bias
from carlab.prediction.learned import LearnedModel
from carlab.prediction.predict import ConstantVelocity, NoChange, PredictiveModel, SimulatorModel, predicted_at
from carlab.prediction.windows import cut_windows, segments_of, split_segments
from learning.rollouts import StatelessModel
from sim_backends import CarParameters, SimulatorConfig
from sim_backends.car_parameters import MocapParameters
from tests.helpers.reference_dynamics import reference_rates

PARAMETERS = CarParameters()
DELAY_S = 0.08
CONFIG = SimulatorConfig(
    PARAMETERS, control_period_s=1 / 30, command_delay_s=DELAY_S, mocap=MocapParameters(latency_s=0.0)
)


def derivative(s, u, p):
    """Evaluate the single-track model with Pacejka tyres, slip in wheel frames and rear-wheel drive."""
    return reference_rates(0.0, [*s, *np.zeros(5)], p.max_angle_rad * u[0], u[1], p, {})[:6]


def integrate(state, start_s, moments_s, issued_s, commands, p, delay_s=DELAY_S):
    """Integrate from ``state`` at ``start_s`` to ``moments_s``; each command acts from issue plus delay."""
    switches = issued_s + delay_s
    edges = np.unique(
        np.concatenate([[start_s], moments_s, switches[(switches > start_s) & (switches < moments_s[-1])]])
    )
    found = {start_s: np.asarray(state, dtype=float)}
    for a, b in pairwise(edges.tolist()):
        k = np.searchsorted(switches, 0.5 * (a + b)) - 1
        # Before the first recorded command acts, the first command is assumed to be held.
        u = commands[max(k, 0)]
        found[b] = solve_ivp(lambda _, s, u=u: derivative(s, u, p), (a, b), found[a], rtol=1e-9, atol=1e-11).y[:, -1]
    return np.array([found[t] for t in moments_s])


def drive(times_s, p=PARAMETERS, roughness=1.0):
    rng = np.random.default_rng(3)
    t = times_s[:-1]
    steering = 0.6 * np.sin(1.9 * t) + 0.2 * roughness * rng.uniform(-1, 1, len(t))
    throttle = 0.45 + 0.3 * np.sin(0.8 * t) + 0.1 * roughness * rng.uniform(-1, 1, len(t))
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
    return drive(np.concatenate([[0.0], np.cumsum(rng.uniform(0.006, 0.014, 700))]), roughness=0.2)


def recorded_windows(episode, horizon_s=1.0, stride_s=0.25):
    """Cut windows with the recorded states as initial states."""
    return as_recorded(cut_windows(segments_of([episode]), horizon_s, stride_s))


def rms_of(config, windows):
    return np.sqrt(np.mean(final_errors(SimulatorModel(config), windows) ** 2, axis=0))


def test_true_simulator_predicts_to_integration_accuracy(even):
    windows = recorded_windows(even, 1.0, 0.3)
    assert len(windows) == 22  # from 0.6 s on, with 0.6 s of commands before each
    assert windows.horizon_s == pytest.approx(1.0)
    np.testing.assert_allclose(final_errors(SimulatorModel(CONFIG), windows), 0.0, atol=3e-4)
    assert np.sqrt(np.mean(final_errors(ConstantVelocity(), windows)[:, :2] ** 2)) > 0.1


def test_uneven_stamps_are_resampled_to_an_even_grid(uneven):
    """Averaging commands of 10 ms over 30 ms causes errors of millimetres after a second."""
    windows = recorded_windows(uneven, 1.0, 0.3)
    assert windows.period_s == pytest.approx(0.03, rel=0.02)
    rms = rms_of(CONFIG, windows)
    assert np.all(rms < [2e-3, 2e-3, 4e-3, 4e-3, 4e-3, 2e-2])
    steady = np.sqrt(np.mean(final_errors(ConstantVelocity(), windows) ** 2, axis=0))
    assert np.all(10 * rms < steady)


def test_error_of_a_wrong_parameter_equals_scipy(even):
    wrong = replace(PARAMETERS, front_mu=0.3, drive_gain_n=9.5)
    windows = recorded_windows(even, 1.0, 1.7)
    found = final_errors(SimulatorModel(replace(CONFIG, parameters=wrong)), windows)
    expected = []
    for t0 in windows.t0_s:
        row = round(30 * t0)
        start, truth = even.states[row], even.states[row + 30]
        (end,) = integrate(start, t0, np.array([t0 + 1.0]), even.times_s[:-1], even.sent, wrong)
        dx, dy = end[:2] - truth[:2]
        c, s = np.cos(start[2]), np.sin(start[2])
        yaw_error = (end[2] - truth[2] + np.pi) % (2 * np.pi) - np.pi
        expected.append([c * dx + s * dy, c * dy - s * dx, yaw_error, *(end[3:] - truth[3:])])
    expected = np.array(expected)
    assert np.abs(expected[:, 0]).max() > 0.1
    np.testing.assert_allclose(found, expected, atol=5e-4)
    for k, row in enumerate(channel_errors(found)):
        assert row.rms == pytest.approx(np.sqrt(np.mean(expected[:, k] ** 2)), abs=5e-4)
        assert row.median == pytest.approx(np.median(np.abs(expected[:, k])), abs=5e-4)
        assert row.bias == pytest.approx(np.mean(expected[:, k]), abs=5e-4)
        assert row.rms >= abs(row.bias)
    assert [row.channel for row in channel_errors(found)] == ["x", "y", "yaw", "vx", "vy", "yaw_rate"]


def test_prediction_does_not_depend_on_the_origin_of_the_coordinates(even):
    """Surveyed coordinates are millions of metres from their origin; 32 bits round them to half a metre."""
    windows = recorded_windows(even, 1.0, 1.7)
    offset = np.array([6.5e6, -4.2e6, 0.0, 0.0, 0.0, 0.0])
    far = replace(windows, initial_states=windows.initial_states + offset, measured=windows.measured + offset)
    near_errors, far_errors = (final_errors(SimulatorModel(CONFIG), w) for w in (windows, far))
    np.testing.assert_allclose(far_errors, near_errors, atol=1e-4)


def test_commands_before_a_window_act_through_the_delay(even):
    """Without the delay the same recording has a much larger error."""
    windows = recorded_windows(even)
    assert rms_of(replace(CONFIG, command_delay_s=0.0), windows)[5] > 50 * rms_of(CONFIG, windows)[5]


def test_smoothed_initial_states_are_close_to_the_recorded_ones_without_noise(even):
    windows = cut_windows(segments_of([even]), 1.0, 0.25)
    recorded = as_recorded(windows).initial_states
    better = without_curvature_bias(windows, CONFIG)
    before, after = (np.sqrt(np.mean((w.initial_states - recorded) ** 2, axis=0)) for w in (windows, better))
    assert np.all(after < 0.5 * before + 1e-4)


def test_baseline_predictors_have_closed_form_errors():
    """On a circle of 2 m at 1 m/s constant velocity is exact; no change errs by a chord and 0.5 rad."""
    t = np.arange(121) / 30.0
    a = 0.5 * t
    states = np.column_stack([2 * np.sin(a), 2 - 2 * np.cos(a), a, np.ones(121), np.zeros(121), np.full(121, 0.5)])
    episode = EpisodeData(t, states, np.zeros((120, 2)), np.zeros((120, 2)), np.full(120, np.nan))
    windows = recorded_windows(episode)
    constant_velocity = prediction_errors(ConstantVelocity().predict(windows), windows)
    assert constant_velocity.shape == (len(windows), 31, 6)
    np.testing.assert_allclose(constant_velocity, 0.0, atol=1e-9)
    no_change = final_errors(NoChange(), windows)
    np.testing.assert_allclose(np.hypot(no_change[:, 0], no_change[:, 1]), 4 * np.sin(0.25), atol=1e-9)
    np.testing.assert_allclose(no_change[:, 0], -2 * np.sin(0.5), atol=1e-9)
    np.testing.assert_allclose(no_change[:, 2], -0.5, atol=1e-9)


def test_predictions_at_stamps_restart_every_horizon(even):
    windows = recorded_windows(even, 1.0, 1.0)
    wrong = replace(CONFIG, parameters=replace(PARAMETERS, drive_gain_n=9.5))
    overlay = predicted_at(even.times_s, windows, SimulatorModel(wrong).predict(windows))
    assert overlay.shape == even.states.shape
    starts = np.round(30 * windows.t0_s).astype(int)
    assert np.isnan(overlay[: starts[0]]).all()
    assert np.isfinite(overlay[starts[0] : starts[-1] + 30]).all()
    position_error = np.hypot(*(overlay - even.states)[:, :2].T)
    np.testing.assert_allclose(position_error[starts], 0.0, atol=1e-6)
    assert position_error[starts + 29].min() > 0.02


def test_no_window_contains_a_break_or_standstill(even):
    states = even.states.copy()
    states[100, 0] = np.nan
    segment = (np.arange(241) >= 180).astype(float)
    broken = replace(even, states=states, extra={"segment": segment})
    windows = recorded_windows(broken, 0.5, 1 / 30)
    for row in np.round(30 * windows.t0_s).astype(int):
        assert not row <= 100 <= row + 15
        assert not row < 180 <= row + 15
    assert np.isfinite(windows.measured).all()
    with pytest.raises(DataError, match="moves in no stretch"):
        recorded_windows(replace(even, states=np.zeros_like(even.states)))


def test_gap_in_time_ends_a_window(even):
    times = even.times_s + 0.5 * (np.arange(241) >= 120)
    windows = recorded_windows(replace(even, times_s=times), 0.5, 0.1)
    assert not np.any((windows.t0_s < times[120]) & (windows.t0_s + 0.5 > times[119] + 1e-3))


def test_last_share_is_split_off_with_a_guard_interval(even):
    segments = segments_of([even])
    early, late = split_segments(segments, 0.3, 1.5)
    assert late[0].t_s[0] == pytest.approx(0.7 * 8.0, abs=0.04)
    assert late[0].t_s[0] - early[0].t_s[-1] == pytest.approx(1.5, abs=0.07)
    assert len(late[0].t_s) + len(early[0].t_s) == len(segments[0].t_s) - 45


def test_recordings_without_windows_are_refused(even):
    with pytest.raises(DataError, match="shorter horizon"):
        recorded_windows(even, 60.0)
    single = EpisodeData(np.zeros(1), np.zeros((1, 6)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    with pytest.raises(DataError, match=r"too few commands \(0\)"):
        segments_of([single])


def test_mocap_latency_acts_like_command_delay(even):
    """A delay of 80 ms and a delay of 50 ms plus a latency of 30 ms give equal predictions."""
    windows = recorded_windows(even)
    split = replace(CONFIG, command_delay_s=0.05, mocap=MocapParameters(latency_s=0.03))
    difference = SimulatorModel(split).predict(windows) - SimulatorModel(CONFIG).predict(windows)
    np.testing.assert_allclose(difference, 0.0, atol=1e-5)


class SteadyCar(StatelessModel):
    """A learned car that keeps its body velocities, with noise on its speed."""

    history = 2

    def step(self, features, action, generator):
        state = decode_state(features)
        noise = 0.01 * torch.randn(len(state), generator=generator)
        x, y, yaw, vx, vy, rate = state.unbind(dim=1)
        dx, dy = vx / 30, vy / 30
        next_state = torch.stack(
            [x + yaw.cos() * dx - yaw.sin() * dy, y + yaw.sin() * dx + yaw.cos() * dy, yaw + rate / 30,
             vx + noise, vy, rate], dim=1,
        )  # fmt: skip
        return torch.from_numpy(encode(next_state.numpy(), np.zeros((len(state), 2, 2)))).float()


def test_learned_car_predicts_the_mean_of_sampled_paths():
    """The mean equals constant velocity within the Monte Carlo error; yaw stays unwrapped over four turns."""
    t = np.arange(301) / 30.0
    a = 2.5 * t
    states = np.column_stack(
        [0.4 * np.sin(a), 0.4 - 0.4 * np.cos(a), a, np.ones(301), np.zeros(301), np.full(301, 2.5)]
    )
    windows = recorded_windows(EpisodeData(t, states, np.zeros((300, 2)), np.zeros((300, 2)), np.full(300, np.nan)))
    model: PredictiveModel = LearnedModel(SteadyCar(), n_samples=200)
    found, steady = model.predict(windows), ConstantVelocity().predict(windows)
    assert found.shape == steady.shape
    np.testing.assert_allclose(found[..., 2], steady[..., 2], atol=1e-3)
    np.testing.assert_allclose(found[:, -1, 3], 1.0, atol=5 * 0.01 * np.sqrt(30 / 200))
    np.testing.assert_allclose(found[..., :2], steady[..., :2], atol=0.06)
    far = replace(windows, initial_states=windows.initial_states + np.array([5e5, 5.4e6, 0, 0, 0, 0]))
    np.testing.assert_allclose(model.predict(far)[..., :2] - found[..., :2] - [5e5, 5.4e6], 0.0, atol=1e-6)
    with pytest.raises(DataError, match="past commands"):
        LearnedModel(type("Long", (SteadyCar,), {"history": 99})()).predict(windows)


@pytest.mark.parametrize("effects", [{}, {"tyre_relaxation": {"length": 0.1}}])
def test_prediction_is_independent_of_the_origin_and_of_whole_turns(even, effects):
    """Metric coordinates of a map are millions of metres, which 32 bits resolve to half a metre."""
    windows, config = recorded_windows(even), replace(CONFIG, effects=effects)
    shift = np.array([5e5, 5.4e6, 2.0 * np.pi * 1000, 0.0, 0.0, 0.0])
    arrays = ("initial_states", "past_states", "measured")
    moved = replace(windows, **{name: getattr(windows, name) + shift for name in arrays})
    found = SimulatorModel(config).predict(moved) - shift
    np.testing.assert_allclose(found, SimulatorModel(config).predict(windows), atol=2e-5)
