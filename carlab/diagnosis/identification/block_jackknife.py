"""Covariance of fitted parameters, and standard errors of gains, by blocks of the recording.

Errors of a block are dependent, so blocks count as independent, not rows. A few blocks, such as those with slides,
determine some parameters. The usual sandwich estimate (White 1980; Liang and Zeger 1986) ignores how strongly a fit
follows such blocks, and is too small. The jackknife leaves each block out by one Gauss-Newton step (the estimator CR3
of Bell and McCaffrey 2002).

Standard errors come from the jackknife. The tests of a search divide gains by design effects of the sandwich estimate,
with which their limits were chosen (docs/decisions/0037).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from carlab.core.quantities import FloatArray
from carlab.prediction.windows import PredictionWindows


def jackknife_covariance(information: FloatArray, scores: FloatArray, precision: FloatArray) -> FloatArray:
    """Covariance (n, n) of n parameters; that for independent errors if there is a single block.

    Args:
        information: (B, n, n) Gauss-Newton matrix of each block, without the prior.
        scores: (B, n) gradient of each block's loss.
        precision: (n, n) of the prior.
    """
    normal = information.sum(axis=0) + precision
    count = len(information)
    if count == 1:
        return np.asarray(np.linalg.pinv(normal), dtype=np.float64)
    of_blocks = zip(information, scores, strict=True)
    changes = np.array([np.linalg.lstsq(normal - matrix, score, rcond=None)[0] for matrix, score in of_blocks])
    return np.asarray((count - 1) / count * changes.T @ changes)


def covariance_within_bounds(
    information: FloatArray, scores: FloatArray, precision: FloatArray, held: NDArray[np.bool_]
) -> FloatArray:
    """``jackknife_covariance`` of the parameters that no bound holds, for fixed values of the ``held`` ones (n,).

    A held parameter has the variance that it would have without its bound, and no covariance.
    """
    covariance = np.diag(np.where(held, np.diag(jackknife_covariance(information, scores, precision)), 0.0))
    free = np.ix_(~held, ~held)
    if not held.all():
        covariance[free] = jackknife_covariance(information[:, ~held][:, :, ~held], scores[:, ~held], precision[free])
    return covariance


def sandwich_design_effects(information: FloatArray, scores: FloatArray, precision: FloatArray) -> FloatArray:
    """Variance (n,) by the sandwich estimate over that for independent errors.

    Arguments as for ``jackknife_covariance``.
    """
    independent = np.linalg.pinv(information.sum(axis=0) + precision)
    count = len(information)
    changes = scores @ independent
    variance = count / max(count - 1, 1) * (changes**2).sum(axis=0)
    return np.asarray(variance / np.maximum(np.diag(independent), 1e-30))


def clustered_gain(before: FloatArray, after: FloatArray, windows: PredictionWindows) -> tuple[float, float]:
    """Fall of the loss from ``before`` to ``after`` (S,) and its standard error, clustered by block."""
    gain = before - after
    blocks, index = np.unique(windows.block, return_inverse=True)
    sums = np.bincount(index, weights=gain, minlength=len(blocks))
    error = math.sqrt(len(blocks)) * float(sums.std(ddof=1)) if len(blocks) > 1 else math.inf
    return float(gain.sum()), max(error, 1e-9)


def interval_quantile(blocks: int, probability: float) -> float:
    """Half width of a confidence interval in standard errors that were estimated from a number of blocks.

    A quantile of Student's distribution, because few blocks estimate a standard error inaccurately; of the normal
    distribution for a single block.
    """
    return float(stats.t.ppf(0.5 * (1.0 + probability), blocks - 1 if blocks > 1 else math.inf))
