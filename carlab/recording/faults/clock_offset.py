"""Commands whose clock differs by seconds from that of the poses: correlation with the motion over many lags.

Yaw rate follows steering times speed, and forward acceleration follows throttle. The unexplained variance of both is
compared at all lags. With a clock offset it has one narrow minimum, outside ``LAGS_S``. With a periodic drive it has
several equal minima, and with slow commands a wide one. Both show no offset.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import fftconvolve

from carlab.core.quantities import FloatArray
from carlab.recording.column_mapping import COMMAND_CHANNELS
from carlab.recording.faults.commands import (
    LAGS_S,
    MIN_ROWS,
    CommandResponse,
    GridMotion,
    command_response,
    exchanged_commands,
    explain_too_little,
)
from carlab.recording.faults.fault import Fault
from carlab.recording.faults.robust import first_order_lag, held_means
from carlab.recording.faults.settings import LIMITS

TIME_CONSTANT_S = 0.1
"""[s] First-order lag of the response in the search; the fit at the found lag has its own."""
MIN_POWER_SHARE = 0.25
"""A lag counts fully if its overlap has this share of the largest power; few or constant rows correlate by chance."""


def clock_offset(motion: GridMotion, t_s: FloatArray, commands: Sequence[FloatArray]) -> Fault | None:
    """The fault of both commands (N,), held from each of ``t_s`` (N,) on, if their clock differs by seconds.

    Its evidence has ``delay_s``, the delay of the motion in the recording with the lags of the car [s], the delay
    ``steering_delay_s`` or ``throttle_delay_s`` without them of each command that clearly shows it, and
    ``unexplained_ratio``.
    """
    if motion.rows.sum() < MIN_ROWS:
        return None
    correlations = [
        np.clip(_lag_correlation(motion, t_s, command, channel), 0.0, 0.999)
        for channel, command in zip(COMMAND_CHANNELS, commands, strict=True)
        if np.std(command) >= LIMITS.constant_command
    ]
    if not correlations:
        return None
    information = -np.log1p(-(np.array(correlations) ** 2)).sum(axis=0)  # twice that of Gaussian variables [nat]
    lags_s = motion.period_s * np.arange(-(len(information) // 2), len(information) // 2 + 1, dtype=np.float64)
    lag_s, ratio = _distinct_peak(lags_s, information, float(motion.rows.sum() * motion.period_s))
    if LAGS_S[0] <= lag_s <= LAGS_S[-1] or ratio < LIMITS.offset_unexplained_ratio:
        return None
    found: dict[str, CommandResponse] = {}
    for channel, command, min_share in zip(COMMAND_CHANNELS, commands, LIMITS.command_explained, strict=True):
        response = command_response(motion, t_s + lag_s, command, channel)
        if response is not None and response.best >= min_share and response.gain > 0 and response.is_lag_inside:
            found[channel] = response
    if not found:
        return None
    delay_s = lag_s + float(np.mean([response.lag_s + response.time_constant_s for response in found.values()]))
    clear = {channel: r for channel, r in found.items() if r.best >= LIMITS.clear_response} or found
    own_delays_s = {f"{channel}_delay_s": lag_s + response.lag_s for channel, response in clear.items()}
    observation = (
        f"the motion {'precedes' if delay_s < 0 else 'follows'} the commands by {abs(delay_s):.2f} s: commands and "
        "poses have different clocks"
    )
    evidence = {"delay_s": delay_s, **own_delays_s, "unexplained_ratio": ratio}
    return Fault("clock_offset", ", ".join(COMMAND_CHANNELS), observation, evidence)


def exchanged_with_offset(
    motion: GridMotion, t_s: FloatArray, commands: Sequence[FloatArray], responses: Sequence[CommandResponse | None]
) -> Fault | None:
    """The fault as by ``exchanged_commands``, also if the clock of the commands differs by seconds."""
    fault = exchanged_commands(motion, t_s, commands, responses)
    if fault is not None or not explain_too_little(responses):
        return fault
    offset = clock_offset(motion, t_s, commands[::-1])
    if offset is None:
        return None
    shifted_s = t_s + offset.evidence["delay_s"]
    own = [command_response(motion, shifted_s, u, name) for name, u in zip(COMMAND_CHANNELS, commands, strict=True)]
    return exchanged_commands(motion, shifted_s, commands, own)


def _lag_correlation(motion: GridMotion, t_s: FloatArray, command: FloatArray, channel: str) -> FloatArray:
    """Correlation (2 n + 1,) of the motion with a command (N,) at lags of -n to n rows, half of the recording."""
    is_steering = channel == "steering"
    vx, rate = motion.vx, motion.yaw_rate
    columns = [np.ones_like(vx), vx, vx * np.abs(vx)]
    if not is_steering:
        columns += [rate**2, np.abs(rate), np.abs(rate * vx)]
    base = np.linalg.qr(np.column_stack(columns)[motion.rows])[0]
    values = (rate if is_steering else motion.acceleration)[motion.rows]
    target = np.zeros(len(vx))
    target[motion.rows] = values - base @ (base.T @ values)
    factor: FloatArray = np.where(motion.rows, vx if is_steering else 1.0, 0.0).astype(np.float64)
    held = held_means(t_s, command, motion.t_s - 0.5 * motion.period_s, motion.period_s)
    filtered = first_order_lag(held, motion.period_s, TIME_CONSTANT_S)
    filtered = filtered - filtered.mean()
    target_power = _lag_products(target**2, np.ones(len(vx)))
    command_power = _lag_products(factor**2, filtered**2)
    power = np.maximum(target_power, MIN_POWER_SHARE * target_power.max()) * np.maximum(
        command_power, MIN_POWER_SHARE * command_power.max()
    )
    return np.asarray(_lag_products(target * factor, filtered) / np.sqrt(power + 1e-18))


def _lag_products(values: FloatArray, delayed: FloatArray) -> FloatArray:
    """Sums (2 n + 1,) of values (N,) times ``delayed`` (N,) at lags of -n to n rows, where n is N // 2."""
    middle, n = len(values) - 1, len(values) // 2
    return np.asarray(fftconvolve(values, delayed[::-1])[middle - n : middle + n + 1])


def _distinct_peak(lags_s: FloatArray, information: FloatArray, moving_s: float) -> tuple[float, float]:
    """Lag of the peak [s], and the smallest ratio of the unexplained variance at other lags over that at the peak.

    The ratio is 0 for a peak at the edge of the search, for a broad peak, and for one that is not significant. The
    log-likelihood counts one independent sample for each width of the peak in ``moving_s`` of motion.
    """
    range_s = min(LIMITS.offset_range_s, LIMITS.offset_range_share * float(np.ptp(lags_s)))
    searched = np.flatnonzero(np.abs(lags_s) <= range_s)
    peak = int(searched[np.argmax(information[searched])])
    low = np.flatnonzero(information < 0.5 * information[peak])
    before, after = low[low < peak], low[low > peak]
    if peak in (searched[0], searched[-1]) or not len(before) or not len(after):
        return float(lags_s[peak]), 0.0
    first, last = before[-1], after[0]
    width_s = float(lags_s[last] - lags_s[first])
    gain = float(information[peak] - np.concatenate([information[: first + 1], information[last:]]).max())
    is_significant = 0.5 * gain * moving_s / width_s >= LIMITS.offset_log_likelihood
    return float(lags_s[peak]), float(np.exp(gain)) if is_significant and width_s <= LIMITS.offset_peak_s else 0.0
