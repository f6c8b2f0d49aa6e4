"""Measured quantities as data: estimates with intervals, and measured curves with their named forms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from carlab.core.quantities import FloatArray


@dataclass(frozen=True, slots=True)
class Estimate:
    """A fitted number with its standard deviation and 90 % interval, in ``unit``.

    ``at_limit``: whether the fit ended at a bound of the number. Its interval is then too narrow, and another effect or
    parameter may be the cause.
    """

    value: float
    std: float
    low90: float
    high90: float
    unit: str
    at_limit: bool = False


@dataclass(frozen=True, slots=True)
class RejectedCurves:
    """Measured curves that were fitted and not accepted.

    Attributes:
        curves: ids of the curves that were tested together.
        standard_errors: fall of the loss on left-out blocks with them, in standard errors.
        min_standard_errors: fall that is required, in standard errors.
    """

    curves: tuple[str, ...]
    standard_errors: float
    min_standard_errors: float


@dataclass(frozen=True, slots=True)
class CurveTrial:
    """What the fit of measured curves did in addition to the accepted curves.

    Attributes:
        is_fitted: false if the model leaves too small a share of the excess for curves.
        rejected: curves that were fitted and not accepted.
    """

    is_fitted: bool
    rejected: tuple[RejectedCurves, ...] = ()


@dataclass(frozen=True, slots=True)
class CurveAxis:
    """An input of a measured curve with its knots in ``unit``."""

    name: str
    unit: str
    knots: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class FormFinding:
    """The named form of a measured curve, or the closest form if none lies within the band of the curve.

    Attributes:
        id: id of the form.
        name: a noun phrase.
        is_within_band: whether the form lies within the band; otherwise the curve has no name.
        parameters: by name, with 90 % intervals; without a meaning if the form is not within the band.
        chi2_per_knot: squared difference over the variance, mean over knots.
        max_chi2_per_knot: its limit for a form within the band.
        rms_difference: root mean square difference at the knots, in the unit of the curve.
        knots: number of compared knots.
        indistinguishable_from: names of other forms within the band that are not worse.
    """

    id: str
    name: str
    is_within_band: bool
    parameters: Mapping[str, Estimate]
    chi2_per_knot: float
    max_chi2_per_knot: float
    rms_difference: float
    knots: int
    indistinguishable_from: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class CurveFinding:
    """A measured curve and that of the car file, at the knots of its axes.

    All arrays are (A,) for one axis with A knots, and (A, B) for two axes with A and B knots.

    Attributes:
        id: id of the curve.
        quantity: what the curve gives, in ``unit``.
        unit: its unit.
        axes: inputs.
        car_file: the curve of the car file, in ``unit``.
        measured: the curve of the recordings, in ``unit``; NaN at knots without data.
        std: its standard deviations, in ``unit``; NaN at knots without data.
        support_s: driving time near each knot [s].
        form: its named form; None with too few knots.
    """

    id: str
    quantity: str
    unit: str
    axes: tuple[CurveAxis, ...]
    car_file: FloatArray
    measured: FloatArray
    std: FloatArray
    support_s: FloatArray
    form: FormFinding | None = None
