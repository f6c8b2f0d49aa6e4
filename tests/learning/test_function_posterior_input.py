"""What the posterior over functions makes of simulators and data that are not as they should be."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from linear_simulator import EMPTY, NOISE, UNITS, Linear, rows
from torch import Tensor

from carlab.core.errors import DataError
from learning.posterior.inference import infer


@dataclass(frozen=True)
class BreaksDown(Linear):
    """The same, with no number for a share of its parameters."""

    below: float = -2.0

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        broken = torch.where(parameters[:, 0] < self.below, torch.nan, 0.0)
        return super().__call__(inputs, parameters) + broken[:, None, None]


@pytest.mark.parametrize("count", [0, 12, 60])
def test_draws_for_which_the_simulator_breaks_down_have_no_say(count):
    x, y = (v[:count] for v in rows(60))
    at, _ = rows(5, seed=1)
    found = infer(BreaksDown(), x, y, UNITS, NOISE)
    assert found.parameters[:, 0].min() >= -2.0
    mean, std = found.predict(at)
    theirs, wide = infer(Linear(), x, y, UNITS, NOISE).predict(at)
    assert np.allclose(mean, theirs, atol=0.4 * float(wide.max()))
    assert np.allclose(std, wide, rtol=0.35)
    with pytest.raises(DataError, match="narrow the ranges"):
        infer(BreaksDown(below=50.0), x, y, UNITS, NOISE)


def test_a_simulator_without_parameters_is_conditioned_as_it_is():
    @dataclass(frozen=True)
    class Fixed(Linear):
        size: int = 0

        def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
            return super().__call__(inputs, torch.tensor([[0.8, -1.1, 0.4]]).expand(len(parameters), 3).to(inputs))

    x, y = rows(30)
    found = infer(Fixed(), x, y, UNITS, NOISE)
    at, wanted = rows(50, seed=1, noise=torch.zeros(2))
    assert float(((found.predict(at)[0] - wanted) / UNITS.output_std).abs().max()) < 0.5


def test_an_output_that_never_changes_keeps_a_share_of_the_expected_noise():
    x, y = rows(60)
    y[:, 1] = UNITS.output_mean[1]
    found = infer(None, x, y, UNITS, NOISE)
    noise = found.noise_std * UNITS.output_std / NOISE
    assert float(noise[1]) >= 0.01
    assert 0.5 < float(noise[0]) < 2.0


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"outputs": torch.zeros(5, 2)}, "10 rows of inputs and 5 of outputs"),
        ({"noise_std": torch.tensor([0.1, 0.0])}, "is not positive"),
        ({"normaliser": replace(UNITS, input_std=torch.tensor([1.0, 0.0]))}, "is not positive"),
        ({"inputs": torch.full((10, 2), torch.nan)}, "missing or infinite"),
    ],
)
def test_what_cannot_be_conditioned_on_is_said(changed, said):
    x, y = rows(10)
    with pytest.raises(DataError, match=said):
        infer(**{"model": None, "inputs": x, "outputs": y, "normaliser": UNITS, "noise_std": NOISE} | changed)


def test_at_no_inputs_there_is_no_prediction():
    found = infer(None, *rows(12), UNITS, NOISE)
    mean, std = found.predict(EMPTY)
    assert mean.shape == std.shape == (0, 2)
