"""Sentences of a report: each effect, the verdict, the test that would refute it, and the next drive.

The sentences state the uncertainty: indistinguishable effects, and intervals that contain zero.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

from carlab.diagnosis.findings import Diagnosis, EffectFinding, Estimate
from carlab.diagnosis.report.drift import drift_sentence, has_changed
from carlab.diagnosis.report.numbers import listed, number, unit_text, with_unit
from carlab.diagnosis.report.parameters import excluded_sizes, fitted_parameters, late_commands, parameters_at_limit
from carlab.diagnosis.report.recording_causes import has_slow_poses, limited_channels, recording_causes
from carlab.diagnosis.report.residual import (
    agrees_when_fitted,
    difference_when_held_out,
    differs_when_held_out,
    error_fall,
    explained_share,
    explanation,
    is_above_noise,
    relevant_residual,
    remainder,
)
from carlab.diagnosis.report.search_extent import search_sentences
from carlab.diagnosis.settings import EVIDENCE, REPORT
from sim_backends.effects import EFFECTS, Confusable, separation
from sim_backends.registry import REGISTRY

CHANNEL_NAMES = {
    "x": "longitudinal position",
    "y": "lateral position",
    "yaw": "heading",
    "vx": "longitudinal velocity",
    "vy": "lateral velocity",
    "yaw_rate": "yaw rate",
}
AT_90 = " at 90 %"
COUNTED = {1: "one effect", 2: "two effects", 3: "three effects", 4: "four effects"}
VERDICT_TITLES = {
    "mismatch": "Missing physics is found and named",
    "parameters": "Parameters of the car file are wrong",
    "none": "No missing physics is found",
    "data": "The recording is faulty",
    "unexplained": "Physics outside the catalogue is missing",
    "inconclusive": "The recordings are not sufficient",
}


class _Filled:
    """An estimate in the sentence template of an effect (``Effect.sentence``).

    ``{p}`` is the number with unit and interval, ``{p:size}`` its magnitude (with ``{p:left|right}`` for the sign),
    ``{p:percent}`` and ``{p:size percent}`` the same in per cent, ``{p:each minute}`` a rate [1/s] in per cent per
    minute, ``{p:choice a|b}`` a word for a choice, ``{p:place}`` a coordinate, whose sign means nothing.
    """

    def __init__(self, estimate: Estimate | None) -> None:
        self._estimate = estimate

    def __format__(self, spec: str) -> str:
        e = self._estimate
        if spec.startswith("choice "):
            options = spec.removeprefix("choice ").split("|")
            index = 0 if e is None or not math.isfinite(e.value) else round(e.value)
            return options[min(max(index, 0), len(options) - 1)]
        if e is None:
            return "" if "|" in spec else "an unknown amount"
        if "|" in spec:
            positive, negative = spec.split("|")
            return positive if e.value >= 0.0 else negative
        value, low, high = e.value, e.low90, e.high90
        if "size" in spec and value < 0.0:
            value, low, high = -value, -high, -low
        factor, unit = 1.0, unit_text(e.unit)
        if "percent" in spec:
            factor, unit = 100.0, "%"
        if "each minute" in spec:
            factor, unit = 6000.0, "% of its first value each minute"
        return f"{_scaled(value, factor, unit)}{_interval(low, high, factor, e.at_limit, spec != 'place')}"


def _scaled(value: float, factor: float, unit: str) -> str:
    return f"{number(value * factor)} {unit}".strip() if math.isfinite(value) else number(value)


def _interval(low: float, high: float, factor: float, at_limit: bool, has_sign: bool = True) -> str:
    if not (math.isfinite(low) and math.isfinite(high)):
        return " (interval unknown)" if math.isnan(low) or math.isnan(high) else " (open interval at 90 %)"
    if at_limit and low == high:  # beyond a bound a fit has no information about the number
        return " (at the limit of its range; interval unknown)"
    notes = "; its sign is not certain" if has_sign and low < 0.0 < high else ""
    notes += "; at the limit of its range" if at_limit else ""
    return f" ({number(low * factor)} to {number(high * factor)}{AT_90}{notes})"


class _Fields(dict[str, _Filled]):
    def __missing__(self, key: str) -> _Filled:
        return _Filled(None)


def effect_noun(effect_id: str) -> str:
    """Name of an effect: ``a lag of the steering servo``; for an unknown id, the id with spaces."""
    effect = EFFECTS.get(effect_id)
    return effect.name if effect is not None and effect.name else effect_id.replace("_", " ")


def effect_sentence(
    effect_id: str, parameters: Mapping[str, Estimate], car_file_values: Mapping[str, float] | None = None
) -> str:
    """Sentence of an effect with values, units and 90 % intervals: ``Left out: the servo lags by 0.11 s ...``.

    For an effect that the car file states: ``Wrong in the car file: a lag ...: time_constant is 0.11 s, not 0.05 s``.
    """
    if car_file_values:
        return _wrong_numbers(effect_id, parameters, car_file_values)
    effect = EFFECTS.get(effect_id)
    if effect is None or not effect.sentence:
        numbers = ", ".join(f"{name} {_Filled(e)}" for name, e in parameters.items())
        return f"Left out: {effect_noun(effect_id)}" + (f", with {numbers}." if numbers else ".")
    fields = _Fields({name: _Filled(e) for name, e in parameters.items()})
    filled = re.sub(r"\s+", " ", effect.sentence.format_map(fields))
    head, level, tail = filled.partition(AT_90)  # only the first interval states the level
    return f"Left out: {head}{level}{tail.replace(AT_90, '')}.{late_commands(effect_id, parameters)}"


def _wrong_numbers(effect_id: str, parameters: Mapping[str, Estimate], car_file_values: Mapping[str, float]) -> str:
    """Sentence of an effect that the car file states with other values."""
    found = []
    for name, e in parameters.items():
        stated, unit = car_file_values[name], unit_text(e.unit)
        choices = REGISTRY[f"effects.{effect_id}.{name}"].choices
        if choices and round(e.value) != round(stated):
            found.append(f"{name} is {choices[round(e.value)]}, not {choices[round(stated)]}")
        elif not choices:
            interval = _interval(e.low90, e.high90, 1.0, e.at_limit)
            found.append(f"{name} is {_scaled(e.value, 1.0, unit)}{interval}, not {_scaled(stated, 1.0, unit)}")
    head, level, tail = listed(found).partition(AT_90)
    return f"Wrong in the car file: {effect_noun(effect_id)}: {head}{level}{tail.replace(AT_90, '')}."


def withdrawal_sentences(diagnosis: Diagnosis) -> list[str]:
    """A sentence for each effect that the search accepted and a later test withdrew."""
    return [f"Withdrawn: {effect_noun(effect.id)}, because {effect.reason}." for effect in diagnosis.withdrawn]


def refutation_sentence(effect_id: str) -> str:
    """The observation that would refute an effect."""
    effect = EFFECTS.get(effect_id)
    if effect is None or not effect.refuted_if:
        return "This would be wrong if a fit to another recording gave the effect other parameters."
    return f"This would be wrong if {effect.refuted_if}."


def _separations(effect_id: str, others: Sequence[str]) -> list[Confusable]:
    """Drives and reasons that separate the pairs of a set, pairs with ``effect_id`` first."""
    names = [effect_id, *others]
    pairs = [(effect_id, other) for other in others]
    pairs += [(a, b) for k, a in enumerate(names[1:]) for b in names[k + 2 :]]
    return [found for a, b in pairs if (found := separation(a, b)) is not None]


def separating_drive(effect_id: str, others: Sequence[str]) -> str:
    """Name of the manoeuvre that separates the most pairs of a set of confusable effects; empty if none does."""
    drives = [found.drive for found in _separations(effect_id, others) if found.drive]
    return max(drives, key=drives.count) if drives else ""


def separating_reason(effect_id: str, others: Sequence[str]) -> str:
    """Why the manoeuvre of ``separating_drive`` separates a set, or what to do if no manoeuvre does."""
    drive, found = separating_drive(effect_id, others), _separations(effect_id, others)
    reasons = [entry.reason for entry in found if entry.drive == drive and entry.reason]
    if drive:
        text = "; ".join(dict.fromkeys(reasons))
        return text[0].upper() + text[1:] + "."
    if reasons:
        return reasons[0]
    return "No known manoeuvre separates them. Another kind of recording is needed."


def verdict_title(diagnosis: Diagnosis) -> str:
    """Title of the verdict."""
    if diagnosis.effects and all(effect.indistinguishable_from for effect in diagnosis.effects):
        return "Missing physics is found, with more than one possible name"
    if diagnosis.effects and all(effect.car_file_values for effect in diagnosis.effects):
        return "Effects of the car file have wrong numbers"
    if differs_when_held_out(diagnosis):
        return "The held-out recordings differ from the fitted ones"
    if diagnosis.verdict == "unexplained" and not diagnosis.search.covers_catalogue:
        return "Missing physics is found, but not named"
    return VERDICT_TITLES[diagnosis.verdict]


def confidence_text(confidence: float, n_indistinguishable: int = 0) -> str:
    """A confidence in words; ``n_indistinguishable`` is the number of other effects that may be the cause."""
    if n_indistinguishable:
        return f"one of {n_indistinguishable + 1} indistinguishable effects"
    levels = ((0.98, "almost certain"), (0.9, "very likely"), (0.7, "likely"), (0.5, "more likely than not"))
    return next((text for level, text in levels if confidence >= level), "uncertain, record another drive")


def set_noun(effect: EffectFinding) -> str:
    """Name of an effect, with those that are indistinguishable from it."""
    noun = effect_noun(effect.id)
    if not effect.indistinguishable_from:
        return noun
    others = listed([effect_noun(name) for name in effect.indistinguishable_from], "or")
    return f"{noun} (or {others}; these recordings do not distinguish them)"


def verdict_sentence(diagnosis: Diagnosis) -> str:
    """The verdict in a few sentences with the scores; where constant velocity is better, the first one says so."""
    sentence_of_verdict = {
        "mismatch": _mismatch,
        "parameters": _parameters,
        "none": _none,
        "data": _data,
        "unexplained": _unexplained,
        "inconclusive": _inconclusive,
    }[diagnosis.verdict]
    tails = (
        _with_uncatalogued(diagnosis),
        _with_curves(diagnosis),
        _with_drift(diagnosis),
        recording_causes(diagnosis),
        search_sentences(diagnosis.search),
    )
    return f"{worse_than_constant_velocity(diagnosis)}{sentence_of_verdict(diagnosis)}{''.join(tails)}"


def _with_drift(diagnosis: Diagnosis) -> str:
    """What changed in the car since the fitted recordings; empty without a drift."""
    return "".join(f" {drift_sentence(d, diagnosis.horizon_s)}" for d in diagnosis.drift if d.is_drift)


def _with_uncatalogued(diagnosis: Diagnosis) -> str:
    """The held-out error with physics outside the catalogue; empty without it."""
    if "with_uncatalogued_physics" not in diagnosis.held_out:
        return ""
    found = diagnosis.held_out["with_uncatalogued_physics"]
    where = "" if diagnosis.curves else " model.toml contains it."
    position = with_unit(found.position_m, "m")
    return (
        f" With physics outside the catalogue, the held-out position error is {position} (all channels: "
        f"{number(found.score)} noise floors).{where}"
    )


def _with_curves(diagnosis: Diagnosis) -> str:
    """The held-out error with measured curves; empty without curves."""
    if not diagnosis.curves or "with_curves" not in diagnosis.held_out:
        return ""
    found = diagnosis.held_out["with_curves"]
    curves = f"{len(diagnosis.curves)} measured curves" if len(diagnosis.curves) > 1 else "a measured curve"
    position = with_unit(found.position_m, "m")
    return (
        f" With {curves}, the held-out position error is {position} (all channels: {number(found.score)} noise floors)."
    )


def worse_than_constant_velocity(diagnosis: Diagnosis) -> str:
    """Where constant velocity predicts held-out recordings better than the model, and why; empty if nowhere."""
    significant = [s for s in diagnosis.skill if s.standard_errors < -EVIDENCE.skill_z_min]
    worse = [s for s in significant if s.model_m > s.constant_velocity_m]  # the mean and the rms may disagree
    if not worse:
        return ""
    whole = [s for s in worse if s.regime == "all"]
    worst = max(whole or worse, key=lambda s: s.model_m - s.constant_velocity_m)
    place = f"recording {worst.recording}" + ("" if worst.regime == "all" else f" at {worst.regime}")
    steady = worst.constant_velocity_m < EVIDENCE.steady_share * worst.travelled_m
    why = (
        "Velocities hardly change there, so this drive does not separate the possible causes."
        if steady
        else "The car has changed since the fitted recordings."
        if has_changed(diagnosis, worst.recording)
        else "The model is wrong there."
    )
    return (
        f"This model predicts held-out {place} worse than constant velocity ({with_unit(worst.model_m, 'm')} against "
        f"{with_unit(worst.constant_velocity_m, 'm')} after {with_unit(diagnosis.horizon_s, 's')}). {why} "
    )


def _mismatch(diagnosis: Diagnosis) -> str:
    effects, text = diagnosis.effects, " ".join(_statements(diagnosis.effects))
    if fall := error_fall(diagnosis, "refit", "with_effects"):
        named = "it" if len(effects) == 1 else "them"
        named = "corrected numbers" if effects and all(e.car_file_values for e in effects) else named
        text += f" With {named}, {fall}{explanation(diagnosis)}."
    rest = remainder(found) if (found := relevant_residual(diagnosis)) is not None else ""
    if not rest or agrees_when_fitted(diagnosis):
        return f"{text}{rest}{_warning_above_noise(diagnosis, 'with_effects')}"
    return f"{text}{rest}"


def _statements(effects: Sequence[EffectFinding]) -> list[str]:
    """What is missing in the simulator, and what the car file states with wrong numbers."""
    missing = [set_noun(effect) for effect in effects if not effect.car_file_values]
    wrong = [set_noun(effect) for effect in effects if effect.car_file_values]
    found = []
    if missing or not wrong:
        count = COUNTED.get(max(len(missing), 1), f"{len(missing)} effects")
        found.append(f"The simulator leaves out {count}: {listed(missing) or 'an effect that is not in this report'}.")
    if wrong:
        count, have = COUNTED.get(len(wrong), f"{len(wrong)} effects"), "has" if len(wrong) == 1 else "have"
        found.append(f"{count.capitalize()} of the car file {have} wrong numbers: {listed(wrong)}.")
    return found


def _parameters(diagnosis: Diagnosis) -> str:
    text = f"No missing physics is found. {fitted_parameters(diagnosis)}"
    warnings = f"{_warning_above_noise(diagnosis, 'refit')}{_warning_of_fitted(diagnosis)}"
    return f"{text}{parameters_at_limit(diagnosis)}{warnings}"


def _warning_above_noise(diagnosis: Diagnosis, which: str) -> str:
    """A warning if the score stays well above the noise floor; else empty."""
    if not is_above_noise(diagnosis, which) or has_slow_poses(diagnosis):
        return ""
    if which != "nominal" and agrees_when_fitted(diagnosis):
        return (
            f" On the fitted recordings, this error is {number(diagnosis.fitted_score)} noise floors: the held-out "
            "recordings have conditions that the fitted ones lack, or the car changed between them."
        )
    return " This error is above the noise: the simulator lacks physics that the diagnosis does not find."


def _warning_of_fitted(diagnosis: Diagnosis) -> str:
    """A warning if only the fitted recordings have an error well above the noise; else empty."""
    if is_above_noise(diagnosis, "refit") or not diagnosis.fitted_score > REPORT.score_above_noise:
        return ""
    return (
        f" On the fitted recordings, the error of the refit is {number(diagnosis.fitted_score)} noise floors: they "
        "show physics that the held-out recordings do not. Diagnose drives of each kind by themselves."
    )


def _none(diagnosis: Diagnosis) -> str:
    held = diagnosis.held_out.get("nominal")
    text = "No missing physics is found. Neither other parameters nor an effect improves the prediction significantly."
    if held is None:
        return text
    return (
        f"{text} The position error after {with_unit(diagnosis.horizon_s, 's')} is {with_unit(held.position_m, 'm')}; "
        f"all channels: {number(held.score)} noise floors (a noise floor is the estimated error of measurement noise)."
        f"{excluded_sizes(diagnosis)}{_warning_above_noise(diagnosis, 'nominal')}{_warning_of_fitted(diagnosis)}"
    )


def _data(diagnosis: Diagnosis) -> str:
    ids = list(dict.fromkeys(fault.id.replace("_", " ") for fault in diagnosis.data_faults))
    faults = f" ({listed(ids)})" if ids else ""
    return f"The recording is faulty{faults}. No physics can be identified from it until the fault is corrected."


def _unexplained(diagnosis: Diagnosis) -> str:
    if differs_when_held_out(diagnosis):
        return difference_when_held_out(diagnosis)
    rest = diagnosis.unexplained
    which = "none of the searched effects" if diagnosis.search.effects else "no effect of the catalogue"
    text = f"The simulator lacks physics that {which} explains"
    if explained_share(diagnosis, "refit", before="nominal") > REPORT.min_parameter_share:
        text = f"{fitted_parameters(diagnosis)} The simulator also lacks physics that {which} explains"
    if not diagnosis.search.is_complete:
        text = "The search for effects did not finish, and it has not found what the simulator lacks"
    if rest is None:
        return text + "."
    where = listed([CHANNEL_NAMES.get(c, c) for c in rest.channels])
    shows = f" The error appears in {where}" if where else " The error appears"
    sentence = f"{text}.{shows}, {regime_clause(rest.regime)}."
    if not diagnosis.search.is_complete or limited_channels(diagnosis):
        return sentence
    return f"{sentence} Class of the missing physics: {rest.kind or 'unknown'}."


def _inconclusive(diagnosis: Diagnosis) -> str:
    why = diagnosis.sentence or diagnosis.advice
    return f"No verdict. {why}" if why else "No verdict. The recordings are not sufficient."


def regime_clause(regime: str) -> str:
    """A regime as a clause: ``mostly where lateral acceleration > 2 m/s²``, ``mostly while the steering changes``."""
    if not regime or regime == "everywhere alike":
        return "equally in all driving conditions"
    if change := re.fullmatch(r"\|(steering|throttle) rate\| > 0 /s", regime):
        return f"mostly while the {change[1]} changes"
    return f"mostly where {unit_text(regime)}"
