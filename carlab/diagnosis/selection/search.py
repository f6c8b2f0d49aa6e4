"""Forward selection of missing effects.

Each step screens all candidates, refits the best of them together with the base parameters, tests them on unseen
blocks, accepts one, and applies moves. Elimination and pairwise comparison follow. The stages exchange fitted models
(``selection.problem``); no stage calls a later stage.
"""

from __future__ import annotations

from dataclasses import replace

from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.selection.candidates import accept, next_candidates
from carlab.diagnosis.selection.elimination import EliminationResult, delete_each, eliminate
from carlab.diagnosis.selection.moves import apply_moves
from carlab.diagnosis.selection.pairwise_tests import compare_pairs
from carlab.diagnosis.selection.problem import Candidate, RunControl, SearchProblem, SearchResult
from carlab.diagnosis.selection.refit import fit_base, fit_with_scale, refit


def search(problem: SearchProblem, control: RunControl) -> SearchResult:
    """Add effects until none is accepted."""
    control.progress("refit of the base parameters", 0.0)
    base = model = fit_base(problem)
    max_effects = problem.settings.selection.max_effects
    history: list[tuple[str, Fit]] = []
    tried: tuple[Candidate, ...] = ()
    while len(model.effects) < max_effects and not control.ends_search():
        control.progress(f"searching for effect {len(model.effects) + 1}", len(model.effects) / max_effects)
        candidates = next_candidates(problem, model, control)
        if not model.effects:
            tried = candidates
        leader = accept(problem, model, candidates, control)
        if control.ends_search() or leader is None:
            break
        before, fit = set(model.effects), leader.fit
        added = fit_with_scale(problem, (*model.effects, leader.effect), fit.config, fit.free, fit.z)
        model = apply_moves(problem, added, control)
        history.append((leader.effect, model.fit))
        if set(model.effects) == before:
            break
    is_complete = not control.ends_search()
    eliminated = eliminate(problem, model, control)
    pairs = compare_pairs(problem, eliminated, control)
    model = eliminated.model
    ordered = tuple(sorted(model.effects, key=lambda e: -pairs.chi2[e]))
    return SearchResult(
        base.fit, model.fit, ordered, pairs.chi2, pairs.rivals, tuple(history), tried, model.scale, is_complete
    )


def restrict(problem: SearchProblem, found: SearchResult, names: tuple[str, ...], control: RunControl) -> SearchResult:
    """The result with only ``names`` of its effects, refitted."""
    if not names:
        return found.without_effects()
    model = refit(problem, names, found.best, found.scale)
    pairs = compare_pairs(problem, EliminationResult(model, delete_each(problem, model, control)), control)
    history = tuple((name, step) for name, step in found.history if name in names)
    return replace(found, best=model.fit, effects=names, chi2=pairs.chi2, rivals=pairs.rivals, history=history)


__all__ = ["restrict", "search"]
