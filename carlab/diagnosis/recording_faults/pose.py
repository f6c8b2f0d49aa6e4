"""Repair of stamps and poses: unit, sign, repeated rows, outliers, missing rows."""

from __future__ import annotations

import math

import numpy as np

from carlab.core.angles import wrap
from carlab.diagnosis.recording_faults.episode_repair import EpisodeRepair
from carlab.recording.column_mapping import UNITS
from carlab.recording.faults.fault import Fault
from carlab.recording.faults.heading import heading_faults
from carlab.recording.faults.pose import rows_off_path, stale_rows
from carlab.recording.faults.robust import runs
from carlab.recording.faults.stamps import gap_rows
from carlab.recording.pose_velocity import BoolArray

CONTROL_PERIODS_S = (5e-4, 0.6)
"""[s] Range of plausible control and sampling periods of a model car."""
MAX_INTERPOLATION_S = 0.25
"""[s] Maximum interpolated gap: motion of 2 Hz at 10 m/s^2 deviates by 2 mm from a cubic."""
MAX_HEADING_REPAIRS = 3
MAX_ROW_PERIODS = 1.5
"""Longest time from row to row, in control periods: beyond it, commands between the rows are lost."""
MIN_OFFSET_RAD = math.radians(30.0)
"""[rad] A smaller constant offset of yaw is a parameter of the measurement."""


def check_pose(repair: EpisodeRepair, control_period_s: float) -> None:
    """Check and repair stamps and pose: units, then repeated rows (they resemble jumps), outliers, gaps."""
    _check_time_unit(repair, control_period_s)
    _check_row_period(repair, control_period_s)
    _check_frame(repair)
    _check_repeats(repair)
    _check_outliers(repair)
    _check_gaps(repair)


def _check_time_unit(repair: EpisodeRepair, control_period_s: float) -> None:
    """Detect stamps in milli-, micro- or nanoseconds by an implausible period."""
    low, high = CONTROL_PERIODS_S
    period = repair.period_s
    if low <= period <= high:
        return
    fitting = {unit: f for unit, f in UNITS["t"].items() if low <= period * f <= high}
    if not fitting:
        repair.report(
            "wrong_unit", "t", len(repair.times_s), f"reported: the period of {period:.3g} s fits no time unit."
        )
        return
    unit = min(fitting, key=lambda u: abs(math.log(period * fitting[u] / control_period_s)))
    repair.times_s = repair.times_s * fitting[unit]
    repair.cut_at_jumps()
    fault = Fault("wrong_unit", "t", f"a period of {period:.3g} s is implausible")
    repair.repaired(fault, f"the stamps are in {unit} and were converted")


def _check_row_period(repair: EpisodeRepair, control_period_s: float) -> None:
    """Report rows that are further apart than the commands of the car file."""
    if repair.period_s <= MAX_ROW_PERIODS * control_period_s:
        return
    action = (
        f"reported: rows are {repair.period_s:.3g} s apart, and the control period of the car file is "
        f"{control_period_s:.3g} s: the recording lacks the commands between the rows. Record a row for each command, "
        "or correct control_period."
    )
    repair.report("coarse_rows", "steering, throttle", len(repair.times_s), action)


def _check_frame(repair: EpisodeRepair) -> None:
    """Repair unit, sign and axes of the pose by the course over ground; an axis shows after unit and sign are right."""
    for _ in range(MAX_HEADING_REPAIRS):
        n_faults = len(repair.faults)
        _repair_heading(repair)
        if len(repair.faults) == n_faults:
            return


def _repair_heading(repair: EpisodeRepair) -> None:
    states = repair.states
    for fault in heading_faults(repair.times_s, {"x": states[:, 0], "y": states[:, 1], "yaw": states[:, 2]}):
        option = fault.option or ""
        if fault.channel == "x, y":
            states[:, :2] *= fault.evidence["factor"]
            remedy = "converted to metres"
        elif option == "--yaw-unit deg":
            states[:, 2] = np.deg2rad(states[:, 2])
            remedy = "converted to radians"
        elif option == "--yaw-sign -1":
            states[:, 2] *= -1.0
            remedy = "the sign of yaw was changed"
        elif option == "--swap-xy":
            states[:, [0, 1]] = states[:, [1, 0]]
            remedy = "x and y were exchanged"
        elif abs(fault.evidence.get("offset_rad", 0.0)) > MIN_OFFSET_RAD:
            states[:, 2] += fault.evidence["offset_rad"]
            remedy = "yaw was rotated by that angle"
        else:
            continue
        repair.repaired(fault, remedy)


def _check_repeats(repair: EpisodeRepair) -> None:
    """Interpolate rows that repeat the previous pose while the car moves."""
    stale = stale_rows(repair.times_s, repair.states[:, :3])
    if not stale.any():
        return
    count = int(stale.sum())
    rows = f"1 row ({stale.mean():.2%}) repeats" if count == 1 else f"{count} rows ({stale.mean():.2%}) repeat"
    observation = (
        f"{rows} the previous pose although the car moves (the logger was faster than the cameras, or a frame was lost)"
    )
    channel = "x, y, yaw, vx, vy, yaw_rate" if repair.has_velocity_columns else "x, y, yaw"
    repair.repaired(Fault("stale_samples", channel, observation), _interpolate(repair, stale, columns=6), count)


def _check_outliers(repair: EpisodeRepair) -> None:
    """Interpolate short runs of rows whose pose is far from the path of their neighbours."""
    outliers = rows_off_path(repair.times_s, repair.states[:, :3])
    if outliers.any():
        count = int(outliers.sum())
        rows = "1 row is far from the path of its" if count == 1 else f"{count} rows is far from the path of their"
        observation = f"the pose of {rows} neighbours (another marker, a bad frame)"
        remedy = _interpolate(repair, outliers, columns=3)
        repair.repaired(Fault("outliers", "x, y, yaw", observation), remedy, count)
    repair.cut_at_jumps()


def _check_gaps(repair: EpisodeRepair) -> None:
    """Cut at gaps and at the remaining jumps (lost tracking), and count missing rows of an even clock."""
    jumps = repair.cut_at_jumps()
    if jumps:
        times = "once" if jumps == 1 else f"{jumps} times"
        fault = Fault("outliers", "x, y, yaw", f"the pose jumps {times} without a return: tracking was lost")
        repair.repaired(fault, f"the recording was cut at the {'jump' if jumps == 1 else 'jumps'}", jumps)
    step, period = np.diff(repair.times_s), repair.period_s
    gaps = gap_rows(repair.times_s)
    is_even = np.mean(np.abs(step - period) < 0.1 * period) > 0.9
    missing = np.where(np.diff(repair.rows) == 1, np.round(step / period) - 1.0, 0.0)  # without the rows removed here
    places = missing >= 1 if is_even else np.isin(np.arange(len(step)), gaps - 1)
    count = int(missing[places].sum())
    if count < 1:
        return
    repair.is_changed |= len(gaps) > 0
    repair.report(
        "dropouts",
        "t",
        count,
        f"repaired: {count} rows are missing in {int(places.sum())} places, up to {step.max():.2f} s; the recording "
        f"was cut at the {len(gaps)} gaps of more than three periods.",
    )


def _interpolate(repair: EpisodeRepair, bad: BoolArray, *, columns: int) -> str:
    """Interpolate the first ``columns`` states of short runs of ``bad`` rows by a cubic; remove long runs.

    Returns the action as a clause.
    """
    states, t_s = repair.states, repair.times_s
    repair.interpolated = repair.interpolated | bad
    count = 0
    for first, last in runs(bad):
        good = np.array([k for k in range(first - 4, last + 4) if 0 <= k < len(bad) and not bad[k]], dtype=np.int64)
        before = int((good < first).sum())
        is_long = last >= len(bad) or first == 0 or t_s[last] - t_s[first - 1] > MAX_INTERPOLATION_S
        if is_long or min(before, len(good) - before) < 2:
            states[first:last] = np.nan
            continue
        span = t_s[good] - t_s[first]
        scale = max(float(np.abs(span).max()), 1e-9)
        values = states[good, :columns]
        values[:, 2] = np.unwrap(wrap(values[:, 2]))
        fitted = np.linalg.lstsq(np.vander(span / scale, 4, increasing=True), values, rcond=None)[0]
        design = np.vander((t_s[first:last] - t_s[first]) / scale, 4, increasing=True)
        states[first:last, :columns] = design @ fitted
        count += last - first
    if np.isnan(states).any():
        repair.keep(np.asarray(np.isfinite(states).all(axis=1)))
    removed = int(bad.sum()) - count
    how = "1 was interpolated from its" if count == 1 else f"{count} were interpolated from their"
    removal = f", {removed} {'was' if removed == 1 else 'were'} removed" if removed else ""
    return f"{how} neighbours{removal}"
