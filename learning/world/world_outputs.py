"""Conversion of body-frame predictions to the seven outputs that the authors of Sim-FSVGD score.

Their state is x, y, sin(yaw), cos(yaw), vx, vy in the world frame and the yaw rate, with independent Gaussians
(Rothfuss et al., arXiv 2403.16644, section 6). Sine and cosine of one angle are redundant, and near an extreme their
density is degenerate: the score serves only for comparison with the paper.
"""

from __future__ import annotations

import torch
from torch import Tensor

from learning.evaluation import Mixture

MIN_STD = 1e-6
"""Lower bound of a standard deviation: that of a sine near its extreme is almost zero."""


def seven_outputs(prediction: Mixture, velocity_mps: Tensor, yaw_rad: Tensor) -> Mixture:
    """Independent Gaussians with the mean and variance of each of the seven outputs, for each component.

    Moments are exact for independent errors of the six outputs; their correlations are ignored.

    Args:
        prediction: changes of the six ``transitions.OUTPUTS`` over a step (L, N, 6); several Gaussians approximate a
            Student-t component.
        velocity_mps: vx, vy along the body axes at the step's start (N, 2).
        yaw_rad: yaw at the step's start (N,).

    Returns:
        Changes of x and y, sine and cosine of the yaw, vx, vy in the world frame, change of the yaw rate (L, N, 7).
    """
    prediction = prediction.gaussians()
    mean = prediction.means.double()
    variance = (prediction.marginal_scales.double() ** 2).expand_as(mean)
    speed = mean[..., 3:5] + velocity_mps.double()
    sin, cos = _circle(yaw_rad.double(), torch.zeros_like(yaw_rad.double()))
    position = _to_world(mean[..., :2], variance[..., :2], sin, cos, 0.5 * torch.sin(2.0 * yaw_rad.double()))
    yaw, yaw_variance = yaw_rad.double() + mean[..., 2], variance[..., 2]
    sin, cos = _circle(yaw, yaw_variance)
    sin_cos = 0.5 * torch.exp(-2.0 * yaw_variance) * torch.sin(2.0 * yaw)
    velocity = _to_world(speed, variance[..., 3:5], sin, cos, sin_cos)
    parts = [*position, sin, cos, *velocity, (mean[..., 5], mean[..., 5] ** 2 + variance[..., 5])]
    means = torch.stack([first for first, _ in parts], dim=-1)
    squares = torch.stack([second for _, second in parts], dim=-1)
    return Mixture(means, (squares - means**2).clamp_min(MIN_STD**2).sqrt())


def measured_seven_outputs(changes: Tensor, velocity_mps: Tensor, yaw_rad: Tensor) -> Tensor:
    """The seven outputs (N, 7) of measured changes (N, 6); velocity (N, 2) and yaw (N,) as for ``seven_outputs``."""
    exact = Mixture(changes[None], torch.zeros_like(changes[None]))
    return seven_outputs(exact, velocity_mps, yaw_rad).means[0]


Moments = tuple[Tensor, Tensor]
"""Mean of a random variable, and of its square."""


def _circle(angle: Tensor, variance: Tensor) -> tuple[Moments, Moments]:
    """Sine and cosine of a Gaussian angle."""
    once, twice = torch.exp(-0.5 * variance), torch.exp(-2.0 * variance) * torch.cos(2.0 * angle)
    return (once * angle.sin(), 0.5 * (1.0 - twice)), (once * angle.cos(), 0.5 * (1.0 + twice))


def _to_world(vector: Tensor, variance: Tensor, sin: Moments, cos: Moments, sin_cos: Tensor) -> tuple[Moments, Moments]:
    """A vector (..., 2) rotated by an independent angle; ``sin_cos`` is the mean of sine times cosine."""
    ahead, left = vector.unbind(-1)
    ahead_square, left_square = (vector**2 + variance).unbind(-1)
    cross_term = 2.0 * sin_cos * ahead * left
    x = cos[0] * ahead - sin[0] * left, cos[1] * ahead_square + sin[1] * left_square - cross_term
    y = sin[0] * ahead + cos[0] * left, sin[1] * ahead_square + cos[1] * left_square + cross_term
    return x, y
