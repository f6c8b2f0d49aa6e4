"""Check of the pose: unit of x, y and yaw, sense of rotation and axes, by the course over ground."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.recording.audit_report import Finding, Severity
from carlab.recording.csv_mapping import ColumnMapping

MOVING_MPS = 0.2
"""Slower than this, the course over ground is noise."""


def check_heading(t_s: FloatArray, values: Mapping[str, FloatArray], mapping: ColumnMapping) -> list[Finding]:
    """Compare yaw with the course over ground: unit, sense of rotation, constant offset.

    A car moves along its heading, forward or backward, up to its slip. So course - yaw, doubled to make forward and
    backward alike, is concentrated when yaw is read rightly, and spread over the circle otherwise.
    """
    reach = max(1, round(0.05 / float(np.median(np.diff(t_s)))))
    span = t_s[2 * reach :] - t_s[: -2 * reach]
    dx = values["x"][2 * reach :] - values["x"][: -2 * reach]
    dy = values["y"][2 * reach :] - values["y"][: -2 * reach]
    yaw = values["yaw"][reach:-reach]
    turn = (values["yaw"][2 * reach :] - values["yaw"][: -2 * reach] + np.pi) % (2 * np.pi) - np.pi
    speed = np.hypot(dx, dy) / span
    findings = []
    fast = float(np.percentile(speed, 95)) if len(speed) else 0.0
    # 40 m/s: no model car drives that fast; one that reaches 0.04 m/s does where millimetres pass for metres.
    if fast > 40.0:
        unit = "mm" if fast > 400.0 else "cm"
        findings.append(
            Finding(
                "wrong_unit",
                "x, y",
                Severity.WARNING if mapping.columns["x"].unit else Severity.ERROR,
                f"The pose moves at up to {fast:.0f} m/s if x and y are metres: they look like {unit}; say so with "
                f"--x-unit {unit} --y-unit {unit} (or --x-unit m --y-unit m if it is so).",
                evidence={"speed_p95_mps": fast},
                option=f"--x-unit {unit} --y-unit {unit}",
            )
        )
    moving = speed > MOVING_MPS * (1000.0 if fast > 400.0 else 100.0 if fast > 40.0 else 1.0)
    course = np.arctan2(dy, dx)[moving]
    if moving.sum() < 50 or abs(np.mean(np.exp(2j * course))) > 0.95:
        findings.append(
            Finding(
                "too_little_motion",
                "yaw",
                Severity.INFO,
                f"The car moves in only {int(moving.sum())} rows or always the same way: unit and sign of yaw "
                f"cannot be checked.",
                int(moving.sum()),
            )
        )
        return findings
    means = {
        (unit, sign): complex(np.mean(np.exp(2j * (course - sign * factor * yaw[moving]))))
        for unit, factor in (("rad", 1.0), ("deg", np.pi / 180.0))
        for sign in (1, -1)
    }
    best = max(means, key=lambda key: abs(means[key]))
    unit, sign = best
    declared, found = abs(means["rad", 1]), abs(means[best])
    evidence = {f"concentration_{u}{'+' if s > 0 else '-'}": abs(m) for (u, s), m in means.items()}
    # 0.2 apart: with n_eff of some tens of independent courses, chance concentrations stay below 0.3 and honest ones
    # above 0.7 (a drifting car included: 0.9 in recordings with 0.3 rad of slip).
    if best != ("rad", 1) and found > 0.6 and found - declared > 0.2:
        if unit == "deg":
            findings.append(
                Finding(
                    "wrong_unit",
                    "yaw",
                    Severity.FAULT if mapping.columns["yaw"].unit else Severity.ERROR,
                    f"Column '{mapping.columns['yaw'].name}' (yaw) follows the course over ground only when read "
                    f"in degrees "
                    f"(agreement {found:.2f} against {declared:.2f} in radians); say so with --yaw-unit deg.",
                    evidence=evidence,
                    option="--yaw-unit deg",
                )
            )
        if sign < 0:
            turned = abs(np.angle(means[best])) / 2 > np.pi / 4
            option = "--swap-xy" if turned else "--yaw-sign -1"
            other = "x and y are exchanged" if turned else "yaw counts clockwise, or y points to the right"
            findings.append(
                Finding(
                    "wrong_sign" if not turned else "wrong_frame",
                    "yaw",
                    Severity.FAULT,
                    f"Yaw turns against the course over ground (agreement {found:.2f} with the sign changed, "
                    f"{declared:.2f} as it "
                    f"is): {other}; use {option}" + ("." if turned else " (or --y-sign -1)."),
                    evidence=evidence,
                    option=option,
                )
            )
        return findings
    offset = _offset(course, yaw[moving], turn[moving] / np.hypot(dx, dy)[moving], float(np.angle(means["rad", 1])) / 2)
    # 10 degrees: a misplaced rigid body may be off by less, another convention (yaw from north) is off by 90.
    if declared > 0.6 and abs(offset) > np.deg2rad(10):
        findings.append(
            Finding(
                "wrong_frame",
                "yaw",
                Severity.FAULT,
                f"The car moves {np.rad2deg(offset):.0f} degrees away from its yaw on average: yaw is measured "
                f"from another axis; "
                f"add {offset:.3f} rad with --yaw-offset {offset:.3f}.",
                evidence={**evidence, "offset_rad": offset},
                option=f"--yaw-offset {offset:.3f}",
            )
        )
    return findings


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
