"""Events: motions that no tyre can cause, as collisions, kerbs and a hand that moves the car.

Tyres of the grip mu change the velocity by at most mu g dt, whatever the commands are. The velocities before and after
each row of the pose are compared with that limit, with the usual changes of the recording, and with its noise. A car
that is carried sideways is not braked by its tyres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import savgol_filter

from carlab.core.episode_data import EpisodeData
from carlab.core.quantities import FloatArray
from carlab.diagnosis.settings import EVENTS
from carlab.prediction.windows import EVENT_COLUMN, body_states, unbroken_rows
from carlab.recording.faults.robust import robust_std, runs
from carlab.recording.pose_velocity import BoolArray
from sim_backends.car_parameters import CarParameters, SimulatorConfig
from sim_backends.effects.base import GRAVITY_MPS2


@dataclass(frozen=True, slots=True)
class Event:
    """A motion that no tyre can cause.

    Attributes:
        kind: ``impact``: velocity or yaw rate change too fast. ``carried``: the car moves sideways without friction.
        from_s, to_s: begin and end since the first row of the recording [s].
        x_m, y_m: place at the begin.
        velocity_change_mps: change of the velocity from before to after the event.
        yaw_rate_change_radps: change of the yaw rate, positive to the left.
        recording: number of the recording, from 1.
        role: ``fit`` or ``held out``; empty without roles.
    """

    kind: Literal["impact", "carried"]
    from_s: float
    to_s: float
    x_m: float
    y_m: float
    velocity_change_mps: float
    yaw_rate_change_radps: float
    recording: int = 1
    role: str = ""


@dataclass(frozen=True, slots=True)
class EventUse:
    """Events of the recordings, and what was done about them.

    Attributes:
        found: the events, in the order of recordings and time.
        are_left_out: whether no fitted and no scored window contains them.
        fit_windows, held_out_windows: number of windows that were left out.
    """

    found: tuple[Event, ...] = ()
    are_left_out: bool = True
    fit_windows: int = 0
    held_out_windows: int = 0


def mark_events(
    episodes: Sequence[EpisodeData], config: SimulatorConfig
) -> tuple[list[EpisodeData], tuple[Event, ...]]:
    """Find the events of recordings without faults, and mark their rows: no prediction window contains them.

    Args:
        episodes: recordings; those without events are returned as they are.
        config: simulator of the car file, for grip and yaw inertia.
    """
    marked, events = [], []
    for number, episode in enumerate(episodes, start=1):
        own = [replace(event, recording=number) for event in find_events(episode, config)]
        events += own
        marked.append(_with_column(episode, own) if own else episode)
    return marked, tuple(events)


def _with_column(episode: EpisodeData, events: Sequence[Event]) -> EpisodeData:
    t = episode.times_s - episode.times_s[0]
    inside = np.any([(t >= e.from_s - 1e-6) & (t <= e.to_s + 1e-6) for e in events], axis=0)
    return replace(episode, extra={**episode.extra, EVENT_COLUMN: inside.astype(np.float64)})


def find_events(episode: EpisodeData, config: SimulatorConfig) -> list[Event]:
    """Events of a recording without faults, in the order of time; none if its period is too long to see them."""
    if episode.ticks < 2 or episode.period_s > EVENTS.max_period_s:
        return []
    stretches = [_Stretch.of(episode, rows) for rows in unbroken_rows(episode)]
    if not stretches:
        return []
    impacts = _impact_rows(stretches, config.parameters)
    found = []
    for stretch, (impact, above_grip) in zip(stretches, impacts, strict=True):
        carried = _carried_rows(stretch, config.parameters)
        for first, last in _merged(stretch.t_s, impact | carried, EVENTS.merge_s):
            if not (above_grip | carried)[first : last + 1].any():
                continue
            kind: Literal["impact", "carried"] = "carried" if carried[first : last + 1].any() else "impact"
            velocity, yaw_rate = stretch.change_over(first, last)
            began_s, ended_s = (float(stretch.t_s[k] - episode.times_s[0]) for k in (first, last))
            x_m, y_m = (float(v) for v in stretch.pose[first, :2])
            found.append(Event(kind, began_s, ended_s, x_m, y_m, velocity, yaw_rate))
    return found


def grip_limits(car: CarParameters) -> FloatArray:
    """Largest acceleration [m/s2] and yaw acceleration [rad/s2] (2,) by tyres: both axles at their grip."""
    moment_per_grip = car.mass_kg * GRAVITY_MPS2 * car.front_axle_m * car.rear_axle_m / car.wheelbase_m
    yaw_acceleration = (car.front_mu + car.rear_mu) * moment_per_grip / car.yaw_inertia_kgm2
    return np.array([max(car.front_mu, car.rear_mu) * GRAVITY_MPS2, yaw_acceleration])


def _grip_ratio(stretches: Sequence[_Stretch], car: CarParameters) -> FloatArray:
    """Acceleration and yaw acceleration (2,) that the recording shows over those of the car file, at least 1.

    The recording shows the accelerations that the car sustains for several rows; a collision is shorter. A car sustains
    no yaw acceleration, so its usual one counts, and hard steering exceeds it by ``usual_factor``.
    """
    sustained, turning = [], []
    for stretch in stretches:
        width = stretch.rows_of(EVENTS.widths_s[0])
        changes = stretch.changes(width, 0)
        is_moving = np.isfinite(changes.elapsed_s) & (stretch.speed_mps > EVENTS.moving_mps)
        steady = _steady(changes, width)[is_moving]
        sustained.append(np.hypot(steady[:, 0], steady[:, 1]) / changes.elapsed_s[is_moving])
        turning.append((changes.sizes[:, 1] / changes.elapsed_s)[is_moving])
    shown = [np.concatenate(each) for each in (sustained, turning)]
    if len(shown[0]) < EVENTS.min_moving_rows:
        return np.ones(2)
    usual = [float(np.quantile(each, EVENTS.usual_quantile)) for each in shown]
    return np.maximum(np.array([1.0, EVENTS.usual_factor]) * usual / grip_limits(car), 1.0)


def _steady(changes: _Changes, width: int) -> FloatArray:
    """Steady part (n, 3) of the changes over ``width`` rows: a running median, which an impulse does not change."""
    return np.asarray(median_filter(np.nan_to_num(changes.values), (EVENTS.steady_widths * width, 1)))


@dataclass(frozen=True, slots=True)
class _Changes:
    """Changes between mean velocities before and after each row, NaN at the ends of a stretch.

    ``values`` (n, 3) of the velocity in the frame of the recording [m/s] and of the yaw rate [rad/s], ``elapsed_s``
    (n,) between the centres of the means.
    """

    values: FloatArray
    elapsed_s: FloatArray

    @property
    def sizes(self) -> FloatArray:
        """Sizes (n, 2) of the changes of velocity and yaw rate."""
        return np.column_stack([np.hypot(self.values[:, 0], self.values[:, 1]), np.abs(self.values[:, 2])])


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Unbroken stretch of n rows: stamps (n,), poses (n, 3) with yaw unwrapped, and speeds (n,) by its columns."""

    period_s: float
    t_s: FloatArray
    pose: FloatArray
    speed_mps: FloatArray

    @classmethod
    def of(cls, episode: EpisodeData, rows: slice) -> _Stretch:
        pose = episode.states[rows, :3].copy()
        pose[:, 2] = np.unwrap(pose[:, 2])
        return cls(episode.period_s, episode.times_s[rows], pose, np.hypot(*episode.states[rows, 3:5].T))

    def rows_of(self, span_s: float) -> int:
        """Number of rows of a time, at least one."""
        return max(round(span_s / self.period_s), 1)

    def changes(self, width: int, gap: int) -> _Changes:
        """Compare ``width`` rows before and after each row, ``gap`` rows away from it."""
        outer = width + gap
        rows = np.arange(outer, len(self.t_s) - outer)
        a, b, c, d = rows - outer, rows - gap, rows + gap, rows + outer
        values, elapsed_s = np.full((len(self.t_s), 3), np.nan), np.full(len(self.t_s), np.nan)
        values[rows] = self._velocities(c, d) - self._velocities(a, b)
        elapsed_s[rows] = 0.5 * (self.t_s[c] + self.t_s[d] - self.t_s[a] - self.t_s[b])
        return _Changes(values, elapsed_s)

    def change_over(self, first: int, last: int) -> tuple[float, float]:
        """Size of the change of velocity, and change of yaw rate, from before row ``first`` to after row ``last``."""
        width, end = self.rows_of(EVENTS.lasting_width_s), len(self.t_s) - 1
        before, after = max(first - 1, 1), min(last + 1, end - 1)
        early = self._velocities(np.array([max(before - width, 0)]), np.array([before]))
        late = self._velocities(np.array([after]), np.array([min(after + width, end)]))
        vx, vy, yaw_rate = (late - early)[0]
        return float(np.hypot(vx, vy)), float(yaw_rate)

    def _velocities(self, first: np.ndarray, last: np.ndarray) -> FloatArray:
        """Mean velocities (k, 3) from rows ``first`` (k,) to rows ``last`` (k,)."""
        return np.asarray((self.pose[last] - self.pose[first]) / (self.t_s[last] - self.t_s[first])[:, None])


def _impact_rows(stretches: Sequence[_Stretch], car: CarParameters) -> list[tuple[BoolArray, BoolArray]]:
    """Rows around which velocity or yaw rate change too fast, for each stretch.

    Returns:
        Rows (n,) of lasting changes beyond the grip of the car file, and those of them that are also beyond the grip of
        the recording.
    """
    fast, lasting, above_grip = ([np.zeros(len(s.t_s), dtype=bool) for s in stretches] for _ in range(3))
    limits, grip_ratio = np.array(EVENTS.grip_factors) * grip_limits(car), _grip_ratio(stretches, car)
    for width_s in EVENTS.widths_s:
        width = stretches[0].rows_of(width_s)
        changes = [s.changes(width, 0) for s in stretches]
        if not any(np.isfinite(c.elapsed_s).any() for c in changes):
            continue
        steady = [_steady(c, width) for c in changes]
        usual = _usual_changes(stretches, changes, steady)
        for k, (stretch, change) in enumerate(zip(stretches, changes, strict=True)):
            limit = limits * change.elapsed_s[:, None]
            is_fast = change.sizes > np.maximum(limit, usual)
            later = stretch.changes(stretch.rows_of(EVENTS.lasting_width_s), width)
            expected = steady[k] * (later.elapsed_s / change.elapsed_s)[:, None]
            lasts = np.minimum(_along(later.values, change), _along(later.values - expected, change))
            fast[k] |= is_fast.any(axis=1)
            lasting[k] |= (is_fast & (lasts >= EVENTS.lasting_share * change.sizes**2)).any(axis=1)
            above_grip[k] |= (is_fast & (change.sizes > grip_ratio * limit)).any(axis=1)
    for is_fast, is_lasting in zip(fast, lasting, strict=True):
        for first, end in runs(is_fast):
            is_fast[first:end] = is_lasting[first:end].any()
    return [(is_fast, is_fast & is_above) for is_fast, is_above in zip(fast, above_grip, strict=True)]


def _along(later: FloatArray, change: _Changes) -> FloatArray:
    """Products (n, 2) of later changes (n, 3) with those of velocity and yaw rate: positive in the same direction."""
    products = later * change.values
    return np.column_stack([products[:, 0] + products[:, 1], products[:, 2]])


def _usual_changes(
    stretches: Sequence[_Stretch], changes: Sequence[_Changes], steady: Sequence[FloatArray]
) -> FloatArray:
    """Changes (2,) of velocity and yaw rate that usual driving and noise do not exceed."""
    values, sizes = np.concatenate([c.values for c in changes]), np.concatenate([c.sizes for c in changes])
    is_known = np.isfinite(values).all(axis=1)
    is_moving = is_known & (np.concatenate([s.speed_mps for s in stretches]) > EVENTS.moving_mps)
    usual = np.zeros(2)
    if is_moving.sum() >= EVENTS.min_moving_rows:
        usual = np.quantile(sizes[is_moving], EVENTS.usual_quantile, axis=0)
    rough = (values - np.concatenate(steady))[is_known]
    x, y, yaw = (robust_std(column) for column in rough.T)
    return np.asarray(np.maximum(EVENTS.usual_factor * usual, EVENTS.noise_z * np.array([max(x, y), yaw])))


def _carried_rows(stretch: _Stretch, car: CarParameters) -> BoolArray:
    """Rows (n,) in which the car is carried: it moves sideways, and its tyres do not brake that motion."""
    found = np.zeros(len(stretch.t_s), dtype=bool)
    width = 2 * max(stretch.rows_of(EVENTS.slide_half_width_s), 2) + 1
    if len(stretch.t_s) < width:
        return found
    rate, rate2 = (savgol_filter(stretch.pose, width, 2, deriv=k, delta=stretch.period_s, axis=0) for k in (1, 2))
    vx, vy, yaw_rate = body_states(stretch.pose, rate).T[3:]
    side = np.sign(vy)
    braking = -side * body_states(stretch.pose, rate2)[:, 4]
    axles = side * (vy + car.front_axle_m * yaw_rate), side * (vy - car.rear_axle_m * yaw_rate)
    is_sliding = (np.abs(vy) > np.maximum(np.abs(vx), EVENTS.slide_mps)) & (np.minimum(*axles) > 0.5 * EVENTS.slide_mps)
    is_free = is_sliding & (braking < EVENTS.slide_friction_share * grip_limits(car)[0])
    standing = np.flatnonzero(np.hypot(vx, vy) < EVENTS.moving_mps)
    reach = stretch.rows_of(EVENTS.carry_s)
    for first, end in runs(is_free):
        if stretch.t_s[end - 1] - stretch.t_s[first] < EVENTS.slide_s - 1e-6:
            continue
        stop, restart = (standing[standing < first], standing[standing >= end])
        begin = max(first - reach, 0, *stop[-1:])
        found[begin : min(end + reach, len(found), *(restart[:1] + 1))] = True
    return found


def _merged(t_s: FloatArray, rows: BoolArray, merge_s: float) -> list[tuple[int, int]]:
    """First and last row of each group of ``rows`` (n,) without a distance of more than ``merge_s``."""
    index = np.flatnonzero(rows)
    groups = np.split(index, np.flatnonzero(np.diff(t_s[index]) > merge_s) + 1) if len(index) else []
    return [(int(group[0]), int(group[-1])) for group in groups]
