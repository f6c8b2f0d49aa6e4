"""Checks of individual columns of a file: missing values, stamps, repeats, range of commands, further sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from carlab.core.angles import wrap
from carlab.core.quantities import FloatArray
from carlab.recording.audit.report import Finding, Severity
from carlab.recording.column_mapping import (
    COMMAND_CHANNELS,
    MIN_PERIOD_S,
    POSE_CHANNELS,
    UNITS,
    VELOCITY_CHANNELS,
    ColumnMapping,
    ColumnSource,
)
from carlab.recording.faults.pose import frozen_rows, stale_rows
from carlab.recording.faults.robust import LAGS_S, correlation, fit_column
from carlab.recording.faults.stamps import gap_rows
from carlab.recording.pose_velocity import BoolArray, IndexArray

MIN_ROWS = 3
"""Minimum number of rows of a recording."""
MIN_COMPLETE_SHARE = 0.5
"""Rows with pose and command over rows of the rarer one; with less, rows are messages of different topics.
Lost poses leave the command in each row with a pose: the share is 1. Different topics have few equal stamps."""
MAX_NUMBER = 1e12
"""Larger numbers in SI units are markers of missing values or corrupt data."""
MAX_STAMP = 1e20
"""The same for stamps, whose unit may not be declared yet: nanoseconds since 1970 are 1.8e18."""
MIN_PULSE = 500.0
"""Minimum pulse width [us] of a servo: a column of larger commands has pulse widths. The maximum is about 2500."""
MAX_ROWS_OF_A_STEP_BACK = 10
"""Rows that a corrected clock repeats for each step back; with more, the clock starts again: a second drive."""
NUMBERING = "all further checks number the remaining rows"
"""Clause of a sentence about rows that were left out."""
MAX_LOST_SHARE = 0.5
"""Share of the rows above which rows before the newest stamp are not left out: the file is not sorted by time."""
MAX_PERIOD_S = 2.0
"""Longest plausible time between two rows; a longer one has another unit (milliseconds, nanoseconds)."""
MAX_COMMAND = 1.05
"""A calibration overshoots by up to 5 %; a larger command has another unit (degrees, per cent, microseconds)."""


def check_missing(values: Mapping[str, FloatArray], mapping: ColumnMapping) -> tuple[list[Finding], BoolArray]:
    """Find empty, non-finite or too large cells. Returns findings and the mask of complete rows (N,).

    ``values`` are the columns (N,) by channel.
    Commands of the last row are not executed, so they may be missing.
    """
    whole = np.ones(len(values["t"]), dtype=bool)
    findings = []
    for channel, column in values.items():
        is_missing = np.isnan(column)
        is_too_large = np.abs(column) > (MAX_STAMP if channel == "t" else MAX_NUMBER)
        for bad in (is_missing, is_too_large):
            bad[-1] &= channel not in COMMAND_CHANNELS
        whole &= ~(is_missing | is_too_large)
        findings += _cell_findings(channel, column, is_missing, is_too_large, mapping)
    is_empty_column = any(finding.evidence.get("share") == 1.0 for finding in findings)
    if not is_empty_column and _has_different_topics(values):
        findings = [_joined_messages_finding(values)]
    return findings, whole


def _has_different_topics(values: Mapping[str, FloatArray]) -> bool:
    """Whether a pose and a command channel of ``values`` (N,) have their numbers in different rows."""
    present = {channel: ~np.isnan(column) for channel, column in values.items()}
    pairs = [(present[p], present[c]) for p in POSE_CHANNELS for c in COMMAND_CHANNELS if {p, c} <= present.keys()]
    return any(np.sum(pose & sent) < MIN_COMPLETE_SHARE * min(pose.sum(), sent.sum()) for pose, sent in pairs)


def _joined_messages_finding(values: Mapping[str, FloatArray]) -> Finding:
    """The fault of a table whose rows are messages of different topics, as ``values`` (N,) by channel show."""
    whole = np.all(~np.isnan(np.stack(list(values.values()))), axis=0)
    sentence = (
        f"Only {whole.sum()} of {len(whole)} rows have a number in each of {', '.join(values)}: the rows are messages "
        "of different topics; take the newest command before each pose with --missing hold."
    )
    return Finding.at(~whole, "joined_messages", "pose, commands", Severity.ERROR, sentence, option="--missing hold")


def _cell_findings(
    channel: str, column: FloatArray, is_missing: BoolArray, is_too_large: BoolArray, mapping: ColumnMapping
) -> list[Finding]:
    """Findings about missing and too large cells of one column; the masks and the column are (N,)."""
    source = mapping.columns.get(channel)
    name = channel if source is None else source.name
    n_rows, bad = len(column), is_missing | is_too_large
    example = ""
    if is_too_large.any():
        row = int(np.argmax(is_too_large))
        offset_rad = mapping.yaw_offset_rad if channel == "yaw" else 0.0
        source = source or ColumnSource(channel)
        cell = (column[row] - offset_rad) / source.factor(channel) + source.neutral
        example = f"{cell:.4g} in row {row + 1}"
    if bad.all():
        remedy = "remove it from the file" if channel in VELOCITY_CHANNELS else "repair the file"
        what = f"has no plausible number in any row ({example})" if example else "has no number in any row"
        sentence = f"Column '{name}' {what}; {remedy}."
        return [Finding.at(bad, "not_a_number", channel, Severity.ERROR, sentence, {"share": 1.0})]
    severity, treatment, option = (
        (Severity.REPAIRED, f"those rows were left out and the command before each was held; {NUMBERING}", None)
        if mapping.missing == "drop"
        else (Severity.ERROR, "leave those rows out with --missing drop, or repair the file", "--missing drop")
    )
    sentences = {
        f"Column '{name}' has no number in {is_missing.sum()} of {n_rows} rows, the first in row "
        f"{np.argmax(is_missing) + 1}; {treatment}.": is_missing,
        f"Column '{name}' has too large numbers in {is_too_large.sum()} of {n_rows} rows, the first is {example}; "
        f"{treatment}.": is_too_large,
    }
    return [
        Finding.at(rows, "not_a_number", channel, severity, sentence, {"share": float(np.mean(rows))}, option)
        for sentence, rows in sentences.items()
        if rows.any()
    ]


def check_order(t_s: FloatArray, mapping: ColumnMapping) -> tuple[list[Finding], BoolArray]:
    """Find stamps (N,) that repeat or go back. Returns findings and the mask of rows that advance, shape (N,)."""
    advances = t_s > np.maximum.accumulate(np.concatenate([[-np.inf], t_s[:-1]]))
    if advances.all():
        return [], advances
    step = np.diff(t_s)
    repeated, back = int(np.sum(step == 0)), int(np.sum(step < 0))
    k = int(np.flatnonzero(step <= 0)[0])
    lost, rows = int((~advances).sum()), len(t_s)
    if back == 0 and rows - lost < MIN_ROWS:
        sentence = (
            f"Time does not increase: {repeated} of {rows} stamps repeat the one before. Name the column with the "
            "stamps in --mapping, or remove the time column from the file and give the rate of the rows with --rate."
        )
        return [Finding.at(~advances, "stamp_order", "t", Severity.ERROR, sentence)], advances
    severity, treatment, option = (
        (Severity.REPAIRED, f"{lost} of {rows} rows were left out; {NUMBERING}", None)
        if mapping.stamps == "drop"
        else (Severity.ERROR, "leave such rows out with --stamps drop, or sort or cut the file", "--stamps drop")
    )
    if lost > repeated + MAX_ROWS_OF_A_STEP_BACK * back and mapping.stamps != "drop":
        row = int(np.argmin(step)) + 2
        treatment = (
            f"the clock starts again in row {row}, so cut the file in front of it and import both parts (--stamps drop "
            f"would leave out {lost} of {rows} rows)"
        )
        option = None
    elif lost - repeated > MAX_LOST_SHARE * rows and mapping.stamps != "drop":
        treatment = f"sort the rows by time (--stamps drop would leave out {lost} of {rows} rows)"
        option = None
    sentence = (
        f"Time does not increase: {repeated} stamps repeat and {back} go back, first from {t_s[k]:.6g} s in row "
        f"{k + 1} to {t_s[k + 1]:.6g} s in row {k + 2}; {treatment}."
    )
    evidence = {"repeated": repeated, "back": back, "largest_step_back_s": float(-min(step.min(), 0.0))}
    return [Finding.at(~advances, "stamp_order", "t", severity, sentence, evidence, option)], advances


def check_stamps(t_s: FloatArray, mapping: ColumnMapping) -> list[Finding]:
    """Gaps, jitter and a clock that was constructed afterwards. ``t_s`` (N,) increases."""
    unit = _check_time_unit(t_s, mapping)
    if unit is not None and unit.severity is Severity.ERROR:
        return [unit]
    gaps = gap_rows(t_s)
    findings = [] if unit is None else [unit]
    findings += [_gap_finding(t_s, gaps, mapping)] if len(gaps) else []
    return findings + (_check_even_stamps(t_s) or _check_jitter(t_s, gaps, mapping))


def _check_time_unit(t_s: FloatArray, mapping: ColumnMapping) -> Finding | None:
    """Stamps that are too close for a sensor, or too far apart to control a car.

    Too close is an error; too far is one if another unit is plausible and none is declared.
    """
    source = mapping.columns.get("t")
    median_s = float(np.median(np.diff(t_s)))
    if source is not None and median_s < MIN_PERIOD_S:
        sentence = (
            f"Column '{source.name}': rows are {median_s:.4g} s apart, closer than the samples of any sensor; correct "
            "the unit with --t-unit, or convert the column to seconds."
        )
        return Finding("wrong_unit", "t", Severity.ERROR, sentence, evidence={"median_s": median_s})
    if source is None or median_s <= MAX_PERIOD_S:
        return None
    if source.unit is not None:
        sentence = f"Column '{source.name}': rows are {median_s:.4g} s apart in the unit {source.unit}; check the unit."
        return Finding("wrong_unit", "t", Severity.WARNING, sentence, evidence={"median_s": median_s})
    unit = next((u for u, factor in UNITS["t"].items() if median_s * factor <= MAX_PERIOD_S), None)
    if unit is None:
        return None
    sentence = (
        f"Column '{source.name}': rows are {median_s:.4g} s apart; the unit looks like {unit}; say so with --t-unit "
        f"{unit} (or --t-unit s)."
    )
    return Finding(
        "wrong_unit", "t", Severity.ERROR, sentence, evidence={"median_s": median_s}, option=f"--t-unit {unit}"
    )


def _gap_finding(t_s: FloatArray, gaps: IndexArray, mapping: ColumnMapping) -> Finding:
    step = np.diff(t_s)
    median, longest = float(np.median(step)), float(step[gaps - 1].max())
    counted = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
    severity, treatment = {
        "error": (Severity.ERROR, "split the recording there with --gaps split, or import it whole with --gaps keep"),
        "split": (Severity.REPAIRED, "the recording was split there"),
        "keep": (Severity.WARNING, "kept as one episode; the command before each gap is held across it"),
    }[mapping.gaps]
    sentence = (
        f"{counted} in time, the first after row {gaps[0]} ({step[gaps[0] - 1]:.3f} s where rows are {median:.4f} s "
        f"apart), the longest {longest:.3f} s; {treatment}."
    )
    option = "--gaps split" if mapping.gaps == "error" else None
    return Finding.at(gaps, "dropouts", "t", severity, sentence, {"median_s": median, "longest_s": longest}, option)


def _check_even_stamps(t_s: FloatArray) -> list[Finding]:
    """Stamps that all lie within 2 % of a period of a straight line: no computer that drives a car measures those."""
    rows = np.arange(len(t_s))
    slope, start = np.polyfit(rows, t_s, 1)
    deviation = float(np.abs(t_s - start - slope * rows).max())
    if len(t_s) <= 30 or deviation >= 0.02 * float(np.median(np.diff(t_s))):
        return []
    sentence = (
        f"Every stamp lies within {deviation * 1e3:.2g} ms of an even {1 / slope:.5g} Hz: the clock may be nominal "
        "(row number times period) rather than measured."
    )
    evidence = {"rate_hz": float(1 / slope), "largest_deviation_s": deviation}
    return [Finding("nominal_clock", "t", Severity.INFO, sentence, evidence=evidence)]


def _check_jitter(t_s: FloatArray, gaps: IndexArray, mapping: ColumnMapping) -> list[Finding]:
    """Steps of time, other than ``gaps``, that vary by more than 5 % or are off by more than half a period."""
    step = np.diff(t_s)
    median = float(np.median(step))
    low, high = (float(q) for q in np.percentile(step, [1, 99]))
    odd = np.setdiff1d(np.flatnonzero((step < 0.5 * median) | (step > 1.5 * median)) + 1, gaps)
    if high - low <= 0.05 * median and not len(odd):
        return []
    longest = float(np.delete(step, gaps - 1).max())
    sentence = (
        f"Rows are {median * 1e3:.2f} ms apart, 98 % of them between {low * 1e3:.2f} and {high * 1e3:.2f} ms; "
        f"{len(odd)} steps are off by more than half a period (the longest without a gap {longest * 1e3:.1f} ms)."
    )
    if mapping.clock == "column":
        sentence += " The import does not change the stamps."
    evidence = {"median_s": median, "p1_s": low, "p99_s": high, "shortest_s": float(step.min())}
    return [Finding.at(odd, "stamp_jitter", "t", Severity.INFO, sentence, evidence)]


def check_held(t_s: FloatArray, columns: Mapping[str, FloatArray]) -> list[Finding]:
    """Columns (N,) that change only every few rows: a slow source repeated in fast rows. One finding a hold length."""
    held: dict[int, list[str]] = {}
    for name, column in columns.items():
        edges = np.flatnonzero(np.concatenate([[True], np.diff(column) != 0, [True]]))
        lengths = np.diff(edges)
        # A held column repeats for the same number of rows over and over: at least 20 runs, most of one length (give or
        # take the beat between the two rates), hardly any shorter.
        if len(lengths) < 20:
            continue
        mode = int(np.bincount(lengths).argmax())
        tolerance = max(1, round(0.2 * mode))
        is_mode = np.abs(lengths - mode) <= tolerance
        if mode >= 3 and is_mode.mean() > 0.4 and np.mean(lengths < mode - tolerance) < 0.1:
            held.setdefault(mode, []).append(name)
    period = float(np.median(np.diff(t_s)))
    findings = []
    for length, names in sorted(held.items()):
        rate_hz = 1 / (length * period)
        sentence = (
            f"New values come only every {length} rows, {rate_hz:.1f} Hz in rows of {1 / period:.1f} Hz; a change is "
            f"seen up to {length * period:.2f} s late."
        )
        evidence = {"rows": length, "rate_hz": rate_hz}
        findings.append(Finding("held_samples", ", ".join(names), Severity.INFO, sentence, evidence=evidence))
    return findings


def check_stale(t_s: FloatArray, values: Mapping[str, FloatArray]) -> list[Finding]:
    """Rows that repeat the pose before while the car moves; ``values`` has x, y and yaw, each (N,)."""
    stale = stale_rows(t_s, np.column_stack([values[name] for name in POSE_CHANNELS]))
    if not stale.any():
        return []
    severity = Severity.WARNING if stale.mean() > 0.01 else Severity.INFO
    repeats = "1 row repeats" if stale.sum() == 1 else f"{stale.sum()} rows repeat"
    sentence = (
        f"{repeats} the pose of the row before although the car moves (first row "
        f"{np.argmax(stale) + 1}): the logger was faster than the camera system or lost a frame."
    )
    return [Finding.at(stale, "stale_samples", "x, y, yaw", severity, sentence)]


def check_jumps(
    t_s: FloatArray, values: Mapping[str, FloatArray], jumps: IndexArray, mapping: ColumnMapping
) -> list[Finding]:
    """Steps of the pose that no car makes; ``values`` has x, y and yaw (N,), ``jumps`` (J,) is of ``pose_jumps``."""
    if not len(jumps):
        return []
    step = float(np.hypot(np.diff(values["x"]), np.diff(values["y"]))[jumps - 1].max())
    turn = float(np.abs(wrap(np.diff(values["yaw"])))[jumps - 1].max())
    severity, treatment, option = (
        (Severity.REPAIRED, "The recording was split there", None)
        if mapping.gaps == "split"
        else (Severity.FAULT, "Velocities are not estimated across; cut it with --gaps split", "--gaps split")
    )
    times = "once" if len(jumps) == 1 else f"{len(jumps)} times"
    sentence = (
        f"The pose jumps {times} (first at row {jumps[0] + 1}, {t_s[jumps[0]]:.2f} s), by up to {step:.2f} "
        f"m and {turn:.2f} rad between rows: tracking was lost or another body was taken for the car. {treatment}."
    )
    evidence = {"largest_m": step, "largest_rad": turn}
    return [Finding.at(jumps, "outliers", "x, y, yaw", severity, sentence, evidence, option)]


def check_command_range(values: Mapping[str, FloatArray], mapping: ColumnMapping) -> list[Finding]:
    """Commands (N,) beyond [-1, 1], and commands that never change. The last row's command is not executed."""
    findings = []
    for channel in COMMAND_CHANNELS:
        column = values[channel][:-1]
        name = mapping.columns[channel].name
        largest = float(np.abs(column).max())
        beyond = np.abs(column) > 1.0 + 1e-6
        if beyond.any():
            severity = Severity.ERROR if largest > MAX_COMMAND else Severity.WARNING
            full_command = max(largest / abs(mapping.columns[channel].scale), 1.0)  # the option replaces this scale
            if channel == "throttle" and 10.0 * MAX_COMMAND < full_command <= 100.0:
                full_command = 100.0  # per cent
            option: str | None = f"--{channel}-scale {_rounded_down(1.0 / full_command)}"
            remedy = f"say what full command is, for example {option}"
            if float(column.min()) >= MIN_PULSE:
                option = None
                remedy = (
                    "these are pulse widths in microseconds: give the neutral one and the scale, for example "
                    f"--{channel}-neutral 1500 --{channel}-scale 0.002"
                )
            sentence = (
                f"Column '{name}' ({channel}) reaches {largest:.4g} where commands lie in [-1, 1], first in row "
                f"{np.argmax(beyond) + 1}; {remedy}."
            )
            evidence = {"largest": largest}
            findings.append(Finding.at(beyond, "command_range", channel, severity, sentence, evidence, option))
        elif float(np.ptp(column)) < 1e-6:
            sentence = f"Column '{name}' ({channel}) is {column[0]:.3g} throughout: its effect cannot be identified."
            findings.append(Finding("constant_command", channel, Severity.WARNING, sentence, len(column)))
    return findings


def _rounded_down(value: float) -> str:
    """A positive number with three significant digits, not above the value."""
    step = 10.0 ** (math.floor(math.log10(value)) - 2)
    return f"{math.floor(value / step + 1e-9) * step:.3g}"


def check_gate(throttle: FloatArray, gate: FloatArray, name: str) -> list[Finding]:
    """Rows whose throttle (N,) did not reach the motor because the gate column (N,) is not 1."""
    inert = (throttle != 0) & (gate != 1) & np.isfinite(throttle)
    if not inert.any():
        return []
    sentence = (
        f"In {inert.sum()} rows (first row {np.argmax(inert) + 1}) throttle is logged but '{name}' is not 1, so the "
        "car did not get it: 'sent' holds their product, 'requested' the column."
    )
    return [Finding.at(inert, "gated_throttle", "throttle", Severity.REPAIRED, sentence)]


def check_reference(t_s: FloatArray, name: str, column: FloatArray, channel: str, state: FloatArray) -> list[Finding]:
    """Compare a sensor (N,) with the state (N,) it measures again; find where the pose stands still meanwhile."""
    findings = []
    threshold = max(0.25 * float(np.percentile(np.abs(column), 95)), 0.2)
    frozen = frozen_rows(t_s, state, column, threshold)
    if frozen.any():  # tracking was lost, or another body was taken for the car
        first = int(np.argmax(frozen))
        sentence = (
            f"The pose stands still in {frozen.sum()} rows (first row {first + 1}, {t_s[first]:.2f} s) in which "
            f"'{name}' shows motion: the pose is not the car's; leave that part out (--gaps split)."
        )
        evidence = {"seconds": float(frozen.sum() * np.median(np.diff(t_s)))}
        findings.append(
            Finding.at(frozen, "frozen_pose", "x, y, yaw", Severity.FAULT, sentence, evidence, "--gaps split")
        )
    rows = ~frozen & np.isfinite(column) & (np.abs(state) > threshold)
    if rows.sum() < 100:
        return findings
    fit = fit_column(t_s, state, column, rows, lags_s=LAGS_S, time_constants_s=(0.0,))
    agreement = correlation(fit.prediction[rows], column[rows]) * float(np.sign(fit.scale))
    if abs(agreement) > 0.3:
        is_inside = LAGS_S[0] < fit.lag_s < LAGS_S[-1]
        lag = f"{fit.lag_s * 1e3:.0f} ms later" if is_inside else "at a lag that this drive does not show"
        sentence = (
            f"'{name}' is {fit.scale:.2f} times the {channel} of the pose, {lag} (correlation {agreement:.2f}); it is "
            "an extra column and not used for the state."
        )
        evidence = {"scale": fit.scale, "correlation": agreement} | ({"lag_s": fit.lag_s} if is_inside else {})
        findings.append(Finding("reference_column", channel, Severity.INFO, sentence, evidence=evidence))
    return findings
