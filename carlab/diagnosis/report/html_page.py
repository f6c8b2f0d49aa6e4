"""The report as one HTML page, rendered from a template."""

from __future__ import annotations

import math
from importlib import resources
from typing import Any

from jinja2 import Environment, StrictUndefined

from carlab.diagnosis.findings import Diagnosis, EffectFinding, Estimate, FigureData
from carlab.diagnosis.report import figures
from carlab.diagnosis.report import sentences as text
from carlab.diagnosis.report.curves import ceiling_sentence, curve_charts, curve_sentences
from carlab.diagnosis.report.drift import drift_sentences
from carlab.diagnosis.report.effect_lines import held_out_change
from carlab.diagnosis.report.events import diagnosed_event_sentences
from carlab.diagnosis.report.next_drive import drive_command, next_drive
from carlab.diagnosis.report.numbers import listed, number, percent, unit_text, with_unit
from carlab.diagnosis.report.residual import explained_share, formula_symbols, relevant_residual, shown_errors
from carlab.diagnosis.report.svg import interval_bar
from carlab.diagnosis.settings import EVIDENCE, REPORT


def render_page(diagnosis: Diagnosis, figure_data: FigureData) -> str:
    """Render the page: self-contained, without scripts; all text from outside is escaped."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {
        "num": number,
        "percent": percent,
        "unit": unit_text,
        "words": lambda name: name.replace("_", " "),
    }
    source = (resources.files("carlab.diagnosis.report") / "templates" / "report.html").read_text(encoding="utf-8")
    return environment.from_string(source).render(**page_context(diagnosis, figure_data))


def page_context(diagnosis: Diagnosis, figure_data: FigureData) -> dict[str, Any]:
    """Variables of the template. Figures contain effects only if the verdict names some."""
    figure_data = figure_data if diagnosis.effects else figures.without_effects(figure_data)
    drive, why = next_drive(diagnosis)
    command = drive_command(drive)
    rest = relevant_residual(diagnosis)
    worst = figures.worst_stretch(figure_data.traces)
    candidates = sorted((c for c in figure_data.candidates if math.isfinite(c[1])), key=lambda c: -c[1])
    return {
        "d": diagnosis,
        "title": text.verdict_title(diagnosis),
        # That of an inconclusive diagnosis is a reason, not a verdict.
        "sentence": text.verdict_sentence(diagnosis) if diagnosis.verdict == "inconclusive" else diagnosis.sentence,
        "cards": _cards(diagnosis),
        "effects": [_effect(effect, figure_data) for effect in diagnosis.effects],
        "overlay": figures.overlay(*worst, diagnosis.effects) if worst else [],
        "overlay_trace": worst[0].name if worst else "",
        "overlay_stretch": worst[1] if worst else (0.0, 0.0),
        "overlay_models": [m for m in figures.MODELS if worst and m in worst[0].predicted],
        "labels": figures.LABELS,
        "in_time": [(t.name, f, t.marked) for t in figure_data.traces if (f := figures.error_in_time(t)) is not None],
        "regimes": figures.regime_charts(figure_data),
        "score_chart": figures.score_chart(figure_data),
        "explained": explained_share(diagnosis),
        "known": bool(diagnosis.effects) and explained_share(diagnosis) >= 0.0,
        "driven": bool(figure_data.traces),
        "candidates": [(text.effect_noun(c[0]), c[0], c[1]) for c in candidates[: REPORT.max_candidates]],
        "candidate_count": len(figure_data.candidates),
        "curves": [(c, curve_charts(c)) for c in diagnosis.curves],
        "curve_sentences": curve_sentences(diagnosis),
        "ceiling": ceiling_sentence(diagnosis),
        "min_windows": EVIDENCE.skill_windows_min,
        "drift": [(d, figures.drift_charts(d)) for d in diagnosis.drift],
        "drift_sentences": drift_sentences(diagnosis),
        "event_sentences": diagnosed_event_sentences(diagnosis),
        "rest": rest,
        "rest_where": listed([text.CHANNEL_NAMES.get(c, c) for c in rest.channels]) if rest else "",
        "rest_symbols": formula_symbols(rest.formula) if rest else "",
        "rest_regime": text.regime_clause(rest.regime) if rest else "",
        "drive": command,
        "why": why.removesuffix(f" Drive it with: {command}"),
        "held_out": shown_errors(diagnosis),
        "parameters": [
            (name, diagnosis.car_file_parameters.get(name), e, _bar(e)) for name, e in diagnosis.parameters.items()
        ],
        "withdrawn": text.withdrawal_sentences(diagnosis),
        "limits": [
            (text.effect_noun(effect), f"{effect}.{name}", e, _bar(e))
            for effect, own in diagnosis.limits.items()
            for name, e in own.items()
        ],
    }


def _bar(e: Estimate) -> Any:
    return interval_bar(e.value, e.low90, e.high90)


def _cards(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Scores of the models, for the head of the page."""
    order = ("nominal", "refit", "with_effects", "with_uncatalogued_physics", "with_curves", "noise_floor")
    shown = shown_errors(diagnosis)
    return [{"label": figures.LABELS[k], "errors": shown[k], "style": k} for k in order if k in shown]


def _effect(effect: EffectFinding, figure_data: FigureData) -> dict[str, Any]:
    where, evidence = effect.where, effect.evidence
    places = [f"in {listed([text.CHANNEL_NAMES.get(c, c) for c in where.channels])}"] if where.channels else []
    places.append(text.regime_clause(where.regime))
    if where.lag_s is not None:
        places.append(f"at a lag of {with_unit(where.lag_s, 's')}")
    if where.time is not None:
        places.append(f"from {with_unit(where.time[0], 's')} to {with_unit(where.time[1], 's')}")
    if where.place is not None:
        x, y, radius = (with_unit(v, "m") for v in where.place)
        places.append(f"within {radius} of x = {x}, y = {y}")
    noun = text.effect_noun(effect.id)
    return {
        "id": effect.id,
        "noun": noun[0].upper() + noun[1:],
        "sentence": effect.sentence,
        "confidence": effect.confidence,
        "confidence_text": text.confidence_text(effect.confidence, len(effect.indistinguishable_from)),
        "where": ", ".join(places),
        "evidence_texts": _evidence_texts(effect),
        "parameters": [(name, e, _bar(e)) for name, e in effect.parameters.items()],
        "others": [(other, text.effect_noun(other)) for other in effect.indistinguishable_from],
        "drive": drive_command(effect.separating_drive),
        "reason": text.separating_reason(effect.id, effect.indistinguishable_from)
        if effect.indistinguishable_from
        else "",
        "refutation": text.refutation_sentence("" if effect.car_file_values else effect.id),
        "correlation": figures.correlation_chart(figure_data, effect.id),
        "fingerprint": figures.fingerprint_chart(effect) if evidence.deletion_fingerprint else None,
    }


def _evidence_texts(effect: EffectFinding) -> list[str]:
    evidence = effect.evidence
    texts = [change] if (change := held_out_change(effect)) else []
    strength = evidence.standard_errors
    if math.isfinite(strength):
        verb = "lowers" if strength < 0 else "raises"
        weak = " (weak evidence)" if abs(strength) < 3 else ""
        size = number(abs(strength))
        texts.append(f"The effect {verb} the held-out log-likelihood by {size} standard errors{weak}.")
    visible = evidence.visibility
    if math.isfinite(visible):
        hidden = " Most of it is confounded with other parameters." if visible < 0.3 else ""
        share = percent(visible)
        texts.append(f"Other parameters cannot reproduce {share} of its influence on the errors.{hidden}")
    return texts
