"""Prediction errors against an integrator that shares nothing with the simulator: scipy on the equations."""

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
from carlab.prediction.windows import cut_windows, split_tracks, tracks_of
from sim_backends import CarParameters, SimulatorConfig
from sim_backends.car_parameters import MocapParameters

PARAMETERS = CarParameters()
DELAY_S = 0.08
CONFIG = SimulatorConfig(
    PARAMETERS, control_period_s=1 / 30, command_delay_s=DELAY_S, mocap=MocapParameters(latency_s=0.0)
)


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
    """Windows whose initial states are the recorded ones."""
    return as_recorded(cut_windows(tracks_of([episode]), horizon_s, stride_s))


def rms_of(config, windows):
    return np.sqrt(np.mean(final_errors(SimulatorModel(config), windows) ** 2, axis=0))


def test_the_right_simulator_predicts_to_integration_accuracy(even):
    windows = recorded_windows(even, 1.0, 0.3)
    assert len(windows) == 22  # from 0.6 s on, with 0.6 s of commands before each
    assert windows.horizon_s == pytest.approx(1.0)
    np.testing.assert_allclose(final_errors(SimulatorModel(CONFIG), windows), 0.0, atol=3e-4)
    assert np.sqrt(np.mean(final_errors(ConstantVelocity(), windows)[:, :2] ** 2)) > 0.1


def test_uneven_stamps_are_put_onto_an_even_grid(uneven):
    """Commands that change every 10 ms, as means over 30 ms: some millimetres in a second, no centimetres."""
    windows = recorded_windows(uneven, 1.0, 0.3)
    assert windows.period_s == pytest.approx(0.03, rel=0.02)
    rms = rms_of(CONFIG, windows)
    assert np.all(rms < [2e-3, 2e-3, 4e-3, 4e-3, 4e-3, 2e-2])
    steady = np.sqrt(np.mean(final_errors(ConstantVelocity(), windows) ** 2, axis=0))
    assert np.all(10 * rms < steady)


def test_a_wrong_parameter_gives_the_error_that_scipy_computes(even):
    wrong = replace(PARAMETERS, front_mu=0.3, drive_gain_n=9.5)
    windows = recorded_windows(even, 1.0, 1.7)
    found = final_errors(SimulatorModel(replace(CONFIG, parameters=wrong)), windows)
    wanted = []
    for t0 in windows.t0_s:
        row = round(30 * t0)
        start, truth = even.states[row], even.states[row + 30]
        (end,) = integrate(start, t0, np.array([t0 + 1.0]), even.times_s[:-1], even.sent, wrong)
        dx, dy = end[:2] - truth[:2]
        c, s = np.cos(start[2]), np.sin(start[2])
        turned = (end[2] - truth[2] + np.pi) % (2 * np.pi) - np.pi
        wanted.append([c * dx + s * dy, c * dy - s * dx, turned, *(end[3:] - truth[3:])])
    wanted = np.array(wanted)
    assert np.abs(wanted[:, 0]).max() > 0.1
    np.testing.assert_allclose(found, wanted, atol=5e-4)
    for k, row in enumerate(channel_errors(found)):
        assert row.rms == pytest.approx(np.sqrt(np.mean(wanted[:, k] ** 2)), abs=5e-4)
        assert row.median == pytest.approx(np.median(np.abs(wanted[:, k])), abs=5e-4)
        assert row.bias == pytest.approx(np.mean(wanted[:, k]), abs=5e-4)
        assert row.rms >= abs(row.bias)
    assert [row.channel for row in channel_errors(found)] == ["x", "y", "yaw", "vx", "vy", "yaw_rate"]


def test_commands_before_a_window_act_through_the_delay(even):
    """With the delay left out the same recording is predicted worse by far."""
    windows = recorded_windows(even)
    assert rms_of(replace(CONFIG, command_delay_s=0.0), windows)[5] > 50 * rms_of(CONFIG, windows)[5]


def test_smoothed_initial_states_are_close_to_the_recorded_ones_without_noise(even):
    windows = cut_windows(tracks_of([even]), 1.0, 0.25)
    recorded = as_recorded(windows).initial_states
    better = without_curvature_bias(windows, CONFIG)
    before, after = (np.sqrt(np.mean((w.initial_states - recorded) ** 2, axis=0)) for w in (windows, better))
    assert np.all(after < 0.5 * before + 1e-4)


def test_baselines_in_closed_form():
    """A car on a circle of 2 m at 1 m/s: constant velocity is right, no change is one chord and half a radian off."""
    t = np.arange(121) / 30.0
    a = 0.5 * t
    states = np.column_stack([2 * np.sin(a), 2 - 2 * np.cos(a), a, np.ones(121), np.zeros(121), np.full(121, 0.5)])
    episode = EpisodeData(t, states, np.zeros((120, 2)), np.zeros((120, 2)), np.full(120, np.nan))
    windows = recorded_windows(episode)
    whole = prediction_errors(ConstantVelocity().predict(windows), windows)
    assert whole.shape == (len(windows), 31, 6)
    np.testing.assert_allclose(whole, 0.0, atol=1e-9)
    still = final_errors(NoChange(), windows)
    np.testing.assert_allclose(np.hypot(still[:, 0], still[:, 1]), 4 * np.sin(0.25), atol=1e-9)
    np.testing.assert_allclose(still[:, 0], -2 * np.sin(0.5), atol=1e-9)
    np.testing.assert_allclose(still[:, 2], -0.5, atol=1e-9)


def test_predictions_at_stamps_restart_every_horizon(even):
    windows = recorded_windows(even, 1.0, 1.0)
    wrong = replace(CONFIG, parameters=replace(PARAMETERS, drive_gain_n=9.5))
    overlay = predicted_at(even.times_s, windows, SimulatorModel(wrong).predict(windows))
    assert overlay.shape == even.states.shape
    starts = np.round(30 * windows.t0_s).astype(int)
    assert np.isnan(overlay[: starts[0]]).all()
    assert np.isfinite(overlay[starts[0] : starts[-1] + 30]).all()
    away = np.hypot(*(overlay - even.states)[:, :2].T)
    np.testing.assert_allclose(away[starts], 0.0, atol=1e-6)
    assert away[starts + 29].min() > 0.02


def test_no_window_spans_a_break_or_a_parked_car(even):
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


def test_the_last_share_is_split_off_with_a_guard(even):
    tracks = tracks_of([even])
    early, late = split_tracks(tracks, 0.3, 1.5)
    assert late[0].t_s[0] == pytest.approx(0.7 * 8.0, abs=0.04)
    assert late[0].t_s[0] - early[0].t_s[-1] == pytest.approx(1.5, abs=0.07)
    assert len(late[0].t_s) + len(early[0].t_s) == len(tracks[0].t_s) - 45


def test_what_cannot_be_predicted_is_said(even):
    with pytest.raises(DataError, match="shorter horizon"):
        recorded_windows(even, 60.0)
    single = EpisodeData(np.zeros(1), np.zeros((1, 6)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    with pytest.raises(DataError, match="0 commands"):
        tracks_of([single])


def test_the_latency_of_motion_capture_delays_commands_in_the_recording(even):
    """Commands that act 80 ms later in the recording: by the delay alone, or 50 ms by it and 30 ms by the latency."""
    windows = recorded_windows(even)
    split = replace(CONFIG, command_delay_s=0.05, mocap=MocapParameters(latency_s=0.03))
    alike = SimulatorModel(split).predict(windows) - SimulatorModel(CONFIG).predict(windows)
    np.testing.assert_allclose(alike, 0.0, atol=1e-5)


class SteadyCar:
    """A learned car that keeps its body velocities, with noise on its speed."""

    history = 2

    def step(self, features, action, generator):
        state = decode_state(features)
        noise = 0.01 * torch.randn(len(state), generator=generator)
        x, y, yaw, vx, vy, rate = state.unbind(dim=1)
        dx, dy = vx / 30, vy / 30
        moved = torch.stack(
            [x + yaw.cos() * dx - yaw.sin() * dy, y + yaw.sin() * dx + yaw.cos() * dy, yaw + rate / 30,
             vx + noise, vy, rate], dim=1,
        )  # fmt: skip
        return torch.from_numpy(encode(moved.numpy(), np.zeros((len(state), 2, 2)))).float()


def test_a_learned_car_predicts_by_the_mean_of_its_paths():
    """Four turns, whose yaw counts on: as constant velocity predicts, to the noise over the root of the paths."""
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
    with pytest.raises(DataError, match="past commands"):
        LearnedModel(type("Long", (SteadyCar,), {"history": 99})()).predict(windows)
