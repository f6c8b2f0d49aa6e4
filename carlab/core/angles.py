"""Angles [rad]; unless stated otherwise, functions take floats, NumPy arrays and torch tensors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from carlab.core.quantities import FloatArray


def wrap(angle_rad: Any) -> Any:
    """Map angles (...) onto [-pi, pi). Differentiable with slope 1 for torch tensors."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


def align_unwrapped(measured_rad: FloatArray, starts: ArrayLike, predicted_rad: FloatArray) -> tuple[FloatArray, ...]:
    """Unwrap a measured angle (n,), and shift predictions (B, N) by multiples of 2 pi to match it at their starts.

    Args:
        measured_rad: angle at the ticks (n,).
        starts: tick of the first angle of each prediction (B,).
        predicted_rad: unwrapped predictions (B, N).

    Returns:
        The unwrapped angle (n,) and the shifted predictions (B, N).
    """
    whole = np.unwrap(measured_rad)
    turns = np.round((whole[np.asarray(starts, dtype=int)] - predicted_rad[:, 0]) / (2.0 * np.pi))
    return whole, predicted_rad + 2.0 * np.pi * turns[:, None]
