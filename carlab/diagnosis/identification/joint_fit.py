"""Joint fit of a simulator's parameters and the initial states of all windows.

A fit with estimated initial states (``fit.Fitter``) is biased: the local polynomial through the poses cannot follow a
jump of the acceleration, and parameters compensate its error. Here the initial state of each window is fitted together
with the parameters, so that only measurement noise is left: the maximum likelihood of multiple shooting (Bock and Plitt
1984, "A multiple shooting algorithm for direct solution of optimal control problems"), by the Gauss-Newton method with
Huber weights. The initial states are eliminated window by window (variable projection, Kaufman 1975).

The simulations have 64 bits: rounding errors of 32 bits change the cost of 20 000 errors by about one, as much as a
parameter that is one standard deviation off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.block_jackknife import covariance_within_bounds
from carlab.diagnosis.identification.bounded_step import (
    bounded_step,
    coordinate_bounds,
    held_at_bounds,
    inward_steps,
)
from carlab.diagnosis.identification.error_scale import MAX_WHITE, huber
from carlab.diagnosis.identification.fit import MAX_STEP, Fit, Fitter
from carlab.diagnosis.identification.fit_parameters import FitParameter, difference_steps, numbers_at
from carlab.diagnosis.identification.free_initial_states import (
    initial_state_correction,
    linearised_by_initial_states,
)
from carlab.diagnosis.settings import IDENTIFICATION
from carlab.prediction.errors import bounded, prediction_errors
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import IndexArray
from sim_backends.car_parameters import SimulatorConfig

_ITERATIONS = 12
_SMALL_DECREASE = 1e-2
"""Decrease of the cost, predicted or actual, at which a fit ends; a parameter one standard deviation off costs 0.5."""
_DAMPINGS = (1e-8, 1e-4, 1e-2, 1.0)
"""Levenberg-Marquardt dampings, relative to the diagonal; the first that lowers the cost is used."""
_STATE_STEP = 0.05
"""Difference of the initial states for derivatives, in standard deviations of the noise."""
_NORMAL_MEDIAN_SQUARE = 0.4549
"""Median of the square of a standard normal variable."""


@dataclass(frozen=True, slots=True)
class _Linearisation:
    """Errors at a point with their derivatives, in standard deviations of the noise.

    Attributes:
        white: errors (S, E) at the best initial states of the linearised windows.
        states: derivatives by the initial states (S, E, 6).
        parameters: derivatives by the parameters (S, E, n).
        shift: change of the initial states (S, 6) to the best ones, in SI units.
        weights: Huber weights (S, E).
    """

    white: FloatArray
    states: FloatArray
    parameters: FloatArray
    shift: FloatArray
    weights: FloatArray

    def projected(self) -> tuple[FloatArray, FloatArray]:
        """Derivatives by the parameters (S, E, n) with the best initial states, and those of these states (S, 6, n)."""
        weighted = np.swapaxes(self.states * self.weights[..., None], 1, 2)
        normal = weighted @ self.states + 1e-9 * np.eye(6)
        following = -np.linalg.solve(normal, weighted @ self.parameters)
        return np.asarray(self.parameters + self.states @ following), np.asarray(following)


def joint_fit(fitter: Fitter, start: Fit, measured_std: FloatArray) -> Fit | None:
    """Fit parameters and initial states together, from a fit with estimated initial states.

    Args:
        fitter: windows, prior and settings.
        start: the fit to start from.
        measured_std: standard deviations (6,) of the noise of the measured channels.

    Returns:
        The simulator with the covariance of its parameters; cost and loss are those with estimated initial states. None
        if the simulator leaves more than noise (``joint_max_noise_ratio``): then free initial
        states would hide a part of its error. None, too, if the iterations end at a higher cost than that of ``start``.
    """
    problem = _Problem(fitter, start.config, start.free, measured_std)
    if not start.free:
        return None
    shift, noise_ratio = problem.with_free_initial_states(start.z)
    if noise_ratio > IDENTIFICATION.joint_max_noise_ratio:
        return None
    precision = fitter.precision(start.free)
    at_start = _trial(problem, start.z, fitter.windows.initial_states, shift, precision)
    # A full first step often raises the cost at first, but reaches the minimum in fewer iterations than damped ones.
    point = _Point(start.z, fitter.windows.initial_states, math.inf)
    for _ in range(_ITERATIONS):
        before = point.cost
        point, predicted_decrease = _iterated(problem, point, precision)
        if min(predicted_decrease, before - point.cost) < _SMALL_DECREASE:
            break
    return _result(problem, point, precision) if point.cost <= at_start.cost else None


@dataclass(frozen=True, slots=True)
class _Point:
    """Parameters (n,), initial states (S, 6), and the cost, which is infinite before the first iteration."""

    z: FloatArray
    states: FloatArray
    cost: float


def _iterated(problem: _Problem, point: _Point, precision: FloatArray) -> tuple[_Point, float]:
    """The point after the first damped Gauss-Newton step that lowers the cost, and the decrease that it predicts.

    If no step lowers the cost, the parameters stay. A window that is far from linear, for example in a spin, keeps its
    initial state if the correction raises its loss.
    """
    at = problem.linearised(point.z, point.states)
    jacobian, following = at.projected()
    normal, gradient = _normal(jacobian, at)
    normal += precision
    gradient = gradient + precision @ point.z
    diagonal = np.diag(np.diag(normal) + 1e-9)
    low, high = coordinate_bounds(problem.free)
    lowest, highest = np.maximum(low - point.z, -MAX_STEP), np.minimum(high - point.z, MAX_STEP)
    steps = [bounded_step(normal + damping * diagonal, gradient, lowest, highest) for damping in _DAMPINGS]
    for change in (*steps, np.zeros(len(gradient))):
        followed = point.states + np.einsum("skn,n->sk", following, change) * problem.std
        trial = _trial(problem, point.z + change, followed, at.shift, precision)
        if trial.cost < point.cost:
            return trial, -0.5 * float(gradient @ steps[0])
    return point, 0.0


def _trial(problem: _Problem, z: FloatArray, states: FloatArray, shift: FloatArray, precision: FloatArray) -> _Point:
    """The point with parameters ``z``. ``shift`` is added to the initial state of each window whose loss it lowers."""
    choices = np.stack([states, states + shift])
    losses = problem.losses(problem.white(np.stack([z, z]), choices))
    best = losses.argmin(axis=0)
    return _Point(z, choices[best, np.arange(len(best))], float(losses.min(axis=0).sum() + 0.5 * z @ precision @ z))


def _normal(jacobian: FloatArray, at: _Linearisation) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton matrix (n, n) of the parameters, and their gradient (n,)."""
    weighted = (jacobian * at.weights[..., None]).reshape(-1, jacobian.shape[-1])
    return weighted.T @ jacobian.reshape(weighted.shape), weighted.T @ at.white.reshape(-1)


def _result(problem: _Problem, point: _Point, precision: FloatArray) -> Fit:
    """The fit with the covariance of its parameters."""
    fitter, free, z = problem.fitter, problem.free, point.z
    at = problem.linearised(z, point.states)
    gradient = _normal(at.projected()[0], at)[1] + precision @ z
    covariance = _covariance(at, fitter.windows.block, precision, held_at_bounds(free, z, gradient))
    config = problem.config.with_values(numbers_at(free, z))
    loss = fitter.loss(config)
    cost = float(loss.sum() + fitter.prior(free, z[None])[0])
    return Fit(config, free, z, cost, loss, covariance)


def _covariance(at: _Linearisation, block: IndexArray, precision: FloatArray, held: NDArray[np.bool_]) -> FloatArray:
    """Covariance (n, n) by the jackknife over blocks; bounds hold the ``held`` parameters (n,)."""
    jacobian = at.projected()[0]
    parts = [
        _normal(jacobian[own], replace(at, white=at.white[own], weights=at.weights[own]))
        for own in (block == each for each in np.unique(block))
    ]
    information, scores = (np.array(each) for each in zip(*parts, strict=True))
    return covariance_within_bounds(information, scores, precision, held)


@dataclass(frozen=True, slots=True)
class _Problem:
    """Windows of a fitter, a simulator with n free parameters, and the noise (6,) of the channels."""

    fitter: Fitter
    config: SimulatorConfig
    free: tuple[FitParameter, ...]
    std: FloatArray

    def with_free_initial_states(self, z: FloatArray) -> tuple[FloatArray, float]:
        """Change of the initial states (S, 6) to the best ones, and the noise ratio with them.

        The noise ratio is the robust variance of the errors, by the median of their squares, over that of the
        measurement noise. It is about 1 if the simulator explains the recordings.
        """
        windows = self.fitter.windows
        of_windows = np.tile(z, (len(windows), 1))
        white, jacobian = linearised_by_initial_states(windows, self.config, self.free, of_windows, self.std)
        shift, error, _ = initial_state_correction(white, jacobian)
        return shift * self.std, float(np.median(error**2)) / _NORMAL_MEDIAN_SQUARE

    def losses(self, white: FloatArray) -> FloatArray:
        """Huber loss of each window (..., S) of whitened errors (..., S, E)."""
        return np.asarray(huber(white).sum(axis=-1))

    def white(self, z: FloatArray, states: FloatArray) -> FloatArray:
        """Whitened errors (P, S, E) with parameters (P, n) and initial states (P, S, 6)."""
        windows, sets = self.fitter.windows, len(z)
        count = len(windows)
        stacked = replace(windows.take(np.tile(np.arange(count), sets)), initial_states=states.reshape(-1, 6))
        values = {f.name: np.repeat(f.value(z[:, k]), count)[None] for k, f in enumerate(self.free)}
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a diverged simulation is clipped below
            predicted = simulate_windows(stacked, self.config, values, in_double=True).reshape(sets, count, -1, 6)
            white = prediction_errors(predicted, windows)[:, :, 1:] / self.std
        return bounded(white, MAX_WHITE).reshape(sets, count, -1)

    def linearised(self, z: FloatArray, states: FloatArray) -> _Linearisation:
        """Errors at the best initial states near ``states`` (S, 6), and derivatives."""
        steps = inward_steps(self.free, z, difference_steps(self.free))
        moved_z = np.vstack([z, np.tile(z, (6, 1)), z + np.diag(steps)])
        moved_states = np.tile(states, (len(moved_z), 1, 1))
        moved_states[1:7] += _STATE_STEP * np.diag(self.std)[:, None]
        white = self.white(moved_z, moved_states)
        changes = np.moveaxis(white[1:] - white[0], 0, -1)
        by_states, by_parameters = changes[..., :6] / _STATE_STEP, changes[..., 6:] / steps
        shift, error, weights = initial_state_correction(white[0], by_states)
        return _Linearisation(error, by_states, by_parameters, shift * self.std, weights)
