"""Repair of command columns by the response of the motion: sign, shifted rows, a separate clock.

A plausible delay is physics and stays. A response before the command, a response of the opposite sign, and a delay that
grows with time are faults of the recording.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from carlab.diagnosis.recording_faults.episode_repair import EpisodeRepair
from carlab.recording.column_mapping import COMMAND_CHANNELS
from carlab.recording.faults.clock_offset import clock_offset, exchanged_with_offset
from carlab.recording.faults.command_clock import WINDOW_S, WindowLags, clock_rate, window_lags
from carlab.recording.faults.commands import (
    LAGS_S,
    CommandResponse,
    GridMotion,
    command_response,
    grid_motion,
    moves_backward,
    reversed_yaw,
    wrong_command_sign,
)
from carlab.recording.faults.fault import Fault
from carlab.recording.faults.limited_commands import limited_command
from carlab.recording.faults.settings import LIMITS
from sim_backends.car_parameters import SimulatorConfig

METHOD_LAG_S = (0.02, -0.007)
"""[s] Lag that the method estimates for steering and throttle of a car without delay, because of its dynamics."""
PLAUSIBLE_EXTRA_S = (0.25, 0.45)
"""[s] Maximum plausible delay of steering and throttle in addition to that of the car file."""
MIN_VARIANCE_RATIO = 1.15
"""Residual variance at the best plausible delay over that at the best delay."""
SAME_SHIFT_S = 0.06
"""[s] Maximum difference between a recording's shift and the median shift of the recordings to count as equal."""
MIN_DRIFT_SIGMAS, MIN_DRIFT_S, MIN_DRIFT_RATE = 6.0, 0.04, 3e-4


def check_yaw_direction(repairs: Sequence[EpisodeRepair]) -> None:
    """Rotate yaw by 180 degrees if it points to the rear by both commands in all recordings with clear responses."""
    motions = [repair.motion() for repair in repairs]
    if not all(moves_backward(motion) for motion in motions):
        return
    clear = []
    for repair, motion in zip(repairs, motions, strict=True):
        responses = _responses(repair, grid_motion(repair.times_s, motion, repair.segment))
        if all(r is not None and r.best > LIMITS.command_explained[k] for k, r in enumerate(responses)):
            clear.append(reversed_yaw(responses))
    fault = clear[0] if clear else None
    if fault is None or None in clear:
        return
    for repair in repairs:
        repair.states[:, 2] += np.pi
        repair.repaired(fault, "yaw was rotated by 180 degrees")


def check_commands(repairs: Sequence[EpisodeRepair], nominal: SimulatorConfig) -> None:
    """Check and repair the command columns of all recordings; a common fault needs less evidence in each of them."""
    expected_s = nominal.command_delay_s + nominal.mocap.latency_s
    motions = _motions_after_clock_offsets(repairs, expected_s)
    pairs = list(zip(repairs, motions, strict=True))
    by_recording = [_responses(repair, motion) for repair, motion in pairs]
    if _exchange_columns(repairs, motions, by_recording):
        motions = _motions_after_clock_offsets(repairs, expected_s)
        pairs = list(zip(repairs, motions, strict=True))
        by_recording = [_responses(repair, motion) for repair, motion in pairs]
    is_restamped = _check_clock(repairs, motions, by_recording)
    by_recording = [
        _responses(*pair) if is_new else found
        for pair, found, is_new in zip(pairs, by_recording, is_restamped, strict=True)
    ]
    for channel in range(len(COMMAND_CHANNELS)):
        responses = [found[channel] for found in by_recording]
        clear = [r for r in responses if r is not None and r.best > LIMITS.command_explained[channel]]
        if clear:
            _check_sign(repairs, clear, channel)
            _check_shift(repairs, responses, channel, expected_s)
    for repair in repairs:
        _check_limits(repair)


def _check_limits(repair: EpisodeRepair) -> None:
    """Report commands that the log or the radio limits: no repair, because the executed commands are unknown."""
    motion = grid_motion(repair.times_s, repair.motion(), repair.segment)
    for command, name in zip(repair.commands.T, COMMAND_CHANNELS, strict=True):
        fault = limited_command(motion, repair.times_s, command, name)
        if fault is not None:
            remedy = "Log the commands that the car executes, without this limit"
            repair.report(fault.id, name, len(fault.rows), f"reported: {fault.observation}. {remedy}.")


def _exchange_columns(
    repairs: Sequence[EpisodeRepair],
    motions: Sequence[GridMotion],
    responses: Sequence[Sequence[CommandResponse | None]],
) -> bool:
    """Exchange both commands of the recordings with that fault, and of all if none follows a command of its own."""
    faults = [
        exchanged_with_offset(motion, repair.times_s, list(repair.commands.T), own)
        for repair, motion, own in zip(repairs, motions, responses, strict=True)
    ]
    known = next((fault for fault in faults if fault is not None), None)
    follows_own = any(
        r is not None and r.best >= share
        for own in responses
        for r, share in zip(own, LIMITS.command_explained, strict=True)
    )
    for repair, own_fault in zip(repairs, faults, strict=True):
        fault = own_fault if follows_own else known
        if fault is not None:
            repair.commands = repair.commands[:, ::-1].copy()
            repair.repaired(fault, "the columns were exchanged")
    return known is not None


def _motions_after_clock_offsets(repairs: Sequence[EpisodeRepair], expected_s: float) -> list[GridMotion]:
    """The motion of each recording, after both commands were shifted where their clock differs by seconds."""
    motions = [grid_motion(repair.times_s, repair.motion(), repair.segment) for repair in repairs]
    faults = [clock_offset(m, r.times_s, list(r.commands.T)) for r, m in zip(repairs, motions, strict=True)]
    advice = "set the clocks of both computers by NTP or PTP"
    if others := faults.count(None):
        advice += f"; the audit finds no offset in {others} of {len(faults)} recordings: check their clocks too"
    return [
        motion if fault is None else _without_clock_offset(repair, fault, expected_s, advice)
        for repair, motion, fault in zip(repairs, motions, faults, strict=True)
    ]


def _without_clock_offset(repair: EpisodeRepair, fault: Fault, expected_s: float, advice: str) -> GridMotion:
    """Shift both commands to the delay of the car file. Returns the motion of the remaining rows.

    The actuators may add delays, so the command with the smaller delay shows that of both.
    """
    delays_s = [
        fault.evidence[key] - method_s
        for channel, method_s in zip(COMMAND_CHANNELS, METHOD_LAG_S, strict=True)
        if (key := f"{channel}_delay_s") in fault.evidence
    ]
    rows = round((expected_s - min(delays_s)) / repair.period_s)
    late_s = rows * repair.period_s
    for channel in range(len(COMMAND_CHANNELS)):
        repair.retime(channel, -late_s)
    repair.trim(abs(rows) + 1, at_end=rows > 0)
    change = f"{'reduced' if rows > 0 else 'increased'} by {abs(late_s):.2f} s"
    remedy = f"the stamps of the commands were {change}, and their unknown delay was fitted; {advice}"
    repair.repaired(fault, remedy)
    return grid_motion(repair.times_s, repair.motion(), repair.segment)


def _responses(repair: EpisodeRepair, motion: GridMotion) -> list[CommandResponse | None]:
    """Response to each command."""
    return [
        command_response(motion, repair.times_s, command, name)
        for command, name in zip(repair.commands.T, COMMAND_CHANNELS, strict=True)
    ]


def _check_sign(repairs: Sequence[EpisodeRepair], clear: Sequence[CommandResponse], channel: int) -> None:
    """Change the sign if the response is opposite to the command in every recording with a clear response."""
    if any(a.gain > 0 for a in clear) or all(a.lag_s < -LIMITS.early_response_s for a in clear):
        return
    fault = wrong_command_sign(COMMAND_CHANNELS[channel], max(clear, key=lambda a: a.best))
    for repair in repairs:
        repair.commands[:, channel] *= -1.0
        repair.repaired(fault, "its sign was changed")


def _check_shift(
    repairs: Sequence[EpisodeRepair], responses: Sequence[CommandResponse | None], channel: int, expected_s: float
) -> None:
    """Shift a column if the response precedes it, or follows later than a plausible delay."""
    zero_s = expected_s + METHOD_LAG_S[channel]
    shifts = [zero_s - r.lag_s for r in responses if r is not None and _is_impossible(r, channel, expected_s)]
    name = COMMAND_CHANNELS[channel]
    for repair, response in zip(repairs, responses, strict=True):
        if response is None or not shifts:
            continue
        shift_s = zero_s - response.lag_s
        if not _is_impossible(response, channel, expected_s) and abs(shift_s - np.median(shifts)) > SAME_SHIFT_S:
            continue
        rows = round(shift_s / repair.period_s)
        is_late = shift_s > 0
        repair.retime(channel, -rows * repair.period_s)
        repair.trim(abs(rows) + 1, at_end=is_late)
        observation = (
            f"the motion {'precedes' if is_late else 'follows'} the {name} command by {abs(shift_s) * 1e3:.0f} ms, "
            f"{'which is impossible' if is_late else 'later than any actuator responds'}"
        )
        remedy = f"the column was shifted by {rows} rows to the delay of the car file ({expected_s * 1e3:.0f} ms)"
        repair.repaired(Fault("column_shift", name, observation), remedy)


def _is_impossible(response: CommandResponse, channel: int, expected_s: float) -> bool:
    """Whether no plausible delay explains nearly as much of the motion as the best delay."""
    earliest = METHOD_LAG_S[channel] - LIMITS.early_response_s
    latest = METHOD_LAG_S[channel] + expected_s + PLAUSIBLE_EXTRA_S[channel]
    if response.best < LIMITS.command_explained[channel] or response.gain <= 0 or earliest <= response.lag_s <= latest:
        return False
    plausible = response.explained[(earliest <= LAGS_S) & (latest >= LAGS_S)].max()
    return bool((1.0 - plausible) / max(1.0 - response.best, 1e-9) > MIN_VARIANCE_RATIO)


def _check_clock(
    repairs: Sequence[EpisodeRepair],
    motions: Sequence[GridMotion],
    responses: Sequence[Sequence[CommandResponse | None]],
) -> list[bool]:
    """Correct the stamps of commands from a clock that runs fast or slow; whether each recording was changed."""
    is_changed = [False] * len(repairs)
    lags = [window_lags(found) for found in responses]
    longest_s = max((float(np.ptp(repair.times_s)) for repair in repairs), default=0.0)
    pooled = clock_rate(WindowLags.joined(lags))
    for k, (repair, motion, windows) in enumerate(zip(repairs, motions, lags, strict=True)):
        length_s = float(np.ptp(repair.times_s))
        own = clock_rate(windows)
        rate = _significant(own, length_s)
        if rate is None and own is not None and pooled is not None:
            is_common = abs(own[0] - pooled[0]) < 3.0 * own[1] and abs(own[0]) > 2.0 * own[1]
            rate = _significant(pooled, longest_s) if is_common else None
        if rate is None:
            continue
        rate, is_changed[k] = _restamp(repair, motion, rate), True
        if rate < 0:  # the last commands were recorded after the last pose
            repair.trim(math.ceil(-rate * length_s / repair.period_s) + 1, at_end=True)
        observation = (
            f"the delay of the commands {'grows' if rate > 0 else 'shrinks'} by {abs(rate) * 1e3:.2f} ms a second "
            f"({len(windows.t_s)} windows of {WINDOW_S:.0f} s): commands and poses have different clocks"
        )
        repair.repaired(
            Fault("clock_drift", "steering, throttle", observation),
            "the commands were converted to the clock of the poses",
        )
    return is_changed


def _significant(found: tuple[float, float] | None, length_s: float) -> float | None:
    """The rate [s/s] if it and its effect over ``length_s`` exceed their thresholds."""
    if found is None:
        return None
    rate, error = found
    is_large = abs(rate) > max(MIN_DRIFT_SIGMAS * error, MIN_DRIFT_RATE) and abs(rate) * length_s > MIN_DRIFT_S
    return rate if is_large else None


def _restamp(repair: EpisodeRepair, motion: GridMotion, rate: float) -> float:
    """Resample the commands from a clock that gains ``rate`` [s/s]; refine and return the rate."""
    recorded = repair.commands.copy()
    for _ in range(2):
        # A row contains the command sent since the previous row, so each time belongs to the following row.
        moments = repair.times_s - rate * (repair.times_s - repair.times_s[0])
        rows = np.searchsorted(repair.times_s, moments - 0.02 * repair.period_s)
        repair.commands = recorded[np.minimum(rows, len(recorded) - 1)]
        remaining = clock_rate(window_lags(_responses(repair, motion)))
        if remaining is None or abs(remaining[0]) < remaining[1]:
            break
        rate += remaining[0]
    return rate
