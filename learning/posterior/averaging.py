"""Bayesian model averaging by held-out predictive densities.

A model that the data contradict predicts held-out rows badly and loses its weight; the average then follows the other
models. Weights are those of pseudo-Bayesian model averaging with the Bayesian bootstrap (Yao, Vehtari, Simpson and
Gelman 2018, "Using stacking to average Bayesian predictive distributions", section 3.4).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from learning.evaluation import Predictor, WeightedMixture

MAX_FOLDS = 10
"""Maximum number of folds; with so many rows or fewer, each row is left out once."""
N_BOOTSTRAP = 2000
MIN_WEIGHT = 0.01
"""Models with a smaller weight are left out of the average."""


Fit = Callable[[Tensor, Tensor], Predictor]
"""Fit of a model to raw inputs (n, D) and outputs (n, O)."""


@dataclass(frozen=True, slots=True)
class AveragedModel:
    """Models with weights (K,) that sum to 1."""

    models: Sequence[Predictor]
    weights: Tensor

    def predict(self, inputs: Tensor) -> WeightedMixture:
        """Prediction at raw inputs (N, D)."""
        return WeightedMixture([model.predict(inputs) for model in self.models], self.weights)


def average(fits: Sequence[Fit], inputs: Tensor, outputs: Tensor, seed: int = 0) -> AveragedModel:
    """Average models by their log densities of rows that they were not fitted to; then fit them to all rows.

    Args:
        fits: one for each model.
        inputs: raw (n, D).
        outputs: raw (n, O).
        seed: of folds and bootstrap.
    """
    weights = averaging_weights(held_out_log_densities(fits, inputs, outputs, seed), seed)
    chosen = [k for k, weight in enumerate(weights) if weight >= MIN_WEIGHT]
    models = [fits[k](inputs, outputs) for k in chosen]
    return AveragedModel(models, weights[chosen] / weights[chosen].sum())


def held_out_log_densities(fits: Sequence[Fit], inputs: Tensor, outputs: Tensor, seed: int = 0) -> Tensor:
    """Log density (K, n) of each row by each model fitted without the row's fold."""
    count = len(inputs)
    densities = torch.zeros((len(fits), count), dtype=torch.float64)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    for fold in torch.arange(count).tensor_split(min(MAX_FOLDS, count)):
        held_out, kept = order[fold], torch.ones(count, dtype=torch.bool)
        kept[held_out] = False
        at_kept, at_held_out = kept.to(inputs.device), held_out.to(inputs.device)
        for k, fit in enumerate(fits):
            prediction = fit(inputs[at_kept], outputs[at_kept]).predict(inputs[at_held_out])
            densities[k, held_out] = prediction.log_density(outputs[at_held_out]).double().cpu()
    return densities


def averaging_weights(log_densities: Tensor, seed: int = 0) -> Tensor:
    """Weights (K,) of models by their held-out log densities (K, n).

    ``softmax(n sum_i g_i log p_k(y_i))``, averaged over uniform Dirichlet draws of the rows' weights g. The bootstrap
    keeps the weights from following a difference that few rows cause.
    """
    count = log_densities.shape[1]
    if count == 0:
        return torch.full((len(log_densities),), 1.0 / len(log_densities), dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand((N_BOOTSTRAP, count), generator=generator, dtype=torch.float64)
    exponential = -torch.log1p(-uniform)  # Normalised exponential variables are Dirichlet distributed.
    row_weights = exponential / exponential.sum(dim=1, keepdim=True)
    finite = log_densities.double().nan_to_num(nan=-1e6, posinf=1e6, neginf=-1e6)
    return torch.softmax(count * row_weights @ finite.T, dim=1).mean(dim=0)
