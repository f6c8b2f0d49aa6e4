"""Model discrepancy (simulator against reality) as a Gaussian process whose covariance is fitted to data.

Each output has its process: a plane with unknown slopes, and a smooth function with one lengthscale per input
(automatic relevance determination). Hyperparameters and noise maximise the evidence times a log-normal prior (maximum a
posteriori; Rasmussen and Williams 2006, equations 2.30 and 5.8). Inputs and outputs are normalised.

The evidence integrates over the simulator's parameters. Their prior moments enter the covariance. Draws given the same
rows enter as draws of the residual: the mean of their log densities is the expectation step of expectation maximisation
(Dempster, Laird and Rubin 1977), whose fixed point maximises the evidence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from learning.networks.adam import Adam, half_cosine
from learning.posterior.row_noise import FIT_BLOCK_ROWS, RowNoise, prior_logs, random_rows

STEPS = 120
LEARNING_RATE, FINAL_RATE_SHARE = 0.08, 0.05
"""Initial rate of Adam; final share of it after a half cosine."""
BATCH_ROWS = 300
"""Rows of one evidence gradient; a random subset of more."""
STEPS_PER_BATCH = 30
"""Consecutive steps on the same subset."""
CHOLESKY_JITTER = 1e-6
"""Variance added before a Cholesky factorisation."""
PRIOR_DISCREPANCY_STD = 0.3
"""Default prior size of the discrepancy in normalised outputs."""
PRIOR_LENGTHSCALE = 3.0
LOG_STD_SCALE, LOG_STD_SHAPE = 1.0, 0.3
"""Prior standard deviations of logarithms: of sizes, of lengthscales and slopes of each output."""
LOG_STD_OUTPUT_FACTOR, LOG_STD_INPUT_FACTOR = 1.0, 1.0
"""The same of a common factor on all sizes of an output, and on the lengthscales of all outputs along an input."""
LOG_STDS = (
    *(LOG_STD_SCALE, LOG_STD_SHAPE, LOG_STD_SHAPE, LOG_STD_SCALE, LOG_STD_SCALE, LOG_STD_SHAPE),
    *(LOG_STD_OUTPUT_FACTOR, LOG_STD_INPUT_FACTOR),
)
"""The same for a covariance's six parts in their order, and the two factors."""

Evaluated = tuple[Tensor, Callable[[Tensor], list[Tensor]]]
"""A covariance, and the map from a gradient with respect to it to gradients with respect to its hyperparameters."""


@dataclass(frozen=True, slots=True)
class DiscrepancyCovariance:
    """Covariance of each output's discrepancy: ``s^2 r(a, b; l) + (w a) . (w b) + c^2 + d^2 f(a) f(b) r(a, b; m)``.

    ``r(a, b; l)`` is ``exp(-|(a - b) / l|^2 / 2)``. The last term is the simulator's own output f times a process: the
    multiplicative factor of Kennedy and O'Hagan 2000 ("Predicting the output from a complex computer code when fast
    approximations are available", equation 1), here varying with the inputs.

    Attributes:
        scales: s (O,).
        lengthscales: l (O, D).
        slopes: w (O, D).
        offsets: c (O,).
        multiplier_stds: d (O,).
        multiplier_lengthscales: m (O, D).
    """

    scales: Tensor
    lengthscales: Tensor
    slopes: Tensor
    offsets: Tensor
    multiplier_stds: Tensor
    multiplier_lengthscales: Tensor

    @classmethod
    def at_prior_median(cls, inputs: int, prior_std: Tensor, multiplier_share: float = 1.0) -> DiscrepancyCovariance:
        """The prior median of all hyperparameters.

        Args:
            inputs: D.
            prior_std: prior size of the discrepancy (O,). Every part has this size at inputs one unit from the centre,
                the plane with all slopes together.
            multiplier_share: size of the multiplicative part relative to the others.
        """
        size = prior_std.double()
        ones = torch.ones((len(size), inputs), dtype=torch.float64, device=size.device)
        lengthscales = PRIOR_LENGTHSCALE * ones
        slopes = size[:, None] * ones / math.sqrt(inputs)
        return cls(size, lengthscales, slopes, size, multiplier_share * size, lengthscales)

    def __call__(self, first: Tensor, second: Tensor | None = None) -> Tensor:
        """Covariances (O, ..., N, M) between inputs (..., N, D) and (..., M, D).

        Inputs of width D + O end in the simulator's outputs; those of width D have no multiplicative part.
        """
        return self._terms(first, first if second is None else second)[0]

    def _terms(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """The covariance as of ``__call__``, its smooth term, and its multiplicative term if any."""
        outputs, width = self.lengthscales.shape
        a, b = first[..., :width], second[..., :width]
        shape = (outputs, *[1] * first.ndim)
        smooth = _rbf(a, b, self.lengthscales).mul_(self.scales.view(shape) ** 2)
        covariance = _scaled_inner_product(a, b, self.slopes).add_(smooth).add_(self.offsets.view(shape) ** 2)
        if first.shape[-1] == width:
            return covariance, smooth, None
        scaled = [self.multiplier_stds.view(shape[:-1]) * x[..., width:].movedim(-1, 0) for x in (first, second)]
        multiplicative = _rbf(a, b, self.multiplier_lengthscales)
        multiplicative.mul_(scaled[0][..., :, None]).mul_(scaled[1][..., None, :])
        return covariance.add_(multiplicative), smooth, multiplicative

    def with_pullback(self, inputs: Tensor) -> tuple[Tensor, Callable[[Tensor], list[Tensor]]]:
        """The covariance matrix of inputs, and its derivative in closed form.

        Args:
            inputs: (n, D) or (n, D + O).

        Returns:
            The covariance (O, n, n), and the map from a symmetric gradient with respect to it to the gradients with
            respect to the logarithms of the six attributes, in their order.
        """
        x = inputs[:, : self.lengthscales.shape[1]]
        covariance, smooth, multiplicative = self._terms(inputs, inputs)

        def lengthscale_gradient(weighted: Tensor, lengthscales: Tensor) -> Tensor:
            """Gradient with respect to the log lengthscales (O, D), from a gradient times their covariance term."""
            return 2.0 * (weighted.sum(dim=2) @ x**2 - ((weighted @ x) * x).sum(dim=1)) / lengthscales**2

        def pullback(gradient: Tensor) -> list[Tensor]:
            by_smooth = gradient * smooth
            parts = [
                2.0 * by_smooth.sum(dim=(1, 2)),
                lengthscale_gradient(by_smooth, self.lengthscales),
                2.0 * self.slopes**2 * ((gradient @ x) * x).sum(dim=1),
                2.0 * self.offsets**2 * gradient.sum(dim=(1, 2)),
            ]
            if multiplicative is None:
                return [*parts, torch.zeros_like(self.multiplier_stds), torch.zeros_like(self.multiplier_lengthscales)]
            weighted = gradient * multiplicative
            by_lengthscales = lengthscale_gradient(weighted, self.multiplier_lengthscales)
            return [*parts, 2.0 * weighted.sum(dim=(1, 2)), by_lengthscales]

        return covariance, pullback


def _scaled_inner_product(a: Tensor, b: Tensor, factors: Tensor) -> Tensor:
    """Inner products (O, ..., N, M) of inputs (..., N, D) and (..., M, D), both multiplied by factors (O, D)."""
    return (a * factors.view(len(factors), *[1] * (a.ndim - 1), -1) ** 2) @ b.transpose(-1, -2)


def _rbf(a: Tensor, b: Tensor, lengthscales: Tensor) -> Tensor:
    """``exp(-|(a - b) / l|^2 / 2)`` (O, ..., N, M) for lengthscales (O, D)."""
    inverse = 1.0 / lengthscales
    factors = inverse.view(len(inverse), *[1] * (a.ndim - 1), -1)
    squares = [((x[None] * factors) ** 2).sum(dim=-1) for x in (a, b)]
    distance = _scaled_inner_product(a, b, inverse).mul_(-2.0)
    distance.add_(squares[0][..., :, None]).add_(squares[1][..., None, :])
    return distance.clamp_min_(0.0).mul_(-0.5).exp_()


def fit_discrepancy(
    inputs: Tensor,
    residual: Tensor,
    parameter_covariance: Tensor | None,
    noise_std: Tensor,
    prior_std: Tensor,
    row_weights: Tensor,
    simulated_mean: Tensor | None = None,
    seed: int = 0,
    multiplier_share: float = 1.0,
    step_numbers: Tensor | None = None,
) -> tuple[DiscrepancyCovariance, RowNoise]:
    """Fit the covariance of the discrepancy and the noise by the evidence.

    With more than ``BATCH_ROWS`` rows the gradient is stochastic (Chen et al. 2020, "Stochastic gradient descent in
    correlated settings: a study on Gaussian processes"). It is that of the subset's evidence and is not scaled to all
    rows: the priors weigh as much as with ``BATCH_ROWS`` rows.

    Args:
        inputs: normalised (n, D).
        residual: normalised outputs less the simulator's prior mean (n, O), or draws given the rows (P, n, O).
        parameter_covariance: prior covariance of the simulator's output due to its parameters (O, n, n); None: zero,
            as for draws given the rows.
        noise_std: prior median of the noise (O,).
        prior_std: prior size of the discrepancy (O,).
        row_weights: Student-t weights (n,); a row's noise variance is divided by its weight.
        simulated_mean: normalised outputs of the simulator (n, O), if any.
        seed: of the subsets of rows.
        multiplier_share: prior size of the multiplicative part relative to the others.
        step_numbers: of the rows' steps (n,), as for ``RowNoise``; None: the noise of rows is independent.

    Returns:
        The covariance and the noise.
    """
    residual, inputs = residual.double(), inputs.double()
    medians = _prior_medians(DiscrepancyCovariance.at_prior_median(inputs.shape[1], prior_std, multiplier_share))
    inputs = inputs if simulated_mean is None else torch.cat([inputs, simulated_mean.double()], dim=1)
    noise_medians, noise_stds = prior_logs(noise_std, step_numbers)

    def evaluate(logs: list[Tensor], rows: Tensor) -> Evaluated:
        covariance, part_gradients = _covariance_of(logs).with_pullback(inputs[rows])
        noise_gradients = _add_noise(covariance, RowNoise.of_logs(logs[8:], step_numbers).take(rows), row_weights[rows])
        if parameter_covariance is not None:
            covariance += _of_rows(parameter_covariance, rows)

        def pullback(gradient: Tensor) -> list[Tensor]:
            by_parts = part_gradients(gradient)
            scales, lengthscales, slopes, offsets, multiplier_stds, multiplier_lengthscales = by_parts
            by_output = scales + slopes.sum(dim=1) + offsets + multiplier_stds
            by_input = (lengthscales + multiplier_lengthscales).sum(dim=0)
            return [*by_parts, by_output, by_input, *noise_gradients(gradient)]

        return covariance, pullback

    widths = (*LOG_STDS, *noise_stds)
    logs = _maximise_posterior([*medians, *noise_medians], widths, residual, evaluate, seed, step_numbers)
    return _covariance_of(logs), RowNoise.of_logs(logs[8:], step_numbers)


def fit_noise(
    residual: Tensor,
    parameter_covariance: Tensor | None,
    noise_std: Tensor,
    row_weights: Tensor,
    seed: int = 0,
    step_numbers: Tensor | None = None,
) -> RowNoise:
    """Fit the noise alone, for a simulator without discrepancy; arguments as for ``fit_discrepancy``."""
    medians, stds = prior_logs(noise_std, step_numbers)
    outputs = len(noise_std)

    def evaluate(logs: list[Tensor], rows: Tensor) -> Evaluated:
        covariance = row_weights.new_zeros((outputs, len(rows), len(rows)), dtype=torch.float64)
        gradients = _add_noise(covariance, RowNoise.of_logs(logs, step_numbers).take(rows), row_weights[rows])
        if parameter_covariance is not None:
            covariance += _of_rows(parameter_covariance, rows)
        return covariance, gradients

    logs = _maximise_posterior(medians, stds, residual.double(), evaluate, seed, step_numbers)
    return RowNoise.of_logs(logs, step_numbers)


def _add_noise(covariance: Tensor, noise: RowNoise, row_weights: Tensor) -> Callable[[Tensor], list[Tensor]]:
    """Add noise to covariances (O, n, n) in place; returns the pullback to the logarithms of the noise."""
    noise.add_to(covariance, row_weights)
    covariance.diagonal(dim1=1, dim2=2).add_(CHOLESKY_JITTER)
    return lambda gradient: noise.log_gradients(gradient, row_weights)


def _maximise_posterior(
    medians: list[Tensor],
    log_stds: Sequence[float],
    residual: Tensor,
    evaluate: Callable[[list[Tensor], Tensor], Evaluated],
    seed: int,
    step_numbers: Tensor | None,
) -> list[Tensor]:
    """Logarithms of hyperparameters at the maximum of evidence times Gaussian priors, by Adam.

    Args:
        medians: prior means of the logarithms, the initial values.
        log_stds: their prior standard deviations.
        residual: zero-mean Gaussian (n, O), or draws of it (P, n, O).
        evaluate: covariance (O, m, m) of the rows with indices (m,) for given logarithms, and its pullback.
        seed: of the subsets of rows.
        step_numbers: of the rows' steps (n,), if known.
    """
    generator, count = torch.Generator().manual_seed(seed), residual.shape[-2]
    rows = torch.arange(count, device=residual.device)
    logs = [m.clone() for m in medians]
    optimisers = [Adam(value) for value in logs]
    for step in range(STEPS):
        if count > BATCH_ROWS and step % STEPS_PER_BATCH == 0:
            rows = random_rows(count, BATCH_ROWS, step_numbers, generator, FIT_BLOCK_ROWS).to(residual.device)
        covariance, pullback = evaluate(logs, rows)
        gradients = pullback(evidence_gradient(residual[..., rows, :], covariance))
        rate = LEARNING_RATE * half_cosine(step, STEPS, FINAL_RATE_SHARE)
        prior_gradients = [(v - m) / width**2 for v, m, width in zip(logs, medians, log_stds, strict=True)]
        for optimiser, gradient, prior_gradient in zip(optimisers, gradients, prior_gradients, strict=True):
            optimiser.step(gradient + prior_gradient, rate)
    return logs


def _of_rows(covariance: Tensor, rows: Tensor) -> Tensor:
    """Covariances (O, m, m) of the rows with indices (m,), from those of all (O, n, n)."""
    return covariance if len(rows) == covariance.shape[1] else covariance[:, rows][:, :, rows]


def _prior_medians(start: DiscrepancyCovariance) -> list[Tensor]:
    """Logarithms of the six parts of a covariance, and zeros for the factors by output and by input."""
    parts = (
        start.scales, start.lengthscales, start.slopes, start.offsets, start.multiplier_stds,
        start.multiplier_lengthscales,
    )  # fmt: skip
    factors = torch.zeros_like(start.scales), torch.zeros_like(start.lengthscales[0])
    return [*(part.log() for part in parts), *factors]


def _covariance_of(logs: list[Tensor]) -> DiscrepancyCovariance:
    """The covariance, from logarithms of its six parts and of the factors by output and by input; ignores others."""
    scales, lengthscales, slopes, offsets, multiplier_stds, multiplier_lengthscales, by_output, by_input = logs[:8]
    return DiscrepancyCovariance(
        (scales + by_output).exp(), (lengthscales + by_input).exp(), (slopes + by_output[:, None]).exp(),
        (offsets + by_output).exp(), (multiplier_stds + by_output).exp(), (multiplier_lengthscales + by_input).exp(),
    )  # fmt: skip


def evidence_gradient(residual: Tensor, covariance: Tensor) -> Tensor:
    """Gradient (O, n, n) of the negative log evidence with respect to the covariance.

    ``(K^-1 - K^-1 r r^T K^-1) / 2`` (Rasmussen and Williams 2006, equation 5.9), averaged over draws of r.

    Args:
        residual: (n, O), or equally weighted draws (P, n, O).
        covariance: of zero-mean Gaussians (O, n, n).
    """
    factor = torch.linalg.cholesky(covariance)
    draws = residual.view(-1, *residual.shape[-2:]).permute(2, 1, 0)  # (O, n, P)
    solved = torch.cholesky_solve(draws, factor)
    gradient: Tensor = torch.cholesky_inverse(factor)
    # The gradient is symmetric; its transpose has the memory layout of the other matrices.
    return gradient.baddbmm_(solved, solved.transpose(1, 2), beta=0.5, alpha=-0.5 / draws.shape[2]).mT
