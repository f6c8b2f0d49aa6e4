"""Checks of units, frames, signs, spikes and lag of velocity columns against the motion of the pose itself."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.recording.audit.comparison import LagFit, correlation, fit_lag, unit_of_scale
from carlab.recording.audit.heading import MOVING_MPS
from carlab.recording.audit.report import Finding, Severity, first_rows
from carlab.recording.csv.mapping import ColumnMapping
from carlab.recording.pose_velocity import BoolArray, PoseMotion

LAGS_S = np.arange(-0.05, 0.3001, 0.005)


def check_yaw_rate(
    t_s: FloatArray, yaw_rate: FloatArray, motion: PoseMotion, mapping: ColumnMapping
) -> tuple[list[Finding], BoolArray]:
    """Unit, sign, lag and spikes of a yaw_rate column (N,). Returns findings and the mask of spiked rows, (N,)."""
    name = mapping.columns["yaw_rate"].name
    turning = np.abs(motion.yaw_rate) > 0.3
    no_spikes = np.zeros(len(t_s), dtype=bool)
    if turning.sum() < 30:
        return [], no_spikes
    fit = fit_lag(t_s, motion.yaw_rate, yaw_rate, turning, LAGS_S)
    findings = _check_turn_scale(fit, mapping)
    if findings:
        return findings, no_spikes
    findings = _lag_finding("yaw_rate", name, t_s, fit)
    found, spikes = _check_spikes(t_s, yaw_rate, motion, fit.lag_s, mapping)
    return findings + found, spikes


def _check_turn_scale(fit: LagFit, mapping: ColumnMapping) -> list[Finding]:
    """Unit, sign and factor of yaw_rate by its slope over the turn rate of yaw."""
    column = f"Column '{mapping.columns['yaw_rate'].name}' (yaw_rate)"
    evidence = {"slope": fit.scale, "correlation": fit.correlation}
    findings = []
    unit = unit_of_scale("yaw_rate", fit.scale)
    if unit:
        option = f"--yaw-rate-unit {unit}"
        sentence = (
            f"{column} is {fit.scale:.1f} times the turn rate of yaw: it is in degrees a second; say so with {option}."
        )
        severity = Severity.FAULT if mapping.columns["yaw_rate"].unit else Severity.ERROR
        findings.append(Finding("wrong_unit", "yaw_rate", severity, sentence, evidence=evidence, option=option))
    if fit.scale < 0 and fit.correlation < -0.5:
        option = "--yaw-rate-sign -1"
        sentence = (
            f"{column} turns against yaw (slope {fit.scale:.2f}, correlation {fit.correlation:.2f}); use {option}."
        )
        findings.append(Finding("wrong_sign", "yaw_rate", Severity.FAULT, sentence, evidence=evidence, option=option))
    elif not unit and fit.correlation > 0.8 and fit.scale > 0 and abs(fit.scale - 1) > 0.15:
        option = f"--yaw-rate-scale {1 / fit.scale:.3f}"
        sentence = f"{column} is {fit.scale:.2f} times the turn rate of yaw; use {option}."
        findings.append(Finding("column_scale", "yaw_rate", Severity.FAULT, sentence, evidence=evidence, option=option))
    return findings


def _check_spikes(
    t_s: FloatArray, yaw_rate: FloatArray, motion: PoseMotion, lag_s: float, mapping: ColumnMapping
) -> tuple[list[Finding], BoolArray]:
    """Rows far from the turn rate of yaw. Returns findings and the mask of spikes with their tails, (N,)."""
    name = mapping.columns["yaw_rate"].name
    error = yaw_rate - np.interp(t_s - lag_s, t_s, motion.yaw_rate)
    sigma = 1.4826 * float(np.median(np.abs(error)))
    period = float(np.median(np.diff(t_s)))
    # A wrapped difference is off by 2 pi / period; a filter after it lowers that, so a quarter counts, if it is far
    # from the noise. Its tail through the filter is what lies within two rows and still is 8 sigma and 3 rad/s off.
    main = np.abs(error) > max(8 * sigma, 0.25 * 2 * np.pi / period)
    off = np.abs(error) > max(8 * sigma, 3.0)
    near = np.convolve(main, np.ones(5), mode="same") > 0
    spikes = off & near if main.any() else np.zeros(len(t_s), dtype=bool)
    findings = [_spike_finding(yaw_rate, motion, main, spikes, mapping)] if main.any() else []
    other = np.flatnonzero(off & ~near)
    if len(other):
        findings.append(
            Finding(
                "outliers",
                "yaw_rate",
                Severity.INFO,
                f"Column '{name}' (yaw_rate) is more than {max(8 * sigma, 3.0):.1f} rad/s away from the turn rate "
                f"of yaw in {len(other)} further rows (first row {other[0] + 1}): an impact, or a frame that came "
                "late.",
                len(other),
                first_rows(other),
            )
        )
    return findings, spikes


def _spike_finding(
    yaw_rate: FloatArray, motion: PoseMotion, main: BoolArray, spikes: BoolArray, mapping: ColumnMapping
) -> Finding:
    """Spikes at one yaw come from the difference of a wrapped angle; spikes at no particular yaw are outliers."""
    directions = np.exp(1j * motion.yaw_unwrapped[main])
    wrapped = bool(abs(directions.mean()) > 0.8)
    share_ccw = float(np.mean(motion.yaw_rate[main] > 0))
    size = np.abs(yaw_rate[main])
    count, smallest, largest = len(size), float(size.min()), float(size.max())
    where = (
        f"all where yaw passes {float(np.angle(directions.mean())):.1f} rad, {share_ccw:.0%} of them "
        "counter-clockwise: the difference of a wrapped angle"
        if wrapped
        else "at no particular yaw: outliers"
    )
    repaired = mapping.repair_yaw_rate
    remedy = (
        "those rows were taken from the pose" if repaired else "take those rows from the pose with --repair-yaw-rate"
    )
    return Finding(
        "yaw_wrap_spikes" if wrapped else "outliers",
        "yaw_rate",
        Severity.REPAIRED if repaired else Severity.FAULT,
        f"Column '{mapping.columns['yaw_rate'].name}' (yaw_rate) has {count} spikes of {smallest:.0f} to "
        f"{largest:.0f} rad/s ({int(spikes.sum())} rows with their tails), {where}; {remedy}.",
        int(spikes.sum()),
        first_rows(np.flatnonzero(spikes), 60),
        {"spikes": count, "smallest": smallest, "largest": largest, "share_ccw": share_ccw},
        None if repaired else "--repair-yaw-rate",
    )


def check_velocity(
    t_s: FloatArray, vx: FloatArray, vy: FloatArray, motion: PoseMotion, mapping: ColumnMapping
) -> list[Finding]:
    """Unit, frame, signs and lag of vx, vy columns (N,), as in the file but for unit and sign, against the pose."""
    speed = np.hypot(motion.vx_world, motion.vy_world)
    moving = speed > MOVING_MPS
    if moving.sum() < 50:
        return []
    names = f"'{mapping.columns['vx'].name}', '{mapping.columns['vy'].name}'"
    ratio = float(np.median(np.hypot(vx, vy)[moving] / speed[moving]))
    findings = _check_speed_scale(ratio, names, mapping)
    if findings:
        return findings
    frames = {"body": (motion.vx, motion.vy), "world": (motion.vx_world, motion.vy_world)}
    frame, findings = _check_frame(vx, vy, frames, moving, {"speed_ratio": ratio}, mapping)
    columns = {"vx": (vx, frames[frame][0]), "vy": (vy, frames[frame][1])}
    for channel, (column, reference) in columns.items():
        r = correlation(reference[moving], column[moving])
        if r < -0.5:
            option = f"--{channel}-sign -1"
            sentence = (
                f"Column '{mapping.columns[channel].name}' ({channel}) runs against the pose (correlation {r:.2f}); "
                f"use {option}."
            )
            evidence = {"correlation": r}
            findings.append(Finding("wrong_sign", channel, Severity.FAULT, sentence, evidence=evidence, option=option))
    if findings:
        return findings
    fits = [fit_lag(t_s, reference, column, moving, LAGS_S) for column, reference in columns.values()]
    return _lag_finding("vx, vy", names, t_s, max(fits, key=lambda fit: fit.remainder_unshifted))


def _check_speed_scale(ratio: float, names: str, mapping: ColumnMapping) -> list[Finding]:
    """Unit or factor of vx and vy by the median ``ratio`` of their speed to that of the pose."""
    if ratio < 1e-6:
        sentence = f"Columns {names} are zero while the pose moves; estimate velocities from it with --velocities pose."
        return [Finding("column_scale", "vx, vy", Severity.FAULT, sentence, option="--velocities pose")]
    unit = unit_of_scale("vx", ratio)
    if not unit and abs(ratio - 1) <= 0.15:
        return []
    option = f"--vx-unit {unit} --vy-unit {unit}" if unit else f"--vx-scale {1 / ratio:.4g} --vy-scale {1 / ratio:.4g}"
    undeclared = unit is not None and mapping.columns["vx"].unit is None
    what = f"they look like {unit}; say so with" if unit else "scale them with"
    return [
        Finding(
            "wrong_unit" if unit else "column_scale",
            "vx, vy",
            Severity.ERROR if undeclared else Severity.FAULT,
            f"Columns {names} are {ratio:.4g} times the speed of the pose; {what} {option}.",
            evidence={"speed_ratio": ratio},
            option=option,
        )
    ]


def _check_frame(
    vx: FloatArray,
    vy: FloatArray,
    frames: Mapping[str, tuple[FloatArray, FloatArray]],
    moving: BoolArray,
    evidence: Mapping[str, float],
    mapping: ColumnMapping,
) -> tuple[str, list[Finding]]:
    """Compare vx and vy with the pose's velocity in each frame, under all signs. Returns the frame to use, findings."""
    remainder = {
        (frame, sx, sy): float(np.median(np.hypot(sx * vx - rx, sy * vy - ry)[moving]))
        for frame, (rx, ry) in frames.items()
        for sx in (1, -1)
        for sy in (1, -1)
    }
    declared = mapping.velocity_frame
    best = min(remainder, key=lambda key: remainder[key])
    median_speed = float(np.median(np.hypot(*frames["world"])[moving]))
    # Read rightly, columns and pose differ by lag and noise, at most a tenth or so of the speed. Another reading is
    # accepted only if it leaves less than 0.6 of the remainder, and if that is more than 0.15 of the speed.
    wrong = remainder[declared, 1, 1] > 0.15 * median_speed and remainder[best] < 0.6 * remainder[declared, 1, 1]
    if not wrong or best[0] == declared:
        return declared, []
    finding = Finding(
        "wrong_frame",
        "vx, vy",
        Severity.FAULT,
        f"Columns '{mapping.columns['vx'].name}', '{mapping.columns['vy'].name}' are in the {best[0]} frame, not in "
        f"the {declared} frame: against the pose they are off by {remainder[best]:.3f} m/s read so and by "
        f"{remainder[declared, 1, 1]:.3f} m/s as declared (median); use --velocity-frame {best[0]}.",
        evidence={**evidence, **{f"remainder_{frame}_mps": remainder[frame, 1, 1] for frame in frames}},
        option=f"--velocity-frame {best[0]}",
    )
    return best[0], [finding]


def _lag_finding(channel: str, name: str, t_s: FloatArray, fit: LagFit) -> list[Finding]:
    period = float(np.median(np.diff(t_s)))
    # A fifth of a row is what the comparison resolves on 30 s of clean data; less, or hardly better, is no finding.
    if abs(fit.lag_s) < 0.2 * period or fit.remainder > 0.9 * fit.remainder_unshifted:
        return []
    rows = fit.lag_s / period
    like = ", as backward differences are" if abs(rows - 0.5) < 0.15 else ""
    return [
        Finding(
            "column_shift",
            channel,
            Severity.INFO,
            f"{name if channel != 'yaw_rate' else 'yaw_rate'} lag the differentiated pose by {fit.lag_s * 1e3:.0f} ms "
            f"({rows:.2f} rows{like}); estimate velocities without delay with --velocities pose.",
            evidence={
                "lag_s": fit.lag_s,
                "rows": rows,
                "remainder": fit.remainder,
                "remainder_unshifted": fit.remainder_unshifted,
            },
            option="--velocities pose",
        )
    ]
