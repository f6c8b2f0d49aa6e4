"""Identify the named form of a measured curve: fit forms to its knots; a form within the band gives the name.

A measured curve is linear between knots, a form is not. So a form is compared by its least-squares approximation that
is linear between the same knots. The misfit is the sum of squared differences over the variances of the knots. Its
distribution for the true form follows from the covariance of the knots (Satterthwaite 1946).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_distribution

from carlab.core.quantities import FloatArray
from carlab.diagnosis.curves.named_forms import FORMS, Form
from carlab.diagnosis.findings import CurveFinding, Estimate, FormFinding
from carlab.diagnosis.settings import CurveSettings
from sim_backends.array_ops import ARRAYS
from sim_backends.effects.curves import weights

Z90 = 1.645
"""Quantile of the normal distribution for a 90 % interval."""

DIFFERENCE_SHARE = 0.02
"""Step of a parameter for the derivative of a form, over its value."""

FIT_DIFFERENCE_SHARE = 1.5e-8
"""The same for the derivatives that the fit uses: about the square root of the rounding error."""

FIT_TOLERANCE = 1e-6
"""Relative change of the misfit at which a fit ends."""


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A fitted form: parameters (n,), their covariance, misfit and its limit, and rms difference in the unit."""

    form: Form
    values: FloatArray
    covariance: FloatArray
    chi2: float
    limit: float
    rms: float

    @property
    def fits(self) -> bool:
        return self.chi2 <= self.limit

    def cost(self, settings: CurveSettings) -> float:
        return self.chi2 + settings.form_chi2_per_parameter * len(self.values)


class _Knots:
    """Knots of a curve with data and a band; an anchored knot has no band and is not compared."""

    def __init__(self, curve: CurveFinding, covariance: FloatArray | None, settings: CurveSettings) -> None:
        used = (np.isfinite(curve.measured) & (np.nan_to_num(curve.std) > 0.0)).ravel()
        self.used = np.flatnonzero(used)
        self.measured = curve.measured.ravel()[self.used]
        self.std = curve.std.ravel()[self.used]
        correlation = np.eye(len(self.used))
        if covariance is not None:
            correlation = covariance[np.ix_(self.used, self.used)] / np.outer(self.std, self.std)
        self.correlation = correlation
        axes = [axis.knots for axis in curve.axes]
        fine = [_subdivided(knots, settings.form_points_per_interval) for knots in axes]
        self.inputs = tuple(np.meshgrid(*fine, indexing="ij"))
        self.projections = [_projection(x, knots) for x, knots in zip(fine, axes, strict=True)]

    def __len__(self) -> int:
        return len(self.used)

    def difference(self, form: Form, values: FloatArray) -> FloatArray:
        """Piecewise linear approximation of a form minus the curve, over the band, at the knots.

        Args:
            form: with p parameters.
            values: of the parameters (p,), or several sets of them (m, p).

        Returns:
            Differences (n,), or (m, n).
        """
        axes = len(self.projections)  # curves have one or two
        columns = np.moveaxis(values, -1, 0)
        sets = columns.shape[1:]
        on_grid = form.value(columns.reshape(*columns.shape, *[1] * axes), self.inputs)
        if axes == 2:
            grid = self.projections[0] @ on_grid @ self.projections[1].T
        else:
            grid = on_grid @ self.projections[0].T
        return np.asarray((grid.reshape(*sets, -1)[..., self.used] - self.measured) / self.std)


def identify_form(curve: CurveFinding, covariance: FloatArray | None, settings: CurveSettings) -> FormFinding | None:
    """The named form of a measured curve, or the closest one if none lies within the band.

    Args:
        curve: the curve; only knots with data and a band count.
        covariance: (k, k) of all knots in row-major order; None for independent errors.
        settings: level of the test, and penalty of parameters.

    Returns:
        Among the forms within the band, that with the smallest misfit plus a penalty of its parameters; otherwise the
        form with the smallest such sum, marked as not within the band. None with too few knots for any form.
    """
    knots = _Knots(curve, covariance, settings)
    spare = len(knots) - settings.form_min_spare_knots
    found = [_fitted(form, knots, settings) for form in FORMS.get(curve.id, ()) if len(form.parameters) <= spare]
    if not found:
        return None
    found.sort(key=lambda c: (not c.fits, c.cost(settings)))
    best = found[0]
    others = [c.form for c in found[1:] if c.fits and c.cost(settings) - best.cost(settings) < settings.form_tie_chi2]
    return FormFinding(
        id=best.form.id,
        name=best.form.name,
        is_within_band=best.fits,
        parameters=_estimates(best),
        chi2_per_knot=best.chi2 / len(knots),
        max_chi2_per_knot=best.limit / len(knots),
        rms_difference=best.rms,
        knots=len(knots),
        indistinguishable_from=tuple(form.name for form in others) if best.fits else (),
    )


def _fitted(form: Form, knots: _Knots, settings: CurveSettings) -> _Candidate:
    """The best fit of a form from all its starts."""
    low = np.array([p.low for p in form.parameters])
    high = np.array([p.high for p in form.parameters])
    best, values = knots.difference(form, np.zeros(0)) if not form.parameters else None, np.zeros(0)
    for start in itertools.product(*(p.starts for p in form.parameters)) if form.parameters else ():
        result = least_squares(
            lambda z: knots.difference(form, z), start, jac=lambda z: _fit_jacobian(form, knots, z, high),
            bounds=(low, high), x_scale=np.abs(start) + 1e-3, ftol=FIT_TOLERANCE,
        )  # fmt: skip
        if best is None or result.cost < 0.5 * float(best @ best):
            best, values = result.fun, result.x
    assert best is not None
    jacobian = _jacobian(form, knots, values)
    gain = np.linalg.pinv(jacobian)
    # Residuals of the true form are (1 - J J+) times the errors of the knots.
    annihilator = np.eye(len(knots)) - jacobian @ gain
    errors = annihilator @ knots.correlation @ annihilator.T
    mean, variance = float(np.trace(errors)), 2.0 * float(np.sum(errors**2))
    freedom = 2.0 * mean**2 / max(variance, 1e-12)
    limit = mean / freedom * float(chi2_distribution.ppf(1.0 - settings.form_level, freedom))
    rms = float(np.sqrt(np.mean((best * knots.std) ** 2)))
    return _Candidate(form, values, gain @ knots.correlation @ gain.T, float(best @ best), limit, rms)


def _fit_jacobian(form: Form, knots: _Knots, values: FloatArray, high: FloatArray) -> FloatArray:
    """Derivative (k, p) by differences over small steps, which end within the bounds."""
    steps = FIT_DIFFERENCE_SHARE * np.maximum(np.abs(values), 1.0)
    steps = np.where(values + steps > high, -steps, steps)
    moved = knots.difference(form, np.concatenate([values[None], values + np.diag(steps)]))
    return np.asarray((moved[1:] - moved[0]).T / steps)


def _jacobian(form: Form, knots: _Knots, values: FloatArray) -> FloatArray:
    """Differences (k, p) over steps of 2 %, as a form with a bend has no smooth derivative between the fine points."""
    if not len(values):
        return np.zeros((len(knots), 0))
    steps = DIFFERENCE_SHARE * np.maximum(np.abs(values), 1e-2)
    ahead, behind = (knots.difference(form, values + sign * np.diag(steps)) for sign in (1.0, -1.0))
    return np.asarray((ahead - behind).T / (2.0 * steps))


def _estimates(candidate: _Candidate) -> dict[str, Estimate]:
    std = np.sqrt(np.maximum(np.diag(candidate.covariance), 0.0))
    return {
        p.name: Estimate(float(v), float(s), float(v - Z90 * s), float(v + Z90 * s), p.unit)
        for p, v, s in zip(candidate.form.parameters, candidate.values, std, strict=True)
    }


def _subdivided(knots: Sequence[float], points: int) -> FloatArray:
    """Midpoints of ``points`` equal parts of each interval between knots."""
    shares = (np.arange(points) + 0.5) / points
    return np.concatenate([low + (high - low) * shares for low, high in itertools.pairwise(knots)])


def _projection(x: FloatArray, knots: Sequence[float]) -> FloatArray:
    """Matrix (k, n) from values at x (n,) to the knots (k,) of the least-squares piecewise linear approximation."""
    hats = np.stack([np.broadcast_to(w, x.shape) for w in weights(ARRAYS, x, knots)], axis=1)
    spacing = np.gradient(x)
    return np.asarray(np.linalg.solve(hats.T * spacing @ hats, hats.T * spacing))
