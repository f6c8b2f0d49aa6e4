"""What recordings say about each knot of a measured curve: driving time near it, value and standard deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt

from carlab.core.quantities import FloatArray
from carlab.diagnosis.curves.curve_fit import CurveFit
from carlab.diagnosis.curves.form_fit import identify_form
from carlab.diagnosis.findings import CurveAxis, CurveFinding
from carlab.diagnosis.identification.fit_parameters import numbers_at
from carlab.diagnosis.settings import CurveSettings
from carlab.prediction.windows import RecordingSegment
from sim_backends.array_ops import ARRAYS, Value
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CURVES, Forces, MeasuredCurve
from sim_backends.effects.curves import weights

MEASURED_CURVES = {curve.id: curve for curve in CURVES}


def curve_findings(
    found: CurveFit, nominal: SimulatorConfig, segments: tuple[RecordingSegment, ...], settings: CurveSettings
) -> tuple[CurveFinding, ...]:
    """Each measured curve and that of the car file; knots without data have no value."""
    made = []
    for curve in (MEASURED_CURVES[name] for name in found.curves):
        support_s = driving_time_s(curve, found.fit.config, segments)
        grid = np.meshgrid(*(np.array(axis.knots) for axis in curve.axes), indexing="ij")
        measured = _curve(found, curve, found.fit.z, grid)
        driven = support_s >= settings.min_support_s
        covariance = _covariance(found, curve, grid)
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0)).reshape(measured.shape)
        finding = CurveFinding(
            id=curve.id,
            quantity=curve.quantity,
            unit=curve.unit,
            axes=tuple(CurveAxis(a.name, a.unit, a.knots) for a in curve.axes),
            car_file=curve.base_curve(nominal.values(), *grid),
            measured=np.where(driven, measured, np.nan),
            std=np.where(driven, std, np.nan),
            support_s=support_s,
        )
        made.append(replace(finding, form=identify_form(finding, covariance, settings)))
    return tuple(made)


def without_extrapolation(found: CurveFit, segments: tuple[RecordingSegment, ...], settings: CurveSettings) -> CurveFit:
    """Give knots without any data the deviation of the nearest knot with data; the penalty alone would extrapolate."""
    changes: dict[str, float] = {}
    for curve in (MEASURED_CURVES[name] for name in found.curves):
        driven = driving_time_s(curve, found.fit.config, segments) >= settings.min_fitted_s
        values = found.fit.config.values()
        table = np.array(curve.table({p.name: values[f"effects.{curve.id}.{p.name}"] for p in curve.parameters}))
        if driven.any():
            nearest = distance_transform_edt(~driven, return_distances=False, return_indices=True)
            own = curve.numbers_of_table(table[tuple(nearest)].tolist()) or {}
            changes |= {f"effects.{curve.id}.{name}": value for name, value in own.items()}
    fit = found.fit
    z = [f.coordinate(changes[f.name]) if f.name in changes else z for f, z in zip(fit.free, fit.z, strict=True)]
    return replace(found, fit=replace(fit, config=fit.config.with_values(changes), z=np.array(z)))


def driving_time_s(curve: MeasuredCurve, config: SimulatorConfig, segments: tuple[RecordingSegment, ...]) -> FloatArray:
    """Driving time [s] near each knot, (A,) or (A, B) for one or two axes with A and B knots.

    Each row of the segments counts with its interpolation weights.
    """
    total = np.zeros([len(axis.knots) for axis in curve.axes])
    for segment in segments:
        coordinates = curve.coordinates(ARRAYS, recorded_forces(segment, config))
        total += segment.period_s * knot_weights(curve, coordinates, len(segment.t_s)).sum(axis=-1)
    return total


def knot_weights(curve: MeasuredCurve, coordinates: Sequence[Value], count: int) -> FloatArray:
    """Interpolation weights (A, n) or (A, B, n) of the knots of one or two axes at ``count`` = n points.

    ``coordinates`` are those of the points on each axis, each (n,) or a number.
    """
    by_axis = [
        np.stack(np.broadcast_arrays(*weights(ARRAYS, np.broadcast_to(np.asarray(x), count), axis.knots)))
        for x, axis in zip(coordinates, curve.axes, strict=True)
    ]
    return by_axis[0] if len(by_axis) == 1 else by_axis[0][:, None] * by_axis[1][None]


def recorded_forces(segment: RecordingSegment, config: SimulatorConfig) -> Forces:
    """State, delayed commands and longitudinal force [N] of the n rows of a recording, as inputs (n,) of curves.

    The first command is held before the recording begins, because earlier commands are unknown.
    """
    parameters = config.parameters
    front_m, rear_m = config.axle_distances_m()
    vx, vy, yaw_rate = segment.smooth[:, 3:].T
    rows = np.arange(len(vx))
    commands = [
        column[np.clip(rows - round(delay_s / segment.period_s), 0, len(rows) - 1)]
        for column, delay_s in zip(segment.commands.T, config.delays_s(), strict=True)
    ]
    angle = parameters.max_angle_rad * commands[0]
    acceleration = np.gradient(vx, segment.period_s) - vy * yaw_rate
    zero = np.zeros_like(vx)
    return Forces(
        t_s=segment.t_s, x=zero, y=zero, yaw=zero, vx=vx, vy=vy, yaw_rate=yaw_rate,
        wheel_angle=angle, wheel_sin=np.sin(angle), wheel_cos=np.cos(angle), throttle=commands[1],
        mass=parameters.mass_kg, front_axle=front_m, rear_axle=rear_m,
        load_front=zero, load_rear=zero, grip_front=zero, grip_rear=zero,
        full_drive=np.full_like(vx, parameters.drive_gain_n), damping=zero, rear_stiffness=zero,
        axle_force=parameters.mass_kg * acceleration,
    )  # fmt: skip


def _curve(found: CurveFit, curve: MeasuredCurve, z: FloatArray, grid: Sequence[FloatArray]) -> FloatArray:
    """The curve at its knots for coordinates z (n,) of the fit: the base model's and the deviation."""
    values = found.fit.config.values() | numbers_at(found.fit.free, z)
    own = {p.name: values[f"effects.{curve.id}.{p.name}"] for p in curve.parameters}
    return np.asarray(curve.base_curve(values, *grid) + np.array(curve.table(own)))


def _covariance(found: CurveFit, curve: MeasuredCurve, grid: Sequence[FloatArray]) -> FloatArray:
    """Covariance (k, k) of the curve at its k knots in row-major order, from base parameters and deviations."""
    assert found.fit.covariance is not None
    z, step = found.fit.z, 0.02
    at_z = _curve(found, curve, z, grid)
    moved = [_curve(found, curve, z + step * unit, grid) for unit in np.eye(len(z))]
    jacobian = np.stack([(m - at_z) / step for m in moved]).reshape(len(z), -1)
    return np.asarray(jacobian.T @ found.fit.covariance @ jacobian)
