"""Sentences about fitted parameters of the car file, and about sizes of effects that the recordings exclude."""

from __future__ import annotations

from collections.abc import Mapping

from carlab.diagnosis.findings import Diagnosis, EffectFinding, Estimate
from carlab.diagnosis.report.numbers import listed, with_unit
from carlab.diagnosis.report.residual import error_fall, is_above_noise
from carlab.diagnosis.settings import REPORT
from sim_backends.effects import EFFECTS

COMMANDS_IN_ROWS = (
    " The log may have the commands late: if its rows are poses with the newest command, a command is half a row old "
    "on average."
)


def late_commands(effect_id: str, parameters: Mapping[str, Estimate]) -> str:
    """Sentence about a delay below that of the car file: the log may have the commands late. Empty otherwise."""
    if effect_id not in EFFECTS:
        return ""
    reducing = [parameters.get(p.name) for p in EFFECTS[effect_id].parameters if p.reduces]
    early = [e for e in reducing if e is not None and e.value < 0.0]
    if not any(e.at_limit for e in early):
        return COMMANDS_IN_ROWS if early else ""
    return (
        " The delay adds up to 0 s: the log may have the commands later than they act. Correct it with carlab import "
        "--command-lag."
    )


def stated_number(effect: EffectFinding, car_file_parameters: Mapping[str, float]) -> str:
    """Sentences with the number of the car file that an effect replaces; empty without one number.

    A delay below that of the car file may be due to late commands, as for ``late_commands``.
    """
    numbers = EFFECTS[effect.id].parameters if effect.id in EFFECTS else ()
    if effect.car_file_values or len(numbers) != 1 or numbers[0].same_as not in car_file_parameters:
        return ""
    (parameter,) = numbers
    stated = car_file_parameters[parameter.same_as]
    is_early = parameter.is_delay and effect.parameters[parameter.name].value < stated
    return f" The car file states {with_unit(stated, parameter.unit)}.{COMMANDS_IN_ROWS if is_early else ''}"


def fitted_parameters(diagnosis: Diagnosis) -> str:
    """Sentences about the wrong parameters of the car file and the held-out error with fitted ones.

    If physics stays unexplained far above the noise, the fitted values are no measurements of the parameters.
    """
    which = f": {found}" if (found := wrong_parameters(diagnosis)) else ""
    if found and diagnosis.verdict == "unexplained" and is_above_noise(diagnosis, "refit"):
        which += " (these values may compensate for missing physics)"
    tail = f" With fitted parameters, {fall}." if (fall := error_fall(diagnosis, "nominal", "refit")) else ""
    return f"Parameters of the car file are wrong{which}.{tail}"


def wrong_parameters(diagnosis: Diagnosis) -> str:
    """The parameters that differ most from the car file, in standard deviations; empty without any.

    Those at the limit of their range are left out: their standard deviations are too small.
    """
    differences = {
        name: abs(e.value - diagnosis.car_file_parameters[name]) / max(e.std, 1e-12)
        for name, e in diagnosis.parameters.items()
        if name in diagnosis.car_file_parameters
        and not (e.at_limit or e.low90 <= diagnosis.car_file_parameters[name] <= e.high90)
    }
    largest = sorted(differences, key=lambda name: -differences[name])
    shown = largest[: REPORT.max_wrong_parameters]
    parts = []
    for name in shown:
        e, stated = diagnosis.parameters[name], diagnosis.car_file_parameters[name]
        parts.append(f"{name} is {with_unit(e.value, e.unit)} (car file: {with_unit(stated, e.unit)})")
    others = len(largest) - len(shown)
    if others:
        parts.append(f"{others} more {'differs' if others == 1 else 'differ'}")
    return listed(parts)


def parameters_at_limit(diagnosis: Diagnosis) -> str:
    """Parameters whose fit ended at a limit of their range, with the remedy; empty without any."""
    names = [name for name, e in diagnosis.parameters.items() if e.at_limit]
    if not names:
        return ""
    ends = "ends" if len(names) == 1 else "end"
    return f" {listed(names)} {ends} at the limit of the range in the car file; widen it and diagnose again."


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
    narrowest = sorted(found, key=lambda each: each[0])[: REPORT.max_limits]
    if not narrowest:
        return ""
    sizes = [f"{name} beyond {with_unit(_largest(e), e.unit)}" for _, name, e in narrowest]
    example = listed(sizes)
    return f" The recordings contradict larger effects (90 % intervals), for example {example}; the report lists all."


def _largest(estimate: Estimate) -> float:
    """Largest size within the 90 % interval."""
    return max(abs(estimate.low90), abs(estimate.high90))
