"""Lines about the named effects, for the console and for ``print(report)``."""

from __future__ import annotations

import math

from carlab.diagnosis.findings import Diagnosis, EffectFinding
from carlab.diagnosis.report.numbers import percent
from carlab.diagnosis.settings import REPORT
from sim_backends.effects import EFFECTS


def effect_lines(diagnosis: Diagnosis) -> list[str]:
    """The sentence of each effect, and whether its name or the effect itself is uncertain.

    With several effects, also how much each one lowers the error; with a single effect the verdict states that.
    """
    are_several = len(diagnosis.effects) > 1
    lines = ((e.sentence, held_out_change(e) if are_several else "", _uncertainty(e)) for e in diagnosis.effects)
    return [" ".join(filter(None, parts)) for parts in lines]


def _uncertainty(effect: EffectFinding) -> str:
    """That a name or all names of a set are improbable, or that the effect may be absent; else empty."""
    count = 1 + len(effect.indistinguishable_from)
    probability = count * effect.confidence  # a set shares the probability that its effect is correct
    sentences = []
    if probability < REPORT.uncertain_probability and count == 1:
        sentences.append(f"The name is uncertain (probability {percent(probability)}).")
    elif probability < REPORT.uncertain_probability:
        sentences.append(f"Probably none of these names is correct (probability of one: {percent(probability)}).")
    if _may_be_absent(effect):
        sentences.append("Its 90 % interval includes the value without the effect.")
    return " ".join(sentences)


def _may_be_absent(effect: EffectFinding) -> bool:
    """Whether the interval of each number contains its identity; False for an effect of the car file or at a place."""
    if effect.car_file_values or effect.id not in EFFECTS or EFFECTS[effect.id].disc_parameters:
        return False
    numbers = [(p.identity, effect.parameters[p.name]) for p in EFFECTS[effect.id].parameters if not p.choices]
    return all(identity is not None and e.low90 <= identity <= e.high90 for identity, e in numbers)


def held_out_change(effect: EffectFinding) -> str:
    """Sentence about the change of the held-out error when an effect is added last; empty if it is unknown."""
    fall = effect.evidence.held_out_error_reduction
    if not math.isfinite(fall):
        return ""
    verb = "lowers" if fall >= 0 else "raises"
    return f"Added last, the effect {verb} the error on held-out recordings by {percent(abs(fall))}."
