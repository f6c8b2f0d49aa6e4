"""A deep ensemble: networks that differ by their start (Lakshminarayanan et al. 2017), the plainest baseline.

Each also leaves out another fifth of the rows (more where there are fewer than ten networks), so that there are errors
of rows that were not seen. They tell the noise and how much the networks' disagreement counts; what networks that may
follow every row leave of these says nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from learning.evaluation import Mixture
from learning.fsvgd import FsvgdSettings, Posterior, check_rows, fit
from learning.normaliser import Normaliser
from learning.outliers import output_correlation, turn_of
from learning.residuals import Residuals, residuals
from learning.ridge import Ridge

FOLDS = 5
LEAST_ROWS = 5
"""Fewer rows, or those of fewer than four networks, are seen by all, and noise is that which the networks learned."""
SHARES = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Of the networks' variance, what may count as doubt: their mean is nearer to the truth than each of them is."""
ROUNDS = 40
LEAST_NOISE = 1e-3
"""Of the errors' mean square, what noise is at least."""


@dataclass(frozen=True, slots=True)
class Ensemble:
    """Networks and what is left of their mean.

    Attributes:
        networks: fitted one by one, in outputs that are turned so that errors are nearly independent.
        noise: standard deviation of these (O,), and
        share: of the networks' variance, beside which it stands.
        left: distribution of errors in units of both; it and the noise are none where no rows were left out.
    """

    networks: Posterior
    noise: Tensor | None = None
    share: float = 1.0
    left: Residuals | None = None

    def predict(self, inputs: Tensor) -> Mixture:
        """Prediction at raw inputs (N, D), in raw units."""
        found = self.networks.predict(inputs)
        if self.noise is None or self.left is None:
            return found.smoothed()
        doubt = (self.noise**2 + self.share * self._turned(found.means).var(dim=0)).sqrt() * self.left.scale
        correlation = self.left.factor @ self.left.factor.T / (self.left.scale[:, None] * self.left.scale)
        turn = self.networks.normaliser.error_turn
        return Mixture(found.mean[None], doubt[None], self.left.freedom, turn, correlation)

    def _turned(self, errors: Tensor) -> Tensor:
        turn = self.networks.normaliser.error_turn
        return errors if turn is None else errors @ turn.T


def deep_ensemble(inputs: Tensor, outputs: Tensor, normaliser: Normaliser, settings: FsvgdSettings) -> Ensemble:
    """Fit every particle by itself to the likelihood, with the optimiser's weight decay as the only prior.

    Args:
        inputs: (n, D), n > 0.
        outputs: (n, O).
        normaliser: of both.
        settings: of the fit; kernel and preconditioning are left out.

    Raises:
        DataError: there is no data, rows of inputs and outputs differ in number, or numbers are missing or infinite.
        DivergedError: the networks diverged.
    """
    check_rows(inputs, outputs)
    alone, count = replace(settings, together=False), len(inputs)
    folds = min(FOLDS, settings.particles // 2)
    if count < LEAST_ROWS or folds < 2:
        return Ensemble(fit(inputs, outputs, inputs, None, normaliser, alone))
    order = torch.randperm(count, generator=torch.Generator().manual_seed(settings.seed))
    left_out = (torch.arange(settings.particles)[:, None] % folds == order % folds).to(inputs.device)
    turned = _turned(normaliser, inputs, outputs)
    bare = Ensemble(fit(inputs, outputs, inputs, None, turned, alone, seen_by=~left_out))
    # (L, n, O), but of networks that had not seen the row.
    errors = bare._turned(outputs - bare.networks.predict(inputs).means).double()
    off = left_out.to(errors)[..., None]
    mean = (off * errors).sum(dim=0) / off.sum(dim=0)
    spread = (off * (errors - mean) ** 2).sum(dim=0) / (off.sum(dim=0) - 1.0).clamp_min(1.0)
    told = [(*_noise(mean, share * spread), share) for share in SHARES]
    _, noise, share = max(told, key=lambda each: each[0])
    left = residuals(mean / (noise**2 + share * spread).sqrt())
    return Ensemble(bare.networks, noise.to(outputs), share, left.to(outputs))


def _turned(normaliser: Normaliser, inputs: Tensor, outputs: Tensor) -> Normaliser:
    """With outputs turned until what a line leaves of them is independent."""
    line = Ridge.fit(*(v.cpu().double().numpy() for v in (inputs, normaliser.outputs(outputs))))
    correlation, width = output_correlation(torch.from_numpy(line.errors))
    return normaliser.turned(turn_of(correlation, width).to(outputs))


def _noise(errors: Tensor, known: Tensor) -> tuple[float, Tensor]:
    """Standard deviation (O,) beside known variances (n, O) that errors (n, O) are most likely of, after how likely.

    By Fisher's scoring, of normal errors of which the largest count as three standard deviations: heavy tails would
    have it that everything is noise.
    """
    variance = errors.square().mean(dim=0).clamp_min(1e-18)
    least = LEAST_NOISE * variance
    for _ in range(ROUNDS):
        square = torch.minimum(errors**2, 9.0 * (variance + known))
        weight = (variance + known) ** -2
        variance = torch.maximum((weight * (square - known)).sum(dim=0) / weight.sum(dim=0), least)
    doubt = variance + known
    likelihood = -0.5 * (doubt.log() + (errors**2 / doubt).clamp_max(9.0) + math.log(2.0 * math.pi)).sum()
    return float(likelihood), variance.sqrt()


__all__ = ["Ensemble", "deep_ensemble"]
