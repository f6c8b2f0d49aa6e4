"""Difference of one parameter between two groups, from the errors of one model and their secants.

Along a secant g of the errors e, the generalised least-squares step of a group is ``-sum(w g'e) / sum(w g'g)``. The
difference of the steps of both groups is the change: an error that the model has in both cancels. Its variance is that
of independent errors times a design effect: the spread of the scores of blocks (Liang and Zeger 1986), and of parts of
the first group as long as the second, over that of independent errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from carlab.core.quantities import FloatArray
from carlab.diagnosis.comparison.error_model import ErrorModel
from carlab.diagnosis.settings import ComparisonSettings
from carlab.prediction.windows import IndexArray

MIN_INFORMATION = 1.0
MIN_PART_SHARE = 0.02
"""Minimum share of the information that a part of the first group must have."""


@dataclass(frozen=True, slots=True)
class GroupErrors:
    """Decorrelated errors (S, D) of a group and the block of each window (S,)."""

    errors: FloatArray
    block: IndexArray

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(np.unique(self.block))


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference between the groups along one secant.

    step           change, as a share of the secant
    common         step of the first group
    likelihood_ratio  twice the gain in log-likelihood by the change
    information    of the first and the second group
    design_effect  variance of the step over that for independent errors
    """

    step: float
    common: float
    likelihood_ratio: float
    information: tuple[float, float]
    design_effect: float

    @property
    def standard_errors(self) -> float:
        """Size in standard errors."""
        return float(np.sqrt(max(self.likelihood_ratio, 0.0) / self.design_effect))

    @property
    def borrowed(self) -> float:
        """Variance of the difference over that of the second group's step."""
        first, second = self.information
        return 1.0 + second / first


def difference(
    secants: Sequence[FloatArray],
    groups: Sequence[GroupErrors],
    model: ErrorModel,
    settings: ComparisonSettings,
    known: Sequence[FloatArray] = (),
) -> Difference | None:
    """Difference along a secant; None if a group has no information about it.

    Args:
        secants: decorrelated change of the errors of each group (S, D).
        groups: errors of the reference model in both groups.
        model: distribution of the errors.
        settings: settings of the comparison.
        known: decorrelated Jacobians (S, D) of changes of the second group that are already known; projected out.
    """
    own = [secants[0], _without(secants[1], known, model.weights(groups[1].errors))]
    steps, informations, residuals = [], [], []
    for secant, group in zip(own, groups, strict=True):
        step = 0.0
        for _ in range(settings.weight_iterations):
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
    effect = _design_effect(informations, residuals, groups, settings)
    return Difference(change, steps[0], ratio, (first, second), effect)


def _design_effect(
    informations: Sequence[FloatArray],
    scores: Sequence[FloatArray],
    groups: Sequence[GroupErrors],
    settings: ComparisonSettings,
) -> float:
    """Spread of the scores of blocks and of long parts over the information, at least one."""
    squares = 0.0
    for score, group in zip(scores, groups, strict=True):
        sums = np.bincount(np.unique(group.block, return_inverse=True)[1], weights=score)
        squares += float((sums**2).sum()) * len(sums) / max(len(sums) - 1, 1)
    by_block = max(squares / sum(float(i.sum()) for i in informations), 1.0)
    parts = max(round(groups[0].blocks / groups[1].blocks), 1)
    if parts < 2:
        return by_block
    index = np.unique(groups[0].block, return_inverse=True)[1]
    part = index * parts // (int(index.max()) + 1)
    information = np.bincount(part, weights=informations[0])
    share = information / information.sum()
    usable = share > MIN_PART_SHARE
    expected = by_block * information * (1.0 - share)
    spread = float(np.mean((np.bincount(part, weights=scores[0]) ** 2 / np.maximum(expected, 1e-12))[usable]))
    prior, dof = settings.part_prior_dof, parts - 1
    return by_block * max((prior + dof * spread) / (prior + dof), 1.0)


def p_value(likelihood_ratio: float, design_effect: float, parameters: int, blocks: int) -> float:
    """P-value of no change by an F-test whose degrees of freedom are the blocks of the smaller group."""
    dof = max(blocks - parameters, 1)
    return float(stats.f.sf(max(likelihood_ratio, 0.0) / (design_effect * parameters), parameters, dof))


def _without(secant: FloatArray, known: Sequence[FloatArray], weight: FloatArray) -> FloatArray:
    """The secant with the span of ``known`` projected out, by weighted least squares."""
    if not known:
        return secant
    root = np.sqrt(weight)[:, None]
    basis, _ = np.linalg.qr(np.stack([(root * k).ravel() for k in known], axis=1))
    own = (root * secant).ravel()
    return np.asarray((own - basis @ (basis.T @ own)).reshape(secant.shape) / root)


__all__ = ["Difference", "GroupErrors", "difference", "p_value"]
