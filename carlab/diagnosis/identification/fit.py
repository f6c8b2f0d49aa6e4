"""Fit of a simulator to prediction windows: robust Levenberg-Marquardt, all perturbations in one batch.

Errors are whitened by channel and step. Huber's loss (Huber 1964) at four standard deviations bounds the influence of
outliers. Base parameters have priors (``fit_parameters``); parameters of effects have only bounds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.block_jackknife import covariance_within_bounds, sandwich_design_effects
from carlab.diagnosis.identification.bounded_step import (
    bounded_step,
    coordinate_bounds,
    held_at_bounds,
    inward_steps,
)
from carlab.diagnosis.identification.error_scale import Scale, huber, huber_weight
from carlab.diagnosis.identification.fit_parameters import FitParameter, difference_steps, numbers_at, values_at
from carlab.diagnosis.settings import IDENTIFICATION
from carlab.prediction.errors import prediction_errors
from carlab.prediction.predict import longest_step_s, simulate_windows
from carlab.prediction.windows import IndexArray, PredictionWindows
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CURVES

MAX_STEP = 8.0
"""Maximum change of a coordinate in an iteration."""
MAX_DAMPING_AT_END = 1.0
"""Damping, relative to the diagonal, above which a small gain is no sign of a minimum: the step was short."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted simulator.

    Attributes:
        config: simulator with the fitted parameters.
        free: n fitted parameters.
        z: (n,) coordinates of the parameters.
        cost: Huber loss plus prior.
        loss: (S,) Huber loss of each window.
        covariance: (n, n) covariance of z by the jackknife over blocks.
        design_effects: (n,) variance of z by the sandwich estimate over blocks, over that for independent errors.
    """

    config: SimulatorConfig
    free: tuple[FitParameter, ...]
    z: FloatArray
    cost: float
    loss: FloatArray
    covariance: FloatArray | None = None
    design_effects: FloatArray | None = None

    @property
    def design_effect(self) -> float:
        """Median design effect, at least 1: factor by which dependent errors overstate a gain."""
        if self.design_effects is None or not len(self.free):
            return 1.0
        return max(1.0, float(np.median(self.design_effects)))

    def design_effect_of(self, effect: str) -> float:
        """Design effect of an effect's parameters: variance by blocks over that for independent errors, at least one.

        Twice the gain of several parameters is a sum of chi-squares weighted by such ratios, so their mean divides it
        (Kent 1982). If no parameter of the effect influences the errors (a limit that no command reaches), the result
        is the median of all parameters.
        """
        assert self.design_effects is not None
        prefix = f"effects.{effect}."
        of_parameters = zip(self.free, self.design_effects, strict=True)
        own = [float(d) for f, d in of_parameters if f.name.startswith(prefix) and d > 1e-9]
        return max(self.design_effect, float(np.mean(own)) if own else 0.0)

    def values(self) -> dict[str, float]:
        """Fitted values by dotted name."""
        return numbers_at(self.free, self.z)

    def coordinates(self) -> dict[str, float]:
        """Coordinates by dotted name."""
        return {f.name: float(z) for f, z in zip(self.free, self.z, strict=True)}


class _Point(NamedTuple):
    """Coordinates z (n,), whitened errors (S, U, 6), cost, and the damping of the step that ended here."""

    z: FloatArray
    white: FloatArray
    cost: float
    damping: float


class Linearisation(NamedTuple):
    """Whitened errors (S, U, 6) and their Jacobian (n, S, U, 6)."""

    jacobian: FloatArray
    white: FloatArray


class Fitter:
    """Fits parameters of a simulator to windows with a given scale."""

    def __init__(self, windows: PredictionWindows, scale: Scale) -> None:
        self.windows = windows
        self.scale = scale

    def white(
        self, config: SimulatorConfig, free: Sequence[FitParameter], z: FloatArray, max_step_s: float | None = None
    ) -> FloatArray:
        """Whitened errors (P, S, U, 6) at coordinates z (P, n), in batches that bound the memory.

        ``max_step_s`` is the maximum integration step [s]; default: that of ``simulate_windows``.
        """
        if len(z) > IDENTIFICATION.max_batch_sets:
            parts = np.array_split(z, math.ceil(len(z) / IDENTIFICATION.max_batch_sets))
            return np.concatenate([self.white(config, free, part, max_step_s) for part in parts])
        values = {f.name: f.value(z[:, k]) for k, f in enumerate(free)}
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a diverged simulation is clipped below
            predicted = simulate_windows(self.windows, config, values, ticks=self.scale.steps, max_step_s=max_step_s)
            return self.scale.white_at_steps(prediction_errors(predicted, self.windows, self.scale.steps))

    def jacobian(
        self, config: SimulatorConfig, free: Sequence[FitParameter], z: FloatArray, white: FloatArray
    ) -> FloatArray:
        """Derivatives (n, S, U, 6) of the whitened errors ``white`` (S, U, 6) at coordinates z (n,), by differences.

        At a bound they are those into the range.
        """
        if not len(free):
            return np.zeros((0, *white.shape))
        max_step_s = longest_step_s(self.windows, config, values_at(free, z))
        steps = inward_steps(free, z, difference_steps(free))
        jacobian = self.white(config, free, z + np.diag(steps), max_step_s)
        jacobian -= white
        jacobian /= steps[:, None, None, None]
        return jacobian

    def precision(self, free: Sequence[FitParameter]) -> FloatArray:
        """Precision (n, n) of the Gaussian prior of z; measured curves have a penalty on their roughness."""
        precision = np.diag([1.0 / f.prior_z**2 for f in free])
        index = {f.name: k for k, f in enumerate(free)}
        for curve in CURVES:
            own = [index[n] for p in curve.parameters if (n := f"effects.{curve.id}.{p.name}") in index]
            if own:
                rows = curve.roughness() / IDENTIFICATION.curve_roughness_std
                precision[np.ix_(own, own)] += rows.T @ rows + np.eye(len(own)) / IDENTIFICATION.curve_std**2
        return precision

    def prior(self, free: Sequence[FitParameter], z: FloatArray) -> FloatArray:
        """Prior loss (P,) at z (P, n)."""
        return np.asarray(0.5 * np.einsum("pi,ij,pj->p", z, self.precision(free), z))

    def loss(
        self,
        config: SimulatorConfig,
        free: Sequence[FitParameter] = (),
        z: FloatArray | None = None,
        *,
        max_error: float = math.inf,
    ) -> FloatArray:
        """Huber loss of each window (S,), with whitened errors clipped at ``max_error``."""
        at = np.zeros((1, len(free))) if z is None else z[None]
        return np.asarray(huber(self.white(config, free, at).clip(-max_error, max_error))[0].sum(axis=(1, 2)))

    def best_point(self, config: SimulatorConfig, free: Sequence[FitParameter], starts: FloatArray) -> FloatArray:
        """The point (n,) of (P, n) with the smallest cost."""
        costs = [
            huber(self.white(config, free, part)).sum(axis=(1, 2, 3)) + self.prior(free, part)
            for part in np.array_split(starts, max(1, math.ceil(len(starts) / 8)))
        ]
        return np.asarray(starts[int(np.argmin(np.concatenate(costs)))])

    def fit(
        self,
        config: SimulatorConfig,
        free: Sequence[FitParameter],
        start: FloatArray | None = None,
        *,
        iterations: int = 12,
        tolerance: float = 2e-4,
        compared_cost: float | None = None,
    ) -> Fit:
        """Minimise Huber loss plus prior within the bounds of the parameters.

        The method is Levenberg-Marquardt with an active set of bounds (``bounded_step``).

        Args:
            config: simulator.
            free: n parameters.
            start: their initial coordinates (n,); zeros unless given.
            iterations: maximum number.
            tolerance: the fit ends when an iteration without strong damping lowers the cost by less than this share.
            compared_cost: cost of a model that the fit is only compared with. Then a fall by less than
                ``compared_tolerance`` of the difference ends the fit too.
        """
        count = len(free)
        z = np.zeros(count) if start is None else np.array(start, dtype=np.float64)
        if count == 0:
            loss = self.loss(config)
            return Fit(config, (), z, float(loss.sum()), loss)
        free = tuple(free)
        low, high = coordinate_bounds(free)
        z = z.clip(low, high)
        precision = self.precision(free)
        white = self.white(config, free, z[None])[0]
        at = _Point(z, white, float(huber(white).sum() + self.prior(free, z[None])[0]), 1e-2)
        for _ in range(iterations):
            before = at.cost
            normal, gradient = self._normal(self.jacobian(config, free, at.z, at.white), at.white)
            normal, gradient = normal + precision, gradient + precision @ at.z
            lower = self._lower_point(config, free, at, normal, gradient)
            if lower is None:
                break
            at = lower
            difference = 0.0 if compared_cost is None else abs(at.cost - compared_cost)
            smallest = max(tolerance * at.cost, IDENTIFICATION.compared_tolerance * difference)
            if before - at.cost < smallest and at.damping <= MAX_DAMPING_AT_END:
                break
        fitted = config.with_values(numbers_at(free, at.z))
        return Fit(fitted, free, at.z, at.cost, np.asarray(huber(at.white).sum(axis=(1, 2))))

    def _lower_point(
        self,
        config: SimulatorConfig,
        free: Sequence[FitParameter],
        at: _Point,
        normal: FloatArray,
        gradient: FloatArray,
    ) -> _Point | None:
        """The lowest of the points after steps with several dampings; None if none is lower.

        Args:
            config: simulator.
            free: n parameters.
            at: point of the fit.
            normal: Gauss-Newton matrix (n, n) of the cost there.
            gradient: gradient (n,) of the cost there.
        """
        low, high = coordinate_bounds(free)
        lowest, highest = np.maximum(low - at.z, -MAX_STEP), np.minimum(high - at.z, MAX_STEP)
        damping = at.damping
        for _ in range(3):
            dampings = damping * np.array([0.1, 1.0, 10.0, 100.0])
            matrices = [normal + value * np.diag(np.diag(normal) + 1e-9) for value in dampings]
            tried = at.z + np.array([bounded_step(matrix, gradient, lowest, highest) for matrix in matrices])
            whites = self.white(config, free, tried)
            costs = huber(whites).sum(axis=(1, 2, 3)) + self.prior(free, tried)
            best = int(np.argmin(costs))
            if costs[best] < at.cost:
                return _Point(tried[best], whites[best], float(costs[best]), max(float(dampings[best]), 1e-6))
            damping *= 1e3
        return None

    def with_covariance(
        self, fit: Fit, linearisation: Linearisation | None = None, held: NDArray[np.bool_] | None = None
    ) -> Fit:
        """The same fit with its covariance by the jackknife over blocks (``block_jackknife``).

        Args:
            fit: n parameters.
            linearisation: of the errors at the fit; computed by default.
            held: parameters (n,) that a bound holds; by default ``held_at_bounds``. Their design effect is 0.
        """
        if not fit.free:
            return replace(fit, covariance=np.zeros((0, 0)), design_effects=np.zeros(0))
        linearisation = linearisation or self.linearised(fit)
        held = self.held_at_bounds(fit, linearisation) if held is None else held
        jacobian, white = linearisation
        masks = [self.windows.block == block for block in np.unique(self.windows.block)]
        parts = [self._information(jacobian[:, mask], white[mask]) for mask in masks]
        information = np.array([matrix for matrix, _ in parts])
        scores = np.array([score.sum(axis=1) for _, score in parts])
        precision = self.precision(fit.free)
        covariance = covariance_within_bounds(information, scores, precision, held)
        effects, own = np.zeros(len(fit.free)), np.ix_(~held, ~held)
        effects[~held] = sandwich_design_effects(information[:, ~held][:, :, ~held], scores[:, ~held], precision[own])
        return replace(fit, covariance=covariance, design_effects=effects)

    def held_at_bounds(self, fit: Fit, linearisation: Linearisation) -> NDArray[np.bool_]:
        """Which parameters (n,) of a fit are at a bound beyond which its cost would fall."""
        gradient = self._normal(*linearisation)[1] + self.precision(fit.free) @ fit.z
        return held_at_bounds(fit.free, fit.z, gradient)

    def gauss_newton_step(self, fit: Fit, linearisation: Linearisation, held: NDArray[np.bool_]) -> FloatArray:
        """Change (n,) of the coordinates of a fit that minimises the linearised loss with its prior.

        Bounds do not limit it, but coordinates that are ``held`` (n,) do not change.
        """
        normal, gradient = self._normal(*linearisation)
        precision = self.precision(fit.free)
        step, free = np.zeros(len(fit.free)), ~held
        matrix = (normal + precision)[np.ix_(free, free)]
        step[free] = -np.linalg.pinv(matrix) @ (gradient + precision @ fit.z)[free]
        return step

    def leave_fold_out_loss(
        self, fit: Fit, folds: IndexArray, max_error: float, linearisation: Linearisation | None = None
    ) -> FloatArray:
        """Loss of every window (S,) by a fit without its fold, whitened errors clipped at ``max_error``.

        Args:
            fit: fit to all windows.
            folds: index of each window's fold (S,).
            max_error: bound of the whitened errors.
            linearisation: of the errors at the fit; computed by default.
        """
        if not fit.free:
            return self.loss(fit.config, max_error=max_error)
        loss = np.zeros(len(self.windows))
        for own, _, white in self._without_each_fold(fit, folds, linearisation or self.linearised(fit)):
            loss[own] = huber(white.clip(-max_error, max_error)).sum(axis=(1, 2))
        return loss

    def leave_fold_out_coordinates(
        self, fit: Fit, folds: IndexArray, linearisation: Linearisation | None = None
    ) -> FloatArray:
        """Coordinates (S, n) for every window by a fit without its fold (S,), as ``leave_fold_out_loss``."""
        z = np.tile(fit.z, (len(self.windows), 1))
        if fit.free:
            for own, without, _ in self._without_each_fold(fit, folds, linearisation or self.linearised(fit)):
                z[own] = without
        return z

    def _without_each_fold(
        self, fit: Fit, folds: IndexArray, linearisation: Linearisation
    ) -> Iterator[tuple[NDArray[np.bool_], FloatArray, FloatArray]]:
        """For each fold: its windows (S,), coordinates (n,) of a fit without it, and its whitened errors.

        Each fold is removed from ``fit`` by one Gauss-Newton step (Beirami et al. 2017, approximate leave-k-out), at
        the cost of a few predictions; a refit costs a hundred.
        """
        jacobian, white = linearisation
        weight = huber_weight(white)
        information, score = self._information(jacobian, white)
        normal = information + self.precision(fit.free)
        low, high = coordinate_bounds(fit.free)
        for name in np.unique(folds):
            own = folds == name
            part = jacobian[:, own].reshape(len(fit.free), -1)
            reduced = normal - (part * weight[own].reshape(-1)) @ part.T
            reduced = reduced + 1e-3 * np.diag(np.diag(normal) + 1e-9)
            step = bounded_step(reduced, -score[:, own].sum(axis=1), low - fit.z, high - fit.z)
            step *= min(1.0, IDENTIFICATION.max_fold_step / max(float(np.abs(step).max()), 1e-12))
            trials = fit.z + np.array(IDENTIFICATION.fold_step_shares)[:, None] * step
            whites = self.white(fit.config, fit.free, trials)
            other_costs = huber(whites[:, ~own]).sum(axis=(1, 2, 3)) + self.prior(fit.free, trials)
            best = int(np.argmin(other_costs))
            yield own, trials[best], whites[best, own]

    def linearised(self, fit: Fit) -> Linearisation:
        """The whitened errors linearised at a fit."""
        white = self.white(fit.config, fit.free, fit.z[None])[0]
        return Linearisation(self.jacobian(fit.config, fit.free, fit.z, white), white)

    def _normal(self, jacobian: FloatArray, white: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton matrix (n, n) and gradient (n,) of the loss without the prior."""
        flat, residual = jacobian.reshape(len(jacobian), white.size), white.reshape(-1)
        weight = huber_weight(residual)
        return (flat * weight) @ flat.T, flat @ (weight * residual)

    def _information(self, jacobian: FloatArray, white: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton matrix (n, n) without the prior, and each window's score (n, S)."""
        weight = huber_weight(white)
        flat = jacobian.reshape(len(jacobian), -1)
        return (flat * weight.reshape(-1)) @ flat.T, (jacobian * (weight * white)[None]).sum(axis=(2, 3))
