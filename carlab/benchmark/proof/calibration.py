"""Rates of false and missed names over a range of each decision threshold, from the decisions of finished runs.

A diagnosis records each decision about an effect with its statistics and thresholds (``decisions.json``). One threshold
is varied, the others are fixed, and the recorded decisions are repeated. Later decisions of a run are repeated as
recorded, even if an earlier decision changes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

FACTORS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 4.0)
"""Multiples of a threshold at which the decisions are repeated."""
SCHEMA = "carlab.decisions/1"
FORMER_SETTINGS = {
    "selection.accept_unseen_share": "selection.accept_left_out_share",
    "selection.accept_unseen_ratio": "selection.accept_left_out_ratio",
    "selection.steady_unseen_share": "selection.steady_left_out_share",
    "selection.better_rival_z": "selection.replace_z_min",
}
"""Present names of settings, by the names in files of earlier versions."""
COLUMNS = ("threshold", "value", "false names", "missed names")


@dataclass(frozen=True)
class Rates:
    """Outcome of the decisions that use one setting, at one value of it.

    Names that a wrong base model implies are neither false nor missed.

    false_names          accepted names that are not concealed
    false_opportunities  decisions in which such a name may be accepted
    missed_names         decisions in which a concealed name may be accepted, but no name is
    true_opportunities   decisions in which a concealed name may be accepted
    """

    setting: str
    value: float
    is_present_value: bool
    false_names: int
    false_opportunities: int
    missed_names: int
    true_opportunities: int

    def row(self) -> list[str]:
        """Cells of the table; the present value is marked with an asterisk."""
        value = f"{self.value:.4g}{' *' if self.is_present_value else ''}"
        false = _rate(self.false_names, self.false_opportunities)
        return [self.setting, value, false, _rate(self.missed_names, self.true_opportunities)]


def calibrate(answers: Mapping[str, Any], decisions: Mapping[str, Mapping[str, Any]]) -> list[Rates]:
    """Repeat the decisions of every case at several values of each threshold.

    Args:
        answers: opened answers by name of the case.
        decisions: content of ``decisions.json``, by name of the case.

    Returns:
        Rates by setting, in the order of the values.
    """
    cases = [
        (
            {effect["id"] for effect in answers[name]["effects"]},
            set(answers[name].get("implied_effects", ())),
            _with_present_settings(content["decisions"]),
        )
        for name, content in sorted(decisions.items())
        if content.get("schema") == SCHEMA
    ]
    present = {
        condition["setting"]: float(condition["threshold"]) for *_, made in cases for condition in _conditions(made)
    }
    return [
        _rates(cases, setting, factor * threshold, factor == 1.0)
        for setting, threshold in sorted(present.items())
        for factor in FACTORS
    ]


def _with_present_settings(decisions: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The decisions with the present names of their settings."""
    return [
        {
            **decision,
            "alternatives": [
                [{**c, "setting": FORMER_SETTINGS.get(c["setting"], c["setting"])} for c in conditions]
                for conditions in decision["alternatives"]
            ],
        }
        for decision in decisions
    ]


def _conditions(decisions: Iterable[Mapping[str, Any]]) -> Iterable[Mapping[str, Any]]:
    return (c for decision in decisions for conditions in decision["alternatives"] for c in conditions)


def _rates(
    cases: Sequence[tuple[set[str], set[str], list[dict[str, Any]]]], setting: str, value: float, is_present_value: bool
) -> Rates:
    false_names = false_opportunities = missed_names = true_opportunities = 0
    for concealed, implied, made in cases:
        for key, group in groupby(made, key=lambda d: (d["stage"], d["step"])):
            decided = list(group)
            if not any(c["setting"] == setting for c in _conditions(decided)):
                continue
            steps = [decided] if key[0] == "accept" else [[decision] for decision in decided]
            for step in steps:
                has_true = any(d["effect"] in concealed for d in step)
                has_wrong = any(d["effect"] not in concealed | implied for d in step)
                accepted = next((d["effect"] for d in step if passes(d, setting, value)), None)
                false_opportunities += has_wrong
                true_opportunities += has_true
                false_names += accepted is not None and accepted not in concealed | implied
                missed_names += has_true and accepted is None
    counts = false_names, false_opportunities, missed_names, true_opportunities
    return Rates(setting, value, is_present_value, *counts)


def passes(decision: Mapping[str, Any], setting: str, value: float) -> bool:
    """Whether the name passes with ``setting`` at ``value``: all conditions of one alternative hold."""

    def holds(condition: Mapping[str, Any]) -> bool:
        threshold = value if condition["setting"] == setting else condition["threshold"]
        above = condition["statistic"] > threshold
        return bool(above if condition["above"] else not above)

    return any(all(holds(c) for c in conditions) for conditions in decision["alternatives"])


def _rate(count: int, of: int) -> str:
    return f"{count / of:.3f} ({count} of {of})" if of else "none"
