"""Faults of the recordings themselves, found before any physics is fitted, and repaired where that is safe."""

from __future__ import annotations

from collections.abc import Sequence

from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.findings import DataFault
from carlab.diagnosis.recording_faults.commands import check_commands
from carlab.diagnosis.recording_faults.episode_motion import Patient, merged
from carlab.diagnosis.recording_faults.integration_step import check_integration
from carlab.diagnosis.recording_faults.pose import (
    check_gaps,
    check_jumps,
    check_pose_frame,
    check_repeats,
    check_time_unit,
)
from carlab.diagnosis.recording_faults.velocity import check_velocities
from sim_backends.car_parameters import SimulatorConfig


def check(
    fit: Sequence[EpisodeData], held_out: Sequence[EpisodeData], nominal: SimulatorConfig
) -> tuple[list[EpisodeData], list[EpisodeData], list[DataFault]]:
    """Look for faults of the data in recordings and repair them.

    Stamps and pose are checked by themselves, velocities against the pose (kinematics alone), commands against the
    motion, and the simulator's own step against a finer one. A delay that a car can have is never called a fault.

    Args:
        fit: recordings to fit.
        held_out: recordings that only judge.
        nominal: the simulator of the car file, for the control period and for the delay it states.

    Returns:
        The recordings to fit and those held out, repaired (the very same objects where nothing was touched), and
        what was found. An ``action`` begins with ``repaired``, ``reported`` or ``unusable``.
    """
    patients = [Patient.of(episode) for episode in (*fit, *held_out)]
    for patient in patients:
        if not patient.usable:
            continue
        check_time_unit(patient, nominal.control_period_s)
        check_pose_frame(patient)
        check_repeats(patient)
        check_jumps(patient)
        check_gaps(patient)
        check_velocities(patient)
    check_commands([p for p in patients if p.usable], nominal)
    healed = [patient.discharged() for patient in patients]
    faults = merged([fault for patient in patients for fault in patient.faults])
    faults += check_integration(healed[: len(fit)], nominal)
    return healed[: len(fit)], healed[len(fit) :], faults
