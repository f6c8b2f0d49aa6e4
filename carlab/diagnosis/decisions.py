"""Accepted and rejected effects with their statistics and thresholds: the content of ``decisions.json``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

SCHEMA = "carlab.decisions/1"


@dataclass(frozen=True, slots=True)
class Condition:
    """A comparison: ``statistic`` must be above the threshold, or below it if ``above`` is false.

    ``setting`` is the threshold's dotted name in DiagnosisSettings.
    """

    setting: str
    statistic: float
    threshold: float
    above: bool = True

    @property
    def holds(self) -> bool:
        """Whether the statistic is on the required side of the threshold."""
        return self.statistic > self.threshold if self.above else self.statistic <= self.threshold


Alternatives = tuple[tuple[Condition, ...], ...]
"""Alternative sets of conditions; an effect passes if all conditions of one set hold."""


def passes(alternatives: Alternatives) -> bool:
    """Whether all conditions of one of the alternatives hold."""
    return any(all(condition.holds for condition in conditions) for conditions in alternatives)


@dataclass(frozen=True, slots=True)
class Decision:
    """Whether an effect passed a stage: all conditions of one of the alternatives must hold.

    stage          accept (the first effect that passes is added), replace (a set of effects passes or fails together),
                   keep, support or confirm (each effect alone)
    effect         id of the effect
    alternatives   sets of conditions
    passed         decision
    step           number of effects accepted before
    """

    stage: str
    effect: str
    alternatives: Alternatives
    passed: bool
    step: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "stage": self.stage,
            "effect": self.effect,
            "step": self.step,
            "passed": self.passed,
            "alternatives": [[_condition(c) for c in conditions] for conditions in self.alternatives],
        }


def to_dict(decisions: Sequence[Decision]) -> dict[str, Any]:
    """Plain data of ``decisions.json``, in the order of the decisions."""
    return {"schema": SCHEMA, "decisions": [decision.to_dict() for decision in decisions]}


def _condition(condition: Condition) -> dict[str, Any]:
    """Plain data; an infinite statistic becomes the largest number, because JSON has no infinity."""
    statistic = condition.statistic
    if math.isnan(statistic):
        statistic = -math.inf if condition.above else math.inf
    return {
        "setting": condition.setting,
        "statistic": min(max(float(statistic), -1e300), 1e300),
        "threshold": float(condition.threshold),
        "above": condition.above,
    }
