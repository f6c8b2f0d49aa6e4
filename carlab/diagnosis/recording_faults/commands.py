"""Faults of command columns, found by how the motion follows them: sign, rows of a column, a clock of its own.

A delay that a car can have is physics and stays: up to 0.25 s more than the car file says for steering, 0.45 s for
throttle. What no car can do is answer before it is told to, answer the other way round, or take longer every minute.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.recording_faults.episode_motion import Patient
from carlab.diagnosis.recording_faults.response import CHANNELS, LAGS_S, Motion, Response, motion_of, refined, response
from sim_backends.car_parameters import SimulatorConfig

OWN_LAG_S = (0.02, -0.007)
"""What the method finds for steering and throttle of a car without any delay: tyres are no pure lag."""
EARLY_S = 0.03
"""An answer this much before its command cannot be an error of the method (0.02 s)."""
PLAUSIBLE_EXTRA_S = (0.25, 0.45)
LEAST_EXPLAINED = (0.3, 0.15)
BETTER = 1.15
"""Residual variance at the best delay a car can have, over that at the best of all."""
DRIFT_SIGMAS = 6.0
LEAST_DRIFT_S = 0.04
LEAST_DRIFT_RATE = 3e-4
WINDOW_STD_S = 0.01
"""A window's delay is not known better than this, however well few windows happen to lie on a line."""
_WINDOW_S = 6.0


@dataclass(frozen=True, slots=True)
class Drift:
    """Delays seen in windows: at t_s (w,) and lag_s (w,), both about their middle, by channel (w,) of 0 and 1."""

    t_s: FloatArray
    lag_s: FloatArray
    channel: FloatArray


def check_commands(patients: Sequence[Patient], nominal: SimulatorConfig) -> None:
    """Check and repair the command columns of all recordings; what they agree on is believed sooner."""
    expected_s = nominal.command_delay_s + nominal.mocap.latency_s
    motions = [motion_of(patient) for patient in patients]
    _check_drift(patients, motions)
    for channel, name in enumerate(CHANNELS):
        answers = [response(m, p.times_s, p.commands[:, channel], name) for p, m in zip(patients, motions, strict=True)]
        clear = [a for a in answers if a is not None and a.best > LEAST_EXPLAINED[channel]]
        if not clear:
            continue
        _check_sign(patients, clear, channel)
        _check_shift(patients, answers, channel, expected_s)


def _check_sign(patients: Sequence[Patient], clear: Sequence[Response], channel: int) -> None:
    """The car does the opposite of what it is told, in every recording that shows anything."""
    if any(a.sign > 0 for a in clear) or all(a.lag_s < -EARLY_S for a in clear):
        return
    name = CHANNELS[channel]
    effect = "the car turns right" if channel == 0 else "the car is driven backward"
    share = max(a.best for a in clear)
    for patient in patients:
        patient.commands[:, channel] *= -1.0
        patient.touched = True
        patient.found(
            "wrong_sign",
            name,
            len(patient.times_s),
            f"repaired: with positive {name} {effect} (it explains {share:.0%} of the motion, the wrong way round); "
            "its sign was turned.",
        )


def _check_shift(
    patients: Sequence[Patient], answers: Sequence[Response | None], channel: int, expected_s: float
) -> None:
    """A column whose effect comes before it, or later than any actuator takes."""
    shifts = [None if a is None else _impossible_shift(a, channel, expected_s) for a in answers]
    certain = [s for s in shifts if s is not None]
    if not certain:
        return
    usual = float(np.median(certain))
    name = CHANNELS[channel]
    for patient, answer, own in zip(patients, answers, shifts, strict=True):
        if own is None:
            if answer is None or abs(_shift(answer, channel, expected_s) - usual) > 0.06:
                continue
            own = _shift(answer, channel, expected_s)
        rows = round(own / patient.period_s)
        late = own > 0
        patient.retime(channel, -rows * patient.period_s)
        edge = abs(rows) + 1
        keep = np.ones(len(patient.times_s), dtype=bool)
        keep[-edge:] = not late
        keep[:edge] = late
        patient.keep(keep)
        patient.found(
            "column_shift",
            name,
            len(patient.times_s),
            f"repaired: the motion comes {abs(own) * 1e3:.0f} ms {'before' if late else 'after'} its {name}, "
            f"{'which no car can do' if late else 'longer than any actuator takes'}; the column was moved by {rows} "
            f"rows, to the delay of the car file ({expected_s * 1e3:.0f} ms).",
        )


def _shift(answer: Response, channel: int, expected_s: float) -> float:
    """How much later [s] the column is than the delay of the car file would have it."""
    return expected_s + OWN_LAG_S[channel] - answer.lag_s


def _impossible_shift(answer: Response, channel: int, expected_s: float) -> float | None:
    if answer.best < LEAST_EXPLAINED[channel]:
        return None
    shift = _shift(answer, channel, expected_s)
    longest = expected_s + OWN_LAG_S[channel] + PLAUSIBLE_EXTRA_S[channel]
    possible = (OWN_LAG_S[channel] - EARLY_S <= LAGS_S) & (longest >= LAGS_S)
    worse = (1.0 - answer.explained[possible].max()) / max(1.0 - answer.best, 1e-9)
    own = answer.lag_s - OWN_LAG_S[channel]
    impossible = own < -EARLY_S or own - expected_s > PLAUSIBLE_EXTRA_S[channel]
    return shift if impossible and worse > BETTER and answer.sign > 0 else None


def _check_drift(patients: Sequence[Patient], motions: Sequence[Motion]) -> None:
    """Commands stamped by a clock that gains or loses: the delay grows or shrinks evenly with time."""
    seen = [_windows(p, m) for p, m in zip(patients, motions, strict=True)]
    rates = [_rate(drift) for drift in seen]
    longest = max((float(p.times_s[-1] - p.times_s[0]) for p in patients), default=0.0)
    pooled = _rate(
        Drift(*(np.concatenate([getattr(d, part) for d in seen]) for part in ("t_s", "lag_s", "channel")))
        if seen
        else Drift(np.zeros(0), np.zeros(0), np.zeros(0))
    )
    for patient, motion, own, drift in zip(patients, motions, rates, seen, strict=True):
        length = float(patient.times_s[-1] - patient.times_s[0])
        rate = _believed(own, length)
        if rate is None and pooled is not None and _agrees(own, pooled):
            rate = _believed(pooled, longest)
        if rate is None:
            continue
        recorded = patient.commands.copy()
        patient.touched = True
        for _ in range(2):
            # A logger's rows show what was sent up to a row before, so each moment belongs to the row that follows it.
            moments = patient.times_s - rate * (patient.times_s - patient.times_s[0])
            rows = np.searchsorted(patient.times_s, moments - 0.02 * patient.period_s)
            patient.commands = recorded[np.minimum(rows, len(recorded) - 1)]
            left = _rate(_windows(patient, motion))
            if left is None or abs(left[0]) < left[1]:
                break
            rate += left[0]
        edge = math.ceil(abs(rate) * length / patient.period_s) + 1
        keep = np.ones(len(patient.times_s), dtype=bool)
        keep[-edge:] = rate > 0
        patient.keep(keep)
        patient.found(
            "clock_drift",
            "steering, throttle",
            len(patient.times_s),
            f"repaired: the delay of the commands {'grows' if rate > 0 else 'shrinks'} by {abs(rate) * 1e3:.2f} ms a "
            f"second ({len(drift.t_s)} stretches of {_WINDOW_S:.0f} s): they were stamped by another clock; brought "
            "back to that of the poses.",
        )


def _believed(found: tuple[float, float] | None, length_s: float) -> float | None:
    if found is None:
        return None
    rate, error = found
    sure = abs(rate) > max(DRIFT_SIGMAS * error, LEAST_DRIFT_RATE) and abs(rate) * length_s > LEAST_DRIFT_S
    return rate if sure else None


def _agrees(own: tuple[float, float] | None, pooled: tuple[float, float]) -> bool:
    return own is not None and abs(own[0] - pooled[0]) < 3.0 * own[1] and abs(own[0]) > 2.0 * own[1]


def _windows(patient: Patient, motion: Motion) -> Drift:
    """Delays of both channels in windows of a recording."""
    parts: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for channel, name in enumerate(CHANNELS):
        answer = response(motion, patient.times_s, patient.commands[:, channel], name)
        if answer is None or answer.best < LEAST_EXPLAINED[channel]:
            continue
        number = ((answer.t_s - answer.t_s[0]) / _WINDOW_S).astype(np.int64)
        times, lags = [], []
        for k in np.unique(number):
            rows = number == k
            if rows.sum() < 60:
                continue
            y = answer.target[rows] - answer.target[rows].mean()
            p = answer.predicted[:, rows]
            p = p - p.mean(axis=1, keepdims=True)
            along = p @ y
            size = np.einsum("lr,lr->l", p, p)
            cost = -(np.where(along > 0, along, 0.0) ** 2) / np.maximum(size, 1e-12) / max(float(y @ y), 1e-12)
            if -cost.min() < 0.4 or not 0 < np.argmin(cost) < len(cost) - 1:
                continue
            times.append(float(answer.t_s[rows].mean() - patient.times_s[0]))
            lags.append(refined(LAGS_S, cost))
        if len(lags) >= 4:
            lag = np.array(lags)
            when = np.array(times)
            parts.append((when - when.mean(), lag - np.median(lag), np.full(len(lag), float(channel))))
    if not parts:
        return Drift(np.zeros(0), np.zeros(0), np.zeros(0))
    return Drift(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _rate(drift: Drift) -> tuple[float, float] | None:
    """Growth of the delay [s/s] common to both channels, and its standard error. None where channels contradict."""
    own = [r for r in (_slope(drift, drift.channel == c) for c in (0.0, 1.0)) if r is not None]
    if not own:
        return None
    weights = np.array([1.0 / e**2 for _, e in own])
    rates = np.array([r for r, _ in own])
    rate, error = float(weights @ rates / weights.sum()), float(1.0 / math.sqrt(weights.sum()))
    if len(own) == 2 and abs(rates[0] - rates[1]) > 3.0 * math.hypot(own[0][1], own[1][1]):
        return None
    return rate, error


def _slope(drift: Drift, rows: np.ndarray) -> tuple[float, float] | None:
    t, lag = drift.t_s[rows], drift.lag_s[rows]
    if len(t) < 5:
        return None
    keep = np.ones(len(t), dtype=bool)
    for _ in range(4):
        design = np.column_stack([np.ones(keep.sum()), t[keep]])
        fitted, *_ = np.linalg.lstsq(design, lag[keep], rcond=None)
        miss = np.abs(lag - fitted[0] - fitted[1] * t)
        limit = max(3.0 * 1.4826 * float(np.median(miss)), 0.004)
        if np.array_equal(keep, miss <= limit):
            break
        keep = miss <= limit
        if keep.sum() < 5:
            return None
    freedom = keep.sum() - 2
    variance = max(float(np.sum(miss[keep] ** 2)) / freedom, WINDOW_STD_S**2)
    return float(fitted[1]), math.sqrt(variance / float(np.sum((t[keep] - t[keep].mean()) ** 2)))
