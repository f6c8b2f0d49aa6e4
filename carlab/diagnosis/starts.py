"""Starts of shots without the bias of their local cubic.

A car moves more sharply than a cubic where commands step, and the cubic then smears what follows into the start. How
much, a simulator that is roughly right knows: the same cubic through its own poses, less its own state. Where the
recording bears that out (a quintic through the measured poses differs from the cubic as it does in the simulator), the
bias is taken away; where the simulator is wrong in time or size, so much less of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import savgol_coeffs

from carlab.core.quantities import FloatArray
from carlab.diagnosis.prediction import FILTER, Predictor
from carlab.diagnosis.shots import QUINTIC_WIDTH, Shots, body_states, start_width
from sim_backends.car_parameters import SimulatorConfig

_GROUPS = ((0, 1), (2,), (3,), (4,), (5,))


def corrected(shots: Shots, config: SimulatorConfig) -> Shots:
    """The same shots with the bias of their starts taken away, and ``bent`` as far as it is left.

    Args:
        shots: as cut.
        config: a simulator that is roughly right.
    """
    width = start_width(shots.period_s)
    half = max(width, QUINTIC_WIDTH) // 2
    if shots.steps < half or shots.history.shape[1] <= half:
        return shots
    filtering = FILTER.split(".")[1]
    config = replace(config, effects={name: v for name, v in config.effects.items() if name != filtering})
    about = replace(
        shots,
        start=shots.before[:, -half],
        history=shots.history[:, :-half],
        commands=np.concatenate([shots.history[:, -half:], shots.commands[:, :half]], axis=1),
        measured=np.concatenate([shots.before[:, -half:], shots.measured[:, : half + 1]], axis=1),
        before=shots.before[:, :-half],
        t0_s=shots.t0_s - half * shots.period_s,
        smear_s2=0.0,
    )
    simulated = Predictor(about, config)()[0]
    true = simulated[:, half]
    cubic = _start(simulated[..., :3], width, 3, shots.period_s)
    quintic = _start(simulated[..., :3], 2 * half + 1, 5, shots.period_s)
    turn = shots.start[:, 2] - true[:, 2]
    bias, bent = _turned(cubic - true, turn), _turned(quintic - cubic, turn)
    lost = ~np.isfinite(np.concatenate([bias, bent], axis=1)).all(axis=1)
    bias[lost], bent[lost] = 0.0, 0.0
    share = np.zeros(6)
    for group in _GROUPS:
        both, own = float(np.sum(bent[:, group] * shots.bent[:, group])), float(np.sum(bent[:, group] ** 2))
        share[list(group)] = np.clip(both / max(own, 1e-30), 0.0, 1.0)
    return replace(shots, start=shots.start - share * bias, bent=shots.bent - share * bent)


def _start(pose: FloatArray, width: int, order: int, period_s: float) -> FloatArray:
    """Start states (S, 6) by a local polynomial through the middle ``width`` of poses (S, n, 3)."""
    aside = (pose.shape[1] - width) // 2
    middle = pose[:, aside : aside + width]
    value = savgol_coeffs(width, order, use="dot") @ middle
    slope = savgol_coeffs(width, order, deriv=1, delta=period_s, use="dot") @ middle
    return body_states(value, slope)


def _turned(states: FloatArray, angle: FloatArray) -> FloatArray:
    """Differences of states (S, 6) in a world that is turned by ``angle`` (S,)."""
    sin, cos = np.sin(angle), np.cos(angle)
    out = states.copy()
    out[:, 0] = cos * states[:, 0] - sin * states[:, 1]
    out[:, 1] = sin * states[:, 0] + cos * states[:, 1]
    return out
