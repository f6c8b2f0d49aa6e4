"""How much of the refit's excess over the noise the named effects explain."""

from __future__ import annotations

import numpy as np

from carlab.diagnosis.identification.free_initial_states import loss_of_free_initial_states
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.selection.problem import SearchProblem, SearchResult


def explained_shares(problem: SearchProblem, found: SearchResult, held_out: HeldOut) -> tuple[float, float] | None:
    """Shares of the refit's excess loss and of its squared held-out score above 1 that the effects explain.

    A share is negative if the effects increase the error. None if the squared score is hardly above 1: then its excess
    is as uncertain as the noise floor.
    """
    before, after = (held_out.score(held_out.final_error(fit.config)) for fit in (found.base, found.best))
    excess = before**2 - 1.0
    if excess <= problem.settings.rivals.min_held_out_excess:
        return None
    return explained_loss_share(problem, found, held_out), 1.0 - max(after**2 - 1.0, 0.0) / excess


def explained_loss_share(problem: SearchProblem, found: SearchResult, held_out: HeldOut) -> float:
    """Share of the refit's excess loss that the effects explain, over the fitted and the held-out windows.

    The excess is the loss with free initial states minus that of a perfect simulator. Errors of initial states, which
    hide most of a weak effect at the end of a window, do not enter it.
    """
    excess = []
    for config in (found.base.config, found.best.config):
        total = 0.0
        for windows in (problem.windows, held_out.windows):
            loss = loss_of_free_initial_states(
                windows,
                config,
                (),
                np.zeros((len(windows), 0)),
                held_out.noise.measured,
                max_error=problem.settings.selection.max_left_out_error,
            )
            total += float(loss.sum()) - 3.0 * (windows.steps - 1) * len(windows)
        excess.append(max(total, 0.0))
    return 1.0 - excess[1] / excess[0] if excess[0] > 0.0 else 1.0
