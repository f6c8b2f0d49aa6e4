"""Transforms from the server's axes and rigid body to ``base_link`` in ``map``. Pure functions of numbers.

With Y up, the rotation by +90 degrees about x, (x, y, z) -> (x, -z, y), applies to positions and to the vector parts of
quaternions alike, since the server's body frame has the axes of its world frame. Afterwards z is up in both frames.
"""

from __future__ import annotations

import math

from mocap.natnet.models import Quaternion, Vector3


def z_up_vector(v: Vector3) -> Vector3:
    """Convert a vector from Y up to Z up."""
    return v[0], -v[2], v[1]


def y_up_vector(v: Vector3) -> Vector3:
    """Convert a vector from Z up to Y up: the inverse of ``z_up_vector``."""
    return v[0], v[2], -v[1]


def z_up_quaternion(q: Quaternion) -> Quaternion:
    """Convert a rotation (x, y, z, w) from Y up to Z up."""
    return q[0], -q[2], q[1], q[3]


def y_up_quaternion(q: Quaternion) -> Quaternion:
    """Convert a rotation (x, y, z, w) from Z up to Y up."""
    return q[0], q[2], -q[1], q[3]


def rotate(q: Quaternion, v: Vector3) -> Vector3:
    """Rotate ``v`` by the unit quaternion ``q`` (x, y, z, w): v + 2 w (u x v) + 2 u x (u x v)."""
    x, y, z, w = q
    cx = 2.0 * (y * v[2] - z * v[1])
    cy = 2.0 * (z * v[0] - x * v[2])
    cz = 2.0 * (x * v[1] - y * v[0])
    return (
        v[0] + w * cx + y * cz - z * cy,
        v[1] + w * cy + z * cx - x * cz,
        v[2] + w * cz + x * cy - y * cx,
    )


def yaw_quaternion(yaw_rad: float) -> Quaternion:
    """Quaternion (x, y, z, w) of a rotation about z."""
    return 0.0, 0.0, math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad)


def base_link_pose(
    position_m: Vector3, quaternion: Quaternion, yaw_offset_rad: float, pivot_m: Vector3
) -> tuple[Vector3, float]:
    """Pose of ``base_link`` from the pose of the rigid body (all with Z up).

    Args:
        position_m: Position of the rigid body's pivot in ``map``.
        quaternion: Orientation of the rigid body, x, y, z, w, of unit length.
        yaw_offset_rad: Rotation about z from the rigid body to ``base_link``.
        pivot_m: Position of the pivot in ``base_link``.

    Returns:
        Position of ``base_link`` [m], and the yaw [rad] of its x axis, in (-pi, pi].
    """
    c, s = math.cos(yaw_offset_rad), math.sin(yaw_offset_rad)
    forward = rotate(quaternion, (c, s, 0.0))
    in_body = (c * pivot_m[0] - s * pivot_m[1], s * pivot_m[0] + c * pivot_m[1], pivot_m[2])
    shift = rotate(quaternion, in_body)
    position = (position_m[0] - shift[0], position_m[1] - shift[1], position_m[2] - shift[2])
    return position, math.atan2(forward[1], forward[0])


def tilt_rad(quaternion: Quaternion) -> float:
    """Angle between the body's z axis and the vertical [rad]."""
    x, y, _, _ = quaternion
    return math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))
