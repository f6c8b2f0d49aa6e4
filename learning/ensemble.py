"""A deep ensemble: networks that differ by their start alone (Lakshminarayanan et al. 2017), the plainest baseline."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from learning.fsvgd import FsvgdSettings, Posterior, fit
from learning.normaliser import Normaliser


def deep_ensemble(inputs: Tensor, outputs: Tensor, normaliser: Normaliser, settings: FsvgdSettings) -> Posterior:
    """Fit every particle by itself to the likelihood, with the optimiser's weight decay as the only prior.

    Args:
        inputs: (n, D), n > 0.
        outputs: (n, O).
        normaliser: of both.
        settings: of the fit; kernel and preconditioning are left out.
    """
    alone = replace(settings, together=False)
    return fit(inputs, outputs, inputs, None, normaliser, alone)


__all__ = ["deep_ensemble"]
