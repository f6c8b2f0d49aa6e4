"""Checks of commands: range, sign and delay by their effect; and of sensors that measure a state again."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.recording.audit.comparison import correlation, fit_lag, held_at
from carlab.recording.audit.report import Finding, Severity, first_rows
from carlab.recording.csv.mapping import COMMAND_CHANNELS, ColumnMapping
from carlab.recording.pose_velocity import BoolArray, PoseMotion

_LAGS_S = np.arange(0.0, 0.601, 0.02)
_SLOW_MPS = 0.3


def check_command_range(values: Mapping[str, FloatArray], mapping: ColumnMapping) -> list[Finding]:
    """Commands beyond [-1, 1], and commands that never change. The last row's command is not looked at."""
    findings = []
    for channel in COMMAND_CHANNELS:
        column = values[channel][:-1]
        name = mapping.columns[channel].name
        largest = float(np.abs(column).max())
        beyond = np.flatnonzero(np.abs(column) > 1.0 + 1e-6)
        if len(beyond):
            # Up to 5 % beyond is a calibration that overshoots; more is another unit (degrees, per cent, microseconds).
            grave = largest > 1.05
            option = f"--{channel}-scale {1 / largest:.3g}"
            findings.append(
                Finding(
                    "command_range",
                    channel,
                    Severity.ERROR if grave else Severity.WARNING,
                    f"Column '{name}' ({channel}) reaches {largest:.4g} where commands lie in [-1, 1], first in "
                    f"row {beyond[0] + 1}; "
                    f"say what full command is, for example {option}.",
                    len(beyond),
                    first_rows(beyond),
                    {"largest": largest},
                    option,
                )
            )
        elif float(np.ptp(column)) < 1e-6:
            findings.append(
                Finding(
                    "constant_command",
                    channel,
                    Severity.WARNING,
                    f"Column '{name}' ({channel}) is {column[0]:.3g} throughout: nothing can be learnt about its "
                    f"effect.",
                    len(column),
                )
            )
    return findings


def check_gate(throttle: FloatArray, gate: FloatArray, name: str) -> list[Finding]:
    """Rows whose throttle did not reach the motor because the gate column (N,) is not 1."""
    inert = np.flatnonzero((throttle != 0) & (gate != 1) & np.isfinite(throttle))
    if not len(inert):
        return []
    return [
        Finding(
            "gated_throttle",
            "throttle",
            Severity.REPAIRED,
            f"In {len(inert)} rows (first row {inert[0] + 1}) throttle is logged but '{name}' is not 1, so the "
            f"car did not get it: "
            "'sent' holds their product, 'requested' the column.",
            len(inert),
            first_rows(inert),
        )
    ]


def check_steering(t_s: FloatArray, steering: FloatArray, motion: PoseMotion) -> list[Finding]:
    """Sign and delay of steering by the path's curvature yaw_rate / vx, positive to the left in reverse too."""
    moving = np.abs(motion.vx) > _SLOW_MPS
    if moving.sum() < 100 or np.ptp(steering) < 0.05:
        return []
    # 5 1/m: a turning circle of 0.2 m, tighter than any such car; beyond it the car spins or stands.
    curvature = np.clip(motion.yaw_rate / np.where(moving, motion.vx, 1.0), -5.0, 5.0)
    best, lag = max(
        ((correlation(held_at(t_s, steering, lag)[moving], curvature[moving]), lag) for lag in _LAGS_S),
        key=lambda pair: abs(pair[0]),
    )
    held = held_at(t_s, steering, lag)
    evidence = {"correlation": best, "delay_s": float(lag)}
    for word, rows in (("forward", motion.vx > _SLOW_MPS), ("reverse", motion.vx < -_SLOW_MPS)):
        if rows.sum() > 100:
            evidence[f"correlation_yaw_rate_{word}"] = correlation(held[rows], motion.yaw_rate[rows])
    # 0.3: far above chance for a few dozen turns; a driven car reaches 0.6 when it drifts and 0.99 when it does not.
    if abs(best) < 0.3:
        return [
            Finding(
                "unclear_sign",
                "steering",
                Severity.INFO,
                f"Steering and the path's curvature hardly correlate ({best:.2f}): its sign cannot be told from "
                f"this recording.",
                evidence=evidence,
            )
        ]
    if best < 0:
        return [
            Finding(
                "wrong_sign",
                "steering",
                Severity.FAULT,
                f"Positive steering turns right (correlation with curvature {best:.2f}); use --steering-sign -1.",
                evidence=evidence,
                option="--steering-sign -1",
            )
        ]
    return [_delay("steering", "the path's curvature", best, float(lag), evidence)]


def check_throttle(t_s: FloatArray, throttle: FloatArray, motion: PoseMotion, segment: FloatArray) -> list[Finding]:
    """Sign and delay of throttle: acceleration ~ a * throttle(t - delay) + b * vx + c."""
    if np.ptp(throttle) < 0.05 or np.abs(motion.vx).max() < _SLOW_MPS:
        return []
    acceleration = np.gradient(motion.vx, t_s)
    usable = np.concatenate([[False], np.diff(segment) == 0]) & (np.abs(acceleration) < 30.0)
    moving = usable & (np.hypot(motion.vx, motion.vy) > 0.05)
    if moving.sum() < 100:
        return []
    best = (-1.0, 0.0, 0.0)
    for lag in _LAGS_S:
        held = held_at(t_s, throttle, lag)[moving]
        design = np.column_stack([held, motion.vx[moving], np.ones(len(held))])
        target = acceleration[moving]
        coefficients = np.linalg.lstsq(design, target, rcond=None)[0]
        explained = 1 - float(np.var(target - design @ coefficients) / np.var(target))
        best = max(best, (explained, float(coefficients[0]), float(lag)))
    explained, gain, lag = best
    with_speed = correlation(held_at(t_s, throttle, lag)[usable], motion.vx[usable])
    evidence = {"explained": explained, "gain": gain, "delay_s": lag, "correlation_speed": with_speed}
    # 5 % of the variance explained by throttle and speed together is reached in any recording with starts and stops;
    # where throttle is steady, it shows in the speed that it holds.
    sign = np.sign(gain) if explained > 0.05 else 0.0
    if (sign < 0 and with_speed < 0.3) or (sign == 0 and with_speed < -0.3):
        return [
            Finding(
                "wrong_sign",
                "throttle",
                Severity.FAULT,
                f"Positive throttle drives backward along yaw (gain {gain:.2f} m/s^2, correlation with speed "
                f"{with_speed:.2f}); use "
                "--throttle-sign -1, or --yaw-offset 3.1416 if yaw points to the rear.",
                evidence=evidence,
                option="--throttle-sign -1",
            )
        ]
    if sign <= 0 and with_speed < 0.3:
        return [
            Finding(
                "unclear_sign",
                "throttle",
                Severity.INFO,
                f"Throttle explains too little of the motion ({explained:.0%} of the acceleration): its sign "
                f"cannot be told.",
                evidence=evidence,
            )
        ]
    return [_delay("throttle", "the acceleration", explained, lag, evidence)] if explained > 0.2 else []


def check_reference(t_s: FloatArray, name: str, column: FloatArray, channel: str, state: FloatArray) -> list[Finding]:
    """Compare a sensor (N,) with the state (N,) it measures again; find where the pose stands still meanwhile."""
    findings = []
    # Where tracking is lost or another body is taken for the car, the pose freezes and the sensor still sees motion.
    # Half a second: longer than the sensor's own lag (0.1 to 0.2 s) when the car stops.
    threshold = max(0.25 * float(np.percentile(np.abs(column), 95)), 0.2)
    frozen = _long_runs((np.abs(state) < 0.02) & (np.abs(column) > threshold), t_s, 0.5)
    if frozen.any():
        at = np.flatnonzero(frozen)
        findings.append(
            Finding(
                "frozen_pose",
                "x, y, yaw",
                Severity.FAULT,
                f"The pose stands still in {len(at)} rows (first row {at[0] + 1}, {t_s[at[0]]:.2f} s) in which "
                f"'{name}' shows motion: "
                "it is not the car's; split the recording with --gaps split and leave that part out.",
                len(at),
                first_rows(at),
                {"seconds": float(len(at) * np.median(np.diff(t_s)))},
                "--gaps split",
            )
        )
    usable = ~frozen & np.isfinite(column) & (np.abs(state) > threshold)
    if usable.sum() < 100:
        return findings
    lags_s = np.arange(-0.05, 0.4, 0.01)
    fit = fit_lag(t_s, state, column, usable, lags_s)
    inside = lags_s[0] < fit.lag_s < lags_s[-1]
    if abs(fit.correlation) > 0.3:
        later = f"{fit.lag_s * 1e3:.0f} ms later" if inside else "at a lag that this drive does not tell"
        findings.append(
            Finding(
                "reference_column",
                channel,
                Severity.INFO,
                f"'{name}' is {fit.scale:.2f} times the {channel} of the pose, {later} (correlation "
                f"{fit.correlation:.2f}); it is kept as an extra column and not used for the state.",
                evidence={"scale": fit.scale, "correlation": fit.correlation}
                | ({"lag_s": fit.lag_s} if inside else {}),
            )
        )
    return findings


def _long_runs(mask: BoolArray, t_s: FloatArray, least_s: float) -> BoolArray:
    """The part of ``mask`` (N,) in unbroken runs of at least ``least_s``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    kept = np.zeros(len(mask), dtype=bool)
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        kept[start:end] = t_s[end - 1] - t_s[start] >= least_s
    return kept


def _delay(channel: str, effect: str, strength: float, lag_s: float, evidence: Mapping[str, float]) -> Finding:
    return Finding(
        "command_delay",
        channel,
        Severity.INFO,
        f"{effect[0].upper()}{effect[1:]} follows {channel} after about {lag_s:.2f} s (agreement {strength:.2f}), "
        f"delay, servo or motor "
        "and tyres together.",
        evidence=evidence,
    )
