"""Check of the pose: unit of x, y and yaw, sense of rotation and axes, by the course over ground."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.recording.audit.report import Finding, Severity
from carlab.recording.csv.mapping import ColumnMapping

MOVING_MPS = 0.2
"""Slower than this, the course over ground is noise."""


@dataclass(frozen=True, slots=True)
class _Course:
    """Course over ground [rad] and yaw as declared on the rows that move, and the turn per metre there; each (n,)."""

    course: FloatArray
    yaw: FloatArray
    turn_per_m: FloatArray


def check_heading(t_s: FloatArray, values: Mapping[str, FloatArray], mapping: ColumnMapping) -> list[Finding]:
    """Compare yaw with the course over ground: unit, sense of rotation, constant offset.

    A car moves along its heading, forward or backward, up to its slip. So course - yaw, doubled to make forward and
    backward alike, is concentrated when yaw is read rightly, and spread over the circle otherwise.
    """
    reach = max(1, round(0.05 / float(np.median(np.diff(t_s)))))
    span = t_s[2 * reach :] - t_s[: -2 * reach]
    dx, dy, turn = (values[name][2 * reach :] - values[name][: -2 * reach] for name in ("x", "y", "yaw"))
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    distance = np.hypot(dx, dy)
    speed = distance / span
    findings, unit_per_m = _check_length_unit(speed, mapping)
    moving = speed > MOVING_MPS * unit_per_m
    course = np.arctan2(dy, dx)[moving]
    if moving.sum() < 50 or abs(np.mean(np.exp(2j * course))) > 0.95:
        findings.append(
            Finding(
                "too_little_motion",
                "yaw",
                Severity.INFO,
                f"The car moves in only {int(moving.sum())} rows or always the same way: unit and sign of yaw "
                "cannot be checked.",
                int(moving.sum()),
            )
        )
        return findings
    return findings + _check_yaw(
        _Course(course, values["yaw"][reach:-reach][moving], turn[moving] / distance[moving]), mapping
    )


def _check_length_unit(speed: FloatArray, mapping: ColumnMapping) -> tuple[list[Finding], float]:
    """Unit of x and y by the speed (N,) that they give. Returns findings and how many of that unit are a metre."""
    fast = float(np.percentile(speed, 95)) if len(speed) else 0.0
    # 40 m/s: no model car drives that fast; one that reaches 0.04 m/s does where millimetres pass for metres.
    if fast <= 40.0:
        return [], 1.0
    unit, unit_per_m = ("mm", 1000.0) if fast > 400.0 else ("cm", 100.0)
    option = f"--x-unit {unit} --y-unit {unit}"
    finding = Finding(
        "wrong_unit",
        "x, y",
        Severity.WARNING if mapping.columns["x"].unit else Severity.ERROR,
        f"The pose moves at up to {fast:.0f} m/s if x and y are metres: they look like {unit}; say so with "
        f"{option} (or --x-unit m --y-unit m if it is so).",
        evidence={"speed_p95_mps": fast},
        option=option,
    )
    return [finding], unit_per_m


def _check_yaw(path: _Course, mapping: ColumnMapping) -> list[Finding]:
    """Unit, sense of rotation and offset of yaw by how concentrated course - yaw is under each reading."""
    means = {
        (unit, sign): complex(np.mean(np.exp(2j * (path.course - sign * factor * path.yaw))))
        for unit, factor in (("rad", 1.0), ("deg", np.pi / 180.0))
        for sign in (1, -1)
    }
    best = max(means, key=lambda key: abs(means[key]))
    declared, found = abs(means["rad", 1]), abs(means[best])
    evidence = {f"concentration_{u}{'+' if s > 0 else '-'}": abs(m) for (u, s), m in means.items()}
    # 0.2 apart: with n_eff of some tens of independent courses, chance concentrations stay below 0.3 and honest ones
    # above 0.7 (a drifting car included: 0.9 in recordings with 0.3 rad of slip).
    if best != ("rad", 1) and found > 0.6 and found - declared > 0.2:
        findings = [_degrees(found, declared, evidence, mapping)] if best[0] == "deg" else []
        if best[1] < 0:
            findings.append(_clockwise(means[best], declared, evidence))
        return findings
    offset = _offset(path.course, path.yaw, path.turn_per_m, float(np.angle(means["rad", 1])) / 2)
    # 10 degrees: a misplaced rigid body may be off by less, another convention (yaw from north) is off by 90.
    if declared <= 0.6 or abs(offset) <= np.deg2rad(10):
        return []
    return [
        Finding(
            "wrong_frame",
            "yaw",
            Severity.FAULT,
            f"The car moves {np.rad2deg(offset):.0f} degrees away from its yaw on average: yaw is measured from "
            f"another axis; add {offset:.3f} rad with --yaw-offset {offset:.3f}.",
            evidence={**evidence, "offset_rad": offset},
            option=f"--yaw-offset {offset:.3f}",
        )
    ]


def _degrees(found: float, declared: float, evidence: Mapping[str, float], mapping: ColumnMapping) -> Finding:
    return Finding(
        "wrong_unit",
        "yaw",
        Severity.FAULT if mapping.columns["yaw"].unit else Severity.ERROR,
        f"Column '{mapping.columns['yaw'].name}' (yaw) follows the course over ground only when read in degrees "
        f"(agreement {found:.2f} against {declared:.2f} in radians); say so with --yaw-unit deg.",
        evidence=evidence,
        option="--yaw-unit deg",
    )


def _clockwise(mean: complex, declared: float, evidence: Mapping[str, float]) -> Finding:
    """Yaw counts the other way: x and y are exchanged where the offset that is left is a right angle."""
    exchanged = abs(np.angle(mean)) / 2 > np.pi / 4
    option = "--swap-xy" if exchanged else "--yaw-sign -1"
    cause = "x and y are exchanged" if exchanged else "yaw counts clockwise, or y points to the right"
    return Finding(
        "wrong_frame" if exchanged else "wrong_sign",
        "yaw",
        Severity.FAULT,
        f"Yaw turns against the course over ground (agreement {abs(mean):.2f} with the sign changed, {declared:.2f} as "
        f"it is): {cause}; use {option}" + ("." if exchanged else " (or --y-sign -1)."),
        evidence=evidence,
        option=option,
    )


def _offset(course: FloatArray, yaw: FloatArray, turn_per_m: FloatArray, mean: float) -> float:
    """Angle from yaw to course without what turning adds: a point ahead of the rear axle moves sideways in a turn.

    Fits course - yaw = offset + ahead * (signed path curvature) by the rows less than 45 degrees from ``mean``.
    """
    away = (course - yaw - mean + np.pi) % (2 * np.pi) - np.pi
    forward = np.where(np.abs(away) < np.pi / 2, 1.0, -1.0)
    away = (away + np.pi / 2) % np.pi - np.pi / 2
    near = np.abs(away) < np.pi / 4
    design = np.column_stack([np.ones(int(near.sum())), (forward * turn_per_m)[near]])
    if float(np.std(design[:, 1])) < 1e-6:
        return mean
    fitted = mean + float(np.linalg.lstsq(design, away[near], rcond=None)[0][0])
    return min(mean, fitted, key=abs)  # always turning alike, the fit extrapolates; turning tightly, the mean is biased
