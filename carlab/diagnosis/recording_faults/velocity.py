"""Repair of velocity columns by comparison with the motion of the pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from carlab.core.planar import to_body, to_world
from carlab.diagnosis.recording_faults.episode_repair import EpisodeRepair
from carlab.recording.audit.audit import Channels
from carlab.recording.column_mapping import POSE_CHANNELS, VELOCITY_CHANNELS
from carlab.recording.csv.clocks import rebuilt_clock
from carlab.recording.faults.fault import Fault
from carlab.recording.faults.robust import fit_column
from carlab.recording.faults.settings import LIMITS
from carlab.recording.faults.stamps import nominal_clock
from carlab.recording.faults.velocity import (
    MIN_COMPARED_ROWS,
    backward_differences,
    comparable_rows,
    early_velocities,
    rotated_velocity,
    scale_faults,
    spike_fault,
    velocity_references,
    velocity_spikes,
    world_filtered_velocities,
    wrong_frame_rate,
    wrong_velocity_frame,
)
from carlab.recording.pose_velocity import STATE_HALF_WINDOW_S, PoseMotion


def check_velocities(repairs: Sequence[EpisodeRepair], *, alike: bool) -> None:
    """Check and repair vx, vy and yaw rate of recordings: frame, filter, scale, spikes, early and late columns.

    Args:
        repairs: the recordings.
        alike: whether filters in the world frame, early velocities, backward differences and nominal stamps are
            repaired only if all recordings have them.
    """
    motions = {k: r.motion() for k, r in enumerate(repairs) if r.has_velocity_columns}
    motions = {k: m for k, m in motions.items() if comparable_rows(m, "vx").sum() >= MIN_COMPARED_ROWS}
    for k, motion in motions.items():
        _check_frame(repairs[k], motion)
    _estimate_from_pose(repairs, {k: _filter_in_world(repairs[k], m) for k, m in motions.items()}, alike=alike)
    measured = {k: m for k, m in motions.items() if repairs[k].has_velocity_columns}
    for k, motion in measured.items():
        _check_scales(repairs[k], motion)
        for channel in VELOCITY_CHANNELS:
            _check_spikes(repairs[k], motion, channel)
    measured = {k: m for k, m in motions.items() if repairs[k].has_velocity_columns}
    early = {k: early_velocities(repairs[k].times_s, repairs[k].states, m) for k, m in measured.items()}
    _estimate_from_pose(repairs, early, alike=alike)
    found = {k: _backward_differences(repairs[k], m) for k, m in motions.items()}
    late = {k: fault for k, fault in found.items() if fault is not None}
    if alike and len(late) < len(repairs):
        return
    clocks = {k: clock for k in late if (clock := _clock_fault(repairs[k], motions[k])) is not None}
    for k, fault in late.items():
        if k in clocks and not (alike and len(clocks) < len(repairs)):
            _rebuild_clock(repairs[k], *clocks[k])
        repairs[k].set_velocities(repairs[k].motion())
        repairs[k].repaired(fault, "the velocities were estimated from the pose without delay")


def check_pose_rate(repair: EpisodeRepair) -> None:
    """Report velocities from poses that are too far apart for an accurate estimate."""
    if repair.has_velocity_columns or repair.period_s <= STATE_HALF_WINDOW_S:
        return
    action = (
        f"reported: the velocities are estimated from poses that are {repair.period_s:.3g} s apart, so they have "
        "errors above the noise when the motion changes quickly. Do not interpret an error of this size as missing "
        "physics. Record poses at 30 Hz or faster."
    )
    repair.report("slow_poses", "vx, vy, yaw_rate", len(repair.times_s), action)


def _backward_differences(repair: EpisodeRepair, motion: PoseMotion) -> Fault | None:
    return backward_differences(repair.times_s, repair.states, repair.segment, motion)


def _filter_in_world(repair: EpisodeRepair, motion: PoseMotion) -> Fault | None:
    """The fault of velocities that were filtered in the world frame; backward differences have their own repair."""
    fault = world_filtered_velocities(repair.times_s, repair.states, motion)
    return None if fault is None or _backward_differences(repair, motion) is not None else fault


def _estimate_from_pose(repairs: Sequence[EpisodeRepair], found: Mapping[int, Fault | None], *, alike: bool) -> None:
    """Estimate velocities from the pose where a fault is ``found``; ``alike`` as for ``check_velocities``."""
    faults = {k: fault for k, fault in found.items() if fault is not None}
    if alike and len(faults) < len(repairs):
        return
    for k, fault in faults.items():
        repairs[k].has_velocity_columns = False
        repairs[k].repaired(fault, "the velocities were estimated from the pose")


def _check_frame(repair: EpisodeRepair, motion: PoseMotion) -> None:
    """Frame of the velocities, and a constant angle between them and the yaw."""
    fault = wrong_velocity_frame(repair.times_s, repair.states[:, 3:5].T, motion, "body")
    if fault is not None:
        vx, vy = repair.states[:, 3:5].T
        repair.states[:, 3], repair.states[:, 4] = to_body(vx, vy, motion.yaw_unwrapped)
        repair.repaired(fault, "the velocities were rotated by the yaw")
    rotated = rotated_velocity(repair.states[:, 3:5].T, motion)
    if rotated is not None:  # If the yaw is wrong, the diagnosis finds it as mocap_yaw_misalignment.
        vx, vy = repair.states[:, 3:5].T.copy()
        repair.states[:, 3], repair.states[:, 4] = to_world(vx, vy, np.asarray(rotated.evidence["offset_rad"]))
        repair.repaired(rotated, "vx and vy were rotated back by that angle")


def _check_scales(repair: EpisodeRepair, motion: PoseMotion) -> None:
    """Sign, unit and factor of each column; one factor of all columns is a fault of the stamps."""
    faults = [fault for channel in VELOCITY_CHANNELS for fault in _scale_faults(repair, motion, channel)]
    common = wrong_frame_rate(faults)
    if common is not None:
        factor = common.evidence["factor"]
        repair.states[:, 3:] *= factor
        remedy = (
            f"the velocities were multiplied by {factor:.4g}. Compare the length of the recording with a clock; if the "
            f"stamps are wrong, multiply them by {factor:.4g} and diagnose again, because all forces and delays depend "
            "on them"
        )
        repair.repaired(common, remedy)
        return
    for fault in faults:
        column_factor = fault.evidence.get("factor")
        if column_factor is None:
            repair.has_velocity_columns = False
            repair.repaired(fault, "the velocities were estimated from the pose")
        else:
            repair.states[:, 3 + VELOCITY_CHANNELS.index(fault.channel)] *= column_factor
            repair.repaired(fault, f"multiplied by {column_factor:.4g}")


def _scale_faults(repair: EpisodeRepair, motion: PoseMotion, channel: str) -> list[Fault]:
    """Faults of sign, unit and factor of one column."""
    column = repair.states[:, 3 + VELOCITY_CHANNELS.index(channel)]
    reference, rows = velocity_references(motion)[channel], comparable_rows(motion, channel)
    return scale_faults(channel, fit_column(repair.times_s, reference, column, rows), reference[rows])


def _check_spikes(repair: EpisodeRepair, motion: PoseMotion, channel: str) -> None:
    """Replace outliers of a velocity, and velocities that were computed from interpolated poses."""
    column = repair.states[:, 3 + VELOCITY_CHANNELS.index(channel)]
    fit = fit_column(repair.times_s, velocity_references(motion)[channel], column, np.ones(len(column), dtype=bool))
    spikes = velocity_spikes(channel, repair.period_s, column, fit.prediction)
    near = np.convolve(repair.interpolated, np.ones(7), mode="same") > 0
    fault = spike_fault(channel, column, spikes.without(near), motion)
    replaced = spikes.rows | (near & (spikes.error_sigmas > LIMITS.interpolated_sigmas))
    if replaced.any():
        column[replaced] = fit.prediction[replaced]
        repair.is_changed = True
    if fault is not None:
        repair.repaired(fault, "these rows were replaced by the velocity of the pose", len(fault.rows))


def _clock_fault(repair: EpisodeRepair, motion: PoseMotion) -> tuple[Fault, Channels] | None:
    """Nominal stamps, by distance over speed, with the channels that give the true ones."""
    values = dict(zip((*POSE_CHANNELS, *VELOCITY_CHANNELS), repair.states.T, strict=True))
    channels = Channels(repair.times_s, values, {}, repair.segment, motion)
    fault = nominal_clock(repair.times_s, channels.periods_s())
    return None if fault is None else (fault, channels)


def _rebuild_clock(repair: EpisodeRepair, fault: Fault, channels: Channels) -> None:
    """Replace nominal stamps by those from distance over speed."""
    before = repair.times_s
    repair.times_s = rebuilt_clock(channels)[0] + before[0]
    shift_s = repair.times_s[-1] - before[-1]
    repair.repaired(fault, f"the clock was rebuilt ({shift_s:+.2f} s at the end)", len(fault.rows))
