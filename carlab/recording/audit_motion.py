"""Checks of units, frames, signs, spikes and lag of velocity columns against the motion of the pose itself."""

from __future__ import annotations

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.recording.audit_compare import correlation, fit_lag, unit_of_scale
from carlab.recording.audit_heading import MOVING_MPS
from carlab.recording.audit_report import Finding, Severity, first_rows
from carlab.recording.csv_mapping import ColumnMapping
from carlab.recording.pose_velocity import BoolArray, PoseMotion

LAGS_S = np.arange(-0.05, 0.3001, 0.005)


def check_yaw_rate(
    t_s: FloatArray, yaw_rate: FloatArray, motion: PoseMotion, mapping: ColumnMapping
) -> tuple[list[Finding], BoolArray]:
    """Unit, sign, lag and spikes of a yaw_rate column (N,). Returns findings and the mask of spiked rows, (N,)."""
    name = mapping.columns["yaw_rate"].name
    spikes = np.zeros(len(t_s), dtype=bool)
    turning = np.abs(motion.yaw_rate) > 0.3
    if turning.sum() < 30:
        return [], spikes
    fit = fit_lag(t_s, motion.yaw_rate, yaw_rate, turning, LAGS_S)
    evidence = {"slope": fit.scale, "correlation": fit.correlation}
    findings = []
    unit = unit_of_scale("yaw_rate", fit.scale)
    if unit:
        findings.append(
            Finding(
                "wrong_unit",
                "yaw_rate",
                Severity.FAULT if mapping.columns["yaw_rate"].unit else Severity.ERROR,
                f"Column '{name}' (yaw_rate) is {fit.scale:.1f} times the turn rate of yaw: it is in degrees a "
                f"second; say so "
                f"with --yaw-rate-unit {unit}.",
                evidence=evidence,
                option=f"--yaw-rate-unit {unit}",
            )
        )
    if fit.scale < 0 and fit.correlation < -0.5:
        findings.append(
            Finding(
                "wrong_sign",
                "yaw_rate",
                Severity.FAULT,
                f"Column '{name}' (yaw_rate) turns against yaw (slope {fit.scale:.2f}, correlation "
                f"{fit.correlation:.2f}); "
                "use --yaw-rate-sign -1.",
                evidence=evidence,
                option="--yaw-rate-sign -1",
            )
        )
    elif not unit and fit.correlation > 0.8 and fit.scale > 0 and abs(fit.scale - 1) > 0.15:
        findings.append(
            Finding(
                "column_scale",
                "yaw_rate",
                Severity.FAULT,
                f"Column '{name}' (yaw_rate) is {fit.scale:.2f} times the turn rate of yaw; use --yaw-rate-scale "
                f"{1 / fit.scale:.3f}.",
                evidence=evidence,
                option=f"--yaw-rate-scale {1 / fit.scale:.3f}",
            )
        )
    if findings:
        return findings, spikes
    findings += _lag_finding("yaw_rate", name, t_s, fit.lag_s, fit.remainder, fit.remainder_unshifted)
    error = yaw_rate - np.interp(t_s - fit.lag_s, t_s, motion.yaw_rate)
    sigma = 1.4826 * float(np.median(np.abs(error)))
    period = float(np.median(np.diff(t_s)))
    # A wrapped difference is off by 2 pi / period; a filter after it lowers that, so a quarter counts, if it is far
    # from the noise. Its tail through the filter is what lies within two rows and still is 8 sigma and 3 rad/s off.
    main = np.abs(error) > max(8 * sigma, 0.25 * 2 * np.pi / period)
    off = np.abs(error) > max(8 * sigma, 3.0)
    near = np.convolve(main, np.ones(5), mode="same") > 0
    if main.any():
        directions = np.exp(1j * motion.yaw_unwrapped[main])
        together = abs(directions.mean()) > 0.8
        ccw = float(np.mean(motion.yaw_rate[main] > 0))
        spikes = off & near
        at = np.flatnonzero(main)
        value = np.abs(yaw_rate[main])
        where = (
            f"all where yaw passes {float(np.angle(directions.mean())):.1f} rad, {ccw:.0%} of them "
            f"counter-clockwise: the "
            "difference of a wrapped angle"
            if together
            else "at no particular yaw: outliers"
        )
        repaired = mapping.repair_yaw_rate
        findings.append(
            Finding(
                "yaw_wrap_spikes" if together else "outliers",
                "yaw_rate",
                Severity.REPAIRED if repaired else Severity.FAULT,
                f"Column '{name}' (yaw_rate) has {len(at)} spikes of {value.min():.0f} to {value.max():.0f} rad/s "
                f"({int(spikes.sum())} rows "
                f"with their tails), {where}; "
                + (
                    "those rows were taken from the pose."
                    if repaired
                    else "take those rows from the pose with --repair-yaw-rate."
                ),
                int(spikes.sum()),
                first_rows(np.flatnonzero(spikes), 60),
                {"spikes": len(at), "smallest": float(value.min()), "largest": float(value.max()), "share_ccw": ccw},
                None if repaired else "--repair-yaw-rate",
            )
        )
    other = np.flatnonzero(off & ~near)
    if len(other):
        findings.append(
            Finding(
                "outliers",
                "yaw_rate",
                Severity.INFO,
                f"Column '{name}' (yaw_rate) is more than {max(8 * sigma, 3.0):.1f} rad/s away from the turn rate "
                f"of yaw in "
                f"{len(other)} further rows (first row {other[0] + 1}): an impact, or a frame that came late.",
                len(other),
                first_rows(other),
            )
        )
    return findings, spikes


def check_velocity(
    t_s: FloatArray, vx: FloatArray, vy: FloatArray, motion: PoseMotion, mapping: ColumnMapping
) -> list[Finding]:
    """Unit, frame, signs and lag of vx, vy columns (N,), as in the file but for unit and sign, against the pose."""
    speed = np.hypot(motion.vx_world, motion.vy_world)
    moving = speed > MOVING_MPS
    if moving.sum() < 50:
        return []
    ratio = float(np.median(np.hypot(vx, vy)[moving] / speed[moving]))
    names = f"'{mapping.columns['vx'].name}', '{mapping.columns['vy'].name}'"
    if ratio < 1e-6:
        return [
            Finding(
                "column_scale",
                "vx, vy",
                Severity.FAULT,
                f"Columns {names} are zero while the pose moves; estimate velocities from it with --velocities pose.",
                option="--velocities pose",
            )
        ]
    unit = unit_of_scale("vx", ratio)
    evidence = {"speed_ratio": ratio}
    if unit or abs(ratio - 1) > 0.15:
        option = (
            f"--vx-unit {unit} --vy-unit {unit}" if unit else f"--vx-scale {1 / ratio:.4g} --vy-scale {1 / ratio:.4g}"
        )
        undeclared = unit is not None and mapping.columns["vx"].unit is None
        what = f"they look like {unit}; say so with" if unit else "scale them with"
        return [
            Finding(
                "wrong_unit" if unit else "column_scale",
                "vx, vy",
                Severity.ERROR if undeclared else Severity.FAULT,
                f"Columns {names} are {ratio:.4g} times the speed of the pose; {what} {option}.",
                evidence=evidence,
                option=option,
            )
        ]
    frames = {"body": (motion.vx, motion.vy), "world": (motion.vx_world, motion.vy_world)}
    remainder = {}
    for frame, (rx, ry) in frames.items():
        for sx, sy in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            miss = np.hypot(sx * vx - rx, sy * vy - ry)[moving]
            remainder[frame, sx, sy] = float(np.median(miss))
    declared = mapping.velocity_frame
    best = min(remainder, key=lambda key: remainder[key])
    evidence |= {f"remainder_{frame}_mps": remainder[frame, 1, 1] for frame in frames}
    findings = []
    typical = float(np.median(speed[moving]))
    # Read rightly, columns and pose differ by lag and noise, at most a tenth or so of the speed; 0.6: the better
    # reading must leave clearly less, and 0.15 of the speed: a good match is not doubted.
    wrong = remainder[declared, 1, 1] > 0.15 * typical and remainder[best] < 0.6 * remainder[declared, 1, 1]
    if wrong and best[0] != declared:
        findings.append(
            Finding(
                "wrong_frame",
                "vx, vy",
                Severity.FAULT,
                f"Columns {names} are in the {best[0]} frame, not in the {declared} frame: against the pose they "
                f"are off by "
                f"{remainder[best]:.3f} m/s read so and by {remainder[declared, 1, 1]:.3f} m/s as declared "
                f"(median); use "
                f"--velocity-frame {best[0]}.",
                evidence=evidence,
                option=f"--velocity-frame {best[0]}",
            )
        )
    rx, ry = frames[best[0]] if wrong else frames[declared]
    for channel, column, reference in (("vx", vx, rx), ("vy", vy, ry)):
        r = correlation(reference[moving], column[moving])
        if r < -0.5:
            findings.append(
                Finding(
                    "wrong_sign",
                    channel,
                    Severity.FAULT,
                    f"Column '{mapping.columns[channel].name}' ({channel}) runs against the pose (correlation "
                    f"{r:.2f}); use "
                    f"--{channel}-sign -1.",
                    evidence={"correlation": r},
                    option=f"--{channel}-sign -1",
                )
            )
    if not findings:
        fits = [fit_lag(t_s, ref, col, moving, LAGS_S) for ref, col in ((rx, vx), (ry, vy))]
        fit = max(fits, key=lambda f: f.remainder_unshifted)
        findings += _lag_finding("vx, vy", names, t_s, fit.lag_s, fit.remainder, fit.remainder_unshifted)
    return findings


def _lag_finding(
    channel: str, name: str, t_s: FloatArray, lag_s: float, remainder: float, unshifted: float
) -> list[Finding]:
    period = float(np.median(np.diff(t_s)))
    # A fifth of a row is what the comparison resolves on 30 s of clean data; less, or hardly better, is no finding.
    if abs(lag_s) < 0.2 * period or remainder > 0.9 * unshifted:
        return []
    rows = lag_s / period
    like = ", as backward differences are" if abs(rows - 0.5) < 0.15 else ""
    return [
        Finding(
            "column_shift",
            channel,
            Severity.INFO,
            f"{name if channel != 'yaw_rate' else 'yaw_rate'} lag the differentiated pose by {lag_s * 1e3:.0f} ms "
            f"({rows:.2f} rows{like}); "
            "estimate velocities without delay with --velocities pose.",
            evidence={"lag_s": lag_s, "rows": rows, "remainder": remainder, "remainder_unshifted": unshifted},
            option="--velocities pose",
        )
    ]
