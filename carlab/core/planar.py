"""Vectors and motion in the plane, for NumPy arrays and torch tensors."""

from __future__ import annotations

import math
from typing import Any

from array_api_compat import array_namespace


def to_world(ahead: Any, left: Any, yaw_rad: Any) -> tuple[Any, Any]:
    """Components (x, y) of vectors that are given in frames at a yaw; the shapes (...) broadcast."""
    xp = array_namespace(yaw_rad)
    sin, cos = xp.sin(yaw_rad), xp.cos(yaw_rad)
    return cos * ahead - sin * left, sin * ahead + cos * left


def to_body(x: Any, y: Any, yaw_rad: Any) -> tuple[Any, Any]:
    """Components (ahead, left) of vectors (x, y) in frames at a yaw; the shapes (...) broadcast."""
    xp = array_namespace(yaw_rad)
    sin, cos = xp.sin(yaw_rad), xp.cos(yaw_rad)
    return cos * x + sin * y, cos * y - sin * x


def arc(vx: Any, vy: Any, yaw_rate: Any, time_s: Any) -> tuple[Any, Any, Any]:
    """Motion (ahead, left, turn) in the first body frame at constant body velocities, along a circular arc.

    ``vx`` and ``vy`` [m/s], ``yaw_rate`` [rad/s] and ``time_s`` have shapes (...) that broadcast. The motion is in [m]
    and [rad].
    """
    turn = yaw_rate * time_s
    xp = array_namespace(turn)
    along, across = xp.sinc(turn / math.pi), xp.sin(0.5 * turn) * xp.sinc(0.5 * turn / math.pi)
    return time_s * (along * vx - across * vy), time_s * (across * vx + along * vy), turn
