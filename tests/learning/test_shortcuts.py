"""Test the likelihood loss of drawing simulator parameters and measurement points once per fit."""

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
    """Return the held-out NLL of a simulated race car with this many fixed draws and points."""
    case = CASES["car"].body_frame or CASES["car"]
    data, units = case.data(ROWS, seed), case.normaliser
    noise, discrepancy = torch.tensor(case.prior_noise_std), case.prior_discrepancy * units.output_std
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inference, "PARAMETER_DRAWS", draws)
        target = infer(case.prior, data.inputs, data.outputs, units, noise, discrepancy_std=discrepancy, seed=seed)
    generator = torch.Generator().manual_seed(30_000 + seed)
    fixed_points = measurement_points(case.prior, data.inputs, units, generator, count=points)
    found = distil(target, fixed_points, DistillationSettings(seed=seed))
    return negative_log_likelihood(found.predict(data.test_inputs).smoothed(), data.test_outputs)


@pytest.mark.slow
@pytest.mark.parametrize(("draws", "points"), [(1024, 8192), (128, 48_000)])
def test_fixed_draws_and_points_lose_little_likelihood(draws: int, points: int) -> None:
    """3000 steps of 64 points use each of 48 000 points four times, nearly as good as fresh ones."""
    few, many = (np.array([held_out_nll(s, *n) for s in SEEDS]) for n in ((128, 8192), (draws, points)))
    print(
        f"\nheld-out NLL [nats]: {few.round(2)} with 128 draws and 8192 points, {many.round(2)} with {draws}, {points}"
    )
    assert abs(few.mean() - many.mean()) < 0.1
