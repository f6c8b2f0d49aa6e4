"""Deep ensemble: networks that differ by their initial weights (Lakshminarayanan et al. 2017).

The networks are fitted to the residual of a ridge regression, as the particles of ``learning.posterior.distillation``
are to that of a linear trend. Each network is fitted without one fold of the rows; errors on these held-out rows
determine the noise and the weight of the networks' disagreement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from learning.baselines.ridge import Ridge
from learning.evaluation import Mixture
from learning.functional_svgd.fsvgd import FsvgdSettings, check_rows, fit_fsvgd
from learning.networks.normaliser import Normaliser
from learning.outliers import decorrelation_of, output_correlation
from learning.posterior.particle_posterior import ParticlePosterior
from learning.posterior.residuals import ResidualDistribution, fit_residuals

N_FOLDS = 5
MIN_ROWS = 5
"""With fewer rows or fewer than four networks there is no ridge regression, no rows are held out, and the noise is that
fitted with the networks."""
DISAGREEMENT_WEIGHTS = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Candidate factors on the networks' variance in the predictive variance, in addition to the variance of their mean."""
N_NOISE_ITERATIONS = 40
MIN_NOISE_SHARE = 1e-3
"""Lower bound of the noise variance, relative to the mean square of the errors."""


@dataclass(frozen=True, slots=True)
class Ensemble:
    """Networks and the distribution of their mean's errors.

    Attributes:
        networks: fitted independently, in decorrelated outputs, with the ridge regression as their trend.
        noise_std: of the decorrelated outputs (O,); None without held-out rows.
        disagreement_weight: factor on the networks' variance, which is added to the noise variance.
        residuals: distribution of errors in units of the total standard deviation; None without held-out rows.
    """

    networks: ParticlePosterior
    noise_std: Tensor | None = None
    disagreement_weight: float = 1.0
    residuals: ResidualDistribution | None = None

    def predict(self, inputs: Tensor) -> Mixture:
        """Prediction at raw inputs (N, D), in raw units."""
        components = self.networks.predict(inputs)
        if self.noise_std is None or self.residuals is None:
            return components.smoothed()
        disagreement = components.decorrelated(components.means).var(dim=0)
        scale = self.residuals.scale
        std = (self.noise_std**2 + self.disagreement_weight * disagreement).sqrt() * scale
        correlation = self.residuals.factor @ self.residuals.factor.T / (scale[:, None] * scale)
        return Mixture(components.mean[None], std[None], self.residuals.dof, components.decorrelation, correlation)

    def errors(self, inputs: Tensor, outputs: Tensor) -> Tensor:
        """Decorrelated errors (L, n, O) of the networks at raw rows of (n, D) and (n, O), double precision."""
        components = self.networks.predict(inputs)
        return components.decorrelated(outputs - components.means).double()


def deep_ensemble(inputs: Tensor, outputs: Tensor, normaliser: Normaliser, settings: FsvgdSettings) -> Ensemble:
    """Fit every network independently to the likelihood, with weight decay as the only prior.

    The networks are fitted to the leave-one-out errors of the ridge regression, so that held-out rows are new to both.

    Args:
        inputs: (n, D), n > 0.
        outputs: (n, O).
        normaliser: of both.
        settings: of the fit; kernel and preconditioning are not used.

    Raises:
        DataError: no data, different numbers of rows of inputs and outputs, or missing or infinite numbers.
        DivergedError: the networks diverged.
    """
    check_rows(inputs, outputs)
    settings, count = replace(settings, interacting=False), len(inputs)
    folds = min(N_FOLDS, settings.particles // 2)
    if count < MIN_ROWS or folds < 2:
        return Ensemble(fit_fsvgd(inputs, outputs, inputs, None, normaliser, settings))
    order = torch.randperm(count, generator=torch.Generator().manual_seed(settings.seed))
    held_out = (torch.arange(settings.particles)[:, None] % folds == order % folds).to(inputs.device)
    trend, residual = _ridge_trend(normaliser, inputs, outputs)
    decorrelation = decorrelation_of(*output_correlation(residual)).to(outputs)
    residual_outputs = normaliser.raw_outputs(residual.to(outputs))
    decorrelated = normaliser.decorrelated(decorrelation)
    networks = fit_fsvgd(inputs, residual_outputs, inputs, None, decorrelated, settings, row_mask=~held_out)
    errors = Ensemble(networks).errors(inputs, residual_outputs)
    mask = held_out.to(errors)[..., None]
    members = mask.sum(dim=0)
    mean = (mask * errors).sum(dim=0) / members
    disagreement = (mask * (errors - mean) ** 2).sum(dim=0) / (members - 1.0).clamp_min(1.0)
    # The mean of m networks has the variance of one divided by m; fewer networks hold out a row than predict.
    candidates = [(*_noise(mean, (weight + 1.0 / members) * disagreement), weight) for weight in DISAGREEMENT_WEIGHTS]
    _, noise_std, weight = max(candidates, key=lambda candidate: candidate[0])
    residuals = fit_residuals(mean / (noise_std**2 + (weight + 1.0 / members) * disagreement).sqrt())
    weight += 1.0 / settings.particles
    networks = replace(networks, trend=trend.to(outputs) @ decorrelation.T)
    return Ensemble(networks, noise_std.to(outputs), weight, residuals.to(outputs))


def _ridge_trend(normaliser: Normaliser, inputs: Tensor, outputs: Tensor) -> tuple[Tensor, Tensor]:
    """Ridge regression of normalised outputs on normalised inputs, in double precision on the CPU.

    Returns:
        Constant and slopes (1 + D, O), and the leave-one-out errors of the rows (n, O).
    """
    ridge = Ridge.fit(*(v.cpu().double().numpy() for v in (normaliser.inputs(inputs), normaliser.outputs(outputs))))
    slopes = ridge.weights[:-1] / ridge.scale[:, None]
    constant = ridge.weights[-1] - ridge.mean @ slopes
    return torch.from_numpy(np.vstack([constant, slopes])), torch.from_numpy(ridge.errors)


def _noise(errors: Tensor, known_variance: Tensor) -> tuple[float, Tensor]:
    """Maximum-likelihood noise in addition to known variances, by Fisher scoring.

    Errors are clipped at three standard deviations, because heavy tails would inflate the noise.

    Args:
        errors: (n, O).
        known_variance: (n, O).

    Returns:
        The log-likelihood, and the noise's standard deviation (O,).
    """
    variance = errors.square().mean(dim=0).clamp_min(1e-18)
    min_variance = MIN_NOISE_SHARE * variance
    for _ in range(N_NOISE_ITERATIONS):
        square = torch.minimum(errors**2, 9.0 * (variance + known_variance))
        weight = (variance + known_variance) ** -2
        variance = torch.maximum((weight * (square - known_variance)).sum(dim=0) / weight.sum(dim=0), min_variance)
    total = variance + known_variance
    log_likelihood = -0.5 * (total.log() + (errors**2 / total).clamp_max(9.0) + math.log(2.0 * math.pi)).sum()
    return float(log_likelihood), variance.sqrt()
