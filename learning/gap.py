"""The gap between simulator and reality as a Gaussian process whose covariance is learned from the data.

Each output has a process of its own: a plane with unknown slopes, and a smooth function with one lengthscale for each
input. Scales, lengthscales, slopes and the noise are those that make the data most likely (maximum a posteriori of the
evidence; Rasmussen and Williams 2006, equations 2.30 and 5.8), given what a simulator says and how sure it is. All in
normalised inputs and outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from learning.adam import Adam

STEPS = 120
RATE, LAST_RATE = 0.08, 0.05
"""Of Adam; the share of it that is left at the end of a half cosine."""
EVIDENCE_ROWS = 300
"""Rows of a step, of more so many are drawn."""
SAME_ROWS = 30
"""Steps that see the same rows. With others in each step the optimiser crept: of 600 and 1000 rows with two outputs
whose errors are nearly the same it took a function for noise, and lost most of what one error tells of the other."""
TINY = 1e-6
"""Variance added for the sake of Cholesky's factor."""
EXPECTED_GAP = 0.3
"""Size of a gap before there is data, in normalised outputs, unless something better is known."""
MIDDLE_LENGTH = 3.0
WIDTH_SCALE, WIDTH_OWN, WIDTH_NOISE = 1.0, 0.3, 0.5
"""Standard deviations of the logarithms of what is learned: sizes, an output's own lengths and slopes, noise."""
WIDTH_SIZE, WIDTH_REACH = 1.0, 1.0
"""The same of a factor on all sizes of an output, and of one on the lengthscales of all outputs along an input: a few
rows cannot tell each output's alone."""


Evaluated = tuple[Tensor, Callable[[Tensor], list[Tensor]]]
"""A covariance, and what turns a gradient by it into those by what it was made of."""


@dataclass(frozen=True, slots=True)
class GapCovariance:
    """Covariance of each output's gap: ``s^2 r(a, b; l) + (w a) . (w b) + c^2 + d^2 f(a) f(b) r(a, b; m)``.

    ``r(a, b; l)`` is ``exp(-|(a - b) / l|^2 / 2)``. The last term is what the simulator itself says, f, times a share
    that changes with the inputs (the factor of Kennedy and O'Hagan 2000, "Predicting the output from a complex computer
    code when fast approximations are available", equation 1, as a process): a simulator may be right in one place and
    worth nothing in another.

    Attributes:
        scales: s (O,).
        lengths: l (O, D).
        slopes: w (O, D).
        offsets: c (O,).
        doubts: d (O,).
        doubt_lengths: m (O, D).
    """

    scales: Tensor
    lengths: Tensor
    slopes: Tensor
    offsets: Tensor
    doubts: Tensor
    doubt_lengths: Tensor

    @classmethod
    def before_data(cls, inputs: int, expected: Tensor, share: float = 1.0) -> GapCovariance:
        """The medians of what may be learned, for gaps of an expected size (O,).

        Each part has that size at inputs that lie as far out as their units say, the plane over all of its slopes; the
        simulator's share of itself is ``share`` as large.
        """
        size = expected.double()
        wide = torch.ones((len(size), inputs), dtype=torch.float64, device=size.device)
        long = MIDDLE_LENGTH * wide
        return cls(size, long, size[:, None] * wide / math.sqrt(inputs), size, share * size, long)

    def __call__(self, first: Tensor, second: Tensor | None = None) -> Tensor:
        """Covariances (O, ..., N, M) between inputs (..., N, D) and (..., M, D).

        Inputs of width D + O end in what the simulator says there; those of width D are without a simulator.
        """
        second = first if second is None else second
        outputs, width = self.lengths.shape
        a, b = first[..., :width], second[..., :width]
        alone = (outputs, *[1] * first.ndim)
        found = _near(a, b, self.lengths).mul_(self.scales.view(alone) ** 2)
        found.add_(_inner(a, b, self.slopes)).add_(self.offsets.view(alone) ** 2)
        if first.shape[-1] == width:
            return found
        said = [self.doubts.view(alone[:-1]) * x[..., width:].movedim(-1, 0) for x in (first, second)]
        share = _near(a, b, self.doubt_lengths).mul_(said[0][..., :, None]).mul_(said[1][..., None, :])
        return found.add_(share)

    def with_pullback(self, inputs: Tensor) -> tuple[Tensor, Callable[[Tensor], list[Tensor]]]:
        """The covariance (O, n, n) of inputs (n, D) or (n, D + O) with themselves, and its derivative.

        The derivative turns a symmetric gradient by the covariance into those by the logarithms of the six parts, in
        their order. By hand it is a few products where a tape keeps a dozen matrices.
        """
        width = self.lengths.shape[1]
        x = inputs[:, :width]
        smooth = _near(x, x, self.lengths).mul_(self.scales[:, None, None] ** 2)
        found = _inner(x, x, self.slopes).add_(smooth).add_(self.offsets[:, None, None] ** 2)
        share: Tensor | None = None
        if inputs.shape[1] > width:
            said = self.doubts[:, None] * inputs[:, width:].T
            share = _near(x, x, self.doubt_lengths).mul_(said[:, :, None]).mul_(said[:, None, :])
            found.add_(share)

        def of_lengths(gradient: Tensor, lengths: Tensor) -> Tensor:
            """By the logarithms of lengths (O, D), of a gradient times the covariance that has them."""
            return 2.0 * (gradient.sum(dim=2) @ x**2 - ((gradient @ x) * x).sum(dim=1)) / lengths**2

        def pullback(gradient: Tensor) -> list[Tensor]:
            of_smooth = gradient * smooth
            parts = [
                2.0 * of_smooth.sum(dim=(1, 2)),
                of_lengths(of_smooth, self.lengths),
                2.0 * self.slopes**2 * ((gradient @ x) * x).sum(dim=1),
                2.0 * self.offsets**2 * gradient.sum(dim=(1, 2)),
            ]
            if share is None:
                return [*parts, torch.zeros_like(self.doubts), torch.zeros_like(self.doubt_lengths)]
            of_share = gradient * share
            return [*parts, 2.0 * of_share.sum(dim=(1, 2)), of_lengths(of_share, self.doubt_lengths)]

        return found, pullback


def _inner(a: Tensor, b: Tensor, by: Tensor) -> Tensor:
    """Inner products (O, ..., N, M) of inputs (..., N, D) and (..., M, D) that are both multiplied by (O, D)."""
    return (a * by.view(len(by), *[1] * (a.ndim - 1), -1) ** 2) @ b.transpose(-1, -2)


def _near(a: Tensor, b: Tensor, lengths: Tensor) -> Tensor:
    """``exp(-|(a - b) / l|^2 / 2)`` (O, ..., N, M) for lengths (O, D)."""
    by = 1.0 / lengths
    each = by.view(len(by), *[1] * (a.ndim - 1), -1)
    squares = [((x[None] * each) ** 2).sum(dim=-1) for x in (a, b)]
    distance = _inner(a, b, by).mul_(-2.0).add_(squares[0][..., :, None]).add_(squares[1][..., None, :])
    return distance.clamp_min_(0.0).mul_(-0.5).exp_()


def learn_gap(
    inputs: Tensor,
    residual: Tensor,
    known: Tensor | None,
    noise_std: Tensor,
    expected: Tensor,
    trust: Tensor,
    said: Tensor | None = None,
    seed: int = 0,
    share: float = 1.0,
) -> tuple[GapCovariance, Tensor]:
    """Find the covariance of the gap and the noise by the evidence.

    Of more than ``EVIDENCE_ROWS`` rows each ``SAME_ROWS`` steps see others (Chen et al. 2020, "Stochastic gradient
    descent in correlated settings: a study on Gaussian processes"): as costly as a few rows, and few go unheard.

    Args:
        inputs: normalised (n, D).
        residual: normalised outputs less the simulator's mean (n, O).
        known: covariance of the simulator's own doubt (O, n, n); none unless given.
        noise_std: expected noise (O,).
        expected: size of the gap (O,).
        trust: what a row's noise variance is divided by (n,), 1 unless it is an outlier.
        said: normalised outputs of the simulator (n, O), where there is one.
        seed: of the rows that are drawn.
        share: of the expected size, what the simulator is expected to be wrong by in proportion to what it says.

    Returns:
        The covariance and the noise (O,).
    """
    residual, inputs = residual.double(), inputs.double()
    start = GapCovariance.before_data(inputs.shape[1], expected, share)
    inputs = inputs if said is None else torch.cat([inputs, said.double()], dim=1)
    of_gap = (start.scales, start.lengths, start.slopes, start.offsets, start.doubts, start.doubt_lengths)
    reach = torch.zeros_like(start.lengths[0])
    middles = [*(v.log() for v in of_gap), noise_std.double().log(), torch.zeros_like(start.scales), reach]
    widths = (
        *(WIDTH_SCALE, WIDTH_OWN, WIDTH_OWN, WIDTH_SCALE, WIDTH_SCALE, WIDTH_OWN),
        *(WIDTH_NOISE, WIDTH_SIZE, WIDTH_REACH),
    )

    def evaluated(logs: list[Tensor], rows: Tensor) -> Evaluated:
        covariance, of_parts = _gap_of(logs).with_pullback(inputs[rows])
        of_noise = _noise_variance(logs[6], trust[rows])
        covariance.diagonal(dim1=1, dim2=2).add_(of_noise + TINY)
        if known is not None:
            covariance += _among(known, rows)

        def pullback(gradient: Tensor) -> list[Tensor]:
            parts = of_parts(gradient)
            scales, lengths, slopes, offsets, doubts, doubt_lengths = parts
            size = scales + slopes.sum(dim=1) + offsets + doubts
            return [*parts, _by_noise(gradient, of_noise), size, (lengths + doubt_lengths).sum(dim=0)]

        return covariance, pullback

    logs = _most_probable(middles, widths, residual, evaluated, seed)
    return _gap_of(logs), logs[6].exp()


def learn_noise(residual: Tensor, known: Tensor | None, noise_std: Tensor, trust: Tensor, seed: int = 0) -> Tensor:
    """The noise (O,) alone, of a simulator without a gap; arguments as for ``learn_gap``."""

    def evaluated(logs: list[Tensor], rows: Tensor) -> Evaluated:
        of_noise = _noise_variance(logs[0], trust[rows])
        covariance = torch.diag_embed(of_noise + TINY)
        if known is not None:
            covariance += _among(known, rows)
        return covariance, lambda gradient: [_by_noise(gradient, of_noise)]

    middles = [noise_std.double().log()]
    return _most_probable(middles, (WIDTH_NOISE,), residual.double(), evaluated, seed)[0].exp()


def _most_probable(
    middles: list[Tensor],
    widths: Sequence[float],
    residual: Tensor,
    evaluated: Callable[[list[Tensor], Tensor], Evaluated],
    seed: int,
) -> list[Tensor]:
    """Logarithms under Gaussian priors that make residuals (n, O) with covariances (O, n, n) most probable."""
    generator, count = torch.Generator().manual_seed(seed), len(residual)
    rows = torch.arange(count, device=residual.device)
    logs = [m.clone() for m in middles]
    optimisers = [Adam(value) for value in logs]
    for step in range(STEPS):
        if count > EVIDENCE_ROWS and step % SAME_ROWS == 0:
            rows = torch.randperm(count, generator=generator)[:EVIDENCE_ROWS].to(residual.device)
        covariance, pullback = evaluated(logs, rows)
        gradients = pullback(evidence_gradient(residual[rows], covariance))
        rate = RATE * (LAST_RATE + (1.0 - LAST_RATE) * 0.5 * (1.0 + math.cos(math.pi * step / STEPS)))
        held = [(value - middle) / width**2 for value, middle, width in zip(logs, middles, widths, strict=True)]
        for optimiser, gradient, back in zip(optimisers, gradients, held, strict=True):
            optimiser.step(gradient + back, rate)
    return logs


def _among(known: Tensor, rows: Tensor) -> Tensor:
    """Covariances (O, m, m) of some of the rows, of those (O, n, n) of all."""
    return known if len(rows) == known.shape[1] else known[:, rows][:, :, rows]


def _noise_variance(log_noise: Tensor, trust: Tensor) -> Tensor:
    """Of each output and row (O, n), the larger the less a row is trusted."""
    return torch.exp(2.0 * log_noise)[:, None] / trust


def _by_noise(gradient: Tensor, variance: Tensor) -> Tensor:
    """Gradient (O,) by the logarithms of the noise, from one by the covariance (O, n, n)."""
    return 2.0 * (gradient.diagonal(dim1=1, dim2=2) * variance).sum(dim=1)


def _gap_of(logs: list[Tensor]) -> GapCovariance:
    """The covariance of logarithms: of its six parts, of the noise, of a factor on all sizes, of one on all lengths."""
    scales, lengths, slopes, offsets, doubts, doubt_lengths, _, size, reach = logs
    return GapCovariance(
        (scales + size).exp(), (lengths + reach).exp(), (slopes + size[:, None]).exp(), (offsets + size).exp(),
        (doubts + size).exp(), (doubt_lengths + reach).exp(),
    )  # fmt: skip


def evidence_gradient(residual: Tensor, covariance: Tensor) -> Tensor:
    """Gradient (O, n, n) of the surprise at residuals (n, O) by the covariances (O, n, n) of zero-mean Gaussians.

    The surprise is the negative log density, its gradient ``(K^-1 - K^-1 r r^T K^-1) / 2`` (Rasmussen and Williams
    2006, equation 5.9), which needs no tape through Cholesky's factor.
    """
    factor = torch.linalg.cholesky(covariance)
    solved = torch.cholesky_solve(residual.T[:, :, None], factor)
    gradient: Tensor = torch.cholesky_inverse(factor)
    # It is symmetric, and turned over it lies in memory as other matrices do.
    return gradient.baddbmm_(solved, solved.transpose(1, 2), beta=0.5, alpha=-0.5).mT


__all__ = ["GapCovariance", "evidence_gradient", "learn_gap", "learn_noise"]
