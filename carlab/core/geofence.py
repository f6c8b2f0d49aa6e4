"""Will the car stop inside the arena? Pure geometry; polygons are corners (n, 2) [m] in ``map``, in either sense."""

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
    """Check corners given by a user: at least three, finite, and enclosing an area. Raises ConfigError."""
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


def contains(corners_m: Polygon, x_m: float, y_m: float) -> bool:
    """True where the point lies inside the polygon (even-odd rule)."""
    inside = False
    previous_x, previous_y = corners_m[-1]
    for corner_x, corner_y in corners_m:
        if (corner_y > y_m) != (previous_y > y_m):
            crossing_x = corner_x + (y_m - corner_y) / (previous_y - corner_y) * (previous_x - corner_x)
            if x_m < crossing_x:
                inside = not inside
        previous_x, previous_y = corner_x, corner_y
    return inside


def free_distance_m(corners_m: Polygon, x_m: float, y_m: float, heading_rad: float) -> float:
    """Distance [m] from a point along a heading to the polygon's nearest edge; inf where the ray meets none."""
    direction_x, direction_y = math.cos(heading_rad), math.sin(heading_rad)
    nearest = math.inf
    previous_x, previous_y = corners_m[-1]
    for corner_x, corner_y in corners_m:
        edge_x, edge_y = corner_x - previous_x, corner_y - previous_y
        to_x, to_y = previous_x - x_m, previous_y - y_m
        cross = direction_x * edge_y - direction_y * edge_x
        if abs(cross) > 1e-12:
            along = (to_x * edge_y - to_y * edge_x) / cross
            on_edge = (to_x * direction_y - to_y * direction_x) / cross
            if along >= 0.0 and -1e-9 <= on_edge <= 1.0 + 1e-9:
                nearest = min(nearest, along)
        previous_x, previous_y = corner_x, corner_y
    return nearest


def stopping_distance_m(speed_mps: Any, reaction_s: float, deceleration_mps2: float) -> Any:
    """Distance to standstill: travel during the reaction time plus v^2 / (2 a); of a speed or an array of them."""
    return speed_mps * reaction_s + speed_mps**2 / (2.0 * deceleration_mps2)


def can_stop_inside(corners_m: Polygon, state: CarState, reaction_s: float, deceleration_mps2: float) -> bool:
    """True where the car is inside and its stopping point, straight along its motion over ground, is inside too."""
    if not contains(corners_m, state.x_m, state.y_m):
        return False
    speed = state.speed_mps
    course_rad = state.yaw_rad + math.atan2(state.vy_mps, state.vx_mps)
    needed = stopping_distance_m(speed, reaction_s, deceleration_mps2)
    # From inside, every way meets an edge somewhere: infinity means a course that is none, or an edge just touched.
    return bool(needed < free_distance_m(corners_m, state.x_m, state.y_m, course_rad) < math.inf)


def each_can_stop_inside(
    corners_m: Polygon, places_m: FloatArray, course_rad: FloatArray, needed_m: FloatArray
) -> NDArray[np.bool_]:
    """``can_stop_inside`` of many cars at once.

    Args:
        corners_m: the polygon.
        places_m: where the cars are (n, 2).
        course_rad: which way they move over ground (n,).
        needed_m: their stopping distances (n,).

    Returns:
        True where a car can (n,).
    """
    corners = corners_array(corners_m)
    before = np.roll(corners, 1, axis=0)
    edge = corners - before
    to = before - places_m[:, None]  # (n, edges, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = places_m[:, :1] - edge[:, 0] / edge[:, 1] * to[:, :, 1] + to[:, :, 0]
        spans = (corners[:, 1] > places_m[:, 1:]) != (before[:, 1] > places_m[:, 1:])
        inside = np.sum(spans & (places_m[:, :1] < crossing), axis=1) % 2 == 1
        direction = np.stack([np.cos(course_rad), np.sin(course_rad)], axis=1)[:, None]
        cross = _cross(direction, edge)
        along, on_edge = _cross(to, edge) / cross, _cross(to, direction) / cross
    met = (np.abs(cross) > 1e-12) & (along >= 0.0) & (on_edge >= -1e-9) & (on_edge <= 1.0 + 1e-9)
    free = np.where(met, along, np.inf).min(axis=1)
    found: NDArray[np.bool_] = inside & (needed_m < free) & (free < np.inf)
    return found


def _cross(first: FloatArray, second: FloatArray) -> FloatArray:
    found: FloatArray = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    return found


def rectangle(x_low_m: float, x_high_m: float, y_low_m: float, y_high_m: float) -> tuple[tuple[float, float], ...]:
    """Corners of a rectangle, counter-clockwise."""
    return ((x_low_m, y_low_m), (x_high_m, y_low_m), (x_high_m, y_high_m), (x_low_m, y_high_m))


def corners_array(corners_m: Polygon) -> FloatArray:
    """Corners as an array (n, 2)."""
    return np.asarray(corners_m, dtype=np.float64).reshape(-1, 2)
