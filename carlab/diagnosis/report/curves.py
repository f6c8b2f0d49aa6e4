"""Sentences and charts of measured curves, and the sentence of the explainable ceiling."""

from __future__ import annotations

import itertools

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.curves.support import MEASURED_CURVES
from carlab.diagnosis.findings import CurveFinding, Diagnosis, RejectedCurves
from carlab.diagnosis.report.figures import Figure
from carlab.diagnosis.report.numbers import listed, number, percent, unit_text, with_unit
from carlab.diagnosis.report.residual import relevant_residual, remaining_share
from carlab.diagnosis.report.svg import Chart, padded
from carlab.diagnosis.settings import DEFAULT, REPORT
from sim_backends.effects.curves import DriveMap

MAX_PANELS = 9


def curve_sentences(diagnosis: Diagnosis) -> list[str]:
    """Sentences of each measured curve: its largest difference from the car file, its form, readings of the drive.

    Sentences of curves that are not accepted, or not fitted, come last.
    """
    made = []
    for curve in diagnosis.curves:
        made.append(_largest_difference(curve))
        made.append(form_sentence(curve))
        if curve.id == DriveMap.id:
            made += readings_of_drive(curve)
    return [sentence for sentence in (*made, *_trial_sentences(diagnosis)) if sentence]


def _trial_sentences(diagnosis: Diagnosis) -> list[str]:
    """Why measured curves are not accepted, or not fitted; empty without this stage."""
    trial = diagnosis.curve_trial
    if trial is None:
        return []
    if not trial.is_fitted:
        share = percent(DEFAULT.curves.min_unexplained_share)
        return [
            f"Measured curves are not fitted: the model leaves less than {share} of the refit's squared excess over "
            "the noise floor."
        ]
    return [_rejection(each) for each in trial.rejected]


def _rejection(rejected: RejectedCurves) -> str:
    """The curves that were fitted and not accepted, with the test that they did not pass."""
    quantities = listed([MEASURED_CURVES[name].quantity for name in rejected.curves])
    z = rejected.standard_errors
    test = "the loss on left-out blocks by"
    size = f"{number(abs(z))} standard errors"
    if z >= 0.0:
        size += f", less than the required {number(rejected.min_standard_errors)}"
    if len(rejected.curves) == 1:
        verb = "raises" if z < 0.0 else "lowers"
        return f"The measured curve of the {quantities} is fitted but not accepted: it {verb} {test} {size}."
    verb = "raise" if z < 0.0 else "lower"
    return f"The measured curves of the {quantities} are fitted but not accepted: together they {verb} {test} {size}."


def curves_advice(diagnosis: Diagnosis) -> str:
    """Advice to measure curves if a diagnosis without them leaves a relevant residual; else empty.

    Empty too if the user restricted or ended the search: the report then advises a search of the whole catalogue. A
    search that ends at its time limit, as those of real cars often do, gets both.
    """
    if diagnosis.curves or diagnosis.search.effects or diagnosis.search.stopped_by == "user":
        return ""
    if diagnosis.verdict not in ("mismatch", "unexplained") or relevant_residual(diagnosis) is None:
        return ""
    if remaining_share(diagnosis) < DEFAULT.curves.min_unexplained_share:
        return ""
    return (
        "Measured curves of drive force, steering and tyres may explain a part of the rest: add --curves. "
        "--ceiling shows how much of it can be predicted at all."
    )


def ceiling_sentence(diagnosis: Diagnosis) -> str:
    """How much of the excess is explained, can be explained and cannot; empty without networks."""
    ceiling = diagnosis.ceiling
    if ceiling is None:
        has_networks = not {"black_box", "with_discrepancy"}.isdisjoint(diagnosis.held_out)
        return "The refit has no error above the noise floor, so nothing is left to predict." if has_networks else ""
    shares = (
        f"The model explains {percent(ceiling.by_model)} of the refit's squared excess over the noise floor. Networks "
        f"predict another {percent(ceiling.predictable)} from past commands and velocities. Neither predicts the "
        f"other {percent(ceiling.unpredictable)}."
    )
    if ceiling.by_model + ceiling.predictable <= 0.0:
        return shares
    return f"{shares} The model explains {percent(ceiling.explained_of_predictable)} of the predictable part."


def _largest_difference(curve: CurveFinding) -> str:
    """The knot with the most significant difference from the car file."""
    difference = np.abs(curve.measured - curve.car_file) / np.maximum(curve.std, 1e-9)
    difference[~np.isfinite(difference) | (curve.std <= 0.0)] = -1.0
    place = np.unravel_index(int(np.argmax(difference)), difference.shape)
    if difference[place] <= 0.0:
        return ""
    at = " and ".join(
        f"a {axis.name} of {with_unit(axis.knots[k], axis.unit)}" for axis, k in zip(curve.axes, place, strict=True)
    )
    value, own = (with_unit(float(v[place]), curve.unit) for v in (curve.measured, curve.car_file))
    return f"Measured curve: at {at}, the {curve.quantity} is {value}; the car file has {own}."


def form_sentence(curve: CurveFinding) -> str:
    """The named form of a curve with its parameters, or that none fits; empty with too few knots."""
    form = curve.form
    if form is None:
        return ""
    misfit = f"chi² per knot {number(form.chi2_per_knot)} at {form.knots} knots"
    if not form.is_within_band:
        return (
            f"No named form fits the {curve.quantity} within its band. The closest form, {form.name}, differs by "
            f"{with_unit(form.rms_difference, curve.unit)} rms ({misfit}; at most {number(form.max_chi2_per_knot)} "
            "within the band)."
        )
    values = [
        f"{name} {with_unit(e.value, e.unit)} ({number(e.low90)} to {number(e.high90)})"
        for name, e in form.parameters.items()
    ]
    others = f" Also within the band: {listed(form.indistinguishable_from)}." * bool(form.indistinguishable_from)
    text = f"The {curve.quantity} has the form of {form.name}"
    return f"{text}{': ' * bool(values)}{', '.join(values)} ({misfit}).{others}"


def readings_of_drive(curve: CurveFinding) -> list[str]:
    """What a drive map shows: braking with released throttle, speeds that a throttle holds, saturation."""
    throttle, speed = (np.array(axis.knots) for axis in curve.axes)
    found = []
    released = int(np.flatnonzero(throttle == 0.0)[0])
    moving = (speed > 0.0) & np.isfinite(curve.measured[released])
    braking, own = (-a[released, moving] for a in (curve.measured, curve.car_file))
    std = curve.std[released, moving]
    if moving.sum() >= 2 and (braking - own > REPORT.reading_z_min * std)[:2].all():
        found.append(
            f"With the throttle released, the motor brakes with {number(float(braking.min()))} to "
            f"{number(float(braking.max()))} m/s² from {number(float(speed[moving].min()))} to "
            f"{number(float(speed[moving].max()))} m/s (car file: {number(float(own.min()))} to "
            f"{number(float(own.max()))} m/s²)."
        )
    rows = zip(throttle, curve.measured, curve.car_file, strict=True)
    held = [(u, v) for u, row, base in rows if u > 0.0 and (v := _held_speed(speed, row, base))]
    if len(held) >= 2 and all(a[1] < b[1] for a, b in itertools.pairwise(held)):
        pairs = ", ".join(f"{number(v)} m/s at throttle {number(u)}" for u, v in held)
        found.append(f"The motor holds a speed rather than a force: {pairs}.")
    high, full = curve.measured[-2], curve.measured[-1]
    driven = (speed >= 0.0) & np.isfinite(high) & np.isfinite(full)
    growth = (full - high)[driven]
    expected = (curve.car_file[-1] - curve.car_file[-2])[driven]
    if driven.sum() >= 2 and float(np.median(growth)) < REPORT.saturation_share * float(np.median(expected)):
        found.append(f"Above a throttle of {number(float(throttle[-2]))} the drive force hardly grows: it saturates.")
    return found


def _held_speed(speed: FloatArray, measured: FloatArray, car_file: FloatArray) -> float | None:
    """Speed above 0 at which a controller holds the car; None without one between knots with data.

    The acceleration falls through 0 there, several times as steeply as that of the car file: any motor with damping has
    a speed without acceleration.
    """
    for k in range(len(speed) - 1):
        before, after = measured[k], measured[k + 1]
        if speed[k] >= 0.0 and np.isfinite(before) and np.isfinite(after) and before > 0.0 >= after:
            is_steep = before - after > REPORT.holding_slope_ratio * (car_file[k] - car_file[k + 1])
            return float(speed[k] + (speed[k + 1] - speed[k]) * before / (before - after)) if is_steep else None
    return None


def curve_charts(curve: CurveFinding) -> list[Figure]:
    """The measured curve with its 90 % band, and that of the car file; a map has one panel for each first knot."""
    size = (420, 260) if len(curve.axes) == 1 else (300, 220)
    rows = [()] if len(curve.axes) == 1 else [(k,) for k in range(len(curve.axes[0].knots))]
    spread = 1.645 * np.nan_to_num(curve.std)
    span = padded(
        np.concatenate([np.ravel(v) for v in (curve.car_file, curve.measured - spread, curve.measured + spread)])
    )
    return [_chart(curve, row, span, size) for row in rows[:MAX_PANELS] if np.isfinite(curve.measured[row]).sum() >= 2]


def _chart(curve: CurveFinding, row: tuple[int, ...], span: tuple[float, float], size: tuple[int, int]) -> Figure:
    axis = curve.axes[-1]
    x = np.array(axis.knots)
    measured, std, own = (np.asarray(v[row]) for v in (curve.measured, curve.std, curve.car_file))
    label = f"{curve.quantity} [{unit_text(curve.unit)}]" if curve.unit != "1" else curve.quantity
    at = "" if not row else f"{curve.axes[0].name} {number(curve.axes[0].knots[row[0]])}"
    unit = f" [{unit_text(axis.unit)}]" if axis.unit != "1" else ""
    chart = Chart(f"{curve.quantity} {at}", padded(x), span, size, (f"{axis.name}{unit}", at or label))
    chart.line(x, own, "nominal")
    chart.line(x, measured, "with_effects")
    for sign in (-1.645, 1.645):
        chart.line(x, measured + sign * std, "limit")
    chart.dots(x, measured, "with_effects")
    without = [x[k] for k in range(len(x)) if not np.isfinite(measured[k])]
    half = 0.5 * np.min(np.diff(x))
    chart.spans([(v - half, v + half) for v in without], "bound")
    return Figure(chart.render(), "")
