"""What it costs in likelihood that draws and measurement points of a fit are taken once, and not fresh at each step."""

import numpy as np
import pytest
import torch

from carlab.studies.regression.cases import CASES
from learning.evaluation import negative_log_likelihood
from learning.posterior import inference
from learning.posterior.distillation import DistillationSettings, distil, measurement_points
from learning.posterior.inference import infer

ROWS, SEEDS = 100, (0, 1, 2)


def held_out_nll(seed: int, draws: int, points: int) -> float:
    """Of other rows of the simulated race car, where so many draws and points are banked."""
    case = CASES["car"].ours or CASES["car"]
    data, units = case.data(ROWS, seed), case.normaliser
    noise, discrepancy = torch.tensor(case.prior_noise_std), case.prior_discrepancy * units.output_std
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inference, "PARAMETER_DRAWS", draws)
        target = infer(case.prior, data.inputs, data.outputs, units, noise, discrepancy_std=discrepancy, seed=seed)
    generator = torch.Generator().manual_seed(30_000 + seed)
    held_at = measurement_points(case.prior, data.inputs, units, generator, count=points)
    found = distil(target, held_at, DistillationSettings(seed=seed))
    return negative_log_likelihood(found.predict(data.test_inputs).smoothed(), data.test_outputs)


@pytest.mark.slow
@pytest.mark.parametrize(("draws", "points"), [(1024, 8192), (128, 48_000)])
def test_banks_cost_next_to_nothing(draws: int, points: int) -> None:
    """3000 steps of 64 points see each of 48 000 four times; those are as good as fresh ones."""
    banked, fresh = (np.array([held_out_nll(s, *n) for s in SEEDS]) for n in ((128, 8192), (draws, points)))
    print(
        f"\n{draws} draws, {points} points: {banked.round(2)} with banks of 128 and 8192, {fresh.round(2)} with these"
    )
    assert abs(banked.mean() - fresh.mean()) < 0.1
