"""Position errors of the diagnosed model and of constant velocity, by held-out recording and regime."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from carlab.core.quantities import FloatArray
from carlab.diagnosis.findings import Skill
from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.settings import EVIDENCE
from carlab.prediction.windows import MIN_HISTORY_S, PredictionWindows, history_rows


def skill_of(windows: PredictionWindows, model: FloatArray, constant_velocity: FloatArray) -> tuple[Skill, ...]:
    """Compare two predictions of S held-out windows, by recording and regime.

    Args:
        windows: the held-out windows.
        model: errors (S, 6) of the diagnosed model after the horizon.
        constant_velocity: errors (S, 6) of constant body velocities and yaw rate.
    """
    distances = [np.hypot(e[:, 0], e[:, 1]) for e in (model, constant_velocity)]
    return tuple(
        _skill(windows, rows, recording, regime, distances)
        for recording in np.unique(windows.recording)
        for regime, rows in _regimes(windows, windows.recording == recording)
        if rows.sum() >= EVIDENCE.skill_windows_min
    )


def _regimes(windows: PredictionWindows, own: NDArray[np.bool_]) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """All windows of a recording, those with the smaller and the larger change of the commands, slow and fast ones."""
    yield "all", own
    recent = windows.past_commands[:, -history_rows(windows.period_s, MIN_HISTORY_S) :]
    commands = np.concatenate([recent, windows.commands], axis=1)
    change = np.hypot(*np.moveaxis(np.ptp(commands, axis=1), -1, 0))
    speed = np.abs(windows.initial_states[:, 3])
    for size, low, high in ((change, "steady commands", "changing commands"), (speed, "low speed", "high speed")):
        median = np.median(size[own])
        yield low, own & (size <= median)
        yield high, own & (size > median)


def _skill(
    windows: PredictionWindows, rows: NDArray[np.bool_], recording: int, regime: str, distances: list[FloatArray]
) -> Skill:
    model, constant = (distance[rows] for distance in distances)
    gain, error = clustered_gain(constant, model, windows.take(rows))
    rms = [float(np.sqrt(np.mean(d**2))) for d in (model, constant)]
    steps = np.diff(windows.measured[rows][:, :, :2], axis=1)
    travelled_m = float(np.hypot(steps[..., 0], steps[..., 1]).sum(axis=1).mean())
    return Skill(int(recording) + 1, regime, int(rows.sum()), rms[0], rms[1], travelled_m, gain / error)
