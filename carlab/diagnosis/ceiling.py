"""The explainable ceiling: how much of the excess networks predict from past commands and velocities."""

from __future__ import annotations

from carlab.diagnosis.findings import Ceiling


def ceiling_of(refit_score: float, model_score: float, network_score: float) -> Ceiling | None:
    """Shares of the refit's squared excess by held-out scores [noise floors]; None if the refit has no excess.

    ``network_score`` is that of the better of black box and learned discrepancy.

    The best of model and networks is the estimate of what can be explained. It is a lower bound: a larger network or
    more recordings may predict more.
    """
    excess, model, network = (max(score**2 - 1.0, 0.0) for score in (refit_score, model_score, network_score))
    if excess <= 0.0:
        return None
    model = min(model, excess)
    best = min(model, network)
    return Ceiling((excess - model) / excess, (model - best) / excess, best / excess)
