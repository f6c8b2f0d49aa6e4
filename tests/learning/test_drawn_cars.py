"""Cars drawn from a prior over plausible effects: their rollouts, their spread, and selection by recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from carlab.core.episode_data import EpisodeData
from carlab.core.observation import decode_history, decode_state, encode
from learning.world.drawn_cars import HISTORY, WINDOW_TICKS, DrawnCars, draw_cars, select_cars
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import SimulatorConfig

CAR = SimulatorConfig.from_preset()
LAG, DELAY = "effects.motor_lag.time_constant", "effects.command_delay.extra_delay"


def random_commands(count: int, ticks: int, seed: int = 0) -> torch.Tensor:
    held = torch.rand((count, -(-ticks // 10), 2), generator=torch.Generator().manual_seed(seed)) - 0.3
    return held.repeat_interleave(10, dim=1)[:, :ticks]


def recorded(true: SimulatorConfig, ticks: int = 100, seed: int = 0) -> EpisodeData:
    """An episode of a car without measurement noise and latency."""
    commands = random_commands(1, ticks, seed)
    states = rollout(true, torch.zeros((1, 6)), commands).states[0].numpy().astype(np.float64)
    sent = commands[0].numpy().astype(np.float64)
    times_s = np.arange(ticks + 1) * true.control_period_s
    return EpisodeData(times_s, states, sent, sent, np.full(ticks, np.nan))


def test_rollout_tick_by_tick_equals_the_simulator() -> None:
    values = {"tyre.front.mu": torch.tensor([0.3, 0.5]), "timing.command_delay": torch.tensor([0.05, 0.15])}
    cars = DrawnCars(CAR, values)
    commands = random_commands(2, 30)
    expected = rollout(CAR, torch.zeros((2, 6)), commands, values=values).states
    rollouts = cars.rollouts(2, torch.Generator())
    features = torch.from_numpy(encode(np.zeros((2, 6)), np.zeros((2, HISTORY, 2)))).float()
    for k in range(30):
        features = rollouts.step(features, commands[:, k], torch.Generator())
    state = decode_state(features)
    turn = torch.remainder(state[:, 2] - expected[:, -1, 2] + torch.pi, 2 * torch.pi) - torch.pi
    torch.testing.assert_close(turn, torch.zeros(2), atol=1e-3, rtol=0.0)
    torch.testing.assert_close(state[:, [0, 1, 3, 4, 5]], expected[:, -1, [0, 1, 3, 4, 5]], atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(decode_history(features), commands[:, -HISTORY:])


@pytest.mark.parametrize("history", [0, HISTORY, HISTORY + 4])
def test_rollouts_have_the_past_commands_of_the_caller(history: int) -> None:
    """The features of a step end with all past commands, and the step is that of the simulator after them."""
    wanted = max(history, HISTORY)
    cars = draw_cars(CAR, 4, torch.Generator().manual_seed(0), history)
    commands = random_commands(4, wanted + 1)
    features = torch.from_numpy(encode(np.zeros((4, 6)), commands[:, :wanted].numpy())).float()
    after = cars.rollouts(4, torch.Generator()).step(features, commands[:, -1], torch.Generator())
    assert after.shape == (4, 7 + 2 * wanted)
    torch.testing.assert_close(decode_history(after), commands[:, 1:])
    expected = rollout(CAR, torch.zeros((4, 6)), commands[:, -1:], history=commands[:, :-1], values=cars.values)
    torch.testing.assert_close(decode_state(after)[:, :2], expected.states[:, 1, :2])


def test_commands_act_later_by_the_latency_of_an_effect() -> None:
    """The policy sees states that are 50 ms old."""
    quick = replace(CAR, priors={}, command_delay_s=0.02, effects={"mocap_latency": {"latency": 0.05}})
    for prior, delay_s in ((quick, 0.07), (replace(quick, effects={}), 0.02 + CAR.mocap.latency_s)):
        known = replace(prior, parameter_std={"timing.command_delay": 1e-9})
        cars = draw_cars(known, 20, torch.Generator().manual_seed(0))
        assert float(cars.values["timing.command_delay"].median()) == pytest.approx(delay_s, abs=2e-3)


def test_most_unknown_effects_are_absent_and_the_others_are_plausible() -> None:
    cars = draw_cars(CAR, 4000, torch.Generator().manual_seed(0))
    lag = cars.values[LAG]
    assert 0.5 < float((lag == 0.0).float().mean()) < 1.0
    assert 0.05 < float(lag[lag > 0.0].mean()) < 0.25
    total_s = cars.values["timing.command_delay"] + cars.values[DELAY]
    assert float(total_s.min()) >= 0.0
    gain = cars.values["motor.drive_gain"]
    assert float(gain.quantile(0.02)) < 6.5 < 10.0 < float(gain.quantile(0.98)), "wider than the range of the car file"
    known = replace(CAR, effects={"motor_lag": {"time_constant": 0.1}}, parameter_std={LAG: 0.002})
    own = draw_cars(known, 1000, torch.Generator().manual_seed(0)).values[LAG]
    assert 0.09 < float(own.quantile(0.25)) < float(own.quantile(0.75)) < 0.11, "an estimate has its own width"


def test_recordings_select_cars_like_the_true_one() -> None:
    """In the mean of four sets of drawn cars."""
    true = replace(CAR, priors={}).with_values({"motor.drive_gain": 5.0})
    gains, prior_gains = [], []
    for seed in range(4):
        cars = draw_cars(CAR, 512, torch.Generator().manual_seed(seed))
        selected = select_cars(cars, [recorded(true, seed=3)], 32)
        assert len(selected) == 32
        gains.append(float(selected.values["motor.drive_gain"].mean()))
        prior_gains.append(float(cars.values["motor.drive_gain"].mean()))
    assert abs(np.mean(gains) - 5.0) < 0.6 * abs(np.mean(prior_gains) - 5.0)
    assert len(select_cars(cars, [], 16)) == 16, "without recordings all cars are equally plausible"


@pytest.mark.parametrize("at", ["window", "history", "segment"])
def test_windows_do_not_span_a_gap(at: str) -> None:
    """A recording of one window is useless with a gap in it: the car drives on where nothing is recorded."""
    true = replace(CAR, priors={}).with_values({"motor.drive_gain": 5.0})
    cars = draw_cars(CAR, 64, torch.Generator().manual_seed(1))
    whole = recorded(true, ticks=HISTORY + WINDOW_TICKS)
    chosen = select_cars(cars, [whole], 8).values["motor.drive_gain"]
    assert not torch.equal(chosen, cars.values["motor.drive_gain"][:8]), "the whole recording selects"
    cut = HISTORY // 2 if at == "history" else HISTORY + WINDOW_TICKS // 2
    times_s = whole.times_s + np.where(np.arange(len(whole.times_s)) >= cut, 0.5, 0.0)
    segment = (np.arange(len(times_s)) >= cut).astype(np.float64)
    broken = replace(whole, extra={"segment": segment}) if at == "segment" else replace(whole, times_s=times_s)
    selected = select_cars(cars, [broken], 8)
    assert torch.equal(selected.values["motor.drive_gain"], cars.values["motor.drive_gain"][:8])
