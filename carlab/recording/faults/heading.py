"""Unit of x, y and yaw, sense of rotation and axes of a pose, by the course over ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from carlab.core.angles import wrap
from carlab.core.quantities import FloatArray
from carlab.recording.faults.fault import Fault
from carlab.recording.faults.settings import LIMITS


@dataclass(frozen=True, slots=True)
class _Course:
    """Course over ground [rad], yaw [rad] and turn per metre [rad/m] on the rows that move; each (n,)."""

    course: FloatArray
    yaw: FloatArray
    turn_per_m: FloatArray


def heading_faults(t_s: FloatArray, values: Mapping[str, FloatArray]) -> list[Fault]:
    """Compare yaw with the course over ground: unit, sense of rotation, constant offset.

    A car moves along its heading, forward or backward, up to its slip. So course - yaw, doubled to make forward and
    backward alike, is concentrated when yaw is read correctly, and spread over the circle otherwise. ``values`` has x,
    y [m] and yaw [rad] as declared, each (N,).
    """
    reach = max(1, round(0.05 / float(np.median(np.diff(t_s)))))
    span = t_s[2 * reach :] - t_s[: -2 * reach]
    dx, dy, turn = (values[name][2 * reach :] - values[name][: -2 * reach] for name in ("x", "y", "yaw"))
    distance = np.hypot(dx, dy)
    speed = distance / span
    faults, unit_per_m = _length_unit(speed)
    moving = speed > LIMITS.heading_mps * unit_per_m
    course = np.arctan2(dy, dx)[moving]
    n_moving = int(moving.sum())
    if n_moving < 50 and n_moving < 0.5 * len(moving):
        observation = (
            f"the pose moves faster than {LIMITS.heading_mps:g} m/s in only {n_moving} of {len(moving)} rows, so "
            "velocities and commands cannot be compared with it, and a diagnosis needs a drive"
        )
        return [*faults, Fault("standing_pose", "x, y, yaw", observation)]
    if n_moving < 50 or abs(np.mean(np.exp(2j * course))) > 0.95:
        why = f"the car moves in {n_moving} rows only" if n_moving < 50 else "the car always moves in one direction"
        return [*faults, Fault("too_little_motion", "yaw", f"{why}: unit and sign of yaw cannot be checked")]
    path = _Course(course, values["yaw"][reach:-reach][moving], wrap(turn[moving]) / distance[moving])
    return faults + _yaw_faults(path)


def _length_unit(speed: FloatArray) -> tuple[list[Fault], float]:
    """Unit of x and y by the speed (N,) that they give. Returns faults and how many of that unit are a metre."""
    fast = float(np.percentile(speed, 95)) if len(speed) else 0.0
    if fast <= LIMITS.model_car_mps:
        return [], 1.0
    unit, unit_per_m = ("mm", 1000.0) if fast > 10.0 * LIMITS.model_car_mps else ("cm", 100.0)
    observation = f"the pose moves at up to {fast:.0f} m/s if x and y are metres: they look like {unit}"
    option = f"--x-unit {unit} --y-unit {unit}"
    evidence = {"speed_p95_mps": fast, "factor": 1.0 / unit_per_m}
    return [Fault("wrong_unit", "x, y", observation, evidence, option)], unit_per_m


def _yaw_faults(path: _Course) -> list[Fault]:
    """Unit, sense of rotation and offset of yaw by how concentrated course - yaw is under each reading."""
    means = {
        (unit, sign): complex(np.mean(np.exp(2j * (path.course - sign * factor * path.yaw))))
        for unit, factor in (("rad", 1.0), ("deg", np.pi / 180.0))
        for sign in (1, -1)
    }
    best = max(means, key=lambda key: abs(means[key]))
    declared, found = abs(means["rad", 1]), abs(means[best])
    evidence = {f"concentration_{u}{'+' if s > 0 else '-'}": abs(m) for (u, s), m in means.items()}
    is_concentrated = found > LIMITS.heading_concentration
    if best != ("rad", 1) and is_concentrated and found - declared > LIMITS.heading_gain:
        degrees = (
            f"yaw follows the course over ground only when read in degrees (agreement {found:.2f} against "
            f"{declared:.2f} in radians)"
        )
        faults = [Fault("wrong_unit", "yaw", degrees, evidence, "--yaw-unit deg")] if best[0] == "deg" else []
        return faults + ([_clockwise(means[best], declared, evidence)] if best[1] < 0 else [])
    offset = _near_right_angle(_offset(path, float(np.angle(means["rad", 1])) / 2))
    if declared <= LIMITS.heading_concentration or abs(offset) <= LIMITS.heading_offset_rad:
        return []
    observation = f"the car moves {np.rad2deg(offset):.0f} degrees away from its yaw on average: yaw has another axis"
    evidence = {**evidence, "offset_rad": offset}
    return [Fault("wrong_frame", "yaw", observation, evidence, f"--yaw-offset {offset:.3f}")]


def _clockwise(mean: complex, declared: float, evidence: Mapping[str, float]) -> Fault:
    """Yaw counts the other way: x and y are exchanged where the remaining offset is a right angle."""
    exchanged = abs(np.angle(mean)) / 2 > np.pi / 4
    observation = (
        f"yaw turns against the course over ground (agreement {abs(mean):.2f} with the sign changed, {declared:.2f} as "
        f"it is): {'x and y are exchanged' if exchanged else 'yaw counts clockwise, or y points to the right'}"
    )
    option = "--swap-xy" if exchanged else "--yaw-sign -1"
    return Fault("wrong_frame" if exchanged else "wrong_sign", "yaw", observation, evidence, option)


def _near_right_angle(offset: float) -> float:
    """``offset``, or the nearest multiple of a right angle [rad] if a misplaced rigid body explains the difference."""
    right_angle = np.pi / 2 * round(offset / (np.pi / 2))
    return float(right_angle) if abs(offset - right_angle) <= LIMITS.heading_offset_rad else offset


def _offset(path: _Course, mean: float) -> float:
    """Angle from yaw to course [rad] without what turning adds: a point ahead of the rear axle moves sideways.

    Fits course - yaw = offset + ahead * (signed path curvature) by the rows less than 45 degrees from ``mean``. Of two
    opposite angles that slip cannot explain, the one counts by which the car mostly moves forward.
    """
    away = wrap(path.course - path.yaw - mean)
    is_forward = np.abs(away) < np.pi / 2
    away = (away + np.pi / 2) % np.pi - np.pi / 2
    near = np.abs(away) < np.pi / 4
    design = np.column_stack([np.ones(int(near.sum())), (np.where(is_forward, 1.0, -1.0) * path.turn_per_m)[near]])
    offset = mean
    if float(np.std(design[:, 1])) >= 1e-6:
        fitted = mean + float(np.linalg.lstsq(design, away[near], rcond=None)[0][0])
        offset = min(mean, fitted, key=abs)  # the fit extrapolates if all turns are alike; tight turns bias the mean
    is_reversed = abs(offset) > LIMITS.slip_rad and np.mean(is_forward) < 0.5
    return float(wrap(offset + np.pi)) if is_reversed else offset
