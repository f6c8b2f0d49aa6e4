"""Sentences about faults of the recording that look like physics of the car."""

from __future__ import annotations

from carlab.diagnosis.findings import SLOW_POSES, Diagnosis, EffectFinding, final_model_name
from carlab.diagnosis.report.numbers import listed, number, with_unit
from carlab.diagnosis.report.residual import is_above_noise
from carlab.diagnosis.settings import IDENTIFICATION, REPORT
from sim_backends.effects import EFFECTS
from sim_backends.measurement import COMMAND_DELAY, LATENCY
from sim_backends.registry import REGISTRY

LIMITED, FRAME_RATE = "limited_commands", "wrong_frame_rate"
"""Ids of faults."""


def recording_causes(diagnosis: Diagnosis) -> str:
    """Sentences, each after a space, about limited commands, stamps, poses and length; empty without these causes."""
    of_poses = f"{_slow_poses(diagnosis)}{_late_poses(diagnosis)}{_filtered_poses(diagnosis)}"
    return f"{_limited_commands(diagnosis)}{_wrong_frame_rate(diagnosis)}{of_poses}{_short_recordings(diagnosis)}"


def has_slow_poses(diagnosis: Diagnosis) -> bool:
    """Whether velocities are estimated from poses that are too far apart."""
    return any(fault.id == SLOW_POSES for fault in diagnosis.data_faults)


def limited_channels(diagnosis: Diagnosis) -> list[str]:
    """Commands that the log or the radio limits; empty if named effects explain the recordings with these commands.

    Limited commands lack what the car executes, so no model with them comes near the noise floor. A driver who keeps to
    a limit can look the same before the fit, for example if the motor has a dead band.
    """
    if diagnosis.verdict == "mismatch" and not is_above_noise(diagnosis, "with_effects"):
        return []
    return list(dict.fromkeys(fault.channel for fault in diagnosis.data_faults if fault.id == LIMITED))


def _limited_commands(diagnosis: Diagnosis) -> str:
    """That limited commands cause errors of the simulator."""
    channels = limited_channels(diagnosis)
    if not channels:
        return ""
    return (
        f" The log or the radio limits the {listed(channels)}. The simulator has too small commands there, which looks "
        "like missing physics. Log the commands that the car executes, record again, and diagnose again."
    )


def _wrong_frame_rate(diagnosis: Diagnosis) -> str:
    """That a wrong frame rate changes forces and delays."""
    if all(fault.id != FRAME_RATE for fault in diagnosis.data_faults):
        return ""
    return (
        " The stamps probably have a wrong frame rate, which changes all forces and delays: compare the length of the "
        "recording with a clock before anything else."
    )


def _slow_poses(diagnosis: Diagnosis) -> str:
    """That the remaining error may be that of velocities from poses that are far apart."""
    if not has_slow_poses(diagnosis) or not is_above_noise(diagnosis, final_model_name(diagnosis.held_out)):
        return ""
    return (
        " The poses are so far apart that the estimated velocities have errors above the noise: the remaining error "
        "may be theirs, and no missing physics. Record poses at 30 Hz or faster."
    )


def _short_recordings(diagnosis: Diagnosis) -> str:
    """That the fitted recordings do not determine the parameters, if the car file has a smaller held-out error."""
    held, name = diagnosis.held_out, final_model_name(diagnosis.held_out)
    if not ({"nominal", name} <= held.keys() and is_above_noise(diagnosis, name)):
        return ""
    nominal, model = held["nominal"].score, held[name].score
    if model <= nominal:
        return ""
    return (
        f" The car file has a smaller error on held-out recordings than model.toml ({number(nominal)} against "
        f"{number(model)} noise floors): the fitted recordings may be too short or too uniform to determine "
        "the parameters."
    )


def _late_poses(diagnosis: Diagnosis) -> str:
    """That the fitted latency contains another delay, if it is longer than the prior makes probable.

    No effect explains such a delay, because the fit of a latency that the car file does not state contains it.
    """
    found, delay_s = diagnosis.parameters.get(LATENCY), diagnosis.car_file_parameters.get(COMMAND_DELAY)
    expected_s = REGISTRY[LATENCY].default
    if found is None or delay_s is None or expected_s is None or LATENCY in diagnosis.car_file_parameters:
        return ""
    if COMMAND_DELAY in diagnosis.parameters:  # a repaired clock offset, which hides the delay
        return ""
    if found.value - expected_s <= REPORT.latency_z_max * IDENTIFICATION.latency_std_s:
        return ""
    return (
        f" The poses are {with_unit(found.value, 's')} late (mocap.latency, which the car file does not state). A "
        f"command delay of {with_unit(delay_s + found.value - expected_s, 's')}, not {with_unit(delay_s, 's')} as in "
        f"the car file, with a latency of {with_unit(expected_s, 's')} looks the same. Measure one of both and state "
        "both in the car file."
    )


def _filtered_poses(diagnosis: Diagnosis) -> str:
    """That a filter of the poses looks the same as the named delays and lags of steering and drive."""
    lags_s = {e.id: lag for e in diagnosis.effects if (lag := _lag_s(e, diagnosis)) is not None}
    shared = [name for name, effect in EFFECTS.items() if effect.split_into]
    groups = EFFECTS[shared[0]].split_into
    n_single = sum(any(name in lags_s for name in group) for group in groups)
    if n_single < len(groups) and not (n_single and any(name in lags_s for name in shared)):
        return ""
    both_s = sum(lags_s.get(name, 0.0) for name in shared)
    steering_s, drive_s = (both_s + sum(lags_s.get(name, 0.0) for name in group) for group in groups)
    if min(steering_s, drive_s) <= REPORT.filter_lag_ratio * max(steering_s, drive_s):
        return ""
    return (
        f" The steering is {with_unit(steering_s, 's')} late and the drive {with_unit(drive_s, 's')}. A filter of the "
        "poses in the motion-capture software makes both late by a similar time, and recordings do not distinguish it "
        "from delays and lags of the car. Switch off the smoothing of the software and record again, or compare the "
        "yaw rate with that of a gyroscope on the car."
    )


def _lag_s(effect: EffectFinding, diagnosis: Diagnosis) -> float | None:
    """Delay or time constant of an effect [s] in addition to that of the car file; None for other effects."""
    if effect.id not in EFFECTS or not EFFECTS[effect.id].lag_parameter:
        return None
    (parameter,) = (p for p in EFFECTS[effect.id].parameters if p.name == EFFECTS[effect.id].lag_parameter)
    stated = effect.car_file_values.get(parameter.name)
    if stated is None:
        stated = diagnosis.car_file_parameters.get(parameter.same_as or "", parameter.identity or 0.0)
    return effect.parameters[parameter.name].value - stated
