"""What is left when no effect of the catalogue fits: its channel, its regime, its class, and a formula.

The missing acceleration is read off the start of each shot. A small library of terms with physical meaning is searched
for the two that explain most of it on blocks that were not fitted; parity and growth make the class statement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.diagnosis.findings import Unexplained
from carlab.diagnosis.prediction import Predictor, errors
from carlab.diagnosis.shots import Shots
from sim_backends.car_parameters import SimulatorConfig

READ_S = 0.2
MIN_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class Term:
    """A term of the library: formula in plain symbols, what it says in words, and its value."""

    formula: str
    words: str
    value: Callable[[dict[str, FloatArray]], FloatArray]


TERMS = (
    Term("1", "a constant", lambda f: np.ones_like(f["v"])),
    Term("sign(v)", "odd in speed and independent of its size, like dry friction", lambda f: np.tanh(f["v"] / 0.05)),
    Term("v", "grows with speed", lambda f: f["v"]),
    Term("v |v|", "grows with speed squared, odd in it, like air drag", lambda f: f["v"] * np.abs(f["v"])),
    Term("v^2", "grows with speed squared, even in it", lambda f: f["v"] ** 2),
    Term("u", "grows with throttle", lambda f: f["u"]),
    Term("|u|", "even in throttle", lambda f: np.abs(f["u"])),
    Term("u v", "grows with throttle times speed, like back-EMF", lambda f: f["u"] * f["v"]),
    Term("d", "odd in steering", lambda f: f["d"]),
    Term("|d|", "even in steering", lambda f: np.abs(f["d"])),
    Term("d^3", "odd in steering and grows faster than it", lambda f: f["d"] ** 3),
    Term("d v^2", "odd in steering, grows with speed squared", lambda f: f["d"] * f["v"] ** 2),
    Term("|d| v", "even in steering, grows with speed", lambda f: np.abs(f["d"]) * f["v"]),
    Term("r", "grows with the yaw rate", lambda f: f["r"]),
    Term("r v", "grows with lateral acceleration", lambda f: f["r"] * f["v"]),
    Term("|r| v", "even in turning, grows with lateral acceleration", lambda f: np.abs(f["r"]) * f["v"]),
    Term("r / v", "grows with the path's curvature", lambda f: f["r"] / np.maximum(np.abs(f["v"]), 0.3)),
    Term("w", "grows with side slip", lambda f: f["w"]),
    Term("w |w|", "grows with side slip squared", lambda f: f["w"] * np.abs(f["w"])),
    Term("cos(yaw)", "depends on the heading", lambda f: np.cos(f["yaw"])),
    Term("sin(yaw)", "depends on the heading", lambda f: np.sin(f["yaw"])),
    Term("x", "depends on the place", lambda f: f["x"]),
    Term("y", "depends on the place", lambda f: f["y"]),
    Term("t", "drifts with time", lambda f: f["t"]),
    Term("t u", "a throttle whose effect drifts with time", lambda f: f["t"] * f["u"]),
    Term("t d", "a steering whose effect drifts with time", lambda f: f["t"] * f["d"]),
    Term("du/dt", "follows the rate of throttle, like a lag or a delay", lambda f: f["du"]),
    Term("dd/dt", "follows the rate of steering, like a lag or a delay", lambda f: f["dd"]),
    Term("v dd/dt", "follows the rate of steering times speed, like a lag or a delay", lambda f: f["dd"] * f["v"]),
)
_ACTS_ON = {3: ("vx", "a_x"), 4: ("vy", "a_y"), 5: ("yaw_rate", "dr/dt")}


def features(shots: Shots) -> dict[str, FloatArray]:
    """What the terms are made of, each (S,): speeds, yaw rate, commands that act, their rates, place and time."""
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
        "yaw": shots.start[:, 2],
        "x": shots.start[:, 0],
        "y": shots.start[:, 1],
        "t": shots.t0_s / max(float(shots.t0_s.max()), 1.0),
    }


def describe_rest(shots: Shots, config: SimulatorConfig, floor: FloatArray, share: float) -> Unexplained | None:
    """What ``config`` leaves of ``shots`` in words; None where ``share`` is too small to speak of."""
    if share < MIN_SHARE:
        return None
    error = errors(Predictor(shots, config)(), shots)[0]
    step = min(max(round(READ_S / shots.period_s), 1), shots.steps)
    excess = np.sqrt(np.mean((error[:, -1] / floor) ** 2, axis=0))
    order = np.argsort(-excess)
    channels = tuple(STATE_NAMES[k] for k in order if excess[k] > 0.6 * excess[order[0]])
    missing = -(error[:, step, 3:] - np.median(error[:, step, 3:] * 0.0, axis=0)) / (step * shots.period_s)
    seen = features(shots)
    best: tuple[float, int, tuple[Term, ...], FloatArray] = (0.0, 3, (), np.zeros(0))
    fold = (shots.block // 2) % 2 == 0
    for k in range(3):
        target = missing[:, k]
        spread = 1.4826 * np.median(np.abs(target - np.median(target))) + 1e-9
        target = np.clip(target, -6 * spread, 6 * spread)
        weight = 1.0 / (float(np.std(target)) + 1e-9)
        importance = min(float(excess[3 + k] / excess[3:].max()), 1.0)
        chosen: tuple[Term, ...] = ()
        reached = 0.0
        for _ in range(2):
            trials = [(_explained(seen, (*chosen, t), target * weight, fold), t) for t in TERMS if t not in chosen]
            gain, term = max(trials, key=lambda item: item[0])
            if gain < reached + 0.02:
                break
            reached, chosen = gain, (*chosen, term)
        if chosen and reached * importance > best[0]:
            design = np.stack([t.value(seen) for t in chosen], axis=1)
            best = (reached * importance, 3 + k, chosen, np.linalg.lstsq(design, target, rcond=None)[0])
    reached, channel, terms, numbers = best
    if not terms:
        regime = worst_regime(seen, np.sqrt(np.mean((error[:, -1] / floor) ** 2, axis=1)))
        return Unexplained(share, channels, regime, "no term of the library explains it: noise-like or a state", "")
    name, symbol = _ACTS_ON[channel]
    words = "; ".join(t.words for t in terms)
    formula = f"{symbol} = " + " ".join(f"{n:+.3g} {t.formula}" for n, t in zip(numbers, terms, strict=True))
    regime = worst_regime(seen, np.abs(error[:, -1, channel] / floor[channel]))
    return Unexplained(share, channels, regime, f"{words}; acts on {name}", formula)


def _explained(
    seen: dict[str, FloatArray], terms: tuple[Term, ...], target: FloatArray, fold: NDArray[np.bool_]
) -> float:
    """Share of the target's square explained on blocks that were not fitted."""
    design = np.stack([t.value(seen) for t in terms], axis=1)
    left = 0.0
    for own in (fold, ~fold):
        if not own.any() or own.all():
            return 0.0
        numbers = np.linalg.lstsq(design[~own], target[~own], rcond=None)[0]
        left += float(np.sum((target[own] - design[own] @ numbers) ** 2))
    return 1.0 - left / max(float(np.sum(target**2)), 1e-12)


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
