"""Keep-out shapes: areas of the plan that the car must not enter. Positions are NumPy or torch, batched."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from carlab.core.geofence import contains

Corners = tuple[tuple[float, float], ...]
_OUTLINE_POINTS = 32


@dataclass(frozen=True, slots=True)
class Disc:
    """A disc with centre (x, y) [m] and radius [m]."""

    x_m: float
    y_m: float
    radius_m: float

    def contains(self, positions_m: Any) -> Any:
        """Whether positions (..., 2) lie inside, booleans (...,)."""
        dx, dy = positions_m[..., 0] - self.x_m, positions_m[..., 1] - self.y_m
        return dx * dx + dy * dy < self.radius_m**2

    @property
    def outline_m(self) -> Corners:
        """Corners of a polygon that approximates the circle."""
        angles = np.linspace(0.0, 2.0 * math.pi, _OUTLINE_POINTS, endpoint=False)
        x, y = self.x_m + self.radius_m * np.cos(angles), self.y_m + self.radius_m * np.sin(angles)
        return tuple((float(a), float(b)) for a, b in zip(x, y, strict=True))


@dataclass(frozen=True, slots=True)
class Polygon:
    """A polygon with corners (x, y) [m] in either sense."""

    outline_m: Corners

    def contains(self, positions_m: Any) -> Any:
        """Whether positions (..., 2) lie inside by the even-odd rule, booleans (...,)."""
        return contains(self.outline_m, positions_m[..., 0], positions_m[..., 1])


KeepOut = Disc | Polygon
