"""Detect faults of recordings before any fit, and repair them if that is safe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.findings import DataFault
from carlab.diagnosis.recording_faults.commands import check_commands, check_yaw_direction
from carlab.diagnosis.recording_faults.episode_repair import EpisodeRepair, merged
from carlab.diagnosis.recording_faults.integration_step import check_integration
from carlab.diagnosis.recording_faults.pose import check_pose
from carlab.diagnosis.recording_faults.velocity import check_pose_rate, check_velocities
from carlab.diagnosis.state_alignment import lost_frames
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.measurement import COMMAND_DELAY


def check(
    fit: Sequence[EpisodeData], held_out: Sequence[EpisodeData], nominal: SimulatorConfig, *, alike: bool = False
) -> tuple[list[EpisodeData], list[EpisodeData], list[DataFault]]:
    """Detect and repair faults of recordings.

    Stamps and pose are checked for consistency, velocities against the pose (kinematics only), commands against the
    motion, and the simulator's integration step against a finer one. A plausible delay is not a fault. Rows with
    missing numbers are left out.

    Args:
        fit: recordings to fit.
        held_out: held-out recordings.
        nominal: the simulator of the car file, for its control period and command delay.
        alike: whether a repair that changes the delay of velocities or the stamps needs the fault in all recordings.
            A comparison of recordings needs it, because such a repair of some would appear as a change.

    Returns:
        The recordings to fit and those held out, repaired (the same objects where nothing was changed), and
        what was found. An ``action`` begins with ``repaired``, ``reported`` or ``unusable``.
    """
    repairs = [EpisodeRepair.of(episode) for episode in (*fit, *held_out)]
    for repair in repairs:
        if repair.episode.ticks:
            repair.leave_out_incomplete_rows()
    usable = [repair for repair in repairs if repair.usable]
    for repair in usable:
        check_pose(repair, nominal.control_period_s)
    check_yaw_direction([repair for repair in usable if repair.usable])
    check_velocities(usable, alike=alike)
    for repair in usable:
        check_pose_rate(repair)
    check_commands([repair for repair in usable if repair.usable], nominal)
    repaired = [repair.result() for repair in repairs]
    faults = merged([fault for repair in repairs for fault in repair.faults])
    rows, sentence = lost_frames((*fit, *held_out))
    if rows:
        faults.append(DataFault("lost_frames", "x, y, yaw", rows, f"reported: {sentence}."))
    faults += check_integration(repaired[: len(fit)], nominal)
    return repaired[: len(fit)], repaired[len(fit) :], faults


def with_unknown_delay(config: SimulatorConfig, faults: Sequence[DataFault]) -> SimulatorConfig:
    """Mark the command delay as unknown if a clock offset hid it, so that it is fitted and no effect explains it."""
    return replace(config, unknown=config.unknown | {COMMAND_DELAY}) if hide_delay(faults) else config


def hide_delay(faults: Sequence[DataFault]) -> bool:
    """Whether a clock offset was repaired, which hides the delay of the commands."""
    return any(fault.id == "clock_offset" and fault.action.startswith("repaired") for fault in faults)
