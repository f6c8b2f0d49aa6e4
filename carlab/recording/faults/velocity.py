"""Faults of velocity columns by kinematics alone: a velocity is the derivative of the pose.

No physics of the car enters. A marker off the centre, a rotated body or a latency act on the pose and on its derivative
alike. A filter behind the velocities is fitted and is no fault.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import gaussian_filter1d

from carlab.core.planar import to_body
from carlab.core.quantities import FloatArray
from carlab.recording.column_mapping import UNITS, VELOCITY_CHANNELS
from carlab.recording.faults.fault import Fault
from carlab.recording.faults.robust import (
    FILTER_LAG_PERIODS,
    LAGS_S,
    ColumnFit,
    first_order_lag,
    fit_column,
    robust_std,
    trimmed_scale,
)
from carlab.recording.faults.settings import LIMITS
from carlab.recording.pose_velocity import BoolArray, PoseMotion

Frame = Literal["body", "world"]
MIN_COMPARED_ROWS = 60
"""Minimum number of rows with motion for a comparison of a velocity with the pose."""
SMOOTHING_S = 0.08
"""[s] Standard deviation of the Gaussian that smooths both velocities before filters are compared."""
WORLD_FILTERS_S = np.arange(0.0, 0.3001, 0.02)
"""[s] Time constants of filters of the velocities in the world frame."""


def velocity_references(motion: PoseMotion, frame: Frame = "body") -> dict[str, FloatArray]:
    """Velocities of the pose (N,) that the columns vx, vy [m/s] and yaw_rate [rad/s] should hold."""
    vx, vy = (motion.vx, motion.vy) if frame == "body" else (motion.vx_world, motion.vy_world)
    return {"vx": vx, "vy": vy, "yaw_rate": motion.yaw_rate}


def comparable_rows(motion: PoseMotion, channel: str) -> BoolArray:
    """Rows (N,) in which the motion of the pose is well above noise."""
    moving: BoolArray = np.hypot(motion.vx_world, motion.vy_world) > LIMITS.moving_mps
    return moving | (np.abs(motion.yaw_rate) > LIMITS.turning_radps) if channel == "yaw_rate" else moving


def wrong_velocity_frame(t_s: FloatArray, velocity: FloatArray, motion: PoseMotion, declared: Frame) -> Fault | None:
    """Compare vx and vy (2, N) with the pose in both frames: the right frame leaves far less, whatever the scale."""
    moving = comparable_rows(motion, "vx")
    size = np.mean(velocity[:, moving] ** 2, axis=1)
    total = float(size.sum()) + 1e-18
    unexplained: dict[Frame, float] = {}
    frames: tuple[Frame, Frame] = ("body", "world")
    for frame in frames:
        references = velocity_references(motion, frame)
        shares = [
            fit_column(t_s, references[name], velocity[k], moving).unexplained for k, name in ((0, "vx"), (1, "vy"))
        ]
        unexplained[frame] = float(np.dot(shares, size)) / total
    other: Frame = "world" if declared == "body" else "body"
    if unexplained[declared] <= LIMITS.frame_unexplained:
        return None
    if unexplained[other] >= LIMITS.frame_ratio * unexplained[declared]:
        return None
    observation = (
        f"vx and vy are in the {other} frame, not in the {declared} frame: the motion of the pose leaves "
        f"{unexplained[other]:.1%} of them unexplained there and {unexplained[declared]:.0%} in the {declared} frame"
    )
    evidence = {f"remainder_{frame}_mps": math.sqrt(share * total) for frame, share in unexplained.items()}
    return Fault("wrong_frame", "vx, vy", observation, evidence, f"--velocity-frame {other}")


def rotated_velocity(velocity: FloatArray, motion: PoseMotion) -> Fault | None:
    """Find body velocities (2, N) that are those of the pose in rotated axes, as of a pose whose yaw has an offset."""
    moving = comparable_rows(motion, "vx")
    column, own = (velocity[0] + 1j * velocity[1])[moving], (motion.vx + 1j * motion.vy)[moving]
    angle_rad = float(np.angle(np.vdot(own, column)))
    error = np.abs(column - own)
    error_rotated = np.abs(column * np.exp(-1j * angle_rad) - own)
    is_rotated = float(np.median(error_rotated)) < LIMITS.rotated_ratio * float(np.median(error))
    if not is_rotated or not LIMITS.rotated_rad < abs(angle_rad) < LIMITS.reversed_rad:
        return None
    observation = (
        f"vx and vy are rotated by {np.rad2deg(angle_rad):.0f} degrees against the motion of the pose: the yaw has "
        "another axis than the velocities"
    )
    evidence = {"offset_rad": -angle_rad}
    return Fault("wrong_frame", "vx, vy", observation, evidence, f"--yaw-offset {-angle_rad:.3f}")


def unit_of_scale(channel: str, scale: float) -> str | None:
    """The unit of ``channel``, other than SI, whose numbers are ``scale`` times those in SI."""
    units = list(UNITS[channel].items())[1:]
    return next((unit for unit, factor in units if abs(scale * factor - 1.0) < LIMITS.unit_share), None)


def scale_faults(channel: str, fit: ColumnFit, reference: FloatArray) -> list[Fault]:
    """Sign, unit and factor of a velocity column by its fit to the pose's velocity.

    Args:
        channel: ``vx``, ``vy`` or ``yaw_rate``; ``vx, vy`` for the speed of both.
        fit: the column fitted by the reference.
        reference: the pose's velocity on the compared rows (n,), in SI units.

    Returns:
        Faults with ``factor`` in their evidence, by which to multiply the column; without it, the column does not
        measure the motion at all.
    """
    size, rms = abs(fit.scale), math.sqrt(float(np.mean(reference**2)))
    evidence = {"slope": fit.scale, "unexplained": fit.unexplained}
    is_constant = size < LIMITS.constant_scale and rms > LIMITS.constant_mps
    if is_constant or (rms > 0.3 and fit.unexplained > LIMITS.unrelated_unexplained):
        observation = f"{channel} does not follow the motion of the pose"
        return [Fault("column_scale", channel, observation, evidence, "--velocities pose")]
    if fit.unexplained > LIMITS.sign_unexplained or rms < 1e-6 or size == 0.0:
        return []
    faults = []
    flag = channel.replace("_", "-")
    if fit.scale < 0:
        observation = f"{channel} runs against the motion of the pose (slope {fit.scale:.2f})"
        faults.append(Fault("wrong_sign", channel, observation, evidence | {"factor": -1.0}, f"--{flag}-sign -1"))
    is_off = abs(size - 1.0) > max(LIMITS.scale_share, 4.0 * math.sqrt(fit.unexplained / len(reference)))
    if not is_off or fit.unexplained >= LIMITS.scale_unexplained[0 if 0.75 < size < 4.0 / 3.0 else 1]:
        return faults
    names = channel.split(", ")
    unit = unit_of_scale(names[0], size)
    factor = 1.0 / size if unit is None else UNITS[names[0]][unit]
    quantity, verb = ("speed", "are") if len(names) > 1 else ("motion", "is")
    observation = f"{channel} {verb} {size:.4g} times the {quantity} of the pose"
    observation += f": the unit looks like {unit}" if unit else ""
    what = f"unit {unit}" if unit else f"scale {factor:.4g}"
    option = " ".join(f"--{name.replace('_', '-')}-{what}" for name in names)
    identity = "wrong_unit" if unit else "column_scale"
    return [*faults, Fault(identity, channel, observation, evidence | {"factor": factor}, option)]


def wrong_frame_rate(faults: Sequence[Fault]) -> Fault | None:
    """The fault of stamps that run too fast or too slow: the velocities have one factor against the pose.

    Args:
        faults: those of ``scale_faults``. Small lateral velocities have none, because noise hides their factor.

    Returns:
        The fault with ``factor`` in its evidence, by which to multiply the stamps or else all velocities.
    """
    slopes = {
        channel: fault.evidence["slope"]
        for fault in faults
        if "factor" in fault.evidence and fault.id != "wrong_sign"
        for channel in fault.channel.split(", ")
    }
    if not {"vx", "yaw_rate"} <= slopes.keys():
        return None
    values = np.array(list(slopes.values()))
    scale = float(values.mean())
    if values.min() <= 0.0 or np.ptp(values) > LIMITS.common_scale_share * scale:
        return None
    observation = (
        f"{', '.join(slopes)} are all {scale:.4g} times the motion of the pose: probably the stamps are too "
        f"{'far apart' if scale > 1.0 else 'close together'} (a wrong frame rate), or else the velocities have this "
        "wrong scale"
    )
    return Fault("wrong_frame_rate", ", ".join(("t", *VELOCITY_CHANNELS)), observation, {"factor": 1.0 / scale})


@dataclass(frozen=True, slots=True)
class Spikes:
    """Spikes of a column: rows with a spike, with a spike or its tail, and other rows far off; each (N,).

    ``error_sigmas`` (N,) is the absolute error of the fit over its robust standard deviation.
    """

    peaks: BoolArray
    rows: BoolArray
    others: BoolArray
    error_sigmas: FloatArray

    def without(self, rows: BoolArray) -> Spikes:
        """The spikes outside ``rows`` (N,)."""
        return Spikes(self.peaks & ~rows, self.rows & ~rows, self.others & ~rows, self.error_sigmas)


def velocity_spikes(channel: str, period_s: float, column: FloatArray, prediction: FloatArray) -> Spikes:
    """Rows of a velocity column (N,) [m/s or rad/s] far from ``prediction`` (N,), its fit to the pose's velocity."""
    index = VELOCITY_CHANNELS.index(channel)
    error = np.abs(column - prediction)
    sigma = robust_std(column - prediction)
    peaks = error > max(LIMITS.spike_sigmas * sigma, LIMITS.spike_step[index] / period_s)
    far = error > max(LIMITS.spike_tail_sigmas * sigma, LIMITS.spike_tail[index])
    near = np.convolve(peaks, np.ones(5), mode="same") > 0
    return Spikes(peaks, peaks | (far & near), far & ~near, error / max(sigma, 1e-12))


def spike_fault(channel: str, column: FloatArray, spikes: Spikes, motion: PoseMotion) -> Fault | None:
    """Spikes of a column (N,): at one yaw, they are differences of a wrapped angle; at no particular yaw, outliers."""
    peaks = spikes.peaks
    if not peaks.any():
        return None
    direction = complex(np.exp(1j * motion.yaw_unwrapped[peaks]).mean())
    is_wrap = channel == "yaw_rate" and abs(direction) > LIMITS.wrap_concentration
    size = np.abs(column[peaks])
    share_ccw = float(np.mean(motion.yaw_rate[peaks] > 0))
    where = (
        f"all where yaw passes {np.angle(direction):.1f} rad, {share_ccw:.0%} of them counter-clockwise: the "
        "difference of a wrapped angle"
        if is_wrap
        else "at no particular yaw: outliers"
    )
    observation = (
        f"{channel} has {len(size)} spikes of {size.min():.0f} to {size.max():.0f} {next(iter(UNITS[channel]))} "
        f"({int(spikes.rows.sum())} rows with their tails), {where}"
    )
    evidence = {"spikes": len(size), "smallest": size.min(), "largest": size.max(), "share_ccw": share_ccw}
    identity = "yaw_wrap_spikes" if is_wrap else "outliers"
    rows = np.flatnonzero(spikes.rows)
    return Fault(identity, channel, observation, {k: float(v) for k, v in evidence.items()}, "--repair-yaw-rate", rows)


def velocity_lag(channel: str, period_s: float, fit: ColumnFit) -> Fault | None:
    """Dead time of a column behind the pose. A fifth of a row is what the fit resolves on 30 s of clean data."""
    if abs(fit.lag_s) < 0.2 * period_s or fit.unexplained > 0.9**2 * fit.unexplained_unshifted:
        return None
    rows = fit.lag_s / period_s
    like = ", as backward differences are" if abs(rows - 0.5) < 0.15 else ""
    evidence: Mapping[str, float] = {
        "lag_s": fit.lag_s,
        "rows": rows,
        "remainder": fit.residual_rms,
        "remainder_unshifted": fit.rms * math.sqrt(fit.unexplained_unshifted),
    }
    verb = ("lag" if rows > 0.0 else "precede") + ("" if "," in channel else "s")
    size = f"{abs(fit.lag_s) * 1e3:.0f} ms ({abs(rows):.2f} rows{like})"
    observation = f"{channel} {verb} the differentiated pose by {size}"
    return Fault("column_shift", channel, observation, evidence, "--velocities pose")


def early_velocities(t_s: FloatArray, states: FloatArray, motion: PoseMotion) -> Fault | None:
    """Velocities in ``states`` (N, 6) that precede the motion of its poses by half a row or more.

    A filter makes velocities late, not early. So the poses have a longer delay than the velocities, for example if a
    gyroscope measures the yaw rate and motion capture has a latency. Both vx and yaw rate must precede the motion; vy
    is often noise and does not count.
    """
    period_s = float(np.median(np.diff(t_s)))
    references = velocity_references(motion)
    found = []
    for channel in ("vx", "yaw_rate"):
        column, rows = states[:, 3 + VELOCITY_CHANNELS.index(channel)], comparable_rows(motion, channel)
        if rows.sum() < MIN_COMPARED_ROWS:
            return None
        fit = fit_column(t_s, references[channel], column, rows, lags_s=LAGS_S, time_constants_s=(0.0,))
        found.append(velocity_lag(channel, period_s, fit))
    if any(fault is None or fault.evidence["rows"] > -0.5 for fault in found):
        return None
    lead_s = -float(np.mean([fault.evidence["lag_s"] for fault in found if fault is not None]))
    observation = f"the velocities precede the motion of the pose by {lead_s * 1e3:.0f} ms: the poses are late"
    return Fault("column_shift", "vx, vy, yaw_rate", observation, {"lead_s": lead_s}, "--velocities pose")


def world_filtered_velocities(t_s: FloatArray, states: FloatArray, motion: PoseMotion) -> Fault | None:
    """Velocities in ``states`` (N, 6) that were filtered in the world frame and then rotated by the present yaw.

    While the car turns, such a filter puts a part of the forward velocity into vy: about vx times yaw rate times lag. A
    filter of body velocities does not. Only vy is compared, because vx hardly differs.
    """
    moving = comparable_rows(motion, "vx")
    if moving.sum() < MIN_COMPARED_ROWS:
        return None
    period_s = float(np.median(np.diff(t_s)))
    width = SMOOTHING_S / period_s
    column = gaussian_filter1d(states[:, 4], width)[moving]

    def remainder(frame: Frame, time_constant_s: float, dead_time_s: float) -> float:
        """Mean square of vy that the pose leaves, with both of its velocities filtered in a frame."""
        references = (velocity_references(motion, frame)[channel] for channel in ("vx", "vy"))
        filtered = (first_order_lag(each, period_s, time_constant_s) for each in references)
        ahead, left = (np.interp(t_s - dead_time_s, t_s, each) for each in filtered)
        vy = left if frame == "body" else to_body(ahead, left, motion.yaw_unwrapped)[1]
        return trimmed_scale(gaussian_filter1d(vy, width)[moving], column)[1]

    filters = [(tau, rows * period_s) for tau in WORLD_FILTERS_S for rows in FILTER_LAG_PERIODS]
    in_body = min(remainder("body", *each) for each in filters)
    in_world = [remainder("world", *each) for each in filters]
    if min(in_world) >= LIMITS.frame_ratio * in_body:
        return None
    lag_s = sum(filters[int(np.argmin(in_world))])
    rms_mps = math.sqrt(in_body)
    observation = (
        f"vx and vy are those of the world frame about {lag_s * 1e3:.0f} ms before (by a filter or a difference of "
        f"poses), rotated by the present yaw, so a part of vx is in vy (about {rms_mps:.2g} m/s)"
    )
    return Fault("wrong_frame", "vx, vy", observation, {"lag_s": lag_s, "remainder_mps": rms_mps}, "--velocities pose")


def backward_differences(t_s: FloatArray, states: FloatArray, segment: FloatArray, motion: PoseMotion) -> Fault | None:
    """Whether the velocities in ``states`` (N, 6) are backward differences of its poses, by any clock.

    Such columns are half a row late and contain nothing else than the pose. The comparison is relative and about the
    medians: nominal stamps change both by the same factor.
    """
    distance = np.hypot(*np.diff(states[:, :2], axis=0).T)
    speed = np.hypot(states[1:, 3], states[1:, 4])
    centred = np.hypot(motion.vx, motion.vy)[1:]
    rows = (np.diff(segment) == 0) & (speed > 0.5) & (distance > 0) & (centred > 0.1)
    if rows.sum() < 100:
        return None
    to_backward = robust_std(speed[rows] * np.diff(t_s)[rows] / distance[rows])
    if to_backward > min(0.4 * robust_std(speed[rows] / centred[rows]), 0.02):
        return None
    observation = (
        f"the velocities are backward differences of the pose (the speeds agree within {to_backward:.1%}), so they are "
        f"half a row ({500 * float(np.median(np.diff(t_s))):.0f} ms) late"
    )
    return Fault("column_shift", "vx, vy, yaw_rate", observation)
