"""Checks that need no model of the car: missing values, stamps, repeated rows, jumps of the pose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.recording.audit.report import Finding, Severity, first_rows
from carlab.recording.csv.mapping import COMMAND_CHANNELS, POSE_CHANNELS, ColumnMapping
from carlab.recording.pose_velocity import BoolArray, IndexArray

LARGEST = 1e12
"""Beyond this in SI units, a number is a marker or damage, and its square overflows soon."""
GAP_PERIODS = 3.0
GAP_S = 0.1
"""A gap is longer than three median periods and than 0.1 s: in that time a car at its limit (10 m/s^2) moves 5 cm away
from any interpolation, and a held command is older than the delay of a typical car."""


def check_missing(values: Mapping[str, FloatArray], mapping: ColumnMapping) -> tuple[list[Finding], BoolArray]:
    """Find cells that are empty, not finite or absurdly large. Returns findings and the mask of whole rows, shape (N,).

    Commands of the last row are never executed, so they may be missing.
    """
    rows = len(values["t"])
    whole = np.ones(rows, dtype=bool)
    findings = []
    for channel, column in values.items():
        bad = ~np.isfinite(column) | (np.abs(column) > LARGEST)
        if channel in COMMAND_CHANNELS and bad[-1]:
            bad[-1] = False
        if not bad.any():
            continue
        whole &= ~bad
        at = np.flatnonzero(bad)
        name = mapping.columns[channel].name if channel in mapping.columns else channel
        dropped = mapping.missing == "drop"
        what = f"Column '{name}' has no number in {len(at)} of {rows} rows, the first in row {at[0] + 1}"
        findings.append(
            Finding(
                "not_a_number",
                channel,
                Severity.REPAIRED if dropped else Severity.ERROR,
                f"{what}; those rows were left out and the command before each was held."
                if dropped
                else f"{what}; leave those rows out with --missing drop, or repair the file.",
                len(at),
                first_rows(at),
                {"share": float(np.mean(bad))},
                None if dropped else "--missing drop",
            )
        )
    return findings, whole


def check_order(t_s: FloatArray, mapping: ColumnMapping) -> tuple[list[Finding], BoolArray]:
    """Find stamps that repeat or go back. Returns findings and the mask of rows that advance, shape (N,)."""
    advances = t_s > np.maximum.accumulate(np.concatenate([[-np.inf], t_s[:-1]]))
    bad = np.flatnonzero(~advances)
    if not len(bad):
        return [], advances
    step = np.diff(t_s)
    repeated, back = int(np.sum(step == 0)), int(np.sum(step < 0))
    k = int(np.flatnonzero(step <= 0)[0])
    dropped = mapping.stamps == "drop"
    what = (
        f"Time does not increase: {repeated} stamps repeat and {back} go back, first from {t_s[k]:.6g} s in row "
        f"{k + 1} "
        f"to {t_s[k + 1]:.6g} s in row {k + 2}"
    )
    finding = Finding(
        "stamp_order",
        "t",
        Severity.REPAIRED if dropped else Severity.ERROR,
        f"{what}; {len(bad)} rows were left out."
        if dropped
        else f"{what}; leave such rows out with --stamps drop, or sort or cut the file.",
        len(bad),
        first_rows(bad),
        {"repeated": repeated, "back": back, "largest_step_back_s": float(-min(step.min(), 0.0))},
        None if dropped else "--stamps drop",
    )
    return [finding], advances


def gap_rows(t_s: FloatArray) -> IndexArray:
    """Indices k, shape (G,), where there is a gap between rows k - 1 and k."""
    step = np.diff(t_s)
    return np.flatnonzero(step > max(GAP_PERIODS * float(np.median(step)), GAP_S)) + 1


def check_stamps(t_s: FloatArray, mapping: ColumnMapping) -> list[Finding]:
    """Gaps, jitter and a clock that was constructed afterwards. ``t_s`` (N,) increases."""
    gaps = gap_rows(t_s)
    findings = [_gap_finding(t_s, gaps, mapping)] if len(gaps) else []
    return findings + (_check_nominal_clock(t_s) or _check_jitter(t_s, gaps))


def _gap_finding(t_s: FloatArray, gaps: IndexArray, mapping: ColumnMapping) -> Finding:
    step = np.diff(t_s)
    median, longest = float(np.median(step)), float(step[gaps - 1].max())
    severity, treatment = {
        "error": (Severity.ERROR, "split the recording there with --gaps split, or import it whole with --gaps keep"),
        "split": (Severity.REPAIRED, "the recording was split there"),
        "keep": (Severity.WARNING, "kept as one episode; the command before each gap is held across it"),
    }[mapping.gaps]
    return Finding(
        "dropouts",
        "t",
        severity,
        f"{len(gaps)} gaps in time, the first after row {gaps[0]} ({step[gaps[0] - 1]:.3f} s where rows are "
        f"{median:.4f} s apart), the longest {longest:.3f} s; {treatment}.",
        len(gaps),
        first_rows(gaps),
        {"median_s": median, "longest_s": longest},
        "--gaps split" if mapping.gaps == "error" else None,
    )


def _check_nominal_clock(t_s: FloatArray) -> list[Finding]:
    """Stamps that all lie within 2 % of a period of a straight line: no computer that drives a car measures those."""
    rows = np.arange(len(t_s))
    slope, start = np.polyfit(rows, t_s, 1)
    line = start + slope * rows
    deviation = float(np.abs(t_s - line).max())
    if len(t_s) <= 30 or deviation >= 0.02 * float(np.median(np.diff(t_s))):
        return []
    return [
        Finding(
            "nominal_clock",
            "t",
            Severity.INFO,
            f"Every stamp lies within {deviation * 1e3:.2g} ms of an even {1 / slope:.5g} Hz: the clock may be nominal "
            "(row number times period) rather than measured.",
            evidence={"rate_hz": float(1 / slope), "largest_deviation_s": deviation},
        )
    ]


def _check_jitter(t_s: FloatArray, gaps: IndexArray) -> list[Finding]:
    """Steps of time, other than ``gaps``, that vary by more than 5 % or are off by more than half a period."""
    step = np.diff(t_s)
    median = float(np.median(step))
    low, high = (float(q) for q in np.percentile(step, [1, 99]))
    odd = np.flatnonzero((step < 0.5 * median) | (step > 1.5 * median)) + 1
    odd = odd[~np.isin(odd, gaps)]
    if high - low <= 0.05 * median and not len(odd):
        return []
    return [
        Finding(
            "stamp_jitter",
            "t",
            Severity.INFO,
            f"Rows are {median * 1e3:.2f} ms apart, 98 % of them between {low * 1e3:.2f} and {high * 1e3:.2f} ms; "
            f"{len(odd)} steps are off by more than half a period (the longest without a gap "
            f"{float(np.delete(step, gaps - 1).max()) * 1e3:.1f} ms). Stamps are kept as they are.",
            len(odd),
            first_rows(odd),
            {"median_s": median, "p1_s": low, "p99_s": high, "shortest_s": float(step.min())},
        )
    ]


def check_held(t_s: FloatArray, columns: Mapping[str, FloatArray]) -> list[Finding]:
    """Columns that change only every few rows: a slow source repeated in fast rows. One finding a hold length."""
    held: dict[int, list[str]] = {}
    for name, column in columns.items():
        edges = np.flatnonzero(np.concatenate([[True], np.diff(column) != 0, [True]]))
        runs = np.diff(edges)
        # A held column repeats for the same number of rows over and over: at least 20 runs, most of one length (give or
        # take the beat between the two rates), hardly any shorter.
        if len(runs) < 20:
            continue
        usual = int(np.bincount(runs).argmax())
        near = np.abs(runs - usual) <= max(1, round(0.2 * usual))
        if usual >= 3 and near.mean() > 0.4 and np.mean(runs < usual - max(1, round(0.2 * usual))) < 0.1:
            held.setdefault(usual, []).append(name)
    period = float(np.median(np.diff(t_s)))
    return [
        Finding(
            "held_samples",
            ", ".join(names),
            Severity.INFO,
            f"{', '.join(names)}: new values only every {length} rows, {1 / (length * period):.1f} Hz in rows of "
            f"{1 / period:.1f} Hz; a change is seen up to {length * period:.2f} s late.",
            evidence={"rows": length, "rate_hz": 1 / (length * period)},
        )
        for length, names in sorted(held.items())
    ]


def check_stale(values: Mapping[str, FloatArray], speed_mps: FloatArray) -> list[Finding]:
    """Rows that repeat the pose before while the car moves (``speed_mps`` (N,), smoothed)."""
    same = np.ones(len(speed_mps) - 1, dtype=bool)
    for name in POSE_CHANNELS:
        same &= np.diff(values[name]) == 0
    # 0.2 m/s: at 100 Hz that is 2 mm a row, several times the noise and the printed digits of any motion capture.
    stale = np.flatnonzero(same & (speed_mps[1:] > 0.2)) + 1
    if not len(stale):
        return []
    return [
        Finding(
            "stale_samples",
            "x, y, yaw",
            Severity.WARNING if len(stale) > 0.01 * len(speed_mps) else Severity.INFO,
            f"{len(stale)} rows repeat the pose of the row before although the car moves (first row {stale[0] + 1}): "
            "the logger was faster than the camera system or lost a frame.",
            len(stale),
            first_rows(stale),
        )
    ]


def check_jumps(
    t_s: FloatArray, values: Mapping[str, FloatArray], jumps: IndexArray, mapping: ColumnMapping
) -> list[Finding]:
    """Steps of the pose that no car makes. ``jumps`` (J,) as ``pose_jumps`` returns them."""
    if not len(jumps):
        return []
    step = np.hypot(np.diff(values["x"]), np.diff(values["y"]))[jumps - 1]
    turn = np.abs((np.diff(values["yaw"]) + np.pi) % (2 * np.pi) - np.pi)[jumps - 1]
    split = mapping.gaps == "split"
    return [
        Finding(
            "outliers",
            "x, y, yaw",
            Severity.REPAIRED if split else Severity.FAULT,
            f"The pose jumps {len(jumps)} times (first at row {jumps[0] + 1}, {t_s[jumps[0]]:.2f} s), by up to "
            f"{step.max():.2f} m "
            f"and {turn.max():.2f} rad between rows: tracking was lost or another body was taken for the car. "
            + (
                "The recording was split there."
                if split
                else "Velocities are not estimated across; cut it with --gaps split."
            ),
            len(jumps),
            first_rows(jumps),
            {"largest_m": float(step.max()), "largest_rad": float(turn.max())},
            None if split else "--gaps split",
        )
    ]


def segments(rows: int, breaks: IndexArray) -> FloatArray:
    """Number of the unbroken stretch that each row belongs to, shape (rows,)."""
    starts = np.zeros(rows)
    starts[breaks] = 1
    return np.cumsum(starts)
