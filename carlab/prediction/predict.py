"""Predictions of windows by any model; the simulator predicts many parameter sets in one batch.

Times are those of the recording, in which commands act later by the latency of motion capture. The measurement model
(``sim_backends.measurement``) is inverted at the initial state of a window and applied along it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from carlab.core.planar import arc
from carlab.core.quantities import FloatArray
from carlab.prediction.step_length import step_for
from carlab.prediction.windows import IndexArray, PredictionWindows
from sim_backends.array_ops import ARRAYS
from sim_backends.batch.array_rollout import array_rollout
from sim_backends.batch.inputs import with_effects_of_values
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS, DynamicsEffect
from sim_backends.measurement import (
    COMMAND_DELAY,
    MeasurementModel,
    State,
    delay_as_recorded_s,
    is_measurement_parameter,
)
from sim_backends.measurement import velocity_curvature as state_curvature

MAX_SINGLE_POSE = 100.0
"""Maximum coordinate of a pose [m, rad] that is simulated with 32 bits; each step rounds it by at most 4e-6. Surveyed
coordinates of 5e6 m would be rounded to 0.5 m."""


class PredictiveModel(Protocol):
    """A model that predicts the measurements in windows."""

    def predict(self, windows: PredictionWindows) -> FloatArray:
        """Predicted measurements (S, K + 1, 6) of S windows.

        Returns:
            x, y [m], yaw [rad] in the recording's frame, vx, vy [m/s] in the body frame, yaw rate [rad/s].
        """
        ...


@dataclass(frozen=True, slots=True)
class SimulatorModel:
    """A simulator as a predictive model."""

    config: SimulatorConfig

    def predict(self, windows: PredictionWindows) -> FloatArray:
        """As ``PredictiveModel``, (S, K + 1, 6)."""
        return np.asarray(simulate_windows(windows, self.config)[0])


@dataclass(frozen=True, slots=True)
class ConstantVelocity:
    """Baseline with constant body velocities: the path is a circular arc."""

    def predict(self, windows: PredictionWindows) -> FloatArray:
        """As ``PredictiveModel``, (S, K + 1, 6) from the initial state of each window."""
        time_s = windows.period_s * np.arange(windows.steps + 1)
        x, y, yaw, vx, vy, yaw_rate = (column[:, None] for column in windows.initial_states.T)
        ahead, left, turn = arc(vx, vy, yaw_rate, time_s)
        cos, sin = np.cos(yaw), np.sin(yaw)
        columns = (x + cos * ahead - sin * left, y + sin * ahead + cos * left, yaw + turn, vx, vy, yaw_rate)
        return np.stack(np.broadcast_arrays(*columns), axis=-1)


@dataclass(frozen=True, slots=True)
class NoChange:
    """Baseline with a constant state."""

    def predict(self, windows: PredictionWindows) -> FloatArray:
        """As ``PredictiveModel``, (S, K + 1, 6)."""
        return np.repeat(windows.initial_states[:, None], windows.steps + 1, axis=1)


def predicted_at(times_s: FloatArray, windows: PredictionWindows, predicted: FloatArray) -> FloatArray:
    """Predictions (T, 6) at times (T,) of one recording, NaN outside of the windows.

    Args:
        times_s: since the first row of the recording.
        windows: windows of that recording, without overlap.
        predicted: predictions (S, K + 1, 6) of these windows.
    """
    found = np.full((len(times_s), 6), np.nan)
    grid = windows.period_s * np.arange(windows.steps + 1)
    for start_s, states in zip(windows.t0_s, predicted, strict=True):
        rows = np.flatnonzero((times_s > start_s - 1e-6) & (times_s < start_s + windows.horizon_s - 1e-6))
        for channel in range(6):
            found[rows, channel] = np.interp(times_s[rows] - start_s, grid, states[:, channel])
    return found


def simulate_windows(
    windows: PredictionWindows,
    config: SimulatorConfig,
    values: Mapping[str, FloatArray] | None = None,
    *,
    max_step_s: float | None = None,
    ticks: IndexArray | None = None,
    in_double: bool = False,
) -> FloatArray:
    """Predict windows by a simulator with P parameter sets.

    Args:
        windows: S windows.
        config: the simulator, observation effects included.
        values: parameters by dotted name, each (P,), or (P, S) for a value of each window; default: those of
            ``config``.
        max_step_s: maximum integration step; by default as long as the cars of the windows allow.
        ticks: indices (U,) of the ticks to return; all K + 1 by default.
        in_double: simulate with 64 instead of 32 bits, which takes twice as long; always done where 32 are not enough.

    Returns:
        Predicted measurements (P, S, K + 1 or U, 6) in the order and units of ``PredictiveModel``.
    """
    whole, numbers, sets = _by_set(config, values or {})
    measurement = MeasurementModel(ARRAYS, numbers, whole.effects)
    effects = [name for name in whole.effects if EFFECTS[name].kind != "observation"]
    invert = measurement.invert_poses if windows.velocities_from_poses else measurement.invert
    start = _stacked([invert(tuple(windows.initial_states.T))])[0]
    past = _past_of_hidden_states(windows, measurement, effects)
    origin = _origins(start, whole.effects)
    is_far = bool((np.abs(start - origin)[:3] > MAX_SINGLE_POSE).any())
    dtype = np.float64 if in_double or is_far else np.float32
    parts, commands = windows.part_commands(dtype)
    used = measurement.ticks_in_use(ticks, windows.steps, windows.velocity_window_s2)
    states = array_rollout(
        whole.kind,
        effects,
        _car_without_measurement(numbers, effects, measurement) | {"timing.control_period": windows.period_s / parts},
        (start - origin).astype(dtype),
        commands,
        windows.steps * parts,
        before=windows.past_commands.shape[1] * parts,
        past_states=None if past is None else (past - origin).astype(dtype),
        t0_s=windows.t0_s.astype(dtype),
        max_step_s=step_for(windows, whole.kind, numbers, whole.effects) if max_step_s is None else max_step_s,
        every=parts,
        returned=np.array(used),
    )
    in_type = {name: v.astype(dtype) if isinstance(v, np.ndarray) else v for name, v in numbers.items()}
    trajectory = {tick: tuple(own) for tick, own in zip(used, states, strict=True)}
    measured = _measured(trajectory, windows, MeasurementModel(ARRAYS, in_type, whole.effects), ticks)
    predicted = _stacked(measured, sets)
    predicted[:, :3] += origin[:3]
    return predicted.transpose(2, 3, 0, 1)


def _car_without_measurement(
    numbers: Mapping[str, float | FloatArray], effects: Sequence[str], measurement: MeasurementModel
) -> dict[str, Any]:
    """Numbers of the car without its measurement; commands act later by the latency of the measurement."""
    own = {name: value for name, value in numbers.items() if not is_measurement_parameter(name)}
    return own | {COMMAND_DELAY: delay_as_recorded_s(ARRAYS, numbers, effects, measurement.latency_s)}


def longest_step_s(
    windows: PredictionWindows, config: SimulatorConfig, values: Mapping[str, FloatArray] | None = None
) -> float:
    """Longest accurate integration step [s] of ``simulate_windows`` with the same arguments."""
    whole, numbers, _ = _by_set(config, values or {})
    return step_for(windows, whole.kind, numbers, whole.effects)


def _past_of_hidden_states(
    windows: PredictionWindows, measurement: MeasurementModel, effects: Iterable[str]
) -> FloatArray | None:
    """True states (H, 6, P or 1, S) before windows, or None if no hidden state depends on them."""
    used = [EFFECTS[name] for name in effects]
    if not any(isinstance(effect, DynamicsEffect) and effect.states for effect in used):
        return None
    rows = tuple(windows.past_states.transpose(2, 1, 0)[:, :, None])
    return np.stack(np.broadcast_arrays(*measurement.invert_poses(rows)), axis=1)


def _origins(start: FloatArray, effects: Iterable[str]) -> FloatArray:
    """Positions and whole turns (6, 1 or P, S) to subtract from states of this shape: 32 bits resolve numbers near 0.

    Positions are 0 if an effect depends on the place, also one of the measurement.
    """
    origin = np.zeros_like(start)
    if not any("place" in EFFECTS[name].depends_on for name in effects):
        origin[:2] = start[:2]
    origin[2] = 2.0 * np.pi * np.round(start[2] / (2.0 * np.pi))
    return origin


def _measured(
    trajectory: Mapping[int, State], windows: PredictionWindows, measurement: MeasurementModel, ticks: IndexArray | None
) -> list[State]:
    """Measured states of a trajectory of true ones, at some or all ticks."""
    has_filter = measurement.velocity_time_constant_s is not None
    past = windows.past_states[:, :, 3:].transpose(1, 2, 0).astype(trajectory[0][3].dtype) if has_filter else ()
    return measurement.measure(
        trajectory,
        windows.period_s,
        window_s2=windows.velocity_window_s2,
        velocities_before=[tuple(velocities) for velocities in past],
        ticks=None if ticks is None else ticks.tolist(),
    )


def velocity_curvature(states: FloatArray, period_s: float) -> FloatArray:
    """Second time derivative of velocities, in the body frame.

    Args:
        states: (..., K + 1, 6) as of ``PredictiveModel``.
        period_s: time between states.

    Returns:
        (..., K + 1, 3) of vx, vy [m/s3] and yaw rate [rad/s3] by central differences of the velocities in the world; 0
        at both ends.
    """
    rows = tuple(np.moveaxis(states, -1, 0))
    before, now, after = (tuple(r[..., part] for r in rows) for part in (np.s_[:-2], np.s_[1:-1], np.s_[2:]))
    second = np.zeros((*states.shape[:-1], 3))
    second[..., 1:-1, :] = np.stack(state_curvature(ARRAYS, before, now, after, period_s), axis=-1)
    return second


def _by_set(
    config: SimulatorConfig, values: Mapping[str, FloatArray]
) -> tuple[SimulatorConfig, dict[str, float | FloatArray], int]:
    """The simulator with the effects of ``values``, all its parameters, each a number, (P, 1) or (P, S), and P."""
    given = {name: _in_columns(value) for name, value in values.items()}
    whole = with_effects_of_values(config, given)
    return whole, {**whole.values(), **given}, max((len(value) for value in given.values()), default=1)


def _in_columns(value: float | FloatArray) -> FloatArray:
    """A number, (P,) or (P, S) as an array (P, 1) or (P, S)."""
    array = np.asarray(value, dtype=np.float64)
    return array if array.ndim == 2 else array.reshape(-1, 1)


def _stacked(states: Sequence[State], sets: int = 1) -> FloatArray:
    """Stack states, six rows (S,), (1, S) or (P, S) per tick, into one array (ticks, 6, P, S); ``sets`` is least P."""
    rows = [np.atleast_2d(row) for state in states for row in state]
    stacked = np.empty((len(rows), max(sets, *(len(row) for row in rows)), rows[0].shape[1]))
    for k, row in enumerate(rows):
        stacked[k] = row
    return stacked.reshape(len(states), len(states[0]), *stacked.shape[1:])
