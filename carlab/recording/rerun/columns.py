"""Rows of an episode as columns of a rerun recording, for live recordings and for conversions from arrays."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import rerun as rr

from carlab.core.documents import Tick, Transition
from carlab.core.quantities import ACTION_NAMES, FloatArray, Observation
from carlab.recording.rerun import blueprint as look

Row = tuple[int, float, Observation]
"""Step, time on the car's clock [s] and observation."""
Color = tuple[int, int, int]


def entity_part(name: str) -> str:
    """A text as one part of an entity path."""
    return re.sub(r"[^\w-]+", "_", name, flags=re.ASCII) or "_"


class Columns:
    """Sends columns to a stream.

    Args:
        stream: receives the columns.
        origin_s: the car's clock [s] at the zero of the timeline ``car_time``.
        episode: position on the timeline ``episode``; None: without that timeline.
        trail: colour of the driven path; None: that of the car.
        logged: receives the paths of the series with data.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        origin_s: float,
        episode: int | None = None,
        trail: Color | None = None,
        logged: set[str] | None = None,
    ) -> None:
        self._stream = stream
        self.origin_s = origin_s
        self._episode = episode
        self._trail = trail
        self._logged = set() if logged is None else logged
        self._previous: FloatArray | None = None

    def indexes(self, times_s: Sequence[float] | FloatArray, steps: Sequence[int]) -> list[rr.TimeColumn]:
        """All timelines of n rows with times and ticks (n,)."""
        times = [
            rr.TimeColumn(look.CAR_TIME, duration=np.asarray(times_s, dtype=np.float64) - self.origin_s),
            rr.TimeColumn(look.STEP, sequence=np.asarray(steps, dtype=np.int64)),
        ]
        if self._episode is not None:
            times.append(rr.TimeColumn(look.EPISODE, sequence=np.full(len(times_s), self._episode)))
        return times

    def set_time(self, car_time_s: float, step: int) -> None:
        """Set the time of the next logged entities on all timelines."""
        self._stream.set_time(look.CAR_TIME, duration=car_time_s)
        self._stream.set_time(look.STEP, sequence=step)
        if self._episode is not None:
            self._stream.set_time(look.EPISODE, sequence=self._episode)

    def states(self, rows: Sequence[Row]) -> None:
        """Send pose, trail, velocities, age of the pose and raw poses of observations."""
        if not rows:
            return
        indexes = self.indexes([t_s for _, t_s, _ in rows], [step for step, _, _ in rows])
        states = np.array([seen.state.to_array() for _, _, seen in rows])
        self._previous = self._car(look.CAR, look.TRAIL, indexes, states, self._previous, self._trail)
        speed = np.hypot(states[:, 3], states[:, 4])
        for name, values in zip(
            ("speed_mps", "vx_mps", "vy_mps", "yaw_rate_radps"), (speed, *states[:, 3:].T), strict=True
        ):
            self.scalars(f"car/state/{name}", indexes, values)
        self.scalars("car/state/age_ms", indexes, [1e3 * (t_s - seen.t_capture_s) for _, t_s, seen in rows])
        lengths = [sum(pose.tracked for pose in seen.poses) for _, _, seen in rows]
        if any(lengths):
            points = [(pose.x_m, pose.y_m, 0.0) for _, _, seen in rows for pose in seen.poses if pose.tracked]
            columns = rr.Points3D.columns(positions=np.array(points)).partition(lengths)
            self._stream.send_columns(look.POSES, indexes, columns)

    def ticks(self, ticks: Sequence[Tick]) -> None:
        """Send requested and sent commands, lateness and computing time of the policy."""
        if not ticks:
            return
        indexes = self.indexes([tick.t_s for tick in ticks], [tick.step for tick in ticks])
        for channel in ACTION_NAMES:
            for which in ("requested", "sent"):
                values = [getattr(getattr(tick, which), channel) for tick in ticks]
                self.scalars(f"car/action_{which}/{channel}", indexes, values)
        self.scalars("episode/tick/late_ms", indexes, [1e3 * tick.late_s for tick in ticks])
        self.scalars("episode/tick/policy_ms", indexes, [1e3 * tick.policy_s for tick in ticks])

    def rewards(self, transitions: Sequence[Transition]) -> None:
        """Send the reward of each transition at the time of its observation."""
        if transitions:
            indexes = self.indexes([row.t_s for row in transitions], [row.step + 1 for row in transitions])
            self.scalars("episode/transition/reward", indexes, [row.reward for row in transitions])

    def overlay(self, name: str, times_s: Sequence[float], steps: Sequence[int], states: FloatArray) -> None:
        """Send the states of an additional car; rows with NaN are omitted.

        Args:
            name: name of the car.
            times_s: times on the car's clock (n,).
            steps: ticks (n,).
            states: (m, 6) x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s]; the first min(n, m) rows are sent.
        """
        count = min(len(times_s), len(states))
        whole = np.isfinite(states[:count]).all(axis=1)
        states = states[:count][whole]
        if not len(states):
            return
        indexes = self.indexes(np.asarray(times_s)[:count][whole], np.asarray(steps)[:count][whole].tolist())
        self._car(look.overlay_car(name), look.overlay_trail(name), indexes, states, None)
        for path, values in zip(look.overlay_series(name).values(), states[:, 3:].T, strict=True):
            self.scalars(path, indexes, values)

    def _car(
        self,
        car: str,
        trail: str,
        indexes: list[rr.TimeColumn],
        states: FloatArray,
        previous: FloatArray | None,
        color: Color | None = None,
    ) -> FloatArray:
        places = np.column_stack([states[:, :2], np.zeros(len(states))])
        turns = rr.Transform3D.columns(translation=places, quaternion=yaw_quaternion(states[:, 2]))
        self._stream.send_columns(car, indexes, turns)
        # One segment of the trail per row, from the previous position: the view shows all segments up to its time.
        starts = np.vstack([places[:1] if previous is None else previous, places[:-1]])
        strips = list(np.stack([starts, places], axis=1))
        colors = None if color is None else [color] * len(strips)
        self._stream.send_columns(trail, indexes, rr.LineStrips3D.columns(strips=strips, colors=colors))
        return places[-1:]

    def scalars(self, path: str, indexes: list[rr.TimeColumn], values: Sequence[float] | FloatArray) -> None:
        """Send one series (n,), or several of one entity (n, series); nothing if all values are NaN."""
        numbers = np.asarray(values, dtype=np.float64)
        if np.isnan(numbers).all():
            return
        columns = rr.Scalars.columns(scalars=numbers.ravel())
        if numbers.ndim > 1:
            columns = columns.partition(np.full(len(numbers), numbers.shape[1]))
        self._stream.send_columns(path, indexes, columns)
        self._logged.add(path)


def yaw_quaternion(yaw_rad: FloatArray | float) -> FloatArray:
    """Quaternions (..., 4) in the order x, y, z, w of rotations about z by angles (...,) [rad]."""
    half_rad = 0.5 * np.asarray(yaw_rad)
    zero = np.zeros_like(half_rad)
    return np.stack([zero, zero, np.sin(half_rad), np.cos(half_rad)], axis=-1)


def log_surroundings(
    stream: rr.RecordingStream,
    arena_m: Sequence[tuple[float, float]],
    path_m: Sequence[tuple[float, float]],
    goal: tuple[float, float, float] | None,
) -> None:
    """Log arena, reference path and goal of the plan view."""
    width = rr.Radius.ui_points(1.5)
    if arena_m:
        border = [(x, y, 0.0) for x, y in (*arena_m, arena_m[0])]
        line = rr.LineStrips3D([border], radii=width, colors=look.VERMILION, labels="arena", show_labels=False)
        stream.log(look.ARENA, line, static=True)
    if len(path_m) > 1:
        line = rr.LineStrips3D([[(x, y, 0.0) for x, y in path_m]], radii=width, colors=look.GREY)
        stream.log(look.PATH, line, static=True)
    if goal is not None:
        length_m, width_m, height_m = look.CAR_SIZE_M
        turn = rr.Quaternion(xyzw=yaw_quaternion(goal[2]))
        stream.log(look.GOAL, rr.Transform3D(translation=[goal[0], goal[1], 0.0], quaternion=turn), static=True)
        half = [[0.5 * length_m, 0.5 * width_m, 0.01 * height_m]]
        box = rr.Boxes3D(half_sizes=half, radii=rr.Radius.ui_points(1.5), colors=look.GREEN)
        stream.log(f"{look.GOAL}/pose", box, static=True)
        arrow = rr.Arrows3D(vectors=[[0.75 * length_m, 0.0, 0.0]], radii=0.05 * width_m, colors=look.GREEN)
        stream.log(f"{look.GOAL}/heading", arrow, static=True)
