"""What is left when no effect of the catalogue fits: its channel, its regime, its class, and a formula.

Terms of a library with physical meaning are added one by one to the acceleration of a channel, each by what it would do
to whole shots with the free parameters following (forward selection, as in discrepancy modelling with sparse
regression; Brunton et al. 2016, Kaheman et al. 2019). What the chosen terms depend on makes the class statement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.diagnosis.findings import Unexplained
from carlab.diagnosis.fit import Fit, Fitter, Scale
from carlab.diagnosis.residual_terms import TERMS, Term, responses
from carlab.diagnosis.screen import Screen
from carlab.diagnosis.shots import Shots

MOST_TERMS = 3
TERM_CHI2 = 28.0
"""Twice a term's gain over the inflation by dependent errors; some 400 terms are tried."""
NEXT_SHARE = 0.12
"""A further term must gain this share of the first."""
ALIKE = 0.97
"""Among terms that gain this share of the best, the simplest is taken."""
_ACTS_ON = (("vx", "dvx/dt", "m/s2"), ("vy", "dvy/dt", "m/s2"), ("yaw_rate", "dr/dt", "rad/s2"))


@dataclass(frozen=True, slots=True)
class Chosen:
    """One term with the channel it acts on (0 vx, 1 vy, 2 yaw rate), its coefficient and its gain in likelihood."""

    term: Term
    channel: int
    coefficient: float
    gain: float


@dataclass(frozen=True, slots=True)
class Rest:
    """Unnamed terms that a fit calls for, and the fall of its loss that they promise."""

    chosen: tuple[Chosen, ...]

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
        for channel, (_, symbol, _) in enumerate(_ACTS_ON):
            own = [c for c in self.chosen if c.channel == channel]
            if own:
                rows.append(f"{symbol} += " + " ".join(f"{c.coefficient:+.3g} {c.term.formula}" for c in own))
        return "; ".join(rows)


def missing_terms(shots: Shots, fit: Fit, scale: Scale) -> Rest:
    """Forward selection of unnamed terms beside everything that ``fit`` already has."""
    fitter = Fitter(shots, scale)
    screen = Screen(fitter, fit.config, fit)
    inflation = fitter.with_covariance(fit).inflation
    response = responses(shots, fit.config, scale)
    columns, labels = [], []
    for channel in range(3):
        for term in TERMS:
            column = screen.projected(response.of(term, channel))
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
        if 2.0 * best / inflation < TERM_CHI2 or (gains and best < NEXT_SHARE * gains[0]):
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
    return Rest(tuple(
        Chosen(labels[k][0], labels[k][1], float(n / labels[k][2]), g)
        for k, n, g in zip(picked, numbers, gains, strict=True)
    ))  # fmt: skip


def describe(rest: Rest, share: float, held_error: FloatArray, floor: FloatArray, seen: dict[str, FloatArray]) -> (
    Unexplained
):  # fmt: skip
    """The report's entry.

    Args:
        rest: the terms.
        share: of the squared excess.
        held_error: held-out errors after the horizon (S, 6).
        floor: of each channel (6,).
        seen: features at the starts of the held-out shots, each (S,).
    """
    excess = np.maximum(np.mean((held_error / floor) ** 2, axis=0) - 1.0, 0.0)
    order = np.argsort(-excess)
    channels = tuple(STATE_NAMES[k] for k in order if excess[k] > 0.5 * excess[order[0]])
    size = np.sqrt(np.mean((held_error / floor) ** 2, axis=1))
    return Unexplained(share, channels, worst_regime(seen, size), rest.words(), rest.formula())


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
