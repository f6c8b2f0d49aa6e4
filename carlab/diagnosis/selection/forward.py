"""Forward selection along several paths.

The first effect of a greedy search may be a proxy of two others. Where the greedy path has several
effects and leaves a part of the excess, other choices are followed to their end, and left-out blocks choose between the
paths (limited discrepancy search, Harvey and Ginsberg 1995, with one deviation from the greedy choices).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace

import numpy as np

from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.selection.candidates import accepted, next_candidates
from carlab.diagnosis.selection.moves import apply_moves
from carlab.diagnosis.selection.problem import Candidate, Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import fit_with_scale
from carlab.diagnosis.selection.restarts import needs_restart, restart
from carlab.diagnosis.settings import RESTARTS

log = logging.getLogger(__name__)

ALTERNATIVES_PROGRESS = (0.9, 0.9)
"""Progress of the search while other choices are followed."""


@dataclass(frozen=True, slots=True)
class Choice:
    """A candidate that was accepted as the next effect of a path, but not added."""

    path: Path
    candidate: Candidate


@dataclass(frozen=True, slots=True)
class Path:
    """Effects added to the base model one after the other.

    model             fit with all effects
    history           (effect, fit) in the order of acceptance
    first_candidates  candidates for the first effect of this path
    alternatives      further accepted candidates of each step, not confusable with the one that was added
    visited           sets of effects after each step
    failed_restarts     number of successive restarts without a lower cost
    """

    model: Model
    history: tuple[tuple[str, Fit], ...] = ()
    first_candidates: tuple[Candidate, ...] = ()
    alternatives: tuple[Choice, ...] = ()
    visited: frozenset[frozenset[str]] = frozenset()
    failed_restarts: int = 0


def extend(
    problem: SearchProblem, path: Path, control: RunControl, visited: AbstractSet[frozenset[str]] = frozenset()
) -> Path:
    """Add effects to a path until none is accepted, or until its effects are one of the ``visited`` sets."""
    max_effects = problem.settings.selection.max_effects
    while len(path.model.effects) < max_effects and _effects(path) not in visited and not control.ends_search():
        count = len(path.model.effects)
        control.progress(f"searching for effect {count + 1}", count / max_effects)
        candidates = next_candidates(problem, path.model, control)
        path = path if path.history else replace(path, first_candidates=candidates)
        chosen = accepted(problem, path.model, candidates, control)
        if not chosen or control.ends_search():
            break
        before = _effects(path)
        path = _add(problem, path, chosen, control)
        if _effects(path) == before:
            break
    return path


def best_path(problem: SearchProblem, base: Model, greedy: Path, control: RunControl) -> Path:
    """The greedy path, or a path with one other choice whose loss on left-out blocks is significantly lower.

    A path ends where it has the effects that an earlier path had after a step, because it would continue as that path.
    """
    settings = problem.settings.selection
    if len(greedy.model.effects) < settings.min_effects_for_alternatives:
        return greedy
    best, visited = greedy, set(greedy.visited)
    best_first = sorted(greedy.alternatives, key=lambda choice: -choice.candidate.left_out_gain)
    choices = _distinct(best_first[: settings.max_alternatives], settings.same_loss_share)
    for k, choice in enumerate(choices):
        if remaining_excess(problem, base, best.model) < settings.min_remaining_excess or control.ends_search():
            break
        names = (*choice.path.model.effects, choice.candidate.effect)
        log.info("alternative %d of %d: %s", k + 1, len(choices), ", ".join(names))
        labelled = control.part(*ALTERNATIVES_PROGRESS, f"alternative {k + 1} of {len(choices)}: ")
        path = extend(problem, _add(problem, choice.path, (choice.candidate,), labelled), labelled, visited)
        is_new = _effects(path) not in visited
        visited |= path.visited
        if not is_new:
            log.info("it continues as an earlier path: %s", ", ".join(path.model.effects))
            continue
        if _is_better(problem, path.model, best.model):
            log.info("the alternative predicts left-out blocks better: %s", ", ".join(path.model.effects))
            best = path
    return best


def _distinct(choices: Sequence[Choice], same_loss_share: float) -> list[Choice]:
    """The choices, except those with the same loss in each left-out window as an earlier choice of the same path.

    A delay of both commands and a latency of motion capture, for example, predict the same measurements.
    """
    found: list[Choice] = []
    for choice in choices:
        loss = choice.candidate.left_out_loss
        others = (c.candidate.left_out_loss for c in found if c.path is choice.path)
        if not any(np.abs(loss - other).sum() <= same_loss_share * other.sum() for other in others):
            found.append(choice)
    return found


def remaining_excess(problem: SearchProblem, base: Model, model: Model) -> float:
    """Share of the squared excess of the refitted base model that a model leaves, from the scales of their errors."""
    excess, excess_base = (max(problem.excess_of(m.scale), 0.0) for m in (model, base))
    return excess / excess_base if excess_base > 0.0 else 0.0


def _add(problem: SearchProblem, path: Path, chosen: tuple[Candidate, ...], control: RunControl) -> Path:
    """The path with the first of the accepted candidates added."""
    leader, before = chosen[0], path.model
    log.info("accepted %s", leader.effect)
    added = fit_with_scale(problem, (*before.effects, leader.effect), leader.fit.z)
    restarted, failed_restarts = _restarted(problem, added, path.failed_restarts, control)
    model = apply_moves(problem, restarted, control)
    confusable = problem.confusable.get(leader.effect, ())
    others = tuple(Choice(path, c) for c in chosen[1:] if c.effect not in confusable)
    return Path(
        model,
        (*path.history, (leader.effect, model.fit)),
        path.first_candidates,
        (*path.alternatives, *others),
        path.visited | {frozenset(model.effects)},
        failed_restarts,
    )


def _restarted(problem: SearchProblem, model: Model, failed: int, control: RunControl) -> tuple[Model, int]:
    """The model from perturbed parameters, and the number of its path's successive restarts without a lower cost."""
    if failed >= RESTARTS.max_failed or not needs_restart(problem, model):
        return model, failed
    restarted = restart(problem, model, control)
    return restarted, failed + 1 if restarted is model else 0


def _effects(path: Path) -> frozenset[str]:
    return frozenset(path.model.effects)


def _is_better(problem: SearchProblem, model: Model, reference: Model) -> bool:
    """Whether a model predicts left-out blocks significantly better than the reference, with the reference's scale."""
    loss, reference_loss = (problem.left_out_loss(m.fit, reference.scale) for m in (model, reference))
    gain, error = clustered_gain(reference_loss, loss, problem.windows)
    log.info("gain on left-out blocks of the alternative: %.1f (%.1f standard errors)", gain, gain / error)
    return gain > problem.settings.selection.tie_z * error
