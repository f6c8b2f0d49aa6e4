"""Withdrawal of spurious attributions, and description of the residual.

A spurious attribution gives a catalogue name to physics outside the catalogue. Effects are withdrawn if uncatalogued
physics explains as much in their place, if unnamed terms explain much in addition to them or more than them, or if they
increase the error on held-out recordings or explain little of it. Single effects are also withdrawn if they are
negligible, or if they increase that error when they are added last (``weak_effects``).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.diagnosis.curves.curve_rival import RIVAL_CURVES, curve_in_addition, replacing_curve
from carlab.diagnosis.decisions import Alternatives, Condition
from carlab.diagnosis.explained import explained_loss_share, explained_shares
from carlab.diagnosis.findings import Unexplained
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.selection.correlated_errors import without_unsupported_effects
from carlab.diagnosis.selection.problem import RunControl, SearchProblem, SearchResult
from carlab.diagnosis.selection.rival_physics import RivalPhysics, additional_physics, replacing_physics
from carlab.diagnosis.selection.search import restrict
from carlab.diagnosis.settings import EVIDENCE
from carlab.diagnosis.unexplained.description import ResidualModel, fit_residual_terms, start_features, worst_regime
from carlab.diagnosis.unexplained.vibration import Vibration
from carlab.diagnosis.weak_effects import held_out_conditions, without_harmful_effects, without_negligible_effects

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class NamingResult:
    """The accepted effects, and the missing physics outside the catalogue.

    found       search result with the accepted effects only
    residual    significant unnamed terms
    rival       significant uncatalogued physics
    vibration   vibration at the frequency of the wheels
    """

    found: SearchResult
    residual: ResidualModel
    rival: RivalPhysics | None
    vibration: Vibration | None

    @property
    def has_unnamed(self) -> bool:
        """Whether physics outside the catalogue is missing."""
        return bool(self.residual.chosen) or self.rival is not None or self.vibration is not None


def accept_names(
    problem: SearchProblem, found: SearchResult, held_out: HeldOut, vibration: Vibration | None, control: RunControl
) -> NamingResult:
    """Withdraw negligible, spurious and harmful effects, and model the residual.

    After a search that was cut short, the residual may be an effect that was not tried, so it does not make the
    accepted effects spurious.
    """
    found = without_negligible_effects(problem, found, control)
    names = found.effects
    rival = replacing_physics(problem, found, control) or replacing_curve(problem, found, control)
    if rival is not None and rival.names != found.effects:
        found = restrict(problem, found, rival.names, control)
    residual = residual_of(problem, found)
    if rival is None:
        rival = additional_physics(problem, found, control)
    if found.effects and (
        (found.is_complete and _are_spurious(problem, found, residual, rival, held_out, control))
        or _increase_held_out_error(problem, found, held_out, control)
    ):
        found = found.without_effects()
    elif found.effects:
        fewer = without_harmful_effects(problem, found, held_out, control)
        if fewer.effects != found.effects:
            found, residual = fewer, residual_of(problem, fewer)
            rival = additional_physics(problem, found, control)
        if found.is_complete and found.effects and _explain_little(problem, found, held_out, control):
            found = found.without_effects()
    if names and not found.effects:
        log.info("%s: withdrawn as a spurious attribution", ", ".join(names))
        residual = residual_of(problem, found)
        rival = _rival_without_names(problem, found, rival, control)
    return NamingResult(found, residual, rival, vibration)


def accept_requested_names(
    problem: SearchProblem, found: SearchResult, held_out: HeldOut, vibration: Vibration | None, control: RunControl
) -> NamingResult:
    """Withdraw accepted effects that are unsupported or increase the held-out error, and model the residual.

    For a search among requested effects. Most of the catalogue was not searched, so unnamed physics is no evidence
    against the accepted effects. Instead, they must hold with decorrelated errors.
    """
    found = without_unsupported_effects(problem, found, control)
    if found.effects and _increase_held_out_error(problem, found, held_out, control):
        found = found.without_effects()
    elif found.effects:
        found = without_harmful_effects(problem, found, held_out, control)
    return NamingResult(found, residual_of(problem, found), None, vibration)


def with_fewer_effects(
    problem: SearchProblem, naming: NamingResult, found: SearchResult, control: RunControl
) -> NamingResult:
    """The naming after effects were withdrawn from its search: residual and rival physics are fitted again."""
    if found.effects:
        rival = additional_physics(problem, found, control)
    else:
        rival = _rival_without_names(problem, found, naming.rival, control)
    return replace(naming, found=found, residual=residual_of(problem, found), rival=rival)


def _rival_without_names(
    problem: SearchProblem, found: SearchResult, rival: RivalPhysics | None, control: RunControl
) -> RivalPhysics | None:
    """The uncatalogued physics that explains most if all names are withdrawn, or None."""
    if rival is not None and not rival.names:
        return rival
    additional = additional_physics(problem, found, control)
    if rival is None or rival.effect not in RIVAL_CURVES:
        return additional
    curve = curve_in_addition(problem, found, rival.effect, ())
    return curve if additional is None or curve.gain > additional.gain else additional


def residual_of(problem: SearchProblem, found: SearchResult) -> ResidualModel:
    """Unnamed terms in addition to the accepted effects."""
    return fit_residual_terms(problem.fitter(found.scale), found.best)


def _are_spurious(
    problem: SearchProblem,
    found: SearchResult,
    residual: ResidualModel,
    rival: RivalPhysics | None,
    held_out: HeldOut,
    control: RunControl,
) -> bool:
    """Whether unnamed physics explains so much that the accepted effects are spurious.

    With one or two effects the residual must be nearly zero, and they must explain about as much as unnamed
    terms in their place. A car that lacks many effects may also have physics outside the catalogue.
    """
    is_additional = rival is not None and rival.names == found.effects
    unnamed_gain = max(residual.gain, rival.gain if rival is not None and is_additional else 0.0)
    count = len(found.effects)
    if not control.are_confirmed(found.effects, _limits_in_addition(problem, found, unnamed_gain, held_out), count):
        return True
    is_small_set = count < problem.settings.rivals.many_effects
    return is_small_set and not control.are_confirmed(found.effects, _limits_in_place(problem, found), count)


def _limits_in_addition(
    problem: SearchProblem, found: SearchResult, unnamed_gain: float, held_out: HeldOut
) -> Alternatives:
    """Conditions on the gain of unnamed physics in addition to the accepted effects."""
    settings = problem.settings.rivals
    gain = _gain_of_effects(problem, found)
    share = unnamed_gain / (unnamed_gain + gain) if unnamed_gain + gain > 0.0 else 0.0

    def is_below(setting: str) -> Condition:
        return Condition(f"rivals.{setting}", share, float(getattr(settings, setting)), above=False)

    is_irrelevant = _is_irrelevant(problem, found, unnamed_gain)
    if len(found.effects) >= settings.many_effects:
        return (is_irrelevant,), (is_below("spurious_share_many"),)
    explained = explained_loss_share(problem, found, held_out)
    explain_most = Condition("rivals.min_explained_share_of_most", explained, settings.min_explained_share_of_most)
    return (is_irrelevant,), (is_below("spurious_share"),), (is_below("spurious_share_of_most"), explain_most)


def _limits_in_place(problem: SearchProblem, found: SearchResult) -> Alternatives:
    """Conditions on the gain of unnamed terms in place of the accepted effects."""
    gain = _gain_of_effects(problem, found)
    terms = fit_residual_terms(problem.fitter(found.scale), found.base)
    ratio = terms.gain / gain if gain > 0.0 else np.inf
    is_similar = Condition("rivals.unnamed_ratio", ratio, problem.settings.rivals.unnamed_ratio, above=False)
    return (is_similar,), (_is_irrelevant(problem, found, terms.gain - gain),)


def _gain_of_effects(problem: SearchProblem, found: SearchResult) -> float:
    """Fall of the loss from the refit to the fit with the accepted effects, with the scale of the latter."""
    return float(problem.fitter(found.scale).loss(found.base.config).sum() - found.best.loss.sum())


def _is_irrelevant(problem: SearchProblem, found: SearchResult, gain: float) -> Condition:
    """That a gain is a small share of the loss of a perfect simulator."""
    share = gain / (0.5 * found.scale.sigma.size * len(problem.windows))
    return Condition("rivals.min_unnamed_share", share, problem.settings.rivals.min_unnamed_share, above=False)


def _increase_held_out_error(
    problem: SearchProblem, found: SearchResult, held_out: HeldOut, control: RunControl
) -> bool:
    """Whether held-out score and likelihood are both worse with the effects than with the refit alone."""
    conditions = held_out_conditions(held_out, found.base, found.best, problem.settings.selection)
    increase = not control.are_confirmed(found.effects, conditions, len(found.effects))
    if increase:
        log.info("%s: withdrawn, because the held-out error is larger with it", ", ".join(found.effects))
    return increase


def _explain_little(problem: SearchProblem, found: SearchResult, held_out: HeldOut, control: RunControl) -> bool:
    """Whether one or two effects explain little of the excess.

    The strongest part of physics outside the catalogue often resembles an effect; the rest of it remains.
    """
    settings = problem.settings.rivals
    if len(found.effects) >= settings.many_effects:
        return False
    shares = explained_shares(problem, found, held_out)
    if shares is None:
        return False
    alternatives = tuple(
        (Condition("rivals.min_explained_share", share, settings.min_explained_share),) for share in shares
    )
    little = not control.are_confirmed(found.effects, alternatives, len(found.effects))
    if little:
        log.info("%s: withdrawn, because %.2f of the excess is explained", ", ".join(found.effects), max(shares))
    return little


@dataclass(frozen=True, slots=True)
class Description:
    """Class statement and formula of missing physics, and the fall of each channel's squared error with it.

    ``fall`` is (6,) in squared noise floors; ``fit`` is that with uncatalogued physics, if that describes the residual.
    """

    class_statement: str
    formula: str
    fall: FloatArray
    fit: Fit | None = None


def describe_unexplained(
    problem: SearchProblem, naming: NamingResult, share: float, error: FloatArray, held_out: HeldOut
) -> tuple[Unexplained, Fit | None]:
    """Describe the unexplained residual for the report.

    The residual is the ``share`` of the squared excess, with the held-out errors ``error`` (S, 6).

    Returns:
        The description, and the fit with uncatalogued physics, with covariance, if that describes the residual.
    """
    residual, fitter = naming.residual, problem.fitter(naming.found.scale)
    squared = (error / held_out.floor) ** 2
    excess = np.maximum(squared.mean(axis=0) - 1.0, 0.0)
    if not naming.has_unnamed:
        weak = fit_residual_terms(fitter, naming.found.best, problem.settings.rivals.weak_term_chi2)
        residual = weak if _explains(weak, excess, held_out) else ResidualModel(())
    of_terms = Description(residual.class_statement(), residual.formula(), residual.fall / held_out.floor**2)
    description = _describe_by_rival(problem, naming, residual, error, held_out) or of_terms
    if naming.vibration is not None:
        description = _with_vibration(
            description, naming.vibration, excess, held_out, problem.settings.rivals.vibration_share
        )
    fall = description.fall if description.fall.max() > 0.0 else excess
    order = np.argsort(-fall)
    channels = tuple(STATE_NAMES[k] for k in order if fall[k] > 0.5 * fall[order[0]])
    regime = worst_regime(start_features(held_out.windows), np.sqrt(squared.mean(axis=1)))
    fit = None if description.fit is None else fitter.with_covariance(description.fit)
    return Unexplained(share, channels, regime, description.class_statement, description.formula), fit


def _explains(terms: ResidualModel, excess: FloatArray, held_out: HeldOut) -> bool:
    """Whether terms explain a relevant share of ``excess`` (6,) in squared noise floors.

    Of 600 terms and channels, the best one reaches the chi2 of a weak term by chance, but then it explains little.
    """
    fall = float((terms.fall / held_out.floor**2).sum())
    return fall >= EVIDENCE.unexplained_share_min * float(excess.sum())


def _describe_by_rival(
    problem: SearchProblem, naming: NamingResult, residual: ResidualModel, error: FloatArray, held_out: HeldOut
) -> Description | None:
    """Description by uncatalogued physics if it lowers the held-out score; None otherwise."""
    rival = naming.rival
    if rival is None or rival.names != naming.found.effects:
        return None
    if rival.gain <= problem.settings.rivals.description_ratio * residual.gain:
        return None
    after = held_out.final_error(rival.fit.config)
    if held_out.score(after) >= held_out.score(error):
        return None
    fall = np.mean((error / held_out.floor) ** 2 - (after / held_out.floor) ** 2, axis=0)
    return Description(rival.class_statement(), rival.formula(), fall, rival.fit)


def _with_vibration(
    made: Description, vibration: Vibration, excess: FloatArray, held_out: HeldOut, min_share: float
) -> Description:
    """Add vibration to a description; it comes first if it explains enough of the squared excess (6,)."""
    shaken = 0.5 * (vibration.amplitude / held_out.floor) ** 2
    first = bool(shaken.max() > min_share * excess.max())
    of_vibration = [(vibration.class_statement(), vibration.formula())]
    others = [(made.class_statement, made.formula)] if made.formula else []
    parts = of_vibration + others if first else others + of_vibration
    return Description(
        ". ".join(statement for statement, _ in parts),
        "; ".join(formula for _, formula in parts),
        excess if first else made.fall,
        made.fit,
    )
