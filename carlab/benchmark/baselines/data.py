"""Input of all baselines: clean columns, the generator's refit, and velocity errors over short steps.

A baseline knows the refitted base model and explains the discrepancy: the velocity change of the recording minus that
of the model over 0.3 s, divided by the time (a residual acceleration). Commands are delayed by the delay of the car
file, because such methods require delayed inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import median_filter

from carlab.benchmark.cases.refit import Windows, cut_windows, fine_commands, in_start_frame, refit, roll
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.measurement import Recording, body_velocity, window_rows
from carlab.benchmark.world.simulation import FloatArray
from carlab.core.errors import DataError
from carlab.core.planar import to_world

STEP_S = 0.3
EVERY_S = 0.15
SLOW_MPS = 0.3
Table = Mapping[str, FloatArray]


@dataclass
class Steps:
    """M short steps of the refitted model.

    ``starts`` (M, 6), ``rows`` (M,) of the recording where they begin, ``t_s`` their times (M,) [s], ``fine`` the
    acting commands of the whole recording by substeps (N n, 2), ``parts`` the n substeps of a period [s] (n,),
    ``count`` rows in a step, ``ends`` (M, 6) where the refitted model gets.
    """

    car: BaseCar
    starts: FloatArray
    rows: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    t_s: FloatArray
    fine: FloatArray
    parts: FloatArray
    count: int
    ends: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.ends = self.rolled()

    @property
    def length_s(self) -> float:
        """Length of a step [s]."""
        return self.count * float(self.parts.sum())

    @property
    def middle(self) -> FloatArray:
        """States half-way, (M, 6)."""
        return 0.5 * (self.starts + self.ends)

    def commands(self, series: FloatArray | None = None) -> FloatArray:
        """Acting commands of every substep of every step, (M, S, 2)."""
        taken = self.fine if series is None else series
        index = self.rows[:, None] * len(self.parts) + np.arange(self.count * len(self.parts))
        return np.asarray(taken[np.minimum(index, len(taken) - 1)])

    def rolled(
        self,
        *,
        starts: FloatArray | None = None,
        series: FloatArray | None = None,
        scaled: Mapping[str, FloatArray] | None = None,
    ) -> FloatArray:
        """Ends (M, 6) with other starts, other commands, or scaled base parameters (M,)."""
        values: dict[str, object] = {**self.car.free()}
        for name, factor in (scaled or {}).items():
            values[name] = self.car.free()[name] * factor
        begin = self.starts if starts is None else starts
        ends = roll(self.car, values, begin, self.commands(series), np.tile(self.parts, self.count))
        return np.asarray(ends)

    def rates(self, *, at_end: bool) -> FloatArray:
        """Rates of the velocities (M, 3) by the model at the start or the end of a step."""
        commands, which = self.commands(), slice(-1, None) if at_end else slice(0, 1)
        begin = self.ends if at_end else self.starts
        after = roll(self.car, self.car.free(), begin, commands[:, which], self.parts[which])
        return np.asarray((after - begin)[:, 3:] / self.parts[which].sum())


@dataclass(frozen=True)
class Prepared:
    """Input of the baselines for one case.

    Attributes:
        nominal, car: nominal and refitted car.
        fit, hold: recordings to fit and held out.
        floor: noise floors of the six channels (6,).
        steps, hold_steps: short steps of both recordings.
        errors, hold_errors: residual accelerations of these steps (M, 3) [m/s2, m/s2, rad/s2].
        windows: held-out windows.
        refit_score: score of the refitted car on these windows.
    """

    nominal: BaseCar
    car: BaseCar
    fit: Recording
    hold: Recording
    floor: FloatArray
    steps: Steps
    errors: FloatArray
    hold_steps: Steps
    hold_errors: FloatArray
    windows: Windows
    refit_score: float

    @property
    def weights(self) -> FloatArray:
        """One over the standard deviation of the noise of a residual acceleration, (3,)."""
        return np.asarray(STEP_S / (np.sqrt(2.0) * self.floor[3:]))


def prepare(fit: Table, hold: Table, nominal: BaseCar, floor: Mapping[str, float]) -> Prepared:
    """Clean the columns, refit the base model, and cut both recordings into short steps.

    Raises:
        DataError: too few usable rows, or stamps that do not fit the control period.
    """
    floors = np.array([floor[name] for name in ("x", "y", "yaw", "vx", "vy", "yaw_rate")])
    recordings = [clean(table, nominal, floors) for table in (fit, hold)]
    windows = [cut_windows(r, nominal).with_floor(floors) for r in recordings]
    fitted = refit(windows[0], windows[1], nominal)
    car = nominal.with_free(fitted.values)
    cut = [short_steps(r, car) for r in recordings]
    if not np.isfinite(fitted.score) or min(len(steps.rows) for steps, _ in cut) < 30:
        raise DataError("The recording has too few usable rows for a regression; use a longer recording.")
    return Prepared(
        nominal,
        car,
        recordings[0],
        recordings[1],
        floors,
        *cut[0],
        *cut[1],
        windows=windows[1],
        refit_score=fitted.score,
    )


def clean(table: Table, car: BaseCar, floors: FloatArray) -> Recording:
    """Resample on even rows, interpolate gaps and outliers, and re-estimate velocities at jumps of the pose.

    Args:
        table: columns (N,) by name.
        car: with the control period.
        floors: noise floors of the six channels (6,).

    Raises:
        DataError: the stamps do not fit the control period.
    """
    t = np.asarray(table["t"])
    even = t[0] + car.control_period * np.arange(round((t[-1] - t[0]) / car.control_period) + 1)
    if not 100 <= len(even) <= 200_000:
        raise DataError("The time column does not fit the car file's control period.")
    yaw = np.unwrap(table["yaw"])
    columns = [table["x"], table["y"], yaw, table["vx"], table["vy"], table["yaw_rate"]]
    jumps = False
    made = []
    for k, column in enumerate(columns):
        known = np.isfinite(column)
        value = np.interp(even, t[known], column[known])
        middle = median_filter(value, 5)
        off = np.abs(value - middle)
        far = off > max(12.0 * float(np.median(off)), 10.0 * floors[k])
        jumps = jumps or (k < 3 and bool(far.any()))
        made.append(np.where(far, middle, value))
    measured = np.stack(made, axis=1)
    if jumps:
        measured[:, 3:] = body_velocity(measured[:, :3], car.control_period, window_rows(0.075, car.control_period))
    last = np.clip(np.searchsorted(t, even + 1e-6, side="right") - 1, 0, len(t) - 1)
    commands = np.stack([np.nan_to_num(table[name])[last] for name in ("steering", "throttle")], axis=1)
    return Recording(even - even[0], measured, commands, np.zeros_like(measured))


def short_steps(recording: Recording, car: BaseCar) -> tuple[Steps, FloatArray]:
    """Steps from recorded states, and residual accelerations (M, 3) in m/s2, m/s2 and rad/s2."""
    period = car.control_period
    count, stride = max(1, round(STEP_S / period)), max(1, round(EVERY_S / period))
    rows = np.arange(5, len(recording.t_s) - count - 1, stride, dtype=np.int64)
    rows = rows[np.abs(recording.measured[rows, 3]) > SLOW_MPS]
    fine, parts = fine_commands(recording, car)
    steps = Steps(car, recording.measured[rows], rows, recording.t_s[rows], fine, parts, count)
    errors = (recording.measured[rows + count, 3:] - steps.ends[:, 3:]) / steps.length_s
    return steps, errors


def held_out_score(
    data: Prepared, correction: Callable[[Steps], FloatArray], at_end: Callable[[Steps], FloatArray] | None = None
) -> float:
    """Score over 1 s if ``correction`` (residual acceleration (M, 3)) is added after every short step.

    ``at_end`` gives what is added to the measured velocities (M, 3) at the end only.
    """
    windows, car = data.windows, data.car
    period = car.control_period
    count = max(1, round(STEP_S / period))
    fine, parts = fine_commands(data.hold, car)
    total = windows.commands.shape[1] // len(parts)
    first = np.arange(5, len(data.hold.t_s) - total, max(1, round(0.5 / period)), dtype=np.int64)
    state = windows.starts.copy()
    for begin in range(0, total, count):
        rows = first + begin
        steps = Steps(car, state, rows, data.hold.t_s[rows], fine, parts, min(count, total - begin))
        gained = correction(steps) * steps.length_s
        state = steps.ends.copy()
        state[:, 3:] += gained
        moved = 0.5 * steps.length_s * gained
        state[:, :2] += np.stack(to_world(moved[:, 0], moved[:, 1], state[:, 2]), axis=1)
        state[:, 2] += moved[:, 2]
    if at_end is not None:
        state[:, 3:] += at_end(steps)
    errors = in_start_frame(state - windows.recorded, windows.starts) / data.floor
    total_error = float(np.sqrt((errors**2).mean()))
    return total_error if np.isfinite(total_error) else 1e3
