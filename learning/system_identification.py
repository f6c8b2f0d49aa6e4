"""Maximum likelihood over a simulator's parameters: SysID, and GreyBox, which adds a network for what is left."""

from __future__ import annotations

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

SCREENED = 1024
"""Draws of the parameters among which starts are looked for."""
STARTS = 16
STEPS = 600
LEARNING_RATE = 0.05
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
        noise_std: standard deviation of what it leaves, by output (O,).
    """

    model: DomainModel
    parameters: Tensor
    noise_std: Tensor

    def mean(self, inputs: Tensor) -> Tensor:
        """Outputs (N, O) at inputs (N, D)."""
        return self.model(inputs, self.parameters[None])[0]

    def predict(self, inputs: Tensor) -> Mixture:
        """One Gaussian at each of the inputs (N, D)."""
        return Mixture(self.mean(inputs)[None], self.noise_std.expand(1, 1, -1))


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

    The noise of each output is what is left, with the expected noise as ``PSEUDO_ROWS`` further rows; the likelihood is
    the one with that noise put in (concentrated).

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

    def losses(offsets: Tensor) -> Tensor:
        """Concentrated negative log-likelihood (S,) of offsets (S, K) in standard deviations."""
        square = ((outputs - model(inputs, middle + width * offsets)) ** 2).sum(dim=1)
        variance = (square + PSEUDO_ROWS * noise_std**2) / (count + PSEUDO_ROWS)
        return 0.5 * (count + PSEUDO_ROWS) * variance.log().sum(dim=1) + 0.5 * (offsets**2).sum(dim=1) / PRIOR_WIDTHS**2

    starts = torch.where(free, (drawn - middle) / width.clamp_min(1e-9), 0.0)
    with torch.no_grad():
        first = torch.nan_to_num(losses(starts), nan=torch.inf)
    offsets = starts[first.argsort()[:STARTS]].clone().requires_grad_()
    optimiser = torch.optim.Adam([offsets], lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS, eta_min=1e-2 * LEARNING_RATE)
    for _ in range(STEPS):
        (gradient,) = torch.autograd.grad(losses(offsets).nan_to_num(nan=0.0, posinf=0.0).sum(), offsets)
        offsets.grad = torch.where(free & torch.isfinite(gradient), gradient, 0.0)
        optimiser.step()
        schedule.step()
    with torch.no_grad():
        last = torch.nan_to_num(losses(offsets), nan=torch.inf)
        if not torch.isfinite(last).any():
            raise DataError("The simulator gives no finite outputs for this data; check the car file and the rows.")
        parameters = middle + width * offsets[last.argmin()]
        square = ((outputs - model(inputs, parameters[None])[0]) ** 2).sum(dim=0)
    # Each output pays for its share of the fitted parameters.
    degrees = max(count - float(free.sum()) / outputs.shape[1], 0.0)
    left = (square + PSEUDO_ROWS * noise_std**2) / (degrees + PSEUDO_ROWS)
    return Identified(model, parameters.detach(), left.sqrt())


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
