"""Forward selection of missing effects.

Each step screens all candidates, refits the best of them together with the base parameters, tests them on
left-out blocks, accepts one, and applies moves. Where several effects leave a part of the excess, other choices are
followed. Elimination and the choice between confusable effects come last. The stages exchange fitted models
(``selection.problem``); no stage calls a later stage.
"""

from __future__ import annotations

from dataclasses import replace

from carlab.diagnosis.selection.elimination import delete_each, eliminate
from carlab.diagnosis.selection.forward import Path, best_path, extend
from carlab.diagnosis.selection.pairwise_tests import choose_confusable, compare_pairs
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem, SearchResult
from carlab.diagnosis.selection.refit import fit_base, refit
from carlab.diagnosis.selection.shared_delays import replace_shared_delays


def search(problem: SearchProblem, control: RunControl) -> SearchResult:
    """Add effects until none is accepted."""
    is_cut_short = False

    def ends_search() -> bool:
        nonlocal is_cut_short
        is_cut_short = is_cut_short or control.ends_search()
        return is_cut_short

    limited = replace(control, ends_search=ends_search)
    control.progress("refit of the base parameters", 0.0)
    base = fit_base(problem)
    greedy = extend(problem, Path(base), limited)
    path = best_path(problem, base, greedy, limited)
    eliminated = eliminate(problem, path.model, control)
    eliminated = replace_shared_delays(problem, eliminated, control)
    model, pairs = choose_confusable(problem, eliminated, control)
    ordered = tuple(sorted(model.effects, key=lambda e: -pairs.chi2[e]))
    return SearchResult(
        base.fit,
        model.fit,
        ordered,
        pairs.chi2,
        pairs.indistinguishable,
        path.history,
        greedy.first_candidates,
        model.scale,
        not is_cut_short,
    )


def restrict(problem: SearchProblem, found: SearchResult, names: tuple[str, ...], control: RunControl) -> SearchResult:
    """The result with only ``names`` of its effects, refitted."""
    if not names:
        return found.without_effects()
    return with_model(problem, found, refit(problem, names, found.best, found.scale), control)


def with_model(problem: SearchProblem, found: SearchResult, model: Model, control: RunControl) -> SearchResult:
    """The result with a fit of some of its effects."""
    pairs = compare_pairs(problem, delete_each(problem, model, control), control)
    return replace(
        found,
        best=model.fit,
        effects=model.effects,
        chi2=pairs.chi2,
        indistinguishable=pairs.indistinguishable,
        history=tuple((name, step) for name, step in found.history if name in model.effects),
    )
