"""Geofence: whether the car can stop inside the arena. Polygons are corners (n, 2) [m] in ``map``, in either sense."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlab.core.errors import ConfigError
from carlab.core.quantities import CarState, FloatArray

Polygon = Sequence[tuple[float, float]]


def as_polygon(corners_m: Polygon, where: str) -> tuple[tuple[float, float], ...]:
    """Check a user's corners: at least three, finite, with a positive area. Raises ConfigError."""
    try:
        points = np.asarray(corners_m, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        points = np.full((0, 2), np.nan)
    if points.ndim != 2 or points.shape[0] < 3 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ConfigError(f"{where} must be at least three corners [x, y] in metres.")
    x, y = points.T
    if abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) < 2e-4:
        raise ConfigError(f"{where} encloses no area; list its corners in order.")
    return tuple((float(a), float(b)) for a, b in points)


def contains(corners_m: Polygon, x_m: Any, y_m: Any) -> Any:
    """Whether points lie inside the polygon (even-odd rule); floats, or arrays (...) of NumPy or torch."""
    inside: Any = False
    previous_x, previous_y = corners_m[-1]
    for corner_x, corner_y in corners_m:
        if corner_y != previous_y:
            spans = (corner_y > y_m) != (previous_y > y_m)
            crossing_x = corner_x + (y_m - corner_y) / (previous_y - corner_y) * (previous_x - corner_x)
            inside = (spans & (x_m < crossing_x)) ^ inside
        previous_x, previous_y = corner_x, corner_y
    return inside


def free_distance_m(corners_m: Polygon, x_m: Any, y_m: Any, heading_rad: Any) -> FloatArray:
    """Distances (...) [m] from points (...) along headings (...) to the polygon's nearest edge; inf without one."""
    corners = np.asarray(corners_m, dtype=np.float64)
    before = np.roll(corners, 1, axis=0)
    edge_x, edge_y = (corners - before).T
    to_x, to_y = before[:, 0] - np.asarray(x_m)[..., None], before[:, 1] - np.asarray(y_m)[..., None]
    direction_x, direction_y = np.cos(heading_rad)[..., None], np.sin(heading_rad)[..., None]
    cross = direction_x * edge_y - direction_y * edge_x
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (to_x * edge_y - to_y * edge_x) / cross
        on_edge = (to_x * direction_y - to_y * direction_x) / cross
    met = (np.abs(cross) > 1e-12) & (along >= 0.0) & (on_edge >= -1e-9) & (on_edge <= 1.0 + 1e-9)
    return np.asarray(np.where(met, along, np.inf).min(axis=-1))


def stopping_distance_m(speed_mps: Any, reaction_s: float, deceleration_mps2: float) -> Any:
    """Stopping distance [m]: travel during the reaction time plus v^2 / (2 a), for a speed or an array of speeds."""
    return speed_mps * reaction_s + speed_mps**2 / (2.0 * deceleration_mps2)


def can_stop_inside(corners_m: Polygon, state: CarState, reaction_s: float, deceleration_mps2: float) -> bool:
    """Whether the car and its stopping point, straight along its course over ground, are inside."""
    if not contains(corners_m, state.x_m, state.y_m):
        return False
    speed = state.speed_mps
    course_rad = state.yaw_rad + math.atan2(state.vy_mps, state.vx_mps)
    needed = stopping_distance_m(speed, reaction_s, deceleration_mps2)
    # From inside, every ray meets an edge: infinity means a NaN course or a point on an edge.
    return bool(needed < free_distance_m(corners_m, state.x_m, state.y_m, course_rad) < math.inf)


def can_stop_inside_batch(
    corners_m: Polygon, places_m: FloatArray, course_rad: FloatArray, needed_m: FloatArray
) -> NDArray[np.bool_]:
    """Whether cars (n,) at places (n, 2) can stop inside, by their courses over ground and stopping distances (n,)."""
    x_m, y_m = places_m.T
    free = free_distance_m(corners_m, x_m, y_m, course_rad)
    found: NDArray[np.bool_] = contains(corners_m, x_m, y_m) & (needed_m < free) & (free < np.inf)
    return found


def rectangle(x_low_m: float, x_high_m: float, y_low_m: float, y_high_m: float) -> tuple[tuple[float, float], ...]:
    """Corners of a rectangle, counter-clockwise."""
    return ((x_low_m, y_low_m), (x_high_m, y_low_m), (x_high_m, y_high_m), (x_low_m, y_high_m))
