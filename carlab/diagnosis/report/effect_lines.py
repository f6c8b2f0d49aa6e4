"""Lines about the named effects, for the console and for ``print(report)``."""

from __future__ import annotations

import math

from carlab.diagnosis.findings import Diagnosis, EffectFinding
from carlab.diagnosis.report.numbers import percent


def effect_lines(diagnosis: Diagnosis) -> list[str]:
    """The sentence of each effect; with several effects, also how much each one lowers the error.

    With a single effect the verdict states that.
    """
    if len(diagnosis.effects) < 2:
        return [effect.sentence for effect in diagnosis.effects]
    return [f"{effect.sentence} {held_out_change(effect)}".rstrip() for effect in diagnosis.effects]


def held_out_change(effect: EffectFinding) -> str:
    """Sentence about the change of the held-out error when an effect is added last; empty if it is unknown."""
    fall = effect.evidence.held_out_error_reduction
    if not math.isfinite(fall):
        return ""
    verb = "lowers" if fall >= 0 else "raises"
    return f"Added last, the effect {verb} the error on held-out recordings by {percent(abs(fall))}."
