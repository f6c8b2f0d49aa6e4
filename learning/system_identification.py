"""Maximum likelihood over a simulator's parameters: SysID, and GreyBox, which adds a network for what is left."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.domain_models import DomainModel, draw_parameters
from learning.evaluation import Mixture
from learning.fsvgd import FsvgdSettings, GaussianProcessPrior, fit
from learning.function_prior import RbfCovariance
from learning.normaliser import Normaliser
from learning.outliers import log_student
from learning.residuals import Residuals, residuals

SCREENED = 1024
"""Draws of the parameters among which starts are looked for."""
STARTS = 16
STEPS = 600
LEARNING_RATE = 0.05
ROUNDS, ROUND_STEPS, ROUND_RATE = 3, 150, 0.01
"""Of finding the errors' distribution and the parameters under it in turn."""
PRIOR_WIDTHS = 4.0
"""Standard deviations of the parameters' own distribution within which they are held, softly: the data decides."""
PSEUDO_ROWS = 1.0
"""Rows that the expected noise counts for beside the data's own."""


class Predictor(Protocol):
    """What predicts with its doubt."""

    def predict(self, inputs: Tensor) -> Mixture:
        """Prediction at inputs (N, D)."""
        ...


@dataclass(frozen=True, slots=True)
class Identified:
    """A simulator with fitted parameters.

    Attributes:
        model: the simulator.
        parameters: (K,).
        left: distribution of what it leaves.
    """

    model: DomainModel
    parameters: Tensor
    left: Residuals

    def mean(self, inputs: Tensor) -> Tensor:
        """Outputs (N, O) at inputs (N, D)."""
        return self.model(inputs, self.parameters[None])[0]

    def predict(self, inputs: Tensor) -> Mixture:
        """One component at each of the inputs (N, D)."""
        return self.left.about(self.mean(inputs)[None])


@dataclass(frozen=True, slots=True)
class GreyBox:
    """An identified simulator and particles for its error."""

    simulator: Identified
    error: Predictor

    def predict(self, inputs: Tensor) -> Mixture:
        """Prediction at inputs (N, D)."""
        error = self.error.predict(inputs)
        return replace(error, means=error.means + self.simulator.mean(inputs))


def identify(model: DomainModel, inputs: Tensor, outputs: Tensor, noise_std: Tensor, seed: int = 0) -> Identified:
    """Fit the parameters from many starts at once; the best one stands.

    First with independent Gaussian errors, whose size is what is left and the expected noise as ``PSEUDO_ROWS`` further
    rows put into the likelihood (concentrated). Then with errors that vary together and have tails, as what is left
    shows (``residuals``): these and the parameters are found in turn.

    Args:
        model: simulator with a distribution of its parameters.
        inputs: (n, D).
        outputs: (n, O).
        noise_std: expected noise (O,).
        seed: of the starts.

    Raises:
        DataError: there is no data, or no start gives finite numbers.
    """
    count = len(inputs)
    if count == 0:
        raise DataError("Parameters cannot be identified without data; record an episode first.")
    generator = torch.Generator().manual_seed(seed)
    drawn = draw_parameters(model, SCREENED, generator).to(inputs)
    middle, width = drawn.mean(dim=0), drawn.std(dim=0)
    free = width > 1e-9

    def off(offsets: Tensor) -> Tensor:
        """Errors (S, n, O) at offsets (S, K) in standard deviations."""
        return outputs - model(inputs, middle + width * offsets)

    def unlikely(offsets: Tensor) -> Tensor:
        """What the parameters' own distribution says (S,)."""
        return 0.5 * (offsets**2).sum(dim=1) / PRIOR_WIDTHS**2

    def apart(offsets: Tensor) -> Tensor:
        """Concentrated negative log-likelihood (S,) of independent errors."""
        variance = ((off(offsets) ** 2).sum(dim=1) + PSEUDO_ROWS * noise_std**2) / (count + PSEUDO_ROWS)
        return 0.5 * (count + PSEUDO_ROWS) * variance.log().sum(dim=1) + unlikely(offsets)

    starts = torch.where(free, (drawn - middle) / width.clamp_min(1e-9), 0.0)
    with torch.no_grad():
        first = torch.nan_to_num(apart(starts), nan=torch.inf)
    starts = starts[first.argsort()[:STARTS]]
    best = _best(apart, starts, _descended(apart, starts, free, STEPS, LEARNING_RATE))
    # Each output pays for its share of the fitted parameters.
    spent = float(free.sum()) / outputs.shape[1]

    def left_at(offset: Tensor) -> Residuals:
        with torch.no_grad():
            return residuals(off(offset[None])[0], noise_std, PSEUDO_ROWS, spent)

    left = left_at(best)
    for _ in range(ROUNDS):

        def together(offsets: Tensor, left: Residuals = left) -> Tensor:
            """Negative log-likelihood (S,) of errors that vary together, but for a constant."""
            square = left.surprise(off(offsets))
            return unlikely(offsets) - log_student(square, outputs.shape[1], left.freedom).sum(dim=1)

        best = _best(together, best[None], _descended(together, best[None], free, ROUND_STEPS, ROUND_RATE))
        left = left_at(best)
    return Identified(model, (middle + width * best).detach(), left.to(outputs))


def _descended(
    losses: Callable[[Tensor], Tensor], starts: Tensor, free: Tensor, steps: int, learning_rate: float
) -> Tensor:
    """Offsets (S, K) at the ends of Adam's ways down from some; those that are not free (K,) stay."""
    offsets = starts.clone().requires_grad_()
    optimiser = torch.optim.Adam([offsets], lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, eta_min=1e-2 * learning_rate)
    for _ in range(steps):
        (gradient,) = torch.autograd.grad(losses(offsets).nan_to_num(nan=0.0, posinf=0.0).sum(), offsets)
        offsets.grad = torch.where(free & torch.isfinite(gradient), gradient, 0.0)
        optimiser.step()
        schedule.step()
    return offsets.detach()


def _best(losses: Callable[[Tensor], Tensor], starts: Tensor, ends: Tensor) -> Tensor:
    """The one (K,) of the least loss; where a way down ends in what cannot be computed, its start may be."""
    offsets = torch.cat([starts, ends])
    with torch.no_grad():
        last = torch.nan_to_num(losses(offsets), nan=torch.inf)
    if not torch.isfinite(last).any():
        raise DataError("The simulator gives no finite outputs for this data; check the car file and the rows.")
    return offsets[last.argmin()]


def grey_box(
    simulator: Identified,
    inputs: Tensor,
    outputs: Tensor,
    pool: Tensor,
    covariance: RbfCovariance,
    normaliser: Normaliser,
    settings: FsvgdSettings,
) -> GreyBox:
    """Fit particles to what an identified simulator leaves, under a Gaussian-process prior.

    Args:
        simulator: identified on the same data.
        inputs: (n, D).
        outputs: (n, O).
        pool: inputs of the domain (M, D).
        covariance: of the error, on normalised inputs and in normalised outputs.
        normaliser: of inputs and of the error; its output mean is taken to be zero.
        settings: of the fit.
    """
    centred = replace(normaliser, output_mean=torch.zeros_like(normaliser.output_mean))
    everything = centred.inputs(torch.cat([inputs, pool]))
    prior = GaussianProcessPrior(everything, covariance)
    with torch.no_grad():
        error = outputs - simulator.mean(inputs)
    return GreyBox(simulator, fit(inputs, error, pool, prior, centred, settings))


__all__ = ["GreyBox", "Identified", "grey_box", "identify"]
