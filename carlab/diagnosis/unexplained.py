"""What is left when no effect of the catalogue fits: its channel, its regime, its class, and a formula.

Terms of a library with physical meaning are added one by one to the acceleration of a channel, each by what it would do
to whole shots with the free parameters following (forward selection, as in discrepancy modelling with sparse
regression; Brunton et al. 2016, Kaheman et al. 2019). What the chosen terms depend on makes the class statement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.diagnosis.findings import Unexplained
from carlab.diagnosis.fit import Fit, Fitter, Scale
from carlab.diagnosis.residual_terms import TERMS, Term, responses
from carlab.diagnosis.screen import Screen
from carlab.diagnosis.shots import Shots
from sim_backends.car_parameters import SimulatorConfig

MOST_TERMS = 3
TERM_CHI2 = 28.0
"""Twice a term's gain over the inflation by dependent errors; some 400 terms are tried."""
NEXT_SHARE = 0.12
"""A further term must gain this share of the first."""
ALIKE = 0.97
"""Among terms that gain this share of the best, the simplest is taken."""
_ACTS_ON = (
    ("vx", "dvx/dt"),
    ("vy", "dvy/dt"),
    ("yaw_rate", "dr/dt"),
    ("vy and yaw_rate, like a side force of the front axle", "F_front/m"),
    ("vy and yaw_rate, like a side force of the rear axle", "F_rear/m"),
)
"""What a term may act on, in words and symbols; forces are in m/s2 of the whole car's mass."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """One term with what it acts on (its number in ``_ACTS_ON``), its coefficient and its gain in likelihood."""

    term: Term
    channel: int
    coefficient: float
    gain: float


@dataclass(frozen=True, slots=True)
class Rest:
    """Unnamed terms that a fit calls for, and the fall of its loss that they promise."""

    chosen: tuple[Chosen, ...]
    fall: FloatArray = field(default_factory=lambda: np.zeros(6))
    """Fall of the mean squared error at the ends of shots, by channel (6,) and in squared units."""

    @property
    def gain(self) -> float:
        """Fall of the loss by all terms."""
        return sum(c.gain for c in self.chosen)

    def words(self) -> str:
        """The class statement."""
        if not self.chosen:
            return "no term of the library explains it: like noise, vibration (oscillating), or a hidden state"
        parts: list[str] = []
        for c in self.chosen:
            text = f"{c.term.words}; acts on {_ACTS_ON[c.channel][0]}"
            if text not in parts:
                parts.append(text)
        return ". ".join(parts)

    def formula(self) -> str:
        """Missing accelerations in SI units; steering d and throttle u in [-1, 1] as they act, r the yaw rate."""
        rows = []
        for channel, (_, symbol) in enumerate(_ACTS_ON):
            own = [c for c in self.chosen if c.channel == channel]
            if own:
                rows.append(f"{symbol} += " + " ".join(f"{c.coefficient:+.3g} {c.term.formula}" for c in own))
        return "; ".join(rows)


def missing_terms(shots: Shots, fit: Fit, scale: Scale, least_chi2: float = TERM_CHI2) -> Rest:
    """Forward selection of unnamed terms beside everything that ``fit`` already has."""
    fitter = Fitter(shots, scale)
    screen = Screen(fitter, fit.config, fit)
    inflation = fitter.with_covariance(fit).inflation
    response = responses(shots, fit.config, scale)
    arms = _arms(fit.config)
    columns, labels = [], []
    for term in TERMS:
        vx, vy, rate = (screen.projected(response.of(term, k)) for k in range(3))
        for channel, column in enumerate((vx, vy, rate, *(vy + arm * rate for arm in arms))):
            size = float(np.linalg.norm(column))
            if size > 1e-6:
                columns.append(column / size)
                labels.append((term, channel, size))
    if not columns:
        return Rest(())
    design = np.stack(columns)
    residual = screen.residual.copy()
    picked: list[int] = []
    gains: list[float] = []
    basis = np.zeros((0, design.shape[1]))
    for _ in range(MOST_TERMS):
        left = design - (design @ basis.T) @ basis
        length = np.linalg.norm(left, axis=1)
        promise = np.where(length > 0.1, 0.5 * (left @ residual / np.maximum(length, 0.1)) ** 2, 0.0)
        best = float(promise.max())
        if 2.0 * best / inflation < least_chi2 or (gains and best < NEXT_SHARE * gains[0]):
            break
        alike = np.flatnonzero(promise > ALIKE * best)
        k = int(min(alike, key=lambda i: (len(labels[i][0].inputs), i)))
        axis = left[k] / length[k]
        basis = np.vstack([basis, axis])
        residual = residual - axis * float(axis @ residual)
        picked.append(k)
        gains.append(float(promise[k]))
    if not picked:
        return Rest(())
    numbers = -np.linalg.lstsq(design[picked].T, screen.residual, rcond=None)[0]
    chosen = tuple(
        Chosen(labels[k][0], labels[k][1], float(n / labels[k][2]), g)
        for k, n, g in zip(picked, numbers, gains, strict=True)
    )
    shape = (len(shots), -1, 6)
    before, change = screen.residual.reshape(shape)[:, -1], (numbers @ design[picked]).reshape(shape)[:, -1]
    return Rest(chosen, np.mean(before**2 - (before + change) ** 2, axis=0) * scale.sigma[-1] ** 2)


def _arms(config: SimulatorConfig) -> tuple[float, float]:
    """Yaw acceleration [rad/s2] by a side force of the front and of the rear axle that gives 1 m/s2."""
    values = config.values()
    per_inertia = values["vehicle.mass"] / values["vehicle.yaw_inertia"]
    return per_inertia * values["vehicle.front_axle"], -per_inertia * values["vehicle.rear_axle"]


def describe(
    share: float, words: str, formula: str, of_channel: FloatArray, size: FloatArray, seen: dict[str, FloatArray]
) -> Unexplained:
    """The report's entry.

    Args:
        share: of the squared excess.
        words: the class statement.
        formula: of the missing accelerations.
        of_channel: how much is missing in each channel (6,), in squared noise floors.
        size: of each held-out shot's error (S,).
        seen: features at the starts of the held-out shots, each (S,).
    """
    order = np.argsort(-of_channel)
    channels = tuple(STATE_NAMES[k] for k in order if of_channel[k] > 0.5 * of_channel[order[0]])
    return Unexplained(share, channels, worst_regime(seen, size), words, formula)


def start_features(shots: Shots) -> dict[str, FloatArray]:
    """Speeds, yaw rate, commands and their rates, place and time at the start of each shot (S,)."""
    past = shots.history[:, -max(round(0.1 / shots.period_s), 2) :]
    span = past.shape[1] * shots.period_s
    return {
        "v": shots.start[:, 3],
        "w": shots.start[:, 4],
        "r": shots.start[:, 5],
        "d": past[:, :, 0].mean(axis=1),
        "u": past[:, :, 1].mean(axis=1),
        "dd": (past[:, -1, 0] - past[:, 0, 0]) / span,
        "du": (past[:, -1, 1] - past[:, 0, 1]) / span,
        "t": shots.t0_s / max(float(shots.t0_s.max()), 1.0),
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


def worst_regime(seen: dict[str, FloatArray], size: FloatArray) -> str:
    """The feature whose upper third has the largest errors, as a rule."""
    best, text = 1.0, "everywhere alike"
    for name, unit, value in REGIMES:
        feature = value(seen)
        limit = float(np.quantile(feature, 2 / 3))
        high, low = size[feature > limit], size[feature <= limit]
        if len(high) < 5 or len(low) < 5:
            continue
        ratio = float(np.sqrt(np.mean(high**2)) / (np.sqrt(np.mean(low**2)) + 1e-9))
        if ratio > max(best, 1.3):
            best, text = ratio, f"{name} > {limit:.2g} {unit}".strip()
    return text


__all__ = ["REGIMES", "Chosen", "Rest", "describe", "missing_terms", "start_features", "worst_regime"]
