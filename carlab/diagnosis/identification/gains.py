"""Gains of a fit whose errors depend on one another within a block of the recording."""

from __future__ import annotations

import math

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.fit import Fit
from carlab.prediction.windows import PredictionWindows


def clustered_gain(before: FloatArray, after: FloatArray, windows: PredictionWindows) -> tuple[float, float]:
    """Fall of the loss from ``before`` to ``after`` (S,) and its standard error, clustered by block."""
    gain = before - after
    blocks, index = np.unique(windows.block, return_inverse=True)
    sums = np.bincount(index, weights=gain, minlength=len(blocks))
    error = math.sqrt(len(blocks)) * float(sums.std(ddof=1)) if len(blocks) > 1 else math.inf
    return float(gain.sum()), max(error, 1e-9)


def design_effect_of(fit: Fit, effect: str) -> float:
    """Design effect of an effect's parameters: variance by blocks over that for independent errors, at least one.

    Twice the gain of several parameters is a sum of chi-squares weighted by such ratios, so their mean divides it
    (Kent 1982). The median of all parameters replaces it if that of the effect is undefined (a limit never reached).
    """
    assert fit.design_effects is not None
    own = [
        float(d) for f, d in zip(fit.free, fit.design_effects, strict=True)
        if f.name.startswith(f"effects.{effect}.") and d > 1e-9
    ]  # fmt: skip
    return max(fit.design_effect, float(np.mean(own)) if own else 0.0)
