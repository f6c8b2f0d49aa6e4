"""Shares of the refit's excess, and the residual that a report describes."""

from __future__ import annotations

import math
import re

from carlab.diagnosis.findings import Diagnosis, FitErrors, Unexplained, final_model_name
from carlab.diagnosis.report.numbers import number, percent, with_unit
from carlab.diagnosis.settings import EVIDENCE, REPORT


def explained_share(diagnosis: Diagnosis, model: str = "with_effects", *, before: str = "refit") -> float:
    """Share of the squared excess over the noise floor of ``before`` that a model explains, at most 1, or NaN."""
    held = diagnosis.held_out
    if before not in held or model not in held or not held[before].score > 1.0:
        return math.nan
    excess, with_model = (held[name].score ** 2 - 1.0 for name in (before, model))
    return 1.0 - max(with_model, 0.0) / excess


def error_fall(diagnosis: Diagnosis, before: str, after: str) -> str:
    """Clause with the held-out errors of two models; empty if one of them is unknown."""
    held = diagnosis.held_out
    if before not in held or after not in held:
        return ""
    return (
        f"the position error on held-out recordings after {with_unit(diagnosis.horizon_s, 's')} goes from "
        f"{with_unit(held[before].position_m, 'm')} to {with_unit(held[after].position_m, 'm')} (all channels: from "
        f"{number(held[before].score)} to {number(held[after].score)} noise floors)"
    )


def explanation(diagnosis: Diagnosis) -> str:
    """Clause, after a comma, with the share of the refit's squared excess that effects explain; empty if unknown."""
    share = explained_share(diagnosis)
    if not math.isfinite(share):
        return ""
    if share < 0.0:
        return ", so the effects do not lower the error over all channels, and their names are uncertain"
    return f", which explains {percent(share)} of the refit's squared excess over the noise floor"


def remainder(rest: Unexplained) -> str:
    """Sentence, after a space, with the share of the refit's squared excess that stays unexplained."""
    if rest.share > 1.0:
        return " The refit's squared excess over the noise floor stays unexplained."
    return f" Of this squared excess, {percent(rest.share)} stays unexplained."


def remaining_share(diagnosis: Diagnosis) -> float:
    """Share of the refit's squared excess that remains with model.toml; NaN if unknown."""
    return 1.0 - explained_share(diagnosis, final_model_name(diagnosis.held_out))


def shown_errors(diagnosis: Diagnosis) -> dict[str, FitErrors]:
    """Held-out errors by model; without named effects, those with effects are those of the refit and are left out."""
    return {k: v for k, v in diagnosis.held_out.items() if k != "with_effects" or diagnosis.effects}


def is_above_noise(diagnosis: Diagnosis, model: str) -> bool:
    """Whether the score of a model is well above the noise floor."""
    held = diagnosis.held_out.get(model)
    return held is not None and held.score > REPORT.score_above_noise


def agrees_when_fitted(diagnosis: Diagnosis) -> bool:
    """Whether the model with the named effects, if any, explains the fitted recordings to near their noise."""
    return diagnosis.fitted_score < EVIDENCE.unexplained_score_min


def differs_when_held_out(diagnosis: Diagnosis) -> bool:
    """Whether a model without effects explains the fitted recordings, but not the held-out ones."""
    return diagnosis.verdict == "unexplained" and agrees_when_fitted(diagnosis)


def difference_when_held_out(diagnosis: Diagnosis) -> str:
    """Sentences about a refit that explains the fitted recordings, but not the held-out ones."""
    held, fitted = diagnosis.held_out["refit"], number(diagnosis.fitted_score)
    error = f"{number(held.score)} noise floors, {with_unit(held.position_m, 'm')} after "
    error += with_unit(diagnosis.horizon_s, "s")
    if not is_above_noise(diagnosis, "refit"):
        return (
            f"The refitted simulator agrees with the fitted recordings ({fitted} noise floors), and its error on the "
            f"held-out ones is little above the noise ({error}). Longer recordings show whether physics is missing."
        )
    return (
        f"The refitted simulator agrees with the fitted recordings ({fitted} noise floors) but not with the held-out "
        f"ones ({error}). The car or the motion capture changed between them (carlab compare names the change), or the "
        "held-out recordings have conditions that the fitted ones lack."
    )


def relevant_residual(diagnosis: Diagnosis) -> Unexplained | None:
    """The unexplained residual if the report describes it.

    None if its share is small, if no physics is missing and the refit is near the noise floor, and if only held-out
    recordings have it.
    """
    rest = diagnosis.unexplained
    if rest is None or rest.share < EVIDENCE.unexplained_share_min or differs_when_held_out(diagnosis):
        return None
    if diagnosis.verdict in ("none", "parameters") and not is_above_noise(diagnosis, "refit"):
        return None
    return rest


SYMBOLS = {
    "v": "longitudinal velocity vx",
    "w": "lateral velocity vy",
    "r": "yaw rate",
    "u": "throttle in [-1, 1] after the delays of the car file",
    "d": "steering in [-1, 1] after the delays of the car file",
    "before": "0.3 s earlier",
    "x": "position x",
    "y": "position y",
    "t": "time as a share of the recording",
    "s": "distance travelled",
    "grip work": "mean lateral acceleration before the prediction, over 3 m/s²",
    "F_front/m": "side force of the front axle over the mass",
    "F_rear/m": "side force of the rear axle over the mass",
}
"""Meaning of the symbols in formulas of missing accelerations."""
_RATES = {"dr": "r", "du": "u", "dd": "d"}


def formula_symbols(formula: str) -> str:
    """List the symbols of a formula of missing accelerations with their meanings; empty for another description."""
    if "+=" not in formula:
        return ""
    words = re.findall(r"F_front/m|F_rear/m|grip work|[A-Za-z]+", formula)
    used = {_RATES.get(word, word) for word in words}
    return "; ".join(f"{symbol}: {meaning}" for symbol, meaning in SYMBOLS.items() if symbol in used)
