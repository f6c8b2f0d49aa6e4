"""Test the posterior over functions with defective simulators and data."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from linear_simulator import EMPTY, NOISE, UNITS, Linear, mean_and_scale, rows
from torch import Tensor

from carlab.core.errors import DataError
from learning.posterior.inference import infer


@dataclass(frozen=True)
class FailingSimulator(Linear):
    """The linear simulator that returns NaN for parameters below a bound."""

    below: float = -2.0

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        broken = torch.where(parameters[:, 0] < self.below, torch.nan, 0.0)
        return super().__call__(inputs, parameters) + broken[:, None, None]


@pytest.mark.parametrize("count", [0, 12, 60])
def test_parameter_draws_with_nan_outputs_are_excluded(count):
    x, y = (v[:count] for v in rows(60))
    query, _ = rows(5, seed=1)
    posterior, expected = (
        infer(model, x, y, UNITS, NOISE, restart_scales=(1.0,)) for model in (FailingSimulator(), Linear())
    )
    assert posterior.parameters[:, 0].min() >= -2.0
    mean, std = mean_and_scale(posterior.predict(query))
    expected_mean, expected_std = mean_and_scale(expected.predict(query))
    assert np.allclose(mean, expected_mean, atol=0.4 * float(expected_std.max()))
    assert np.allclose(std, expected_std, rtol=0.35)
    with pytest.raises(DataError, match="narrow the ranges"):
        infer(FailingSimulator(below=50.0), x, y, UNITS, NOISE)


def test_simulator_without_parameters_is_accepted():
    @dataclass(frozen=True)
    class Fixed(Linear):
        size: int = 0

        def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
            return super().__call__(inputs, torch.tensor([[0.8, -1.1, 0.4]]).expand(len(parameters), 3).to(inputs))

    x, y = rows(30)
    posterior = infer(Fixed(), x, y, UNITS, NOISE)
    query, expected = rows(50, seed=1, noise=torch.zeros(2))
    assert float(((posterior.predict(query).mean - expected) / UNITS.output_std).abs().max()) < 0.5


def test_constant_output_keeps_one_percent_of_the_expected_noise():
    x, y = rows(60)
    y[:, 1] = UNITS.output_mean[1]
    posterior = infer(None, x, y, UNITS, NOISE)
    noise = posterior.noise_std * UNITS.output_std / NOISE
    assert float(noise[1]) >= 0.01
    assert 0.5 < float(noise[0]) < 2.0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"outputs": torch.zeros(5, 2)}, "10 rows of inputs and 5 of outputs"),
        ({"noise_std": torch.tensor([0.1, 0.0])}, "is not positive"),
        ({"normaliser": replace(UNITS, input_std=torch.tensor([1.0, 0.0]))}, "is not positive"),
        ({"inputs": torch.full((10, 2), torch.nan)}, "missing or infinite"),
    ],
)
def test_invalid_input_is_refused(changed, message):
    x, y = rows(10)
    with pytest.raises(DataError, match=message):
        infer(**{"model": None, "inputs": x, "outputs": y, "normaliser": UNITS, "noise_std": NOISE} | changed)


def test_prediction_is_empty_at_zero_inputs():
    posterior = infer(None, *rows(12), UNITS, NOISE)
    mean, std = mean_and_scale(posterior.predict(EMPTY))
    assert mean.shape == std.shape == (0, 2)
