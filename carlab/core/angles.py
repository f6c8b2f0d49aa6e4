"""Angles [rad]; functions take Python floats, NumPy arrays and torch tensors alike unless they say otherwise."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from carlab.core.quantities import FloatArray


def wrap(angle_rad: Any) -> Any:
    """Map onto [-pi, pi). Differentiable with slope 1 for torch tensors."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


def difference(a_rad: Any, b_rad: Any) -> Any:
    """Smallest signed turn from ``b_rad`` to ``a_rad``."""
    return wrap(a_rad - b_rad)


def circular_mean(angles_rad: FloatArray) -> float:
    """Direction of the mean unit vector of NumPy angles, shape (n,)."""
    return float(np.arctan2(np.mean(np.sin(angles_rad)), np.mean(np.cos(angles_rad))))
