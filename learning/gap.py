"""The gap between simulator and reality as a Gaussian process whose covariance is learned from the data.

Each output has a process of its own: a plane with unknown slopes, and a smooth function with one lengthscale for each
input. Scales, lengthscales, slopes and the noise are those that make the data most likely (maximum a posteriori of the
evidence; Rasmussen and Williams 2006, equations 2.30 and 5.8), given what a simulator says and how sure it is. All in
normalised inputs and outputs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

STEPS = 120
RATE = 0.08
TINY = 1e-6
"""Variance added for the sake of Cholesky's factor."""
EXPECTED_GAP = 0.3
"""Size of a gap before there is data, in normalised outputs, unless something better is known."""
MIDDLE_LENGTH = 3.0
WIDTH_SCALE, WIDTH_LENGTH, WIDTH_SLOPE, WIDTH_NOISE = 1.0, 1.0, 1.0, 0.5
"""Standard deviations of the logarithms of what is learned around its median."""


@dataclass(frozen=True, slots=True)
class GapCovariance:
    """Covariance of each output's gap: ``s^2 exp(-|(a - b) / l|^2 / 2) + (w a) . (w b) + c^2``.

    Attributes:
        scales: s (O,).
        lengths: l (O, D).
        slopes: w (O, D).
        offsets: c (O,).
    """

    scales: Tensor
    lengths: Tensor
    slopes: Tensor
    offsets: Tensor

    @classmethod
    def before_data(cls, inputs: int, expected: Tensor) -> GapCovariance:
        """The medians of what may be learned, for gaps of an expected size (O,)."""
        size = expected.double()
        wide = torch.ones((len(size), inputs), dtype=torch.float64, device=size.device)
        return cls(size, MIDDLE_LENGTH * wide, size[:, None] * wide, size)

    def __call__(self, first: Tensor, second: Tensor | None = None) -> Tensor:
        """Covariances (O, ..., N, M) between inputs (..., N, D) and (..., M, D)."""
        second = first if second is None else second
        outputs, width = self.lengths.shape
        each = (outputs, *[1] * (first.ndim - 1), width)

        def scaled(by: Tensor) -> Tensor:
            """Inner products of inputs that are multiplied by ``by`` (O, D)."""
            return (first * by.view(each) ** 2) @ second.transpose(-1, -2)

        near = 1.0 / self.lengths
        squares = [((x[None] * near.view(each)) ** 2).sum(dim=-1) for x in (first, second)]
        distance = squares[0][..., :, None] + squares[1][..., None, :] - 2.0 * scaled(near)
        alone = (outputs, *[1] * first.ndim)
        smooth = self.scales.view(alone) ** 2 * torch.exp(-0.5 * distance.clamp_min(0.0))
        return smooth + scaled(self.slopes) + self.offsets.view(alone) ** 2


def learn_gap(
    inputs: Tensor, residual: Tensor, known: Tensor | None, noise_std: Tensor, expected: Tensor, trust: Tensor
) -> tuple[GapCovariance, Tensor]:
    """Find the covariance of the gap and the noise by the evidence.

    Args:
        inputs: normalised (n, D).
        residual: normalised outputs less the simulator's mean (n, O).
        known: covariance of the simulator's own doubt (O, n, n); none unless given.
        noise_std: expected noise (O,).
        expected: size of the gap (O,).
        trust: what a row's noise variance is divided by (n,), 1 unless it is an outlier.

    Returns:
        The covariance and the noise (O,).
    """
    residual, inputs = residual.double(), inputs.double()
    start = GapCovariance.before_data(inputs.shape[1], expected)
    middles = [
        start.scales.log(),
        start.lengths.log(),
        start.slopes.log(),
        start.offsets.log(),
        noise_std.double().log(),
    ]
    widths = (WIDTH_SCALE, WIDTH_LENGTH, WIDTH_SLOPE, WIDTH_SLOPE, WIDTH_NOISE)
    logs = [m.clone().requires_grad_() for m in middles]
    optimiser = torch.optim.Adam(logs, lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS, eta_min=0.05 * RATE)
    for _ in range(STEPS):
        gap = GapCovariance(*(v.exp() for v in logs[:4]))
        covariance = gap(inputs) + torch.diag_embed(torch.exp(2.0 * logs[4])[:, None] / trust + TINY)
        if known is not None:
            covariance = covariance + known
        surprise = -log_evidence(residual, torch.linalg.cholesky(covariance))
        for value, middle, width in zip(logs, middles, widths, strict=True):
            surprise = surprise + 0.5 * (((value - middle) / width) ** 2).sum()
        for value, gradient in zip(logs, torch.autograd.grad(surprise, logs), strict=True):
            value.grad = gradient
        optimiser.step()
        schedule.step()
    with torch.no_grad():
        return GapCovariance(*(v.exp() for v in logs[:4])), logs[4].exp()


def log_evidence(residual: Tensor, factor: Tensor) -> Tensor:
    """Log density of residuals (n, O) under zero-mean Gaussians with Cholesky factors (O, n, n)."""
    white = torch.linalg.solve_triangular(factor, residual.T[:, :, None], upper=False)
    logs = factor.diagonal(dim1=1, dim2=2).log().sum()
    density: Tensor = -0.5 * (white * white).sum() - logs - 0.5 * residual.numel() * math.log(2.0 * math.pi)
    return density


__all__ = ["GapCovariance", "learn_gap", "log_evidence"]
