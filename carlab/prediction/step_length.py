"""Integration step of predictions: shorter where a car drives slowly, because its slip angles change fast there.

Near rest, side speed and yaw rate decay with rates in proportion to the cornering stiffness and to the inverse of the
forward speed. A classical Runge-Kutta step is unstable if rate times step exceeds 2.785 (Hairer and Wanner, "Solving
Ordinary Differential Equations II", section IV.2).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.prediction.windows import PredictionWindows
from sim_backends.array_ops import ARRAYS
from sim_backends.batch.array_rollout import count_of_sets
from sim_backends.dynamics.single_track import SingleTrack
from sim_backends.effects.base import SLIP_FLOOR_MPS, ModelKind

MAX_STEP_S = 0.017
"""Maximum integration step: at 30 Hz its error is below a hundredth of a noise floor."""
MIN_STEP_S = MAX_STEP_S / 4.0
"""Minimum integration step; a car that needs a shorter one has parameters that no real car has."""
MAX_RATE_TIMES_STEP = 2.5
"""Bound on the fastest rate times the step: a transient loses a third of its size in each step."""
SLOW_MPS = 2.0 * SLIP_FLOOR_MPS
"""Forward speed [m/s] below which a car counts as slow."""
SLIP_ANGLES = np.linspace(0.0, 0.4, 6)
"""Slip angles [rad] at which the rate is computed; measured curves are steep elsewhere than at 0."""
_DIFFERENCES = (0.003, 0.03)
"""Differences of vy [m/s] and yaw rate [rad/s] for the derivatives: a slip angle of 0.01 rad."""


def step_for(
    windows: PredictionWindows, kind: ModelKind, values: Mapping[str, float | FloatArray], effects: Iterable[str]
) -> float:
    """Integration step [s] of a simulation of S windows by P cars; all have the step of the fastest car.

    Args:
        windows: to simulate.
        kind: of the model.
        values: parameters by dotted name, each a number, (P, 1) or (P, S).
        effects: ids of effects.
    """
    if not (np.abs(windows.measured[:, :, 3]) < SLOW_MPS).any():
        return MAX_STEP_S
    means = {name: v.mean(axis=1) if isinstance(v, np.ndarray) else v for name, v in values.items()}
    rate = fastest_rate(kind, means, effects)
    return float(np.clip(MAX_RATE_TIMES_STEP / max(rate, 1.0), MIN_STEP_S, MAX_STEP_S))


def fastest_rate(kind: ModelKind, values: Mapping[str, float | FloatArray], effects: Iterable[str]) -> float:
    """Largest absolute eigenvalue [1/s] of side speed and yaw rate at the floor of the slip speed, over P cars.

    Arguments are those of ``step_for``, with numbers or values (P,). Hidden states of effects are in steady state.
    """
    stiffest: ModelKind = "dynamic" if kind == "blend" else kind
    by_car = {n: value[:, None, None] if isinstance(value, np.ndarray) else value for n, value in values.items()}
    model = SingleTrack(ARRAYS, stiffest, by_car, effects)
    vy = SLIP_FLOOR_MPS * np.tan(SLIP_ANGLES) + np.array([0.0, _DIFFERENCES[0], 0.0])[:, None]
    yaw_rate = np.array([0.0, 0.0, _DIFFERENCES[1]])[:, None] + 0.0 * vy
    still = np.zeros((count_of_sets(values.values()), *vy.shape))
    body = (still, still, still, still + SLIP_FLOOR_MPS, still + vy, still + yaw_rate)
    with np.errstate(all="ignore"):  # parameters of a diverging fit
        rates, _ = model.evaluate(0.0, body, model.actuation(still, still), settle=True)
        by_state = [
            np.stack([(rate[:, 1 + k] - rate[:, 0]) / step for rate in rates[4:6]], axis=-1)
            for k, step in enumerate(_DIFFERENCES)
        ]
    jacobian = np.nan_to_num(np.stack(by_state, axis=-1), nan=0.0, posinf=0.0, neginf=0.0)
    return float(np.abs(np.linalg.eigvals(jacobian)).max())
