"""Faults of stamps and of the pose, found by the pose alone: unit, sense, repeated rows, jumps, rows that are missing.

Each check repairs the recording it is given and notes what it did. Order matters: units first, then repeated rows
(they look like jumps), then jumps, then what is left of gaps.
"""

from __future__ import annotations

import math

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.recording_faults.episode_motion import BoolArray, Patient, spread
from carlab.recording.audit.heading import check_heading
from carlab.recording.audit.stamps import gap_rows
from carlab.recording.csv.mapping import CANONICAL

CONTROL_PERIODS_S = (5e-4, 0.6)
"""Between these lies any period at which a model car is controlled or seen."""
BRIDGED_S = 0.25
"""Missing poses are interpolated across so much at most: a car of 2 Hz at 10 m/s^2 strays 2 mm from a cubic."""
REACH = 3
"""Rows on either side that predict a row."""
LEAST_JUMP_M, LEAST_JUMP_RAD = 0.02, 0.10
"""A jump is at least this far from where the neighbours put the row: more than any mount shakes between two frames."""
JUMP_SIGMAS = 14.0
STALE_MPS = 0.15
AXIS_RAD = math.radians(30.0)


def check_time_unit(patient: Patient, control_period_s: float) -> None:
    """Stamps in milli-, micro- or nanoseconds: a period that no control loop has."""
    low, high = CONTROL_PERIODS_S
    period = patient.period_s
    if low <= period <= high:
        return
    factors = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
    fitting = {unit: f for unit, f in factors.items() if low <= period * f <= high}
    if not fitting:
        patient.found("wrong_unit", "t", len(patient.times_s), f"reported: rows are {period:.3g} s apart.")
        return
    unit = min(fitting, key=lambda u: abs(math.log(period * fitting[u] / control_period_s)))
    patient.times_s = patient.times_s * fitting[unit]
    patient.touched = True
    patient.cut_at_jumps()
    patient.found(
        "wrong_unit",
        "t",
        len(patient.times_s),
        f"repaired: rows {period:.3g} s apart are no control loop; the stamps are in {unit} and were converted.",
    )


def check_pose_frame(patient: Patient) -> None:
    """Unit, sense and axis of the pose by the course over ground, where the audit is sure of it."""
    values = {"x": patient.states[:, 0], "y": patient.states[:, 1], "yaw": patient.states[:, 2]}
    rows = len(patient.times_s)
    for finding in check_heading(patient.times_s, values, CANONICAL):
        option = finding.option or ""
        if option.startswith("--x-unit"):
            factor = 1e-3 if "mm" in option else 1e-2
            patient.states[:, :2] *= factor
            done = "converted to metres"
        elif option == "--yaw-unit deg":
            patient.states[:, 2] = np.deg2rad(patient.states[:, 2])
            done = "converted to radians"
        elif option == "--yaw-sign -1":
            patient.states[:, 2] *= -1.0
            done = "yaw counted the other way round"
        elif option == "--swap-xy":
            patient.states[:, [0, 1]] = patient.states[:, [1, 0]]
            done = "x and y exchanged"
        elif option.startswith("--yaw-offset") and abs(finding.evidence["offset_rad"]) > AXIS_RAD:
            patient.states[:, 2] += finding.evidence["offset_rad"]
            done = "yaw turned by that angle"
        else:
            continue
        patient.touched = True
        patient.found(finding.id, finding.channel, rows, f"repaired, {done}: {finding.sentence}")


def check_repeats(patient: Patient) -> None:
    """Rows that repeat the pose before to the last digit, and then the pose is somewhere else."""
    pose = patient.states[:, :3]
    same = np.concatenate([[False], (np.diff(pose, axis=0) == 0.0).all(axis=1)])
    same[0] = False
    stale = np.zeros(len(same), dtype=bool)
    for first, last in _runs(same):
        if last >= len(same):
            break
        elapsed = patient.times_s[last] - patient.times_s[first - 1]
        if math.hypot(*(pose[last, :2] - pose[first - 1, :2])) > STALE_MPS * elapsed:
            stale[first:last] = True
    if not stale.any():
        return
    bridged = _bridge(patient, stale, velocities=True)
    share = stale.mean()
    what = "the logger was faster than the cameras, or a frame was lost"
    left = int(stale.sum()) - bridged
    kept = f"; {left} rows in longer runs were cut out" if left else ""
    patient.found(
        "stale_samples",
        "x, y, yaw, vx, vy, yaw_rate" if patient.own_velocities else "x, y, yaw",
        int(stale.sum()),
        f"repaired: {int(stale.sum())} rows ({share:.1%}) repeat the pose before although the car moves ({what}); "
        f"{bridged} of them were interpolated from their neighbours{kept}.",
    )


def check_jumps(patient: Patient) -> None:
    """Single rows, or a few, whose pose is not where their neighbours put it."""
    bad = _off_the_path(patient)
    if not bad.any():
        patient.cut_at_jumps()
        return
    count = int(bad.sum())
    bridged = _bridge(patient, bad, velocities=False)
    patient.cut_at_jumps()
    patient.found(
        "outliers",
        "x, y, yaw",
        count,
        f"repaired: the pose of {count} rows lies far from where the rows about them put the car (another marker, a "
        f"bad frame); {bridged} were interpolated from their neighbours"
        + ("." if bridged == count else f", {count - bridged} were cut out."),
    )


def check_gaps(patient: Patient) -> None:
    """Rows that are missing, by an otherwise even clock; and jumps that are left, where tracking was lost."""
    jumps = patient.cut_at_jumps()
    if jumps:
        patient.touched = True
        patient.found(
            "outliers",
            "x, y, yaw",
            jumps,
            f"repaired: the pose jumps {jumps} times without coming back, tracking was lost; cut there.",
        )
    step = np.diff(patient.times_s)
    period = patient.period_s
    gaps = gap_rows(patient.times_s)
    even = np.mean(np.abs(step - period) < 0.1 * period) > 0.9
    missing = np.where(np.diff(patient.rows) == 1, np.round(step / period) - 1.0, 0.0)  # not what was cut out here
    short = int(missing[missing >= 1].sum()) if even else int(missing[gaps - 1].sum())
    if short < 1:
        return
    if len(gaps):
        patient.touched = True
    patient.found(
        "dropouts",
        "t",
        short,
        f"repaired: {short} rows are missing in {int((missing >= 1).sum()) if even else len(gaps)} places, up to "
        f"{step.max():.2f} s; the recording was cut at the {len(gaps)} gaps of more than three periods.",
    )


def _off_the_path(patient: Patient) -> BoolArray:
    """Rows (N,) that a local cubic through their neighbours misses by far; the worst first, then again."""
    pose = patient.states[:, :3].copy()
    pose[:, 2] = np.unwrap(pose[:, 2])
    rows = len(pose)
    offsets = np.concatenate([np.arange(-REACH, 0), np.arange(1, REACH + 1)]).astype(np.float64)
    weights = np.linalg.pinv(np.vander(offsets, 4, increasing=True))[0]
    reach = offsets.astype(np.int64)
    # Only where the rows about a row are evenly spaced does the rule hold.
    step = np.diff(patient.times_s)
    plain = np.concatenate([[False], np.abs(step - patient.period_s) < 0.5 * patient.period_s])
    whole = np.ones(rows, dtype=bool)
    for k in range(-REACH + 1, REACH + 1):
        whole &= np.roll(plain, -k)
    whole[:REACH] = whole[-REACH:] = False
    inner = np.flatnonzero(whole)
    bad = np.zeros(rows, dtype=bool)
    if len(inner) < 50:
        return bad

    def miss(at: np.ndarray) -> FloatArray:
        return np.asarray(pose[at] - np.einsum("j,nji->ni", weights, pose[at[:, None] + reach]))

    first = miss(inner)
    away = np.stack([np.hypot(first[:, 0], first[:, 1]), np.abs(first[:, 2])])
    usual = np.array([max(spread(first[:, 0]), spread(first[:, 1])), spread(first[:, 2])])
    limit = np.maximum(JUMP_SIGMAS * usual, [LEAST_JUMP_M, LEAST_JUMP_RAD])
    for _ in range(max(rows // 20, 5)):
        ratio = np.max(away / limit[:, None], axis=0)
        worst = int(np.argmax(ratio))
        if ratio[worst] <= 1.0:
            return bad
        row = int(inner[worst])
        bad[row] = True
        good = [k for k in range(row - 2 * REACH, row + 2 * REACH + 1) if 0 <= k < rows and not bad[k]]
        span = np.array(good) - row
        degree = min(3, len(good) - 2)
        design = np.vander(span / REACH, degree + 1, increasing=True)
        pose[row] = np.linalg.lstsq(design, pose[good], rcond=None)[0][0]
        near = np.flatnonzero(np.abs(inner - row) <= REACH)
        again = miss(inner[near])
        away[0, near], away[1, near] = np.hypot(again[:, 0], again[:, 1]), np.abs(again[:, 2])
        away[:, worst] = 0.0
    return np.zeros(rows, dtype=bool)  # every twentieth row: that is how this car is seen, not a fault of rows


def _bridge(patient: Patient, bad: BoolArray, *, velocities: bool) -> int:
    """Interpolate short runs of ``bad`` rows by a cubic through the rows about them, cut out long ones.

    Returns how many rows were interpolated.
    """
    patient.touched = True
    states, t_s = patient.states, patient.times_s
    columns = np.arange(6 if velocities else 3)
    patient.mended = patient.mended | bad
    bridged = 0
    for first, last in _runs(bad):
        good = np.array([k for k in range(first - 4, last + 4) if 0 <= k < len(bad) and not bad[k]], dtype=np.int64)
        before = int((good < first).sum())
        long = last >= len(bad) or first == 0 or t_s[last] - t_s[first - 1] > BRIDGED_S
        if long or min(before, len(good) - before) < 2:
            states[first:last] = np.nan
            continue
        span = t_s[good] - t_s[first]
        scale = max(float(np.abs(span).max()), 1e-9)
        values = states[np.ix_(good, columns)].copy()
        values[:, 2] = np.unwrap(np.arctan2(np.sin(states[good, 2]), np.cos(states[good, 2])))
        design = np.vander(span / scale, 4, increasing=True)
        fitted = np.linalg.lstsq(design, values, rcond=None)[0]
        rows = np.arange(first, last)
        made = np.vander((t_s[rows] - t_s[first]) / scale, 4, increasing=True) @ fitted
        states[np.ix_(rows, columns)] = made
        bridged += last - first
    if np.isnan(states).any():
        patient.keep(np.asarray(np.isfinite(states).all(axis=1)))
    return bridged


def _runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Starts and ends (one past) of the runs of ``mask``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
