"""Difference of one parameter between two groups, from the errors of one model and their secants.

Along a secant g of the errors e, the generalised least-squares step of a group is ``-sum(w g'e) / sum(w g'g)``. The
difference of the steps of both groups is the change: an error that the model has in both cancels. Its variance is that
of independent errors times a design effect: the spread of the scores of blocks over that of independent errors (Liang
and Zeger 1986), times the spread of drives over that of blocks (``drive_spread``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from carlab.core.quantities import FloatArray
from carlab.diagnosis.comparison.drive_spread import DriveSpread, spread_of_parts
from carlab.diagnosis.identification.error_model import ErrorModel
from carlab.diagnosis.settings import COMPARISON
from carlab.prediction.windows import IndexArray

MIN_INFORMATION = 1.0
"""Minimum information of a group along a secant: the reciprocal variance of its step."""


@dataclass(frozen=True, slots=True)
class GroupErrors:
    """Decorrelated errors (S, D) of a group, and the block and the part of each window (S,)."""

    errors: FloatArray
    block: IndexArray
    part: IndexArray


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference between the groups along one secant.

    step           change, as a share of the secant
    common         step of the first group
    likelihood_ratio  twice the gain in log-likelihood by the change
    information    of the first and the second group
    block_effect   variance of the step for independent blocks over that for independent errors
    spread         variance of parts of a drive over that for independent blocks
    dof            degrees of freedom of the variance for independent blocks (Welch 1947)
    """

    step: float
    common: float
    likelihood_ratio: float
    information: tuple[float, float]
    block_effect: float
    spread: DriveSpread
    dof: float

    @property
    def design_effect(self) -> float:
        """Variance of the step over that for independent errors."""
        return self.block_effect * self.spread.ratio

    @property
    def standard_errors(self) -> float:
        """Size in standard errors."""
        return float(np.sqrt(max(self.likelihood_ratio, 0.0) / self.design_effect))

    @property
    def variance_ratio(self) -> float:
        """Variance of the difference over that of the second group's step."""
        first, second = self.information
        return 1.0 + second / first


def difference(
    secants: Sequence[FloatArray],
    groups: Sequence[GroupErrors],
    model: ErrorModel,
    known: Sequence[FloatArray] = (),
) -> Difference | None:
    """Difference along a secant; None if a group has too little information about it.

    Args:
        secants: decorrelated change of the errors of each group (S, D).
        groups: errors of the reference model in both groups.
        model: distribution of the errors.
        known: decorrelated Jacobians (S, D) of changes of the second group that are already known; projected out.
    """
    own = [secants[0], _without(secants[1], known, model.weights(groups[1].errors))]
    steps, informations, residuals = [], [], []
    for secant, group in zip(own, groups, strict=True):
        step = 0.0
        for _ in range(COMPARISON.weight_iterations):
            weight = model.weights(group.errors + step * secant)
            information = weight * (secant**2).sum(axis=1)
            if information.sum() < MIN_INFORMATION:
                return None
            step = float(-(weight * (secant * group.errors).sum(axis=1)).sum() / information.sum())
        score = -weight * (secant * (group.errors + step * secant)).sum(axis=1)
        steps.append(step)
        informations.append(information)
        residuals.append(score)
    first, second = (float(i.sum()) for i in informations)
    change = steps[1] - steps[0]
    ratio = change**2 * first * second / (first + second)
    of_block = [_of_blocks(i, group) for i, group in zip(informations, groups, strict=True)]
    numbers = [_effective_number(own) for own in of_block]
    if min(numbers) < COMPARISON.min_effective_blocks:
        return None
    effects = [_block_effect(i, score, group) for i, score, group in zip(informations, residuals, groups, strict=True)]
    variances = [effect / information for effect, information in zip(effects, (first, second), strict=True)]
    by_block = sum(variances) / (1.0 / first + 1.0 / second)
    dof = sum(variances) ** 2 / sum(v**2 / (number - 1.0) for v, number in zip(variances, numbers, strict=True))
    spread = spread_of_parts(informations, residuals, [group.part for group in groups], effects)
    return None if spread is None else Difference(change, steps[0], ratio, (first, second), by_block, spread, dof)


def _of_blocks(values: FloatArray, group: GroupErrors) -> FloatArray:
    """Sum of the values of windows (S,) in each block."""
    return np.asarray(np.bincount(np.unique(group.block, return_inverse=True)[1], weights=values))


def _effective_number(information: FloatArray) -> float:
    """Effective number of blocks that contribute information (Carter, Schnepel and Steigerwald 2017)."""
    return float(information.sum() ** 2 / (information**2).sum())


def _block_effect(information: FloatArray, score: FloatArray, group: GroupErrors) -> float:
    """Spread of the scores of a group's blocks over its information, at least one."""
    sums = _of_blocks(score, group)
    return max(float((sums**2).sum()) * len(sums) / max(len(sums) - 1, 1) / float(information.sum()), 1.0)


def p_value(difference: Difference, likelihood_ratio: float, parameters: int) -> float:
    """P-value of no change by an F-test with the design effect and the degrees of freedom of a difference."""
    dof = max(min(difference.dof - (parameters - 1), difference.spread.dof), 1.0)
    return float(stats.f.sf(max(likelihood_ratio, 0.0) / (difference.design_effect * parameters), parameters, dof))


def _without(secant: FloatArray, known: Sequence[FloatArray], weight: FloatArray) -> FloatArray:
    """The secant with the span of ``known`` projected out, by weighted least squares."""
    if not known:
        return secant
    root = np.sqrt(weight)[:, None]
    basis, _ = np.linalg.qr(np.stack([(root * k).ravel() for k in known], axis=1))
    own = (root * secant).ravel()
    return np.asarray((own - basis @ (basis.T @ own)).reshape(secant.shape) / root)
