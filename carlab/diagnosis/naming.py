"""Which names of a search are accepted in the end, and what describes the residual.

Physics without a name must not get one (spurious attribution). Names are withdrawn where uncatalogued physics explains
as much in their place, where terms without a name explain much in addition to them or more than them, or where they
make the prediction of held-out recordings worse.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.decisions import Condition, Decision
from carlab.diagnosis.findings import Unexplained
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.selection.problem import RunControl, SearchProblem, SearchResult
from carlab.diagnosis.selection.rival_physics import RivalPhysics, additional_physics, replacing_physics
from carlab.diagnosis.selection.search import restrict
from carlab.diagnosis.unexplained.description import ResidualModel, describe, fit_residual_terms, start_features
from carlab.diagnosis.unexplained.vibration import Vibration
from sim_backends.car_parameters import SimulatorConfig

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class NamingResult:
    """The accepted names, and what is missing without a name.

    found       the search with the accepted names only
    residual    terms without a name that the fit calls for
    rival       uncatalogued physics that it calls for
    vibration   that turns with the wheels
    """

    found: SearchResult
    residual: ResidualModel
    rival: RivalPhysics | None
    vibration: Vibration | None

    @property
    def has_unnamed(self) -> bool:
        """Whether anything is missing that has no name."""
        return bool(self.residual.chosen) or self.rival is not None or self.vibration is not None


def accept_names(
    problem: SearchProblem, found: SearchResult, held_out: HeldOut, vibration: Vibration | None, control: RunControl
) -> NamingResult:
    """Withdraw spurious names, and describe what has none."""
    names = found.effects
    rival = replacing_physics(problem, found, control)
    if rival is not None:
        found = restrict(problem, found, rival.names, control)
    residual = residual_of(problem, found)
    if rival is None:
        rival = additional_physics(problem, found, control)
    if found.effects and _are_spurious(problem, found, residual, rival, control):
        found = found.without_effects()
    elif found.effects and _contradicted(found, held_out):
        log.info("%s: the held-out recordings are predicted worse with it", ", ".join(found.effects))
        found = found.without_effects()
    if names and not found.effects:
        log.info("%s: a spurious attribution", ", ".join(names))
        residual = residual_of(problem, found)
        if rival is None or rival.names:
            rival = additional_physics(problem, found, control)
    return NamingResult(found, residual, rival, vibration)


def residual_of(problem: SearchProblem, found: SearchResult, term_chi2_min: float | None = None) -> ResidualModel:
    """Terms without a name in addition to the accepted effects."""
    settings = problem.settings.unexplained
    return fit_residual_terms(problem.windows, found.best, found.scale, term_chi2_min, settings)


def _are_spurious(
    problem: SearchProblem,
    found: SearchResult,
    residual: ResidualModel,
    rival: RivalPhysics | None,
    control: RunControl,
) -> bool:
    """Whether physics without a name explains so much that the names are spurious.

    One or two names must leave nearly nothing, and must explain about as much as terms without a name would. A car
    with many missing effects may have something without a name too.
    """
    settings = problem.settings.rivals
    windows, scale = problem.windows, found.scale
    named = float(problem.fitter(scale).loss(found.base.config).sum() - found.best.loss.sum())
    few = len(found.effects) < settings.many_effects
    min_gain = settings.min_unnamed_share * 0.5 * scale.sigma.size * len(windows)
    is_additional = rival is not None and rival.names == found.effects
    unnamed = max(residual.gain, rival.gain if rival is not None and is_additional else 0.0)
    share = settings.spurious_share if few else settings.spurious_share_many
    setting = "rivals.spurious_share" if few else "rivals.spurious_share_many"
    unnamed_share = unnamed / (unnamed + named) if unnamed + named > 0.0 else 0.0
    relevant = unnamed / (0.5 * scale.sigma.size * len(windows))
    stands = (
        (Condition(setting, unnamed_share, share, above=False),),
        (Condition("rivals.min_unnamed_share", relevant, settings.min_unnamed_share, above=False),),
    )
    spurious = unnamed > max(share * (unnamed + named), min_gain)
    _record(control, found, stands, not spurious)
    if spurious or not few:
        return spurious
    free_gain = fit_residual_terms(windows, found.base, scale, None, problem.settings.unexplained).gain
    spurious = free_gain > max(settings.unnamed_ratio * named, named + min_gain)
    ratio = free_gain / named if named > 0.0 else np.inf
    surplus = (free_gain - named) / (0.5 * scale.sigma.size * len(windows))
    stands = (
        (Condition("rivals.unnamed_ratio", ratio, settings.unnamed_ratio, above=False),),
        (Condition("rivals.min_unnamed_share", surplus, settings.min_unnamed_share, above=False),),
    )
    _record(control, found, stands, not spurious)
    return spurious


def _record(
    control: RunControl, found: SearchResult, alternatives: tuple[tuple[Condition, ...], ...], passed: bool
) -> None:
    for name in found.effects:
        control.record(Decision("stand", name, alternatives, passed, len(found.effects)))


def _contradicted(found: SearchResult, held_out: HeldOut) -> bool:
    """Whether the held-out score and likelihood are both worse with the names than with the refit alone."""
    without, with_names = held_out.final_error(found.base.config), held_out.final_error(found.best.config)
    return held_out.score(with_names) > held_out.score(without) and held_out.gain(without, with_names)[0] < 0.0


@dataclass(frozen=True, slots=True)
class Description:
    """A class statement with its formula, and by how much each channel's squared error falls with it (6,)."""

    class_statement: str
    formula: str
    fall: FloatArray
    model: SimulatorConfig | None = None


def describe_unexplained(
    problem: SearchProblem, naming: NamingResult, share: float, error: FloatArray, held_out: HeldOut
) -> tuple[Unexplained, SimulatorConfig | None]:
    """The report's entry of what stays unexplained.

    Args:
        problem: what was searched.
        naming: accepted names, and what has no name.
        share: of the squared excess that is unexplained.
        error: held-out errors with the accepted names (S, 6).
        held_out: windows and floor.

    Returns:
        The entry, and the simulator with uncatalogued physics where that describes the residual.
    """
    residual = naming.residual
    if not naming.has_unnamed:
        residual = residual_of(problem, naming.found, problem.settings.rivals.weak_term_chi2)
    of_terms = Description(residual.class_statement(), residual.formula(), residual.fall / held_out.floor**2)
    made = _describe_by_rival(problem, naming, residual, error, held_out) or of_terms
    squared = (error / held_out.floor) ** 2
    excess = np.maximum(squared.mean(axis=0) - 1.0, 0.0)
    if naming.vibration is not None:
        made = _with_vibration(made, naming.vibration, excess, held_out, problem.settings.rivals.vibration_share)
    fall = made.fall if made.fall.max() > 0.0 else excess
    size: FloatArray = np.sqrt(squared.mean(axis=1))
    seen = start_features(held_out.windows)
    return describe(share, made.class_statement, made.formula, fall, size, seen), made.model


def _describe_by_rival(
    problem: SearchProblem, naming: NamingResult, residual: ResidualModel, error: FloatArray, held_out: HeldOut
) -> Description | None:
    """The description by uncatalogued physics where that lowers the held-out score; None otherwise."""
    rival = naming.rival
    if rival is None or rival.names != naming.found.effects:
        return None
    if rival.gain <= problem.settings.rivals.description_ratio * residual.gain:
        return None
    after = held_out.final_error(rival.fit.config)
    score, score_with_rival = held_out.score(error), held_out.score(after)
    if score_with_rival >= score:
        return None
    fall = np.mean((error / held_out.floor) ** 2 - (after / held_out.floor) ** 2, axis=0)
    scores = f"with it in model.toml the score is {score_with_rival:.3g}, not {score:.3g}"
    return Description(f"{rival.class_statement()} ({scores})", rival.formula(), fall, rival.fit.config)


def _with_vibration(
    made: Description, vibration: Vibration, excess: FloatArray, held_out: HeldOut, min_share: float
) -> Description:
    """The description with vibration, which comes first where it explains enough of the squared excess (6,)."""
    shaken = 0.5 * (vibration.amplitude / held_out.floor) ** 2
    first = bool(shaken.max() > min_share * excess.max())
    of_vibration = [(vibration.class_statement(), vibration.formula())]
    others = [(made.class_statement, made.formula)] if made.formula else []
    parts = of_vibration + others if first else others + of_vibration
    return Description(
        ". ".join(statement for statement, _ in parts),
        "; ".join(formula for _, formula in parts),
        excess if first else made.fall,
        made.model,
    )


__all__ = ["NamingResult", "accept_names", "describe_unexplained", "residual_of"]
