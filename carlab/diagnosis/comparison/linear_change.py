"""Linear estimates of all candidates, from the errors of one model and their secants."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlab.core.quantities import FloatArray
from carlab.diagnosis.comparison.candidates import CandidatePoints, size_of
from carlab.diagnosis.comparison.difference import Difference, GroupErrors, difference, p_value
from carlab.diagnosis.comparison.drive_spread import spread_prior
from carlab.diagnosis.comparison.result import Tested
from carlab.diagnosis.identification.error_model import ErrorModel
from carlab.diagnosis.settings import COMPARISON

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Secants:
    """A candidate with its decorrelated secants ``of_group``, (P, S, D) in each of the two groups."""

    at: CandidatePoints
    of_group: tuple[FloatArray, FloatArray]

    def split(self, is_second: NDArray[np.bool_]) -> Secants:
        """The first group's secants as those of two groups; ``is_second`` (S,) are the windows of the second one."""
        return Secants(self.at, (self.of_group[0][:, ~is_second], self.of_group[0][:, is_second]))

    def best(
        self,
        groups: Sequence[GroupErrors],
        model: ErrorModel,
        known: Sequence[FloatArray],
    ) -> LinearChange | None:
        """The point with the largest likelihood ratio; None without a usable one.

        Args:
            groups: errors of both groups.
            model: distribution of the errors.
            known: decorrelated Jacobians (S, D) of changes of the second group that are already known.
        """
        found = []
        for k in range(len(self.at.points)):
            own = [g[k] for g in self.of_group]
            one = difference(own, groups, model, known)
            if one is not None and one.step > 0.0:
                found.append(LinearChange(self, k, one))
        return max(found, key=lambda linear: linear.difference.likelihood_ratio, default=None)


@dataclass(frozen=True, slots=True)
class LinearChange:
    """The linear estimate of a candidate along the secant of one of its points."""

    secants: Secants
    point: int
    difference: Difference

    @property
    def p_value(self) -> float:
        """P-value of no change, for this candidate alone."""
        return p_value(self.difference, self.difference.likelihood_ratio, len(self.secants.at.z0))

    def tested(self) -> Tested:
        """For the report."""
        at = self.secants.at
        z = at.z0 + self.difference.step * (at.points[self.point] - at.z0)
        values = size_of(at.candidate, z, at.z0).tolist()
        names = [short_name(f.name) for f in at.candidate.free]
        return Tested(at.candidate.id, dict(zip(names, values, strict=True)), self.difference.standard_errors)


def linear_changes(
    screened: Sequence[Secants],
    groups: Sequence[GroupErrors],
    model: ErrorModel,
    *,
    length_ratio: float = 1.0,
    known: Sequence[FloatArray] = (),
) -> list[LinearChange]:
    """Linear estimates sorted by likelihood ratio; candidates without enough information are omitted.

    Args:
        screened: candidates with their secants.
        groups: errors of both groups.
        model: distribution of the errors.
        length_ratio: length of a drive of the second group over that of a part.
        known: decorrelated Jacobians (S, D) of changes of the second group that are already known.
    """
    found = [linear for s in screened if (linear := s.best(groups, model, known)) is not None]
    prior = spread_prior([x.difference.spread for x in found])
    log.debug("spread between drives over that of blocks: %.2f (%.1f degrees of freedom)", prior.ratio, prior.dof)
    spreads = [prior.moderated(x.difference.spread, length_ratio) for x in found]
    moderated = [
        replace(x, difference=replace(x.difference, spread=spread)) for x, spread in zip(found, spreads, strict=True)
    ]
    return sorted(moderated, key=lambda x: -x.difference.likelihood_ratio)


def null_p_values(
    screened: Sequence[Secants],
    first: GroupErrors,
    parts: int,
    model: ErrorModel,
    stop: Callable[[], bool] = lambda: False,
) -> FloatArray:
    """Smallest p-values of linear estimates in comparisons within the first group.

    Random parts of the first group take the place of the second group, and all candidates are tested (Westfall and
    Young 1993, "Resampling-based multiple testing"). This accounts for the number of candidates, their correlation, and
    drives that differ more than the p-values assume.

    Args:
        screened: candidates with their secants.
        first: errors of the first group.
        parts: number of parts of the second group; at most half of the first group's are drawn.
        model: distribution of the errors.
        stop: callback; if it returns true, the comparisons so far are the result.

    Returns:
        (n,) sorted; n is at most ``COMPARISON.null_draws``. Comparisons without a usable candidate do not count.
    """
    smallest = []
    for draw in _draws(int(first.part.max()) + 1, parts, COMPARISON.null_draws):
        if stop():
            break
        is_second = np.isin(first.part, draw)
        groups = [_subset(first, ~is_second), _subset(first, is_second)]
        found = linear_changes([s.split(is_second) for s in screened], groups, model)
        if found:
            smallest.append(min(x.p_value for x in found))
    return np.sort(smallest)


def _draws(count: int, parts: int, most: int) -> list[tuple[int, ...]]:
    """Different sets of ``parts`` of ``count`` parts, at most half of them: all, or ``most`` random ones."""
    chosen = min(parts, count // 2)
    if chosen < 1:
        return []
    if math.comb(count, chosen) <= most:
        return list(itertools.combinations(range(count), chosen))
    rng = np.random.default_rng(0)
    drawn: set[tuple[int, ...]] = set()
    while len(drawn) < most:
        drawn.add(tuple(sorted(rng.choice(count, chosen, replace=False).tolist())))
    return sorted(drawn)


def _subset(group: GroupErrors, rows: NDArray[np.bool_]) -> GroupErrors:
    part: NDArray[Any] = np.unique(group.part[rows], return_inverse=True)[1]
    return GroupErrors(group.errors[rows], group.block[rows], part)


def short_name(name: str) -> str:
    """Name of an effect's parameter without the effect; a base parameter keeps its dotted name."""
    return name.rpartition(".")[2] if name.startswith("effects.") else name
