"""Residual with all accepted effects: its channels, regime, class, and a formula.

Forward selection adds terms of a library to the acceleration of a channel, by their influence on the errors of whole
windows with the free parameters projected out (discrepancy modelling with sparse regression; Brunton et al. 2016,
Kaheman et al. 2019). The chosen terms give the class statement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fit, Fitter
from carlab.diagnosis.selection.screening import Screen
from carlab.diagnosis.settings import UNEXPLAINED
from carlab.diagnosis.unexplained.residual_terms import TERMS, Term, responses
from carlab.prediction.windows import PredictionWindows
from sim_backends.car_parameters import SimulatorConfig

_ACTS_ON = (
    ("vx", "dvx/dt"),
    ("vy", "dvy/dt"),
    ("yaw_rate", "dr/dt"),
    ("vy and yaw_rate, like a side force of the front axle", "F_front/m"),
    ("vy and yaw_rate, like a side force of the rear axle", "F_rear/m"),
)
"""Channels of a term as text and symbol; forces are divided by the mass of the car [m/s2]."""


@dataclass(frozen=True, slots=True)
class ChosenTerm:
    """A term, its channel (index in ``_ACTS_ON``), coefficient and gain in log-likelihood."""

    term: Term
    channel: int
    coefficient: float
    gain: float


@dataclass(frozen=True, slots=True)
class ResidualModel:
    """Significant unnamed terms.

    fall  (6,)  predicted fall of the mean squared error at the ends of windows, in squared SI units
    """

    chosen: tuple[ChosenTerm, ...]
    fall: FloatArray = field(default_factory=lambda: np.zeros(6))

    @property
    def gain(self) -> float:
        """Fall of the loss with all terms."""
        return sum(c.gain for c in self.chosen)

    def class_statement(self) -> str:
        """Class of the missing physics."""
        if not self.chosen:
            return (
                "no term of the library explains it: like noise, vibration (oscillating), a hidden state or a force of "
                "another form"
            )
        parts: list[str] = []
        for c in self.chosen:
            text = f"{c.term.statement}; acts on {_ACTS_ON[c.channel][0]}"
            if text not in parts:
                parts.append(text)
        return parts[0] if len(parts) == 1 else "; ".join(f"({k}) {text}" for k, text in enumerate(parts, start=1))

    def formula(self) -> str:
        """Missing accelerations in SI units; d is steering and u throttle in [-1, 1] after delays, r yaw rate."""
        rows = []
        for channel, (_, symbol) in enumerate(_ACTS_ON):
            own = [c for c in self.chosen if c.channel == channel]
            if own:
                rows.append(f"{symbol} += " + " ".join(f"{c.coefficient:+.3g} {c.term.formula}" for c in own))
        return "; ".join(rows)


@dataclass(frozen=True, slots=True)
class _Library:
    """Projected unit columns (N, S U 6) of terms on channels, with term, channel and norm of each."""

    columns: FloatArray
    labels: tuple[tuple[Term, int, float], ...]


def fit_residual_terms(fitter: Fitter, fit: Fit, term_chi2_min: float = UNEXPLAINED.term_chi2_min) -> ResidualModel:
    """Forward selection of unnamed terms with at least the chi2 ``term_chi2_min`` in addition to ``fit``."""
    windows, scale = fitter.windows, fitter.scale
    screen = Screen(fitter, fit.config, fit)
    design_effect = fitter.with_covariance(fit).design_effect
    library = _library(windows, fit, scale, screen)
    if library is None:
        return ResidualModel(())
    picked, gains = _select(library, screen.residual, term_chi2_min, design_effect)
    if not picked:
        return ResidualModel(())
    columns, labels = library.columns, library.labels
    numbers = -np.linalg.lstsq(columns[picked].T, screen.residual, rcond=None)[0]
    chosen = tuple(
        ChosenTerm(labels[k][0], labels[k][1], float(n / labels[k][2]), g)
        for k, n, g in zip(picked, numbers, gains, strict=True)
    )
    shape = (len(windows), -1, 6)
    before, change = screen.residual.reshape(shape)[:, -1], (numbers @ columns[picked]).reshape(shape)[:, -1]
    return ResidualModel(chosen, np.mean(before**2 - (before + change) ** 2, axis=0) * scale.sigma[-1] ** 2)


def _library(windows: PredictionWindows, fit: Fit, scale: Scale, screen: Screen) -> _Library | None:
    """Columns of all terms that change the errors, or None."""
    response = responses(windows, fit.config, scale)
    yaw_per_side = _yaw_per_side_acceleration(fit.config)
    columns, labels = [], []
    for term in TERMS:
        vx, vy, rate = (screen.projected(response.of(term, k)) for k in range(3))
        for channel, column in enumerate((vx, vy, rate, *(vy + arm * rate for arm in yaw_per_side))):
            size = float(np.linalg.norm(column))
            if size > 1e-6:
                columns.append(column / size)
                labels.append((term, channel, size))
    return _Library(np.stack(columns), tuple(labels)) if columns else None


def _select(
    library: _Library, residual: FloatArray, chi2_min: float, design_effect: float
) -> tuple[list[int], list[float]]:
    """Indices of the columns chosen by orthogonal matching pursuit, and their gains."""
    design, labels = library.columns, library.labels
    picked: list[int] = []
    gains: list[float] = []
    basis = np.zeros((0, design.shape[1]))
    for _ in range(UNEXPLAINED.max_terms):
        projected = design - (design @ basis.T) @ basis
        length = np.linalg.norm(projected, axis=1)
        score = np.where(length > 0.1, 0.5 * (projected @ residual / np.maximum(length, 0.1)) ** 2, 0.0)
        best = float(score.max())
        if 2.0 * best / design_effect < chi2_min or (gains and best < UNEXPLAINED.next_term_share * gains[0]):
            break
        nearly_best = np.flatnonzero(score > UNEXPLAINED.simplest_gain_share * best)
        k = int(min(nearly_best, key=lambda i: (len(labels[i][0].inputs), i)))
        axis = projected[k] / length[k]
        basis = np.vstack([basis, axis])
        residual = residual - axis * float(axis @ residual)
        picked.append(k)
        gains.append(float(score[k]))
    return picked, gains


def _yaw_per_side_acceleration(config: SimulatorConfig) -> tuple[float, float]:
    """Yaw acceleration [rad/s2] by a side force of the front and of the rear axle that gives 1 m/s2."""
    values = config.values()
    per_inertia = values["vehicle.mass"] / values["vehicle.yaw_inertia"]
    front_m, rear_m = config.axle_distances_m()
    return per_inertia * front_m, -per_inertia * rear_m


def start_features(windows: PredictionWindows) -> dict[str, FloatArray]:
    """Features at the start of each window (S,).

    v, w, r: vx, vy [m/s], yaw rate [rad/s]; d, u: steering, throttle; dd, du: their rates [1/s]; t: time as a share of
    the recording.
    """
    past = windows.past_commands[:, -max(round(0.1 / windows.period_s), 2) :]
    span = past.shape[1] * windows.period_s
    return {
        "v": windows.initial_states[:, 3],
        "w": windows.initial_states[:, 4],
        "r": windows.initial_states[:, 5],
        "d": past[:, :, 0].mean(axis=1),
        "u": past[:, :, 1].mean(axis=1),
        "dd": (past[:, -1, 0] - past[:, 0, 0]) / span,
        "du": (past[:, -1, 1] - past[:, 0, 1]) / span,
        "t": windows.t0_s / max(float(windows.t0_s.max()), 1.0),
    }


REGIMES: tuple[tuple[str, str, Callable[[dict[str, FloatArray]], FloatArray]], ...] = (
    ("speed", "m/s", lambda f: np.abs(f["v"])),
    ("|steering|", "", lambda f: np.abs(f["d"])),
    ("|steering rate|", "/s", lambda f: np.abs(f["dd"])),
    ("|throttle|", "", lambda f: np.abs(f["u"])),
    ("|throttle rate|", "/s", lambda f: np.abs(f["du"])),
    ("lateral acceleration", "m/s2", lambda f: np.abs(f["v"] * f["r"])),
    ("time", "of the recording", lambda f: f["t"]),
)


FEATURE_DIGITS = 3
"""Decimal digits of a feature (SI units); smaller values are noise or rounding, as rates of constant commands."""


def worst_regime(features: dict[str, FloatArray], window_errors: FloatArray) -> str:
    """The feature whose upper third has the largest errors, as a rule such as ``speed > 2 m/s``.

    Args:
        features: from ``start_features``, each (S,).
        window_errors: error of each window (S,).
    """
    best, text = 1.0, "everywhere alike"
    for name, unit, value in REGIMES:
        feature = value(features).round(FEATURE_DIGITS)
        limit = float(np.quantile(feature, UNEXPLAINED.regime_quantile))
        high, low = window_errors[feature > limit], window_errors[feature <= limit]
        if min(len(high), len(low)) < UNEXPLAINED.regime_windows_min:
            continue
        ratio = float(np.sqrt(np.mean(high**2)) / (np.sqrt(np.mean(low**2)) + 1e-9))
        if ratio > max(best, UNEXPLAINED.regime_ratio_min):
            best, text = ratio, f"{name} > {limit:.2g} {unit}".strip()
    return text
