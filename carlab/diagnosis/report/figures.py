"""The report's figures, drawn from the figure data of a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from carlab.core.angles import wrap
from carlab.core.quantities import STATE_NAMES, STATE_UNITS, FloatArray
from carlab.diagnosis.findings import Drift, EffectFinding, FigureData, Trace
from carlab.diagnosis.report.numbers import number, percent, unit_text
from carlab.diagnosis.report.sentences import CHANNEL_NAMES
from carlab.diagnosis.report.svg import Chart, bar_rows, padded

MODELS = ("nominal", "refit", "with_effects")
LABELS = {
    "nominal": "nominal (car file as given)",
    "refit": "refit (fitted parameters)",
    "with_effects": "with effects",
    "with_uncatalogued_physics": "with physics outside the catalogue",
    "with_curves": "with measured curves",
    "with_discrepancy": "with a learned discrepancy",
    "black_box": "black box",
    "adapted": "adapted to the drive",
    "constant_velocity": "constant velocity",
    "noise floor": "noise floor",
    "noise_floor": "noise floor",
    "recorded": "recorded",
}
DRIFT_AXES = (
    ("share of the drive force", "1"),
    ("steering trim", "rad"),
    ("share of the grip", "1"),
    ("force", "m/s2"),
)
"""Name and unit of each estimated disturbance."""
RESTART_FALL = 0.3
"""A restart lowers the position error below this share of that of the row before."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A drawing and its caption."""

    svg: Markup
    caption: str


def restarts(recorded: FloatArray, predicted: FloatArray) -> list[int]:
    """Rows (k,) at which a prediction restarts: it jumps back to the recording, or begins after a gap.

    Args:
        recorded: states (T, 6).
        predicted: states (T, 6), NaN without a prediction.
    """
    error = np.linalg.norm(predicted[:, :2] - recorded[:, :2], axis=1)
    whole: NDArray[np.bool_] = np.asarray(np.isfinite(predicted).all(axis=1))
    step = np.linalg.norm(np.diff(predicted[:, :2] - recorded[:, :2], axis=0), axis=1)
    median_step = float(np.nanmedian(step)) if np.isfinite(step).any() else 0.0
    with np.errstate(invalid="ignore"):
        back = (error[1:] < RESTART_FALL * error[:-1]) & (step > 4.0 * median_step)
    return [int(k) for k in np.flatnonzero(whole[1:] & (back | ~whole[:-1])) + 1]


def residual(trace: Trace, which: str) -> FloatArray:
    """Predicted minus recorded states (T + 1, 6), yaw wrapped."""
    error = np.asarray(trace.predicted[which] - trace.recorded, dtype=np.float64)
    error[:, 2] = np.asarray(wrap(error[:, 2]))
    return error


def without_effects(figure_data: FigureData) -> FigureData:
    """Remove the curves of the simulator with effects, for a verdict without effects."""
    traces = tuple(
        replace(t, predicted={m: rows for m, rows in t.predicted.items() if m != "with_effects"})
        for t in figure_data.traces
    )
    scores_by_step = tuple(step for step in figure_data.scores_by_step if not step[0].startswith("+ "))
    regimes = {name: (x, a, np.full_like(a, np.nan)) for name, (x, a, _) in figure_data.regimes.items()}
    return replace(figure_data, traces=traces, scores_by_step=scores_by_step, regimes=regimes, correlation={})


def worst_stretch(traces: Sequence[Trace]) -> tuple[Trace, tuple[float, float]] | None:
    """The marked stretch with the largest position error of the refit (or the first available model), and its trace."""
    best: tuple[float, Trace, tuple[float, float]] | None = None
    for trace in traces:
        which = next((m for m in ("refit", "nominal", "with_effects") if m in trace.predicted), None)
        if which is None:
            continue
        far = np.linalg.norm(residual(trace, which)[:, :2], axis=1)
        for start, end in trace.marked:
            inside = far[_rows(trace, (start, end))]
            inside = inside[np.isfinite(inside)]
            if len(inside) and (best is None or inside.max() > best[0]):
                best = (float(inside.max()), trace, (start, end))
    return None if best is None else best[1:]


def _rows(trace: Trace, stretch: tuple[float, float]) -> NDArray[np.intp]:
    inside = (trace.times_s >= stretch[0] - 1e-9) & (trace.times_s < stretch[1] - 1e-9)
    return np.flatnonzero(inside)


def overlay(trace: Trace, stretch: tuple[float, float], effects: Sequence[EffectFinding]) -> list[Figure]:
    """Plan view and velocities in one stretch: the recording and each prediction from the same initial state."""
    rows = _rows(trace, stretch)
    seen = trace.recorded[rows]
    models = [m for m in MODELS if m in trace.predicted]
    places = np.vstack([seen[:, :2], *(trace.predicted[m][rows][:, :2] for m in models)])
    names = "recorded " + ", ".join(LABELS[m] for m in models)
    plan = Chart(
        f"Plan view: {names}",
        padded(places[:, 0], 0.08),
        padded(places[:, 1], 0.08),
        (420, 300),
        ("x [m]", "y [m]"),
        equal=True,
    )
    for effect in effects:
        if effect.where.place is not None:
            plan.circle(*effect.where.place, "place")
    plan.line(seen[:, 0], seen[:, 1], "recorded")
    for model in models:
        states = trace.predicted[model][rows]
        plan.line(states[:, 0], states[:, 1], model, restarts(seen, states))
        plan.dots(states[-1:, 0], states[-1:, 1], model)
    plan.dots(seen[-1:, 0], seen[-1:, 1], "recorded")
    plan.dots(seen[:1, 0], seen[:1, 1], "recorded hollow")
    made = [Figure(plan.render(), "Plan view. The ring is the common start, the dots are the end points.")]
    for k in (3, 4, 5):
        values = np.concatenate([seen[:, k], *(trace.predicted[m][rows][:, k] for m in models)])
        chart = Chart(
            f"{CHANNEL_NAMES[STATE_NAMES[k]]}: {names}",
            (float(trace.times_s[rows[0]]), float(trace.times_s[rows[-1]]) + 1e-9),
            padded(values, 0.1, 1e-3),
            (420, 300),
            ("time [s]", f"{CHANNEL_NAMES[STATE_NAMES[k]]} [{STATE_UNITS[k]}]"),
        )
        chart.line(trace.times_s[rows], seen[:, k], "recorded")
        for model in models:
            states = trace.predicted[model][rows]
            chart.line(trace.times_s[rows], states[:, k], model, restarts(seen, states))
        made.append(Figure(chart.render(), ""))
    return made


def error_in_time(trace: Trace) -> Figure | None:
    """Position error along a whole recording, with the marked stretches shaded."""
    models = [m for m in ("refit", "with_effects") if m in trace.predicted]
    if not models:
        return None
    far = {m: np.linalg.norm(residual(trace, m)[:, :2], axis=1) for m in models}
    top = padded(np.concatenate(list(far.values())))[1]
    span = (float(trace.times_s[0]), float(trace.times_s[-1]) + 1e-9)
    chart = Chart("Position error in time", span, (0.0, top), (880, 200), ("time [s]", "position error [m]"))
    chart.spans(trace.marked, "marked")
    for model in models:
        # Draw the maximum of each few rows, because thinning would cut the peaks of the saw-tooth.
        every = max(len(trace.times_s) // 500, 1)
        count = len(trace.times_s) // every
        folded = np.where(np.isfinite(far[model]), far[model], -1.0)[: count * every].reshape(count, every).max(axis=1)
        chart.line(trace.times_s[: count * every : every], np.where(folded < 0.0, np.nan, folded), model)
    return Figure(chart.render(), "")


def regime_charts(figure_data: FigureData) -> list[Figure]:
    """Error against each driving condition, for the refit and with effects."""
    made = []
    top = padded([v for _, a, b in figure_data.regimes.values() for v in (*a, *b)])[1] if figure_data.regimes else 1.0
    for name, (centres, before, after) in figure_data.regimes.items():
        label = unit_text(name)
        chart = Chart(
            f"Error against {label}", padded(centres), (0.0, max(top, 1.2)), (300, 220), (label, "error [noise floors]")
        )
        chart.across(1.0, "floor")
        for values, style in ((before, "refit"), (after, "with_effects")):
            chart.line(centres, values, style)
            chart.dots(centres, values, style)
        made.append(Figure(chart.render(), ""))
    return made


def correlation_chart(figure_data: FigureData, effect_id: str) -> Figure | None:
    """Cross-correlation of the refit's residual with the command of the effect, with its 99 % bounds."""
    if effect_id not in figure_data.correlation:
        return None
    lags_s, values, bound = figure_data.correlation[effect_id]
    reach = max(float(np.nanmax(np.abs(values), initial=0.0)), bound) * 1.15 + 1e-9
    chart = Chart(
        "Cross-correlation of the residual with the command",
        padded(lags_s),
        (-reach, reach),
        (420, 230),
        ("lag [s]", "correlation with the residual"),
    )
    chart.band(-bound, bound, "bound")
    chart.across(0.0, "zero")
    chart.stems(lags_s, values, "refit")
    chart.dots(lags_s, values, "refit", 2.4)
    finite = np.where(np.isfinite(values), np.abs(values), 0.0)
    peak = int(np.argmax(finite)) if len(finite) else 0
    beyond = int((finite > bound).sum())
    if beyond:
        caption = (
            f"Correlation of the residual of the refitted simulator with earlier commands. {beyond} of {len(values)} "
            f"lags lie outside the shaded 99 % band of uncorrelated data. The largest correlation is "
            f"{number(float(values[peak]))} at a lag of {number(float(lags_s[peak]))} s."
        )
    else:
        caption = (
            "Correlation of the residual of the refitted simulator with earlier commands. All lags lie inside the "
            "shaded 99 % band of uncorrelated data. The correlation alone does not show the effect."
        )
    return Figure(chart.render(), caption)


def score_chart(figure_data: FigureData) -> Figure | None:
    """Scores of the car file, the refit, each added effect, and the noise floor."""
    if not figure_data.scores_by_step:
        return None
    rows = []
    for label, score in figure_data.scores_by_step:
        added = label.startswith("+ ")
        bar_label = "+ " + label[2:].replace("_", " ") if added else LABELS.get(label, label)
        style = "with_effects" if added else "floor" if "floor" in label else label if label in MODELS else "other"
        rows.append((bar_label, score, number(score), style))
    svg = bar_rows("Error by added effect", rows, reference=1.0, label_px=200, size=(760, 34))
    return Figure(svg, "")


def fingerprint_chart(effect: EffectFinding) -> Markup:
    """Relative increase of each channel's error without the effect."""
    known = effect.evidence.deletion_fingerprint
    ordered = sorted(known.items(), key=lambda item: -item[1] if np.isfinite(item[1]) else 0.0)
    rows = [
        (CHANNEL_NAMES.get(c, c), rise, ("+" if rise > 0 else "") + percent(rise), "with_effects")
        for c, rise in ordered
    ]
    return bar_rows("Increase of each channel's error without the effect", rows, label_px=150, size=(430, 23))


def drift_charts(drift: Drift) -> list[Figure]:
    """Each disturbance over time with its 90 % band; none for a recording without an estimate."""
    return [] if len(drift.t_s) < 2 else [_drift_chart(drift, k) for k in range(len(DRIFT_AXES))]


def _drift_chart(drift: Drift, k: int) -> Figure:
    name, unit = DRIFT_AXES[k]
    mean, spread = drift.mean[:, k], 1.645 * drift.std[:, k]
    label = name if unit == "1" else f"{name} [{unit_text(unit)}]"
    span = padded(np.concatenate([mean - spread, mean + spread, [0.0]]))
    chart = Chart(f"{name} over time", padded(drift.t_s), span, (300, 200), ("time [s]", label))
    chart.across(0.0, "floor")
    chart.line(drift.t_s, mean, "with_effects")
    for sign in (-1.0, 1.0):
        chart.line(drift.t_s, mean + sign * spread, "limit")
    return Figure(chart.render(), "")
