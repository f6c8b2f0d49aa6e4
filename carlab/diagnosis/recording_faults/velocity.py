"""Faults of velocity columns, found by kinematics alone: a velocity is the derivative of the pose.

No physics of a car enters, so nothing that a car does can be taken for a fault: a marker off the centre, a turned
body, latency act on the pose and on what is differentiated from it alike. What may be physics of the measurement, a
filter behind the velocities (velocity_filter_lag), is fitted along and left alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.recording_faults.episode_motion import BoolArray, Patient, lagged, spread
from carlab.recording.audit.audit import Channels, check_clock
from carlab.recording.csv.clocks import rebuilt_clock
from carlab.recording.csv.mapping import UNITS
from carlab.recording.pose_velocity import PoseMotion

CHANNELS = ("vx", "vy", "yaw_rate")
SCALE_SHARE = 0.06
"""A factor this far from 1 is a fault: a filter that was not fitted well leaves 2 to 3 %."""
SPIKE_SIGMAS = 12.0
_TIME_CONSTANTS_S = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4)
_SHIFTS = (-1.0, -0.5, 0.0, 0.5, 1.0, 2.0)
_MOVING_MPS = 0.3


@dataclass(frozen=True, slots=True)
class Match:
    """A column is ``scale`` times the pose's velocity through a filter; ``left`` is the share of variance that is not.

    reference (N,) is that filtered velocity.
    """

    scale: float
    left: float
    reference: FloatArray


def check_velocities(patient: Patient) -> None:
    """All checks of vx, vy and yaw rate."""
    if not patient.own_velocities:
        return
    motion = patient.motion()
    moving = np.hypot(motion.vx_world, motion.vy_world) > _MOVING_MPS
    if moving.sum() < 60:
        return
    _check_frame(patient, motion, moving)
    for index, name in enumerate(CHANNELS):
        _check_scale(patient, motion, moving, index, name)
    _check_spikes(patient, motion)
    _check_differences(patient, motion)


def _of_motion(motion: PoseMotion) -> FloatArray:
    return np.column_stack([motion.vx, motion.vy, motion.yaw_rate])


def match(patient: Patient, column: FloatArray, reference: FloatArray, rows: BoolArray) -> Match:
    """Fit ``column`` (N,) by a scaled, filtered, shifted ``reference`` (N,) on ``rows``; spikes do not count."""
    period = patient.period_s
    t_s = patient.times_s
    quiet = rows & (np.abs(column) < 6.0 * np.percentile(np.abs(column[rows]), 90) + 1e-9)
    target = column[quiet]
    total = float(np.mean(target**2)) + 1e-18
    best = Match(0.0, math.inf, reference)
    for time_constant_s in _TIME_CONSTANTS_S:
        filtered = lagged(reference, period, time_constant_s)
        for shift in _SHIFTS:
            moved = np.interp(t_s - shift * period, t_s, filtered)
            x = moved[quiet]
            keep = np.ones(len(x), dtype=bool)
            scale = 0.0
            for _ in range(3):  # least squares without the rows that fit worst
                scale = float(x[keep] @ target[keep]) / (float(x[keep] @ x[keep]) + 1e-18)
                miss = np.abs(target - scale * x)
                keep = miss <= np.percentile(miss, 95)
            left = float(np.mean((target - scale * x)[keep] ** 2)) / total
            if left < best.left:
                best = Match(scale, left, moved)
    return best


def _check_frame(patient: Patient, motion: PoseMotion, moving: BoolArray) -> None:
    """Velocities in the world frame: what a scale and a filter leave there is far less than in the body frame."""
    size = np.mean(patient.states[moving, 3:5] ** 2, axis=0)
    left = {}
    for frame, (ahead, side) in {"body": (motion.vx, motion.vy), "world": (motion.vx_world, motion.vy_world)}.items():
        shares = [match(patient, patient.states[:, 3 + k], (ahead, side)[k], moving).left for k in (0, 1)]
        left[frame] = float(np.dot(shares, size) / size.sum())
    if not (left["body"] > 0.05 and left["world"] < 0.3 * left["body"]):
        return
    c, s = np.cos(motion.yaw_unwrapped), np.sin(motion.yaw_unwrapped)
    vx, vy = patient.states[:, 3].copy(), patient.states[:, 4].copy()
    patient.states[:, 3], patient.states[:, 4] = c * vx + s * vy, c * vy - s * vx
    patient.touched = True
    patient.found(
        "wrong_frame",
        "vx, vy",
        len(vx),
        f"repaired: vx and vy are in the world frame (the pose leaves {left['world']:.1%} of them there and "
        f"{left['body']:.0%} in the body frame unexplained); turned by the yaw.",
    )


def _check_scale(patient: Patient, motion: PoseMotion, moving: BoolArray, index: int, name: str) -> None:
    """Sign, unit and factor of one column."""
    column = patient.states[:, 3 + index]
    reference = _of_motion(motion)[:, index]
    rows = moving if name != "yaw_rate" else moving | (np.abs(motion.yaw_rate) > 0.3)
    found = match(patient, column, reference, rows)
    if found.left > 0.25 or np.std(reference[rows]) < 1e-6:
        if found.left > 0.9 and np.std(reference[rows]) > 0.3:
            patient.states[:, 3 + index] = reference
            patient.touched = True
            patient.found(
                "column_scale",
                name,
                len(column),
                f"repaired: {name} has nothing to do with the motion of the pose; taken from the pose.",
            )
        return
    size = abs(found.scale)
    off = abs(size - 1.0) > max(SCALE_SHARE, 4.0 * math.sqrt(found.left / rows.sum()))
    # A larger rest next to a factor near 1 is a filter of another kind, vibration between the rows, or noise.
    sure = found.left < (0.02 if 0.75 < size < 1.3333 else 0.1)
    if found.scale < 0:
        patient.states[:, 3 + index] *= -1.0
        patient.touched = True
        patient.found(
            "wrong_sign",
            name,
            len(column),
            f"repaired: {name} runs against the motion of the pose (slope {found.scale:.2f}); its sign was turned.",
        )
    if not (off and sure) or size == 0.0:
        return
    unit = next((u for u, f in list(UNITS[name].items())[1:] if abs(size * f - 1.0) < 0.1), None)
    factor = 1.0 / size if unit is None else UNITS[name][unit]
    patient.states[:, 3 + index] *= factor
    patient.touched = True
    patient.found(
        "wrong_unit" if unit else "column_scale",
        name,
        len(column),
        f"repaired: {name} is {size:.4g} times the motion of the pose"
        + (f", it is in {unit}" if unit else "")
        + f"; multiplied by {factor:.4g}.",
    )


def _check_spikes(patient: Patient, motion: PoseMotion) -> None:
    """Single wild rows, and what a repaired pose had done to the velocities about it."""
    reference, mended = _of_motion(motion), patient.mended
    near = np.convolve(mended, np.ones(7), mode="same") > 0 if mended.any() else mended
    limits = (0.1 / patient.period_s, 0.1 / patient.period_s, 0.25 * 2.0 * np.pi / patient.period_s)
    for index, (name, limit) in enumerate(zip(CHANNELS, limits, strict=True)):
        column = patient.states[:, 3 + index]
        rows = np.ones(len(column), dtype=bool)
        found = match(patient, column, reference[:, index], rows)
        miss = column - found.scale * found.reference
        sigma = spread(miss)
        echo = near & (np.abs(miss) > 4.0 * sigma)
        wild = np.abs(miss) > max(SPIKE_SIGMAS * sigma, limit)
        tail = (np.convolve(wild, np.ones(5), mode="same") > 0) & (np.abs(miss) > max(8.0 * sigma, 0.1 * limit))
        taken = echo | wild | tail
        if not taken.any():
            continue
        patient.states[taken, 3 + index] = (found.scale * found.reference)[taken]
        patient.touched = True
        alone = wild & ~near
        if not alone.any():
            continue
        where = np.exp(1j * motion.yaw_unwrapped[alone])
        wrapped = name == "yaw_rate" and abs(where.mean()) > 0.8
        patient.found(
            "yaw_wrap_spikes" if wrapped else "outliers",
            name,
            int((taken & ~near).sum()),
            f"repaired: {name} has {int(alone.sum())} spikes of up to {np.abs(column[alone]).max():.0f}, "
            + (
                f"all where yaw passes {np.angle(where.mean()):.1f} rad: a wrapped angle was differentiated"
                if wrapped
                else "at no particular yaw"
            )
            + "; those rows were taken from the pose.",
        )


def _check_differences(patient: Patient, motion: PoseMotion) -> None:
    """Velocities that are backward differences of the pose, by a clock that may have been another than the stamps'.

    Such columns are half a row late and hold nothing that the pose has not; but distance over speed tells the true
    periods where the stamps are nominal.
    """
    distance = np.hypot(*np.diff(patient.states[:, :2], axis=0).T)
    speed = np.hypot(patient.states[1:, 3], patient.states[1:, 4])
    centred = np.hypot(motion.vx, motion.vy)[1:]
    whole = (np.diff(patient.segment) == 0) & (speed > 0.5) & (distance > 0) & (centred > 0.1)
    if whole.sum() < 100:
        return
    # As shares, and about their medians: where the stamps are nominal, both are off by the same factor.
    backward_share = speed[whole] * np.diff(patient.times_s)[whole] / distance[whole]
    centred_share = speed[whole] / centred[whole]
    to_backward, to_centred = spread(backward_share), spread(centred_share)
    if to_backward > 0.4 * to_centred or to_backward > 0.02:
        return
    _rebuild_clock(patient)
    patient.own_velocities = False
    patient.touched = True
    patient.found(
        "column_shift",
        "vx, vy, yaw_rate",
        len(patient.times_s),
        f"repaired: the velocities are backward differences of the pose (the speed to {to_backward:.1%}), so they are "
        f"half a row ({500 * patient.period_s:.0f} ms) late; taken from the pose without delay.",
    )


def _rebuild_clock(patient: Patient) -> None:
    """Stamps from distance over speed, where the given ones plainly are nominal."""
    names = ("x", "y", "yaw", "vx", "vy", "yaw_rate")
    channels = Channels(
        patient.times_s, dict(zip(names, patient.states.T, strict=True)), {}, patient.segment, patient.motion()
    )
    findings = check_clock(channels)
    if not findings:
        return
    before = patient.times_s
    patient.times_s = rebuilt_clock(channels)[0] + before[0]
    patient.touched = True
    e = findings[0].evidence
    patient.found(
        "clock_drift",
        "t",
        findings[0].count,
        f"repaired: the stamps are nominal. By distance over speed rows were {e['p1_s'] * 1e3:.1f} to "
        f"{e['p99_s'] * 1e3:.1f} ms apart, {e['mean_s'] * 1e3:.2f} ms on average, where the stamps say "
        f"{e['stamped_s'] * 1e3:.2f} ms; the clock was rebuilt ({patient.times_s[-1] - before[-1]:+.2f} s at the end).",
    )
