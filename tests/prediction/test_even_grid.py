"""Commands that change within the steps of thinned recordings, and the noise of velocities at high rates."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.cars import default_car
from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.identification.measurement_noise import estimate_noise
from carlab.diagnosis.identification.velocity_window import with_initial_states
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import PredictionWindows, cut_windows, history_rows, segments_of
from carlab.recording.pose_velocity import pose_motion
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.operator_rollout import operator_rollout

CAR = default_car().simulator
POSE_STD = np.array([3e-4, 3e-4, 2e-3])


def simulated(config: SimulatorConfig, period_s: float, commands: np.ndarray) -> np.ndarray:
    """States (n + 1, 6) of a car that starts at rest, with commands (n, 2) held over each period."""
    past, count, none = history_rows(period_s), len(commands), np.zeros(1, dtype=np.int64)
    windows = PredictionWindows(
        period_s, np.zeros((1, 6)), np.zeros((1, past, 2)), commands[None], np.zeros((1, count + 1, 6)),
        np.zeros((1, past, 6)), np.zeros((1, 6)), np.zeros(1), none, none, np.zeros(1, dtype=bool),
    )  # fmt: skip
    return simulate_windows(windows, config, in_double=True)[0, 0]


def stepping(rate_hz: float, duration_s: float, seed: int) -> np.ndarray:
    """Commands (n, 2) that step at arbitrary rows."""
    rng = np.random.default_rng(seed)
    columns = []
    for mean, std, hold_s in ((0.0, 0.35, 0.5), (0.25, 0.1, 0.8)):
        holds = (hold_s * rate_hz * rng.uniform(0.5, 1.5, int(3 * duration_s / hold_s))).astype(int)
        column = np.repeat(rng.normal(mean, std, len(holds)), holds)[: int(duration_s * rate_hz)]
        columns.append(np.clip(column, -0.7, 0.7))
    return np.column_stack(columns)


def recorded(rate_hz: float, commands: np.ndarray, pose_std: np.ndarray, config: SimulatorConfig = CAR) -> EpisodeData:
    """A drive with noisy poses and the velocities that an import estimates from them."""
    states = simulated(config, 1.0 / rate_hz, commands)
    t_s = np.arange(len(states)) / rate_hz
    states[:, :3] += pose_std * np.random.default_rng(9).normal(size=(len(states), 3))
    motion = pose_motion(t_s, *states[:, :3].T, np.zeros(len(t_s)))
    states[:, 3:] = np.stack([motion.vx, motion.vy, motion.yaw_rate], axis=1)
    return EpisodeData(t_s, states, commands, commands, np.full(len(commands), np.nan), np.zeros((0, 4)), {}, {})


@pytest.mark.parametrize("effect", [{}, {"tyre_relaxation": {"length": 0.15}}])
def test_commands_that_step_within_a_cell_are_simulated_at_their_time(effect: dict[str, dict[str, float]]) -> None:
    config = replace(CAR, effects=effect)
    rate_hz, commands = 250.0, stepping(250.0, 20.0, 1)
    episode = recorded(rate_hz, commands, np.zeros(3), config)
    true = simulated(config, 1.0 / rate_hz, commands)
    windows = cut_windows(segments_of([episode]), 1.0, 0.25)
    rows = np.round(windows.t0_s * rate_hz).astype(int)
    every = round(windows.period_s * rate_hz)
    assert every == 8
    exact = replace(windows, initial_states=true[rows])
    averaged = replace(exact, command_deviations=None)
    after = true[rows + every * windows.steps]
    with_parts, with_averages = (
        np.sqrt(np.mean((simulate_windows(w, config)[0, :, -1] - after) ** 2, axis=0)) for w in (exact, averaged)
    )
    assert np.all(with_parts[:3] < 0.5 * with_averages[:3])
    assert np.hypot(*with_parts[:2]) < 1.5e-3


@pytest.mark.parametrize("rate_hz", [60.0, 250.0])
def test_perfect_simulator_has_the_noise_floor_at_each_rate(rate_hz: float) -> None:
    episode = recorded(rate_hz, stepping(rate_hz, 40.0, 2), POSE_STD)
    segments = segments_of([episode])
    cut = cut_windows(segments, 0.8, 0.3), cut_windows(segments, 1.0, 0.25)
    windows, held_out_windows = with_initial_states(cut, CAR)
    held_out = HeldOut.of(held_out_windows, estimate_noise(segments, windows.curvature_bias), CAR)
    in_floors = np.sqrt(np.mean((held_out.final_error(CAR) / held_out.floor) ** 2, axis=0))
    assert np.all(in_floors[:3] < 1.6)
    assert held_out.score(held_out.final_error(CAR)) < 1.4


def test_noise_of_velocities_is_estimated_at_250_hz() -> None:
    rate_hz = 250.0
    time_s = np.arange(int(60 * rate_hz)) / rate_hz
    commands = np.stack([0.4 * np.sin(2.0 * time_s), 0.25 + 0.1 * np.sin(time_s)], axis=1)
    noisy, exact = (recorded(rate_hz, commands, std) for std in (POSE_STD, np.zeros(3)))
    found = estimate_noise(segments_of([noisy]), np.zeros((10, 6))).measured
    true = np.std(noisy.states - exact.states, axis=0)
    np.testing.assert_allclose(found[:3] / true[:3], 1.0, atol=0.05)
    np.testing.assert_allclose(found[3:] / true[3:], 1.0, atol=0.12)


def test_commands_that_are_constant_in_each_cell_have_no_parts() -> None:
    commands = np.repeat(stepping(30.0, 12.0, 3), 4, axis=0)
    (segment,) = segments_of([recorded(120.0, commands, POSE_STD)])
    assert segment.command_deviations is None
    assert cut_windows([segment], 1.0, 0.25).command_deviations is None
    (segment,) = segments_of([recorded(30.0, stepping(30.0, 12.0, 3), POSE_STD)])
    assert segment.command_deviations is None


def test_parts_of_a_cell_have_the_mean_of_the_cell() -> None:
    commands = stepping(250.0, 12.0, 4)
    (segment,) = segments_of([recorded(250.0, commands, POSE_STD)])
    assert segment.command_deviations is not None
    np.testing.assert_allclose(segment.command_deviations.mean(axis=1), 0.0, atol=1e-12)
    parts = segment.commands[:, None] + segment.command_deviations
    rows_of_parts = commands[: len(parts) * 8].reshape(-1, 4, 2, 2).mean(axis=2)
    np.testing.assert_allclose(parts[: len(rows_of_parts)], rows_of_parts, atol=1e-9)


def test_drives_of_different_rates_are_cut_together() -> None:
    drives = [recorded(rate, stepping(rate, 12.0, 5), POSE_STD) for rate in (250.0, 31.25)]
    windows = cut_windows(segments_of(drives), 1.0, 0.25)
    assert set(windows.recording) == {0, 1}
    assert windows.command_deviations is not None
    assert np.abs(windows.command_deviations[windows.recording == 1]).max() < 1e-9


def test_torch_operators_and_compiled_code_simulate_the_parts_of_cells_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(CAR, effects={"tyre_relaxation": {"length": 0.15}, "steering_lag": {"time_constant": 0.05}})
    episode = recorded(250.0, stepping(250.0, 8.0, 1), np.zeros(3), config)
    windows = cut_windows(segments_of([episode]), 1.0, 0.5)
    assert windows.command_deviations is not None
    by_code = simulate_windows(windows, config, in_double=True)
    monkeypatch.setattr("carlab.prediction.predict.array_rollout", operator_rollout)
    by_operators = simulate_windows(windows, config, in_double=True)
    assert np.allclose(by_code, by_operators, atol=1e-9)
