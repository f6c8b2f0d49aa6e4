"""Effects that the search accepted and that a later test withdrew, with the reasons for the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from carlab.diagnosis.decisions import Decision
from carlab.diagnosis.findings import Withdrawal

REASONS: Mapping[str, str] = {
    "selection.supported_z_min": "its gain on left-out blocks is not significant with decorrelated errors",
    "selection.min_practical_size": "it changes the predictions by a small part of the remaining error",
    "selection.min_held_out_rise": "the error on held-out recordings does not fall",
    "evidence.identity_distance_min": "its parameters do not differ significantly from those without the effect",
    "evidence.range_ratio_min": "the interval of its parameter reaches the end of the range",
    "rivals.curve_z_min": "the loss on left-out blocks is lower with a measured curve in its place",
    "rivals.min_explained_share": "it explains too small a share of the error",
    "rivals.min_unnamed_share": "physics outside the catalogue explains much of the error",
    "rivals.unnamed_ratio": "physics outside the catalogue explains more of the error in its place",
}
"""Reason of a failed test, by the first setting of its conditions."""
REPLACED = REASONS["rivals.unnamed_ratio"]
UNCONFIRMED = "a later test does not confirm it"
TESTS_OF_ACCEPTED = ("support", "confirm")
"""Stages of decisions about accepted effects, after the search."""


def withdrawn_effects(
    decisions: Sequence[Decision], accepted: Sequence[str], remaining: Sequence[str]
) -> tuple[Withdrawal, ...]:
    """The accepted effects that do not remain, each with the reason of its last failed test.

    Args:
        decisions: all decisions of the diagnosis, in their order.
        accepted: effects that the search accepted.
        remaining: effects after all tests, and those that are indistinguishable from them: these may be the cause.
    """
    failed = {d.effect: d for d in decisions if d.stage in TESTS_OF_ACCEPTED and not d.passed}
    withdrawn = (name for name in accepted if name not in remaining)
    return tuple(Withdrawal(name, _reason(failed[name]) if name in failed else REPLACED) for name in withdrawn)


def _reason(decision: Decision) -> str:
    """The reason by the first set of conditions; all sets fail."""
    failed = [c.setting for conditions in decision.alternatives for c in conditions if not c.holds]
    return REASONS.get(failed[0], UNCONFIRMED) if failed else UNCONFIRMED
