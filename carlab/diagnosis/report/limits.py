"""Sentence about the sizes of effects that recordings without missing physics exclude."""

from __future__ import annotations

from carlab.diagnosis.findings import Diagnosis, Estimate
from carlab.diagnosis.report.numbers import listed, with_unit
from carlab.diagnosis.settings import DEFAULT
from sim_backends.effects import EFFECTS


def excluded_sizes(diagnosis: Diagnosis) -> str:
    """The narrowest limits, in typical sizes of the effects; empty without any.

    Only effects that the car file does not state, with a single parameter, which is 0 without the effect. An interval
    beyond the range of the parameter is an error of the model.
    """
    found = []
    for effect, own in diagnosis.limits.items():
        parameter = EFFECTS[effect].parameters[0]
        is_stated = f"effects.{effect}.{parameter.name}" in diagnosis.car_file_parameters
        if len(own) > 1 or parameter.identity != 0.0 or is_stated or own[parameter.name].at_limit:
            continue
        estimate = own[parameter.name]
        found.append((_largest(estimate) / abs(parameter.typical), EFFECTS[effect].name, estimate))
    narrowest = sorted(found, key=lambda each: each[0])[: DEFAULT.report.max_limits]
    if not narrowest:
        return ""
    sizes = [f"{name} beyond {with_unit(_largest(e), e.unit)}" for _, name, e in narrowest]
    example = listed(sizes)
    return f" The recordings contradict larger effects (90 % intervals), for example {example}; the report lists all."


def _largest(estimate: Estimate) -> float:
    """Largest size within the 90 % interval."""
    return max(abs(estimate.low90), abs(estimate.high90))
