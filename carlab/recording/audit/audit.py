"""The audit of a recording: runs the fault detection on a file's columns and proposes options that correct them.

The audit does not change the data. Each finding has evidence and, if available, the option that acts on it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.angles import wrap
from carlab.core.quantities import FloatArray
from carlab.recording.audit import file_checks
from carlab.recording.audit.report import Finding, Severity
from carlab.recording.column_mapping import (
    COMMAND_CHANNELS,
    MAX_LAG_S,
    MAX_LAG_SHARE,
    VELOCITY_CHANNELS,
    ColumnMapping,
    ColumnSource,
)
from carlab.recording.faults.clock_offset import clock_offset, exchanged_with_offset
from carlab.recording.faults.commands import (
    MIN_ROWS,
    CommandResponse,
    GridMotion,
    command_response,
    grid_motion,
    moves_backward,
    reversed_yaw,
    wrong_command_sign,
)
from carlab.recording.faults.fault import Fault
from carlab.recording.faults.heading import heading_faults
from carlab.recording.faults.limited_commands import limited_command
from carlab.recording.faults.robust import LAGS_S, ColumnFit, correlation, fit_column, held_at
from carlab.recording.faults.settings import LIMITS
from carlab.recording.faults.stamps import nominal_clock, periods_by_distance
from carlab.recording.faults.velocity import (
    comparable_rows,
    scale_faults,
    spike_fault,
    velocity_lag,
    velocity_references,
    velocity_spikes,
    wrong_frame_rate,
    wrong_velocity_frame,
)
from carlab.recording.pose_velocity import BoolArray, PoseMotion

MIN_MOVING_ROWS, MIN_TURNING_ROWS = 50, 30
MIN_COMMAND_RANGE = 0.05
"""Minimum range of a command (full command = 1) for a check of its sign."""
EFFECTS = {"steering": "the path's curvature", "throttle": "the acceleration"}


@dataclass(frozen=True, slots=True)
class Channels:
    """A recording's columns after conversion of units, signs and axes by the mapping, before any change of frame.

    ``t_s``, ``values`` by channel (SI units), ``extra`` by column name, and ``segment`` are (N,). ``segment`` numbers
    the parts without a gap or jump. ``motion`` is None without a pose.
    """

    t_s: FloatArray
    values: Mapping[str, FloatArray]
    extra: Mapping[str, FloatArray]
    segment: FloatArray
    motion: PoseMotion | None

    def periods_s(self) -> FloatArray:
        """Time from row to row by distance over speed [s], shape (N - 1,); NaN at low speed."""
        position, velocity = (np.stack([self.values[name] for name in pair]) for pair in (("x", "y"), ("vx", "vy")))
        return periods_by_distance(position, velocity, self.segment)


def audit_channels(
    channels: Channels, mapping: ColumnMapping, heading: Sequence[Finding] = ()
) -> tuple[list[Finding], BoolArray]:
    """Check all but order, gaps, jumps and heading.

    ``heading`` are the findings of ``check_heading``. A wrong yaw makes right velocities and commands look wrong, so
    these are not checked then.

    Returns:
        Findings and the mask of rows with a yaw_rate spike, (N,).
    """
    t_s, values, motion = channels.t_s, channels.values, channels.motion
    findings = file_checks.check_held(t_s, {**values, **channels.extra})
    findings += file_checks.check_command_range(values, mapping)
    if mapping.throttle_gate:
        gate = channels.extra[mapping.throttle_gate]
        findings += file_checks.check_gate(values["throttle"], gate, mapping.throttle_gate)
    if motion is None:
        return findings, np.zeros(len(t_s), dtype=bool)
    findings += file_checks.check_stale(t_s, values)
    grid = grid_motion(t_s, motion, channels.segment)
    sent = {channel: _sent_command(channels, channel, mapping) for channel in COMMAND_CHANNELS}
    responses = {c: command_response(grid, t_s - mapping.command_lag_s, command, c) for c, command in sent.items()}
    has_wrong_yaw = any(finding.severity is Severity.FAULT for finding in heading)
    if not has_wrong_yaw and moves_backward(motion) and (fault := reversed_yaw(list(responses.values()))):
        findings.append(_finding(fault, mapping))
        has_wrong_yaw = True
    if has_wrong_yaw:
        sentence = "Velocities and commands are not compared with the motion of the pose until yaw is corrected."
        findings.append(
            Finding("unchecked", ", ".join((*VELOCITY_CHANNELS, *COMMAND_CHANNELS)), Severity.INFO, sentence)
        )
        return findings, np.zeros(len(t_s), dtype=bool)
    found, spikes = _check_velocities(channels, motion, mapping)
    findings += found + _check_commands(t_s, motion, grid, sent, responses, mapping)
    states = velocity_references(motion)
    for name, channel in mapping.references.items():
        if name not in channels.extra:
            sentence = f"Reference '{name}' is not compared with {channel}: it is no extra column with numbers."
            findings.append(Finding("unused_column", channel, Severity.WARNING, sentence))
            continue
        found = file_checks.check_reference(t_s, name, channels.extra[name], channel, states[channel])
        # Several sensors detect the same frozen pose; only the first finding is reported.
        known = {f.id for f in findings} & {"frozen_pose"}
        findings += [f for f in found if f.id not in known]
    return findings, spikes


def check_heading(t_s: FloatArray, values: Mapping[str, FloatArray], mapping: ColumnMapping) -> list[Finding]:
    """Check unit, sign and axis of the yaw by the course over ground. ``values`` has x, y [m], yaw [rad], each (N,)."""
    return [_finding(fault, mapping) for fault in heading_faults(t_s, values)]


def _finding(fault: Fault, mapping: ColumnMapping) -> Finding:
    """A fault of columns, by their names. A unit that is not SI and not declared is an error."""
    if fault.id == "too_little_motion":
        return Finding.of_fault(fault, Severity.INFO)
    if fault.id == "standing_pose":
        return Finding.of_fault(fault, Severity.WARNING, "check that x, y and yaw are those of the car")
    alternative = " (or --x-unit m --y-unit m if x and y are in metres)" if fault.channel == "x, y" else ""
    if fault.option == "--yaw-sign -1":
        alternative = f" (or {mapping.combined('--y-sign -1')})"
    if "offset_rad" in fault.evidence:  # the option replaces the offset of the mapping
        offset_rad = wrap(mapping.yaw_offset_rad + fault.evidence["offset_rad"])
        fault = replace(fault, option=f"--yaw-offset {offset_rad:.3f}")
    fault = replace(fault, option=mapping.combined(fault.option or ""))
    sources = [mapping.columns[channel] for channel in fault.channel.split(", ")]
    severity, remedy = Severity.FAULT, f"use {fault.option}"
    if fault.id == "wrong_unit" and not sources[0].unit:
        severity, remedy = Severity.ERROR, f"say so with {fault.option}"
    elif fault.channel == "x, y":
        severity = Severity.WARNING
    names = ", ".join(f"'{source.name}'" for source in sources)
    named = replace(fault, observation=f"{'Columns' if len(sources) > 1 else 'Column'} {names}: {fault.observation}")
    return Finding.of_fault(named, severity, remedy + alternative)


def _sign_finding(fault: Fault, mapping: ColumnMapping) -> Finding:
    """The fault of a command with the wrong sign. Throttle also looks like one if yaw points to the rear."""
    fault = replace(fault, option=mapping.combined(fault.option or ""))
    remedy = f"use {fault.option}"
    if fault.channel == "throttle":
        offset_rad = mapping.yaw_offset_rad + (math.pi if mapping.yaw_offset_rad <= 0.0 else -math.pi)
        remedy += f", or --yaw-offset {offset_rad:.5g} if yaw points to the rear"
    return Finding.of_fault(fault, remedy=remedy)


def _clock_finding(fault: Fault, t_s: FloatArray, mapping: ColumnMapping) -> Finding:
    """The fault of commands with another clock. Only a short offset can be corrected in the joined file."""
    lag_s = round(mapping.command_lag_s + LIMITS.command_delay_s - fault.evidence["delay_s"], 2)
    if abs(lag_s) <= min(MAX_LAG_S, MAX_LAG_SHARE * float(t_s[-1] - t_s[0])):
        fault = replace(fault, option=f"--command-lag {lag_s:g}")
        return Finding.of_fault(fault, remedy=f"use {fault.option}")
    change = f"{'subtract' if lag_s > 0 else 'add'} {abs(lag_s):g} s {'from' if lag_s > 0 else 'to'}"
    remedy = f"{change} the stamps of the commands, and join them with the poses again"
    return Finding.of_fault(fault, remedy=remedy + (", and remove --command-lag" if mapping.command_lag_s else ""))


def _check_velocities(
    channels: Channels, motion: PoseMotion, mapping: ColumnMapping
) -> tuple[list[Finding], BoolArray]:
    """Checks of vx, vy and yaw_rate against the pose. Returns findings and the mask of yaw_rate spikes, (N,)."""
    t_s, values = channels.t_s, channels.values
    columns = mapping.velocity_columns(values)
    findings: list[Finding] = []
    spikes = np.zeros(len(t_s), dtype=bool)
    if "vx" in values and "vy" in values:
        velocity = np.stack([values["vx"], values["vy"]])
        findings += _check_velocity(t_s, velocity, motion, mapping) if "vx" in columns else []
        clock = nominal_clock(t_s, channels.periods_s())
        if clock is not None and mapping.clock == "velocity":
            findings.append(Finding.of_fault(clock, Severity.REPAIRED, "they were rebuilt from distance over speed"))
        elif clock is not None:
            findings.append(Finding.of_fault(clock, Severity.WARNING, "rebuild them with --clock velocity"))
    if "yaw_rate" in columns:
        found, spikes = _check_yaw_rate(t_s, values["yaw_rate"], motion, mapping)
        findings += found
    rate = wrong_frame_rate([Fault(f.id, f.channel, f.sentence, f.evidence) for f in findings])
    if rate is not None:
        remedy = (
            f"compare its length with a clock; if the stamps are wrong, multiply them by {rate.evidence['factor']:.4g}"
        )
        findings.append(Finding.of_fault(rate, Severity.WARNING, remedy))
    estimated = [name for name in VELOCITY_CHANNELS if name not in columns]
    return findings + (_estimated_velocities(estimated, values, motion, mapping) if estimated else []), spikes


def _estimated_velocities(
    estimated: Sequence[str], values: Mapping[str, FloatArray], motion: PoseMotion, mapping: ColumnMapping
) -> list[Finding]:
    """Velocities that were estimated from the pose, and columns that are not used for this reason."""
    names = ", ".join(estimated)
    missing = [mapping.columns.get(name, ColumnSource(name)).name for name in estimated if name not in values]
    reason = f" (the file has no {', '.join(missing)})" if missing and mapping.velocities == "columns" else ""
    sentence = f"Estimated from the pose: {names}{reason}, by a {motion.method()}."
    findings = [Finding("estimated_velocity", names, Severity.INFO, sentence)]
    unused = [name for name in estimated if name in values]
    if unused and mapping.velocities == "columns":
        absent = "vy" if unused[0] == "vx" else "vx"
        sentence = (
            f"Column '{mapping.columns[unused[0]].name}' stays an extra column and is not used for the state: vx and "
            f"vy are taken together, and the file has no {absent}."
        )
        findings.append(Finding("unused_column", unused[0], Severity.WARNING, sentence))
    return findings


def _check_velocity(t_s: FloatArray, velocity: FloatArray, motion: PoseMotion, mapping: ColumnMapping) -> list[Finding]:
    """Unit, frame, signs and lag of vx and vy (2, N) as declared, against the pose."""
    moving = comparable_rows(motion, "vx")
    if moving.sum() < MIN_MOVING_ROWS:
        return []
    speed = np.hypot(motion.vx_world, motion.vy_world)
    # Unit and factor by the speed: both columns have the same, and vy alone is often noise.
    faults = scale_faults("vx, vy", fit_column(t_s, speed, np.hypot(*velocity), moving), speed[moving])
    frame = mapping.velocity_frame
    wrong_frame = wrong_velocity_frame(t_s, velocity, motion, frame)
    if wrong_frame is not None:
        frame = "world" if frame == "body" else "body"
    references = velocity_references(motion, frame)
    columns = {"vx": velocity[0], "vy": velocity[1]}
    if not faults:
        for name, column in columns.items():
            fit = fit_column(t_s, references[name], column, moving)
            faults += scale_faults(name, fit, references[name][moving])
    faults += [] if wrong_frame is None else [wrong_frame]
    if faults:
        return [_finding(fault, mapping) for fault in faults]
    fits = [
        fit_column(t_s, references[name], column, moving, lags_s=LAGS_S, time_constants_s=(0.0,))
        for name, column in columns.items()
    ]
    return _lag_findings("vx, vy", t_s, max(fits, key=lambda fit: fit.rms**2 * fit.unexplained_unshifted))


def _check_yaw_rate(
    t_s: FloatArray, yaw_rate: FloatArray, motion: PoseMotion, mapping: ColumnMapping
) -> tuple[list[Finding], BoolArray]:
    """Unit, sign, lag and spikes of a yaw_rate column (N,). Returns findings and the mask of spiked rows, (N,)."""
    rows = np.abs(motion.yaw_rate) > LIMITS.turning_radps
    no_spikes = np.zeros(len(t_s), dtype=bool)
    if rows.sum() < MIN_TURNING_ROWS:
        return [], no_spikes
    faults = scale_faults("yaw_rate", fit_column(t_s, motion.yaw_rate, yaw_rate, rows), motion.yaw_rate[rows])
    if faults:
        return [_finding(fault, mapping) for fault in faults], no_spikes
    fit = fit_column(t_s, motion.yaw_rate, yaw_rate, rows, lags_s=LAGS_S, time_constants_s=(0.0,))
    findings = _lag_findings("yaw_rate", t_s, fit)
    spikes = velocity_spikes("yaw_rate", float(np.median(np.diff(t_s))), yaw_rate, fit.prediction)
    fault = spike_fault("yaw_rate", yaw_rate, spikes, motion)
    if fault is not None and mapping.repair_yaw_rate:
        findings.append(Finding.of_fault(fault, Severity.REPAIRED, "those rows were taken from the pose"))
    elif fault is not None:
        findings.append(Finding.of_fault(fault, remedy=f"take those rows from the pose with {fault.option}"))
    if spikes.others.any():
        sentence = (
            f"Column yaw_rate is far from the derivative of yaw in {spikes.others.sum()} further rows (first row "
            f"{np.argmax(spikes.others) + 1}): an impact, or a frame that came late."
        )
        findings.append(Finding.at(spikes.others, "outliers", "yaw_rate", Severity.INFO, sentence))
    return findings, spikes.rows if fault is not None else no_spikes


def _lag_findings(channel: str, t_s: FloatArray, fit: ColumnFit) -> list[Finding]:
    fault = velocity_lag(channel, float(np.median(np.diff(t_s))), fit)
    remedy = "estimate velocities without delay with --velocities pose"
    return [] if fault is None else [Finding.of_fault(fault, Severity.INFO, remedy)]


def _sent_command(channels: Channels, channel: str, mapping: ColumnMapping) -> FloatArray:
    """The command (N,) that reached the car."""
    command = np.nan_to_num(channels.values[channel])
    if channel == "throttle" and mapping.throttle_gate:
        command = command * channels.extra[mapping.throttle_gate]
    return command


def _check_commands(
    t_s: FloatArray,
    motion: PoseMotion,
    grid: GridMotion,
    sent: Mapping[str, FloatArray],
    responses: Mapping[str, CommandResponse | None],
    mapping: ColumnMapping,
) -> list[Finding]:
    """Clock, sign and delay of both commands by their effect on the motion."""
    findings: list[Finding] = []
    executed_s = t_s - mapping.command_lag_s
    offset = clock_offset(grid, executed_s, list(sent.values()))
    if offset is not None:  # with another clock, sign and delay mean nothing
        return [_clock_finding(offset, t_s, mapping)]
    exchanged = exchanged_with_offset(grid, executed_s, list(sent.values()), list(responses.values()))
    if exchanged is not None:  # the columns of the file, before sign and delay
        names = " and ".join(f"'{mapping.columns[channel].name}'" for channel in COMMAND_CHANNELS)
        return [Finding.of_fault(exchanged, remedy=f"exchange the columns {names} in the mapping")]
    limited = [limited_command(grid, executed_s, command, channel) for channel, command in sent.items()]
    remedy = "log the commands that the car executes"
    findings += [Finding.of_fault(fault, Severity.WARNING, remedy) for fault in limited if fault is not None]
    is_long = grid.rows.sum() >= MIN_ROWS
    for index, (channel, response) in enumerate(responses.items()):
        command = held_at(t_s, sent[channel], -mapping.command_lag_s)
        effect = EFFECTS[channel]
        evidence = {} if response is None else _command_evidence(channel, t_s, command, motion, response)
        if response is None or response.best < LIMITS.command_explained[index]:
            if np.ptp(command) > MIN_COMMAND_RANGE and is_long:
                sentence = f"{channel.capitalize()} explains too little of {effect}: the sign of {channel} is unknown."
                findings.append(Finding("unclear_sign", channel, Severity.INFO, sentence, evidence=evidence))
        elif response.gain < 0 and response.lag_s > -LIMITS.early_response_s:
            findings.append(_sign_finding(wrong_command_sign(channel, response, evidence), mapping))
        elif response.is_lag_inside:  # at the edge, the drive does not show the delay
            delay_s = evidence["delay_s"]
            sentence = (
                f"{effect[0].upper()}{effect[1:]} {'follows' if delay_s >= 0 else 'precedes'} {channel} by about "
                f"{abs(delay_s):.2f} s ({channel} explains {response.best:.0%} of it): the sum of the delay and the "
                f"lags of {'servo' if channel == 'steering' else 'motor'} and tyres."
            )
            findings.append(Finding("command_delay", channel, Severity.INFO, sentence, evidence=evidence))
    return findings


def _command_evidence(
    channel: str, t_s: FloatArray, command: FloatArray, motion: PoseMotion, response: CommandResponse
) -> dict[str, float]:
    """Delay with the time constant [s], gain, share explained, and correlations of the delayed command (N,)."""
    delay_s = response.lag_s + response.time_constant_s
    evidence = {"explained": response.best, "gain": response.gain, "delay_s": delay_s}
    held = held_at(t_s, command, delay_s)
    moving = np.abs(motion.vx) > LIMITS.moving_mps
    if channel == "throttle":
        return evidence | {"correlation_speed": correlation(held[moving], motion.vx[moving])}
    # 5 1/m: a turning circle of 0.2 m, tighter than any such car; beyond it the car spins or stands.
    curvature = np.clip(motion.yaw_rate[moving] / motion.vx[moving], -5.0, 5.0)
    evidence["correlation"] = correlation(held[moving], curvature)
    for word, rows in (("forward", motion.vx > LIMITS.moving_mps), ("reverse", motion.vx < -LIMITS.moving_mps)):
        if rows.sum() > 100:
            evidence[f"correlation_yaw_rate_{word}"] = correlation(held[rows], motion.yaw_rate[rows])
    return evidence
