"""Settings by which fits take few draws and steps, for tests whose subject is not the accuracy of a fit."""

from __future__ import annotations

import pytest


def shorten_inference(patch: pytest.MonkeyPatch) -> None:
    """Posteriors over functions have few draws and steps of the optimiser."""
    patch.setattr("learning.posterior.discrepancy.STEPS", 10)
    patch.setattr("learning.posterior.inference.PRIOR_DRAWS", 64)
    patch.setattr("learning.posterior.inference.PARAMETER_DRAWS", 16)
    patch.setattr("learning.posterior.parameter_posterior.MAX_TEMPERING_STEPS", 2)
    patch.setattr("learning.posterior.parameter_posterior.RANDOM_WALK_STEPS", 1)


def shorten_identification(patch: pytest.MonkeyPatch) -> None:
    """Identification has few restarts and steps, which suffice for a pendulum and for two parameters of a car."""
    for name, value in (("STEPS", 60), ("N_RESTARTS", 4), ("REFINEMENT_STEPS", 15)):
        patch.setattr(f"learning.baselines.system_identification.{name}", value)
