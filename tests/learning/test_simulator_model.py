"""Test the one-step simulator model against rows of simulated drives."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError
from learning.baselines.system_identification import identify
from learning.priors.domain_models import draw_parameters
from learning.priors.simulator_model import CarModel, known_ranges
from learning.transitions import transitions_of
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import MocapParameters, SimulatorConfig
from tests.helpers.measured_rollout import measured_rollout

QUIET = MocapParameters(latency_s=0.0)
HISTORY = 4


def drive(config: SimulatorConfig, ticks: int = 60, seed: int = 0, *, measured: bool = False) -> EpisodeData:
    """Simulate a drive with random commands and without noise."""
    rng = np.random.default_rng(seed)
    sent = np.repeat(rng.uniform(-1, 1, size=(ticks // 6, 2)), 6, axis=0)
    sent[:, 1] = np.abs(sent[:, 1])
    start = torch.tensor([[0.3, -0.2, 0.7, 1.5, 0.0, 0.0]], dtype=torch.float64)
    given = (config, start, torch.from_numpy(sent[None]))
    states = (measured_rollout(*given).measured if measured else rollout(*given).states)[0].numpy()
    return EpisodeData(np.arange(len(sent) + 1) * config.control_period_s, states, sent, sent, np.zeros(len(sent)))


@pytest.mark.parametrize("kind", ["dynamic", "kinematic"])
def test_model_reproduces_each_row_of_a_simulated_drive(kind):
    config = SimulatorConfig(kind=kind, mocap=QUIET)
    rows = transitions_of([drive(config)], HISTORY)
    model = CarModel(config, HISTORY, {"vehicle.mass": (2.0, 2.0)})
    given = torch.tensor([[config.values()["vehicle.mass"]]], dtype=torch.float64)
    found = model(torch.from_numpy(rows.inputs), given)[0].numpy()
    assert np.allclose(found, rows.targets, atol=1e-9)


def test_measurement_latency_delays_the_commands_in_the_model():
    """The model with the 20 ms latency predicts measured velocities better than the model without it."""
    config = SimulatorConfig(mocap=MocapParameters(latency_s=0.02))
    rows = transitions_of([drive(config, measured=True)], HISTORY)
    right = CarModel(config, HISTORY, {"vehicle.mass": (2.0, 2.0)})
    wrong = CarModel(replace(config, mocap=QUIET), HISTORY, {"vehicle.mass": (2.0, 2.0)})
    given = torch.tensor([[config.values()["vehicle.mass"]]], dtype=torch.float64)
    right_error, wrong_error = (
        np.sqrt(np.mean((m(torch.from_numpy(rows.inputs), given)[0].numpy() - rows.targets)[:, 3:] ** 2))
        for m in (right, wrong)
    )
    assert right_error < 0.3 * wrong_error


def test_draws_fill_their_ranges_and_inputs_have_held_commands():
    ranges = {"motor.drive_gain": (6.0, 10.0), "tyre.front.mu": (0.5, 1.0)}
    model = CarModel(SimulatorConfig(mocap=QUIET), HISTORY, ranges)
    generator = torch.Generator().manual_seed(0)
    drawn = draw_parameters(model, 500, generator)
    for k, (low, high) in enumerate(ranges.values()):
        assert low <= float(drawn[:, k].min()) < low + 0.1 * (high - low)
        assert high >= float(drawn[:, k].max()) > high - 0.1 * (high - low)
    inputs = model.inputs(403, generator)
    assert inputs.shape == (403, 3 + 2 * (HISTORY + 1))
    assert torch.isfinite(inputs).all()
    assert inputs[:, 3:].abs().max() <= 1.0
    held = (inputs[:, 3:5] == inputs[:, 5:7]).all(dim=1).float().mean()
    assert float(held) == pytest.approx(1 - 1 / 8, abs=0.06)


@pytest.mark.usefixtures("short_identification")
def test_identification_recovers_the_true_parameters():
    truth = SimulatorConfig(mocap=QUIET).with_values({"motor.drive_gain": 9.1, "tyre.rear.mu": 0.62})
    rows = transitions_of([drive(truth, 120)], HISTORY)
    ranges = {"motor.drive_gain": (6.0, 11.0), "tyre.rear.mu": (0.3, 1.2)}
    model = CarModel(SimulatorConfig(mocap=QUIET), HISTORY, ranges)
    found = identify(model, torch.from_numpy(rows.inputs), torch.from_numpy(rows.targets), torch.full((6,), 1e-3))
    assert found.parameters.tolist() == pytest.approx([9.1, 0.62], rel=1e-2)


def test_range_of_an_unknown_parameter_is_refused():
    with pytest.raises(ConfigError, match=r"'motor\.gain' is not a parameter"):
        CarModel(SimulatorConfig(), 3, {"motor.gain": (1.0, 2.0)})


def test_draws_of_an_extra_delay_never_give_a_negative_total_delay():
    name = "effects.command_delay.extra_delay"
    known = SimulatorConfig(effects={"command_delay": {"extra_delay": -0.03}}, parameter_std={name: 0.02})
    model = CarModel(known, 2, known_ranges(known))
    drawn = model.parameters(torch.randn((5000, 1), generator=torch.Generator().manual_seed(0)))
    assert -known.command_delay_s <= float(drawn.min()) < -0.06
    assert bool(torch.isfinite(model(torch.zeros((3, 9)), drawn[:50])).all())
