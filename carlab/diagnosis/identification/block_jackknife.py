"""Covariance of fitted parameters by the jackknife over blocks.

Errors of a block are dependent, so blocks count as independent, not rows. A few blocks, such as those with slides,
determine some parameters. The usual sandwich estimate (White 1980; Liang and Zeger 1986) ignores how strongly a fit
follows such blocks, and is too small. Here each block is left out by one Gauss-Newton step (the estimator CR3 of Bell
and McCaffrey 2002).
"""

from __future__ import annotations

import math

import numpy as np
from scipy import stats

from carlab.core.quantities import FloatArray


def jackknife_covariance(
    information: FloatArray, scores: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariance of n parameters, and its diagonal over that for independent errors.

    Args:
        information: (B, n, n) Gauss-Newton matrix of each block, without the prior.
        scores: (B, n) gradient of each block's loss.
        precision: (n, n) of the prior.

    Returns:
        (n, n) and (n,). The errors of a single block count as independent.
    """
    normal = information.sum(axis=0) + precision
    independent = np.asarray(np.linalg.pinv(normal), dtype=np.float64)
    count = len(information)
    if count == 1:
        return independent, np.ones(len(independent))
    pairs = zip(information, scores, strict=True)
    changes = np.array([np.linalg.lstsq(normal - own, score, rcond=None)[0] for own, score in pairs])
    covariance = (count - 1) / count * changes.T @ changes
    return covariance, np.diag(covariance) / np.maximum(np.diag(independent), 1e-30)


def interval_quantile(blocks: int, probability: float) -> float:
    """Half width of a confidence interval in standard errors that were estimated from a number of blocks.

    A quantile of Student's distribution, because few blocks estimate a standard error inaccurately; of the normal
    distribution for a single block.
    """
    return float(stats.t.ppf(0.5 * (1.0 + probability), blocks - 1 if blocks > 1 else math.inf))
