"""How far a simulator strays from a recording over a horizon: many shots along it, each started from what was recorded.

A shot starts at a recorded state, with the commands before it as history (for delays and lags), and is driven by the
recorded commands, held as they were. All shots are one batch. Recorded states are taken as true ones: effects on what
motion capture measures are not applied.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.angles import wrap
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.quantities import STATE_NAMES, STATE_UNITS, FloatArray
from carlab.experiment.recorded_shots import IndexArray, RecordedShots
from sim_backends import SimulatorConfig

MIN_SPEED_MPS = 0.1
"""Shots in which the car never drives faster are left out: standing still is predicted by anything."""
HISTORY_S = 0.6
"""Length of the command history beyond the longest delay: six time constants of a slow (0.1 s) servo or motor."""
BASELINES = ("constant velocity", "no change")


@dataclass(frozen=True, slots=True)
class ChannelError:
    """Errors of one channel after the horizon over all shots, in ``unit``.

    Root mean square, median and 90th percentile of the absolute error, and mean (predicted minus recorded).
    """

    channel: str
    unit: str
    rms: float
    median: float
    p90: float
    bias: float


@dataclass(frozen=True, slots=True)
class PredictionErrors:
    """Prediction errors of S shots with K steps each, over a recording of T + 1 states.

    start_rows   (S,)         row of the recording at which each shot starts
    errors       (S, 6)       predicted minus recorded after ``horizon_s``: x, y [m] in the body frame of the shot's
                              start (ahead, left), yaw [rad] in [-pi, pi), vx, vy [m/s], yaw rate [rad/s]
    baselines    (S, 6) each  the same for a car that keeps its body velocities, and for one that stays as it is
    trajectories (S, K + 1, 6)  predicted states in the recording's frame, ``grid_s`` apart
    overlay      (T + 1, 6)   prediction at each recorded stamp, restarted every horizon; NaN where there is none
    left_out                  how many candidate shots were left out, by reason
    note                      how the commands were put onto the simulator's ticks
    """

    horizon_s: float
    stride_s: float
    grid_s: float
    start_rows: IndexArray
    errors: FloatArray
    baselines: Mapping[str, FloatArray]
    trajectories: FloatArray
    overlay: FloatArray
    left_out: Mapping[str, int]
    note: str

    @property
    def shots(self) -> int:
        """Number of shots S."""
        return len(self.start_rows)

    def summary(self, baseline: str | None = None) -> tuple[ChannelError, ...]:
        """Statistics by channel, of the simulator or of a baseline. Raises DataError for an unknown baseline."""
        if baseline is not None and baseline not in self.baselines:
            raise DataError(f"There is no baseline '{baseline}'; choose one of {', '.join(self.baselines)}.")
        errors = self.errors if baseline is None else self.baselines[baseline]
        size = np.abs(errors)
        return tuple(
            ChannelError(
                name,
                unit,
                float(np.sqrt(np.mean(errors[:, k] ** 2))),
                float(np.median(size[:, k])),
                float(np.percentile(size[:, k], 90)),
                float(np.mean(errors[:, k])),
            )
            for k, (name, unit) in enumerate(zip(STATE_NAMES, STATE_UNITS, strict=True))
        )

    def rows(self) -> list[tuple[str, str, float, float, float, float, float, float]]:
        """Table rows: channel, unit, rms, median, p90, bias, rms with constant velocity, rms with no change."""
        others = [self.summary(name) for name in BASELINES]
        return [
            (e.channel, e.unit, e.rms, e.median, e.p90, e.bias, others[0][k].rms, others[1][k].rms)
            for k, e in enumerate(self.summary())
        ]


def prediction_errors(
    episode: EpisodeData,
    config: SimulatorConfig,
    horizon_s: float = 1.0,
    stride_s: float = 0.25,
    *,
    min_speed_mps: float = MIN_SPEED_MPS,
) -> PredictionErrors:
    """Predict ``horizon_s`` ahead from a start every ``stride_s`` along a recording, and compare.

    Even stamps are the simulator's ticks. Uneven ones are kept: the held commands are averaged over cells of at most
    ``GRID_S``, and the recorded state at the end of a shot is interpolated between its neighbours. Before the first
    recorded command the first one is taken to have been held.

    Args:
        episode: The recording; ``sent`` commands are used. A column ``segment`` in ``extra``, as import makes it,
            numbers stretches that no shot may span; nor does any shot span a gap or a state that is not a number.
        config: The simulator; its control period is replaced by the recording's.
        horizon_s: How far to predict [s].
        stride_s: From one start to the next [s].
        min_speed_mps: Shots in which the recorded car stays slower are left out [m/s].

    Raises:
        DataError: Horizon or stride is not positive, or the recording holds no shot of that length.
    """
    if not (horizon_s > 0 and stride_s > 0):
        raise DataError(f"Horizon {horizon_s:g} s and stride {stride_s:g} s must be positive.")
    if not episode.ticks:
        raise DataError("The recording holds no command; there is nothing to predict.")
    recording = RecordedShots(episode)
    steps = max(1, round(horizon_s / recording.grid_s))
    horizon_s = steps * recording.grid_s
    starts, ends, left_out = recording.starts(steps, stride_s, min_speed_mps)
    if not len(starts):
        reasons = ", ".join(f"{count} {why}" for why, count in left_out.items() if count) or "it is too short"
        raise DataError(f"The recording holds no shot of {horizon_s:g} s ({reasons}); choose a shorter horizon.")
    restarts = recording.restarts(horizon_s)
    everything = _predict(recording, config, np.concatenate([starts, restarts]), steps)
    predicted = everything[: len(starts)]
    first, truth = recording.states[starts], recording.ends(starts, ends, horizon_s)
    return PredictionErrors(
        horizon_s=horizon_s,
        stride_s=stride_s,
        grid_s=recording.grid_s,
        start_rows=starts,
        errors=_errors(first, predicted[:, -1], truth),
        baselines={
            BASELINES[0]: _errors(first, _constant_velocity(first, horizon_s), truth),
            BASELINES[1]: _errors(first, first, truth),
        },
        trajectories=predicted,
        overlay=recording.overlay(restarts, everything[len(starts) :], horizon_s),
        left_out=left_out,
        note=recording.note,
    )


def _predict(recording: RecordedShots, config: SimulatorConfig, starts: IndexArray, steps: int) -> FloatArray:
    """Trajectories (len(starts), steps + 1, 6) of all shots, as one batch in double precision."""
    import torch  # heavy: only where something is predicted

    from sim_backends import rollout

    past = int(np.ceil((max(config.delays_s()) + HISTORY_S) / recording.grid_s))
    result = rollout(
        replace(config, control_period_s=recording.grid_s),
        torch.from_numpy(recording.states[starts]),
        torch.from_numpy(recording.held(starts, 0, steps)),
        history=torch.from_numpy(recording.held(starts, -past, 0)),
    )
    states: FloatArray = result.states.numpy()
    return states


def _errors(first: FloatArray, predicted: FloatArray, truth: FloatArray) -> FloatArray:
    """Predicted minus recorded, all (S, 6), with x and y in the body frame of ``first`` and yaw wrapped."""
    errors = predicted - truth
    c, s = np.cos(first[:, 2]), np.sin(first[:, 2])
    ahead, left = c * errors[:, 0] + s * errors[:, 1], c * errors[:, 1] - s * errors[:, 0]
    return np.column_stack([ahead, left, wrap(errors[:, 2]), errors[:, 3:]])


def _constant_velocity(first: FloatArray, span_s: float) -> FloatArray:
    """States (S, 6) after ``span_s`` on the circular arcs of constant body velocities."""
    x, y, yaw, vx, vy, yaw_rate = first.T
    turn = yaw_rate * span_s
    along = np.sinc(turn / np.pi)
    across = np.sin(turn / 2) * np.sinc(turn / (2 * np.pi))
    ahead, left = span_s * (along * vx - across * vy), span_s * (across * vx + along * vy)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([x + c * ahead - s * left, y + s * ahead + c * left, yaw + turn, vx, vy, yaw_rate])
