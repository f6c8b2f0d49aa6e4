"""Estimation of the disturbance of a learned car from its errors over held-out windows.

The rollout of a window is linear in small disturbances: ``e = sum_j G_j d_j`` with pulse responses ``G_j``. So the
variance of each error follows from the process in closed form. Scale, correlation time and degrees of freedom maximise
the composite marginal likelihood over horizons and outputs (Varin, Reid and Firth 2011, "An overview of composite
likelihood methods"); the marginals are what bands of predictions are made of.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.networks.uncompiled_optimisers import uncompiled_optimisers
from learning.outliers import DOF_CANDIDATES, log_student, tail_scales
from learning.posterior.sampler import Assignment
from learning.world.car_dynamics import CarDynamics
from learning.world.disturbance import CHANNELS, TAIL_COMPONENTS, DisturbanceProcess, change_by
from learning.world.drive_windows import DriveWindows, roll_out

CORRELATION_TIMES_S = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
"""Candidates of the correlation time: from one step to longer than a window."""
HORIZON_SHARES = (0.1, 0.2, 0.3, 0.5, 0.75, 1.0)
"""Horizons of the likelihood, as shares of a window."""
PULSE_SIZES = (1.0, 1.0, 5.0)
"""Accelerations of the finite differences [m/s2, m/s2, rad/s2]."""
MIN_SCALE, MAX_SCALE = 0.01, 30.0
"""Bounds of a fitted scale, in the units of ``PULSE_SIZES``."""
MAX_WINDOWS = 300
"""Maximum number of windows; the pulse responses of more take minutes."""
MIN_WINDOWS = 8
"""Minimum number of windows: seven numbers are estimated."""
_ITERATIONS = 25
Times = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class RolloutErrors:
    """Errors of undisturbed rollouts at N = windows x horizons, for x, y [m], yaw [rad] and the body velocities.

    Attributes:
        error: of the particles' mean path (N, 6).
        variance: of the particles' paths and of the measurement noise (N, 6).
        pulses: responses to accelerations of 1 m/s2 or 1 rad/s2 during one of the K steps, by channel (N, 6, K, 3).
        period_s: period of the steps [s].
    """

    error: Tensor
    variance: Tensor
    pulses: Tensor
    period_s: float

    def disturbance_variance(self, correlation_s: float) -> Tensor:
        """Variance (N, 6, 3) of the errors by a disturbance of unit scale of each channel."""
        steps = torch.arange(self.pulses.shape[2], dtype=torch.float64)
        lag_s = (steps[:, None] - steps).abs() * self.period_s
        autocorrelation = torch.exp(-lag_s / correlation_s).to(self.pulses)
        return torch.einsum("nojc,ji,noic->noc", self.pulses, autocorrelation, self.pulses)


def rollout_errors(car: CarDynamics, windows: DriveWindows) -> RolloutErrors:
    """Errors of a car over windows, and their responses to disturbances."""
    particles, steps = len(car.sampler.parameters), windows.commands.shape[1]
    at = sorted({max(round(share * steps), 1) - 1 for share in HORIZON_SHARES})
    count = len(windows)
    every = torch.arange(particles).repeat_interleave(count)
    paths = _paths(car, windows, torch.arange(count).repeat(particles), every, None)
    paths = paths.view(particles, count, steps, 6)[:, :, at]
    noise_variance = (car.sampler.noise**2).sum(dim=0) * car.sampler.scales.flatten().square().median()
    error = paths.mean(dim=0) - windows.motion[:, at].to(paths)
    variance = paths.var(dim=0) + noise_variance
    pulses = _pulse_responses(car, windows)[:, at]
    error, variance, pulses = (v.flatten(0, 1).double() for v in (error, variance, pulses))
    return RolloutErrors(error, variance, pulses, windows.period_s)


def pooled(parts: Sequence[RolloutErrors]) -> RolloutErrors:
    """Errors of several cars or folds with equal periods and windows of equal length."""
    error, variance, pulses = (
        torch.cat([getattr(part, name) for part in parts]) for name in ("error", "variance", "pulses")
    )
    return RolloutErrors(error, variance, pulses, parts[0].period_s)


def _pulse_responses(car: CarDynamics, windows: DriveWindows) -> Tensor:
    """Responses (S, K, 6, K, 3) of the state after each step to unit pulses at each step; by one particle a window."""
    steps, count = windows.commands.shape[1], len(windows)
    kinds = 3 * steps
    window = torch.arange(count).repeat_interleave(1 + kinds)
    pulses = torch.zeros((count, 1 + kinds, steps, 3))
    for j in range(steps):
        for c in range(3):
            pulses[:, 1 + 3 * j + c, j, c] = PULSE_SIZES[c]
    particle = window % len(car.sampler.parameters)
    paths = _paths(car, windows, window, particle, pulses.flatten(0, 1)).view(count, 1 + kinds, steps, 6)
    change = (paths[:, 1:] - paths[:, :1]).view(count, steps, 3, steps, 6) / torch.tensor(PULSE_SIZES)[:, None, None]
    return change.permute(0, 3, 4, 1, 2)


def _paths(
    car: CarDynamics, windows: DriveWindows, window: Tensor, particle: Tensor, accelerations: Tensor | None
) -> Tensor:
    """States (N, K, 6) of rollouts without noise; yaw is continuous.

    Args:
        car: the car.
        windows: windows.
        window: index of each rollout's window (N,).
        particle: index of each rollout's particle (N,).
        accelerations: disturbance of each rollout (N, K, 3); None: zero.
    """
    assignment = Assignment.of_particles(particle, len(car.sampler.parameters))

    def change(inputs: Tensor, step: int) -> Tensor:
        undisturbed = car.sampler.without_noise(inputs, assignment)
        if accelerations is None:
            return undisturbed
        return undisturbed + change_by(accelerations[:, step], windows.period_s)

    return roll_out(windows.take(window), change)


def fit_disturbance(errors: RolloutErrors) -> DisturbanceProcess:
    """Maximise the composite likelihood of errors.

    The correlation time is the best common one of ``CORRELATION_TIMES_S`` and then the best of each channel.

    Args:
        errors: of held-out windows.

    Raises:
        DataError: fewer than ``MIN_WINDOWS`` windows, or errors that are not finite.
    """
    if len(errors.error) < MIN_WINDOWS * len(HORIZON_SHARES) or not torch.isfinite(errors.error).all():
        raise DataError(
            f"The disturbance needs {MIN_WINDOWS} windows with finite errors; record a longer drive, or predict "
            "without it."
        )
    unit = {t: errors.disturbance_variance(t) for t in CORRELATION_TIMES_S}
    best = max((_maximise(errors, [unit[t]] * 3, (t, t, t)) for t in CORRELATION_TIMES_S), key=lambda fit: fit.density)
    for channel in range(len(CHANNELS)):
        for t in CORRELATION_TIMES_S:
            ahead, left, yaw = (t if c == channel else own for c, own in enumerate(best.correlation_s))
            times = (ahead, left, yaw)
            if times == best.correlation_s:
                continue  # the fit with these times is the best one
            fit = _maximise(errors, [unit[own] for own in times], times)
            best = fit if fit.density > best.density else best
    return DisturbanceProcess(best.scale, best.correlation_s, errors.period_s, best.dof)


@dataclass(frozen=True, slots=True)
class _Maximum:
    """Highest mean log density for given correlation times, and where it is."""

    density: float
    scale: tuple[float, float, float]
    correlation_s: Times
    dof: float


def _maximise(errors: RolloutErrors, unit: Sequence[Tensor], times: Times) -> _Maximum:
    """Scales and degrees of freedom with the highest density.

    Args:
        errors: of the windows.
        unit: variances by a disturbance of unit scale, for the correlation time of each channel (N, 6, 3).
        times: correlation times.
    """
    responses = torch.stack([unit[c][..., c] for c in range(len(CHANNELS))], dim=-1)
    best = _Maximum(-math.inf, PULSE_SIZES, times, math.inf)
    for dof in DOF_CANDIDATES:
        density, scale = _maximise_scale(errors, responses, tail_scales(dof, TAIL_COMPONENTS).double())
        if density > best.density:
            best = _Maximum(density, scale, times, dof)
    return best


def _maximise_scale(
    errors: RolloutErrors, responses: Tensor, components: Tensor
) -> tuple[float, tuple[float, float, float]]:
    """Mean log density and scales at its maximum; the scale of a rollout is one of ``components`` (C,)."""
    log_scale = torch.zeros(len(CHANNELS), dtype=torch.float64, requires_grad=True)
    with uncompiled_optimisers():
        optimiser = torch.optim.LBFGS([log_scale], max_iter=_ITERATIONS, line_search_fn="strong_wolfe")

    def scales() -> Tensor:
        return log_scale.clamp(math.log(MIN_SCALE), math.log(MAX_SCALE)).exp()

    def loss() -> Tensor:
        variance = errors.variance + components[:, None, None] ** 2 * (responses @ scales() ** 2)
        density = log_student(errors.error**2 / variance, 1, math.inf) - 0.5 * variance.log()
        return math.log(len(components)) - torch.logsumexp(density, dim=0).mean()

    def closure() -> Tensor:
        log_scale.grad = None
        value = loss()
        value.backward()  # type: ignore[no-untyped-call]
        return value

    optimiser.step(closure)  # type: ignore[no-untyped-call]
    with torch.no_grad():
        ahead, left, yaw = scales().tolist()
        return -float(loss()), (ahead, left, yaw)
