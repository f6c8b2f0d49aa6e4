"""Two regressions of the discrepancy on the library of terms: PySINDy's, and stepwise selection by BIC.

PySINDy (Kaptanoglu et al., 2022, Journal of Open Source Software 7(69), 3994): sequentially thresholded least squares
over columns of unit length, with the threshold that predicts the held-out discrepancy best, or the sparsest within one
standard error. Stepwise: forward selection by the Bayesian information criterion (Schwarz, 1978). Both keep the base
parameters of the refit, so nothing is projected out. They name the effect with the largest share, or "none" if the
held-out score over 1 s falls by less than MIN_SCORE_FALL. This threshold was chosen on the development set; without it
both name an effect in nearly every null case.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from carlab.benchmark.baselines.data import Prepared, Steps, held_out_score
from carlab.benchmark.baselines.terms import AT_END_ONLY, MOCAP_EFFECT_SIZE, Term, effect_of, library
from carlab.benchmark.world.simulation import FloatArray

THRESHOLDS = (0.01, 0.02, 0.04, 0.08, 0.15, 0.3)
MIN_SCORE_FALL = 0.03
MAX_TERMS = 8
# Effects whose parameter may have either sign; other effects need a positive coefficient.
EITHER_SIGN = frozenset({
    "command_delay", "steering_offset", "steering_asymmetry", "throttle_nonlinearity", "throttle_asymmetry",
    "brake_asymmetry", "battery_sag",
    "friction_drift", "torque_steer", "lateral_bias", "road_slope", "marker_offset", "mocap_yaw_misalignment",
})  # fmt: skip


@dataclass(frozen=True)
class System:
    """Weighted, stacked regression: y = X c; the rows are M steps times three channels.

    Attributes:
        terms: the K terms by name.
        fit_x, hold_x: X of both recordings (3 M, K).
        fit_y, hold_y: y of both recordings (3 M,).
    """

    terms: dict[str, Term]
    fit_x: FloatArray
    fit_y: FloatArray
    hold_x: FloatArray
    hold_y: FloatArray

    @classmethod
    def of(cls, data: Prepared) -> System:
        """Evaluate every term on both recordings."""
        terms = library(data)
        parts = []
        for steps, errors in ((data.steps, data.errors), (data.hold_steps, data.hold_errors)):
            columns = [(term(steps) * data.weights).ravel() for term in terms.values()]
            parts += [np.stack(columns, axis=1), (errors * data.weights).ravel()]
        for values in parts:
            np.nan_to_num(values, copy=False, posinf=0.0, neginf=0.0)
        return cls(terms, *parts)

    def squares(self, coefficients: FloatArray) -> FloatArray:
        """Squared errors (3 M,) on the held-out recording for coefficients (K,)."""
        return np.asarray((self.hold_y - self.hold_x @ coefficients) ** 2)

    def dominant(self, coefficients: FloatArray) -> str | None:
        """The effect with the largest contribution by coefficients (K,) among those whose sign is possible."""
        shares: dict[str, float] = {}
        for name, c, column in zip(self.terms, coefficients, self.fit_x.T, strict=True):
            effect = effect_of(name)
            if c > 0.0 or (c < 0.0 and effect in EITHER_SIGN):
                shares[effect] = shares.get(effect, 0.0) + float(c * c * (column @ column))
        return max(shares, key=lambda name: shares[name]) if shares else None


def pysindy_regression(system: System) -> FloatArray:
    """Coefficients (K,) by PySINDy."""
    import pysindy

    lengths = np.maximum(np.linalg.norm(system.fit_x, axis=0), 1e-9)
    unit = max(float(np.linalg.norm(system.fit_y)), 1e-9)
    found = []
    for threshold in THRESHOLDS:
        # y has unit length too, so coefficients and threshold are in the range of correlations.
        solver = pysindy.STLSQ(threshold=threshold, alpha=1e-3, max_iter=50)
        x, y = system.fit_x / lengths, system.fit_y[:, None] / unit
        # Without coefficients above the threshold the package warns and returns an empty model, which is valid here.
        if np.abs(np.linalg.solve(x.T @ x + 1e-3 * np.eye(x.shape[1]), x.T @ y)).max() < threshold:
            break
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "sparsity parameter is too big": the coefficients are then zero
            solver.fit(x, y)
        found.append(np.asarray(solver.coef_, dtype=np.float64).reshape(-1) / lengths * unit)
    found.append(np.zeros(len(lengths)))
    squares = [system.squares(c) for c in found]
    best = min(range(len(found)), key=lambda k: float(squares[k].mean()))
    worse = [s - squares[best] for s in squares]
    near = [k for k, w in enumerate(worse) if w.mean() <= w.std() / np.sqrt(len(w))]
    return np.asarray(found[max(near)])


def stepwise_bic(system: System) -> FloatArray:
    """Coefficients (K,) by forward selection; the steps overlap, so a third of the rows count as independent."""
    x, y = system.fit_x, system.fit_y
    names = list(system.terms)
    gram, moment, total = x.T @ x, x.T @ y, float(y @ y)
    rows = len(y) / 3.0
    chosen: list[int] = []
    best = rows * np.log(total / rows)
    coefficients = np.zeros(len(names))
    while len(chosen) < MAX_TERMS:
        trials = []
        for k in range(len(names)):
            if k in chosen or gram[k, k] < 1e-12:
                continue
            index = [*chosen, k]
            solved = np.linalg.lstsq(gram[np.ix_(index, index)], moment[index], rcond=1e-10)[0]
            if solved[-1] < 0.0 and effect_of(names[k]) not in EITHER_SIGN:
                continue
            left = max(total - float(moment[index] @ solved), 1e-12)
            trials.append((rows * np.log(left / rows) + len(index) * np.log(rows), k, solved))
        if not trials:
            break
        value, k, solved = min(trials, key=lambda trial: trial[0])
        if value >= best:
            break
        best = value
        chosen.append(k)
        coefficients = np.zeros(len(names))
        coefficients[chosen] = solved
    return coefficients


def corrected_score(data: Prepared, system: System, coefficients: FloatArray) -> float:
    """Held-out score with the terms, times coefficients (K,), added to the refitted model."""
    active = [(name, c) for name, c in zip(system.terms, coefficients, strict=True) if c != 0.0]

    def added(steps: Steps, which: list[tuple[str, float]]) -> FloatArray:
        total = np.zeros((len(steps.starts), 3))
        for name, c in which:
            total += c * np.nan_to_num(system.terms[name](steps))
        return total

    inside = [(name, c) for name, c in active if effect_of(name) not in AT_END_ONLY]
    lags = [c for name, c in active if effect_of(name) in AT_END_ONLY]
    return held_out_score(
        data,
        lambda steps: added(steps, inside),
        lambda steps: -MOCAP_EFFECT_SIZE * sum(lags) * steps.rates(at_end=True),
    )
