"""Lines about the named effects, for the console and for ``print(report)``."""

from __future__ import annotations

import math

from carlab.diagnosis.findings import Diagnosis, EffectFinding
from carlab.diagnosis.report.numbers import percent
from carlab.diagnosis.settings import REPORT


def effect_lines(diagnosis: Diagnosis) -> list[str]:
    """The sentence of each effect, and whether its name is uncertain.

    With several effects, also how much each one lowers the error; with a single effect the verdict states that.
    """
    are_several = len(diagnosis.effects) > 1
    lines = ((e.sentence, held_out_change(e) if are_several else "", _uncertainty(e)) for e in diagnosis.effects)
    return [" ".join(filter(None, parts)) for parts in lines]


def _uncertainty(effect: EffectFinding) -> str:
    """That the name is uncertain; empty for a set, which the verdict states, and for a probable name."""
    if effect.indistinguishable_from or effect.confidence >= REPORT.uncertain_probability:
        return ""
    return f"The name is uncertain (probability {percent(effect.confidence)})."


def held_out_change(effect: EffectFinding) -> str:
    """Sentence about the change of the held-out error when an effect is added last; empty if it is unknown."""
    fall = effect.evidence.held_out_error_reduction
    if not math.isfinite(fall):
        return ""
    verb = "lowers" if fall >= 0 else "raises"
    return f"Added last, the effect {verb} the error on held-out recordings by {percent(abs(fall))}."
