"""The audit of a recording: runs all checks in the order in which one can rely on another.

Nothing is changed here. Each finding carries numbers and, where there is one, the option that would act on it; see
``audit_stamps``, ``audit_motion`` and ``audit_commands`` for the checks and the reasons for their thresholds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.recording.audit import commands as audit_commands
from carlab.recording.audit import motion as audit_motion
from carlab.recording.audit import stamps as audit_stamps
from carlab.recording.audit.report import AuditReport, Finding, Severity
from carlab.recording.csv.mapping import COMMAND_CHANNELS, VELOCITY_CHANNELS, ColumnMapping
from carlab.recording.pose_velocity import BoolArray, PoseMotion

__all__ = ["AuditReport", "Channels", "Finding", "Severity", "audit_channels"]


@dataclass(frozen=True, slots=True)
class Channels:
    """A recording's columns after what the mapping declares of units, signs and axes, but before any change of frame.

    ``values`` by channel and ``extra`` by column name are (N,); ``segment`` numbers unbroken stretches; ``motion`` is
    None where there is no pose.
    """

    t_s: FloatArray
    values: Mapping[str, FloatArray]
    extra: Mapping[str, FloatArray]
    segment: FloatArray
    motion: PoseMotion | None

    @property
    def pose_speed_mps(self) -> FloatArray:
        """Speed over ground of the pose, shape (N,); zero where there is no pose."""
        if self.motion is None:
            return np.zeros(len(self.t_s))
        return np.hypot(self.motion.vx_world, self.motion.vy_world)


def audit_channels(channels: Channels, mapping: ColumnMapping) -> tuple[list[Finding], BoolArray]:
    """Check all but order, gaps and jumps. Returns findings and the mask of rows with a yaw_rate spike, (N,)."""
    t_s, values, motion = channels.t_s, channels.values, channels.motion
    spikes = np.zeros(len(t_s), dtype=bool)
    findings = audit_stamps.check_held(t_s, {**values, **channels.extra})
    findings += audit_commands.check_command_range(values, mapping)
    if mapping.throttle_gate:
        gate = channels.extra[mapping.throttle_gate]
        findings += audit_commands.check_gate(values["throttle"], gate, mapping.throttle_gate)
    if motion is None:
        return findings, spikes
    findings += audit_stamps.check_stale(values, channels.pose_speed_mps)
    used = mapping.velocities == "columns"
    estimated = [name for name in VELOCITY_CHANNELS if name not in values or not used]
    if "vx" in values and "vy" in values:
        if used:
            findings += audit_motion.check_velocity(t_s, values["vx"], values["vy"], motion, mapping)
        findings += check_clock(channels)
    if "yaw_rate" in values and used:
        found, spikes = audit_motion.check_yaw_rate(t_s, values["yaw_rate"], motion, mapping)
        findings += found
    if estimated:
        lacking = "are not in the file and " if used else ""
        findings.append(
            Finding(
                "estimated_velocity",
                ", ".join(estimated),
                Severity.INFO,
                f"{', '.join(estimated)} {lacking}were estimated from the pose: {motion.method()}.",
            )
        )
    steering, throttle = (np.nan_to_num(values[name]) for name in COMMAND_CHANNELS)
    if mapping.throttle_gate:
        throttle = throttle * channels.extra[mapping.throttle_gate]
    findings += audit_commands.check_steering(t_s, steering, motion)
    findings += audit_commands.check_throttle(t_s, throttle, motion, channels.segment)
    states = {"vx": motion.vx, "vy": motion.vy, "yaw_rate": motion.yaw_rate}
    for name, channel in mapping.references.items():
        if name in channels.extra and channel in states:
            findings += audit_commands.check_reference(t_s, name, channels.extra[name], channel, states[channel])
    if "frozen_pose" in (f.id for f in findings):  # several sensors see the same; the first is enough
        first = next(f for f in findings if f.id == "frozen_pose")
        findings = [f for f in findings if f.id != "frozen_pose" or f is first]
    return findings, spikes


def true_periods(channels: Channels) -> FloatArray:
    """Time from row to row by distance over speed [s], shape (N - 1,); NaN below 0.3 m/s.

    Right where the velocity columns are backward differences of the pose by the true period, as loggers make them.
    """
    values = channels.values
    distance = np.hypot(np.diff(values["x"]), np.diff(values["y"]))
    speed = np.hypot(values["vx"], values["vy"])[1:]
    whole = (speed > 0.3) & (np.diff(channels.segment) == 0)
    return np.where(whole, distance / np.where(whole, speed, 1.0), np.nan)


def check_clock(channels: Channels) -> list[Finding]:
    """Compare the stamps with distance over speed: shows a nominal clock over rows that were not even."""
    periods = true_periods(channels)
    stamped = np.diff(channels.t_s)
    known = np.isfinite(periods)
    if known.sum() < 200:
        return []
    ratio = periods[known] / stamped[known]
    # The comparison means something only where velocities are plain differences: then most ratios agree to 1 or 2 %.
    # Steps that then are off by more than 10 % in more than 1 % of the rows were stamped wrongly.
    low, middle, high = (float(q) for q in np.percentile(ratio, [25, 50, 75]))
    odd = np.flatnonzero(known)[np.abs(ratio - middle) > 0.1]
    if high - low > 0.02 or abs(middle - 1) > 0.1 or len(odd) < 0.01 * known.sum():
        return []
    p1, p99 = (float(q) for q in np.percentile(periods[known], [1, 99]))
    mean = float(np.mean(periods[known]))
    return [
        Finding(
            "clock_drift",
            "t",
            Severity.WARNING,
            f"By distance over speed, rows were {p1 * 1e3:.1f} to {p99 * 1e3:.1f} ms apart (98 %), "
            f"{mean * 1e3:.2f} ms on average, "
            f"where the stamps say {float(np.mean(stamped)) * 1e3:.2f} ms; {len(odd)} steps are off by more than "
            f"10 %: the time column "
            "is nominal; rebuild it with --clock velocity.",
            len(odd),
            tuple(int(k) + 2 for k in odd[:20]),
            {"mean_s": mean, "p1_s": p1, "p99_s": p99, "stamped_s": float(np.mean(stamped))},
            "--clock velocity",
        )
    ]
