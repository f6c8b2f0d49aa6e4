"""Fit of changed parameters to the second group, under the error distribution of the reference model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.error_model import ErrorModel
from carlab.diagnosis.identification.fit import MAX_STEP, Fitter
from carlab.diagnosis.identification.fit_parameters import FitParameter, numbers_at
from carlab.diagnosis.settings import COMPARISON
from sim_backends.car_parameters import SimulatorConfig

DAMPINGS = (0.0, 0.1, 1.0, 10.0, 100.0)
CHANGE_DIFFERENCE_STEP = 0.3
"""Step of the Jacobian, in coordinates; for the reason see ``fit_parameters.DELAY_DIFFERENCE_STEP``."""


@dataclass(frozen=True, slots=True)
class ChangeFit:
    """Fitted parameters of the second group.

    config, free, z  simulator and parameters with their coordinates (n,)
    gain             fall of the negative log-likelihood
    loss_share       gain over the excess of the loss before
    errors           (S, D) decorrelated errors at the fit
    jacobian         (n, S, D) of the errors
    naive_covariance (n, n) of z for independent errors
    """

    config: SimulatorConfig
    free: tuple[FitParameter, ...]
    z: FloatArray
    gain: float
    loss_share: float
    errors: FloatArray
    jacobian: FloatArray
    naive_covariance: FloatArray

    @property
    def fitted(self) -> SimulatorConfig:
        """The simulator with the fitted parameters."""
        return self.config.with_values(numbers_at(self.free, self.z))


def fit_change(
    fitter: Fitter,
    config: SimulatorConfig,
    free: tuple[FitParameter, ...],
    starts: FloatArray,
    model: ErrorModel,
    offset: FloatArray,
) -> ChangeFit:
    """Fit parameters to the second group.

    Args:
        fitter: windows and scale of the second group.
        config: simulator with the candidate.
        free: its parameters.
        starts: (P, n) initial points; the first is the value of the reference model, whose loss counts as before.
        model: distribution of the errors.
        offset: (S, D) decorrelated error that both groups have along the candidate; added to the errors.
    """

    def errors_at(z: FloatArray) -> FloatArray:
        white = fitter.white(config, free, z)
        return model.decorrelated(white.reshape(*white.shape[:2], -1)) + offset

    first = errors_at(starts)
    losses = model.loss(first).sum(axis=1)
    best = int(np.argmin(losses))
    z, errors, loss, before = starts[best], first[best], float(losses[best]), float(losses[0])
    jacobian = _jacobian(errors_at, free, z)
    for _ in range(COMPARISON.iterations):
        weight = model.weights(errors)[:, None]
        normal = np.einsum("nsd,msd->nm", jacobian * weight, jacobian)
        gradient = np.einsum("nsd,sd->n", jacobian, weight * errors)
        steps = [
            np.linalg.pinv(normal + d * np.diag(np.diag(normal) + 1e-9)) @ gradient for d in DAMPINGS
        ]  # fmt: skip
        tried = z - np.clip(np.array(steps), -MAX_STEP, MAX_STEP)
        whole = errors_at(_within(free, tried))
        losses = model.loss(whole).sum(axis=1)
        best = int(np.argmin(losses))
        gain = loss - float(losses[best])
        if gain <= 0.0:
            break
        z, errors, loss = _within(free, tried)[best], whole[best], float(losses[best])
        jacobian = _jacobian(errors_at, free, z)
        if gain < COMPARISON.tolerance * loss:
            break
    weighted = jacobian * model.weights(errors)[None, :, None]
    covariance = np.asarray(np.linalg.pinv(np.einsum("nsd,msd->nm", weighted, jacobian)))
    return ChangeFit(config, free, z, before - loss, (before - loss) / max(before, 1e-9), errors, jacobian, covariance)


def _within(free: tuple[FitParameter, ...], z: FloatArray) -> FloatArray:
    """Coordinates (P, n) moved into the bounds."""
    return np.array([[f.coordinate(float(f.value(np.array(v)))) for f, v in zip(free, row, strict=True)] for row in z])


def _jacobian(
    errors_at: Callable[[FloatArray], FloatArray], free: tuple[FitParameter, ...], z: FloatArray
) -> FloatArray:
    """Jacobian (n, S, D) by differences over ``CHANGE_DIFFERENCE_STEP`` to both sides, less at a bound."""
    step = CHANGE_DIFFERENCE_STEP * np.eye(len(z))
    ahead, behind = _within(free, z + step), _within(free, z - step)
    width = np.diag(ahead - behind)
    return np.asarray((errors_at(ahead) - errors_at(behind)) / np.where(width > 0.0, width, 1.0)[:, None, None])
