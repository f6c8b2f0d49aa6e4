"""Spread of a parameter between drives, beyond that between blocks of a few seconds.

A car and its floor change from drive to drive, and a wrong model needs other parameters for another drive. So the
variance of a parameter between drives exceeds that of independent blocks. Each group is cut into parts as long as a
drive of the second group. The ratio of both variances is estimated for each candidate, and moderated by the estimates
of all candidates, because there are few parts (Smyth 2004, "Linear models and empirical Bayes methods for assessing
differential expression"). Candidates of one car are correlated, so the prior has at most ``max_prior_ratio`` times the
degrees of freedom of a candidate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import digamma, polygamma

from carlab.core.quantities import FloatArray
from carlab.diagnosis.settings import COMPARISON
from carlab.prediction.windows import IndexArray, PredictionWindows

MAX_PRIOR_DOF = 1e4
MIN_SPREAD = 1e-3


@dataclass(frozen=True, slots=True)
class DriveSpread:
    """Ratio of the variance between parts to that of independent blocks, and its degrees of freedom."""

    ratio: float
    dof: float


@dataclass(frozen=True, slots=True)
class SpreadPrior:
    """Scaled inverse chi-squared distribution of the ratio over candidates."""

    ratio: float
    dof: float

    def moderated(self, spread: DriveSpread, length_ratio: float) -> DriveSpread:
        """Reciprocal of the posterior mean precision for drives ``length_ratio`` times as long as parts; at least 1."""
        prior_dof = min(self.dof, COMPARISON.max_prior_ratio * spread.dof)
        dof = prior_dof + spread.dof
        ratio = (prior_dof * self.ratio + spread.dof * spread.ratio) / dof
        return DriveSpread(1.0 + max(ratio - 1.0, 0.0) * max(length_ratio, 1.0), dof)


def part_blocks(groups: Sequence[PredictionWindows]) -> int:
    """Length of a part in blocks: the longest drive of the second group, or less if the first group is short."""
    first, second = groups
    most = len(np.unique(first.block)) // COMPARISON.min_parts
    return max(min(longest_drive_blocks(second), most), COMPARISON.min_part_blocks)


def longest_drive_blocks(windows: PredictionWindows) -> int:
    """Number of blocks of the longest drive."""
    return max(len(np.unique(windows.block[windows.recording == r])) for r in np.unique(windows.recording))


def parts_of(windows: PredictionWindows, length_blocks: int) -> IndexArray:
    """Index (S,) of the part of each window; a part lies in one drive and has about ``length_blocks`` blocks."""
    part, count = np.zeros(len(windows), dtype=np.int64), 0
    for recording in np.unique(windows.recording):
        rows = windows.recording == recording
        blocks, index = np.unique(windows.block[rows], return_inverse=True)
        pieces = max(round(len(blocks) / length_blocks), 1)
        part[rows] = count + index * pieces // len(blocks)
        count += pieces
    return part


def spread_of_parts(
    informations: Sequence[FloatArray],
    scores: Sequence[FloatArray],
    parts: Sequence[IndexArray],
    block_effects: Sequence[float],
) -> DriveSpread | None:
    """Spread of the scores of parts over that expected of independent blocks; None without two parts in any group.

    Args:
        informations: of each window (S,) of each group.
        scores: derivatives of the loss of each window (S,) at the step of its group.
        parts: index of the part of each window (S,).
        block_effects: variance for independent blocks over that for independent errors, of each group.
    """
    ratios, dof = [], 0
    for information, score, part, effect in zip(informations, scores, parts, block_effects, strict=True):
        of_part = np.bincount(part, weights=information)
        share = of_part / of_part.sum()
        usable = share > COMPARISON.min_part_share
        if usable.sum() > 1:
            expected = effect * of_part * (1.0 - share)
            ratios += list((np.bincount(part, weights=score) ** 2 / np.maximum(expected, 1e-12))[usable])
            dof += int(usable.sum()) - 1
    return DriveSpread(float(np.mean(ratios)), float(dof)) if dof else None


def spread_prior(spreads: Sequence[DriveSpread]) -> SpreadPrior:
    """Prior of the ratio from the estimates of all candidates, by the moments of their logarithms."""
    if len(spreads) < 3:
        return SpreadPrior(1.0, 0.0)
    dof = np.array([s.dof for s in spreads])
    logs = np.log([max(s.ratio, MIN_SPREAD) for s in spreads]) - digamma(dof / 2.0) + np.log(dof / 2.0)
    prior_dof = 2.0 * _inverse_trigamma(float(np.var(logs, ddof=1) - np.mean(polygamma(1, dof / 2.0))))
    ratio = math.exp(float(np.mean(logs)) + float(digamma(prior_dof / 2.0)) - math.log(prior_dof / 2.0))
    return SpreadPrior(max(ratio, 1.0), prior_dof)


def _inverse_trigamma(value: float) -> float:
    """Argument x with polygamma(1, x) = value; ``MAX_PRIOR_DOF`` / 2 if the value is not above that at it."""
    largest = MAX_PRIOR_DOF / 2.0
    if value <= polygamma(1, largest):
        return largest
    return float(brentq(lambda x: float(polygamma(1, x)) - value, 1e-6, largest))
