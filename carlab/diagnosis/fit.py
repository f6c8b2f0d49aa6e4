"""Fitting a simulator to shots: robust Levenberg-Marquardt with every perturbation of every parameter as one batch.

Residuals are whitened by channel and step, and Huber's loss (Huber 1964) at four standard deviations keeps single
disasters from ruling. Base parameters carry weak priors; an effect's parameters carry none beyond their bounds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.prediction import Predictor, errors
from carlab.diagnosis.shots import IndexArray, Shots
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS
from sim_backends.registry import REGISTRY

BASE = (
    "vehicle.yaw_inertia",
    "tyre.front.B",
    "tyre.front.C",
    "tyre.front.mu",
    "tyre.rear.B",
    "tyre.rear.C",
    "tyre.rear.mu",
    "motor.drive_gain",
    "motor.damping",
    "steering.max_angle",
)
TYRES = tuple(name for name in BASE if name.startswith("tyre."))
HUBER = 4.0
USED_STEPS = 6
LONGEST = 4.0
"""Longest step of a coordinate when a fold is taken out."""
FRACTIONS = (1.0, 0.5, 0.2)
"""Shares of that step that are tried; the one that suits the shots that are left is taken."""
PRIOR_SHARE = 0.3
"""Standard deviation of a base parameter about the car file's figure, as a share of it, where no range is given."""


@dataclass(frozen=True, slots=True)
class Free:
    """One number that a fit may move. ``z`` is its coordinate: 0 at ``origin``; ``size`` long, or a ratio of e^size."""

    name: str
    origin: float
    size: float
    low: float
    high: float
    logarithmic: bool = False
    prior_z: float = math.inf
    choice: bool = False

    def value(self, z: FloatArray) -> FloatArray:
        """The number at coordinates z."""
        if self.choice:
            return np.asarray(np.round(np.clip(z, self.low, self.high)))
        raw = self.origin * np.exp(self.size * z) if self.logarithmic else self.origin + self.size * z
        return np.asarray(np.clip(raw, self.low, self.high))

    def coordinate(self, value: float) -> float:
        """The coordinate of a number."""
        value = min(max(value, self.low), self.high)
        if self.logarithmic:
            return math.log(max(value, 1e-12) / self.origin) / self.size
        return (value - self.origin) / self.size


def base_parameters(config: SimulatorConfig) -> tuple[Free, ...]:
    """Base parameters that a refit of this simulator may move: the usual ones and whatever has a range."""
    values = config.values()
    names = [name for name in BASE if config.kind != "kinematic" or name not in (*TYRES, "vehicle.yaw_inertia")]
    names += [n for n in config.priors if n not in names and not n.startswith(("effects.", "timing.", "mocap."))]
    found = []
    for name in names:
        info, value = REGISTRY[name], values[name]
        low, high = max(info.low, 0.05 * value), min(info.high, 20.0 * value)
        share = PRIOR_SHARE
        if name in config.priors:
            low, high = config.priors[name]
            share = max((high - low) / (4.0 * abs(value)), 1e-3)
        if value > 0:
            found.append(Free(name, value, 0.1, low, high, True, share / 0.1))
        else:
            found.append(Free(name, 0.0, 0.1, info.low, 1.0, False))
    return tuple(found)


def effect_parameters(effect_id: str, config: SimulatorConfig) -> tuple[Free, ...]:
    """The numbers of one effect; a delay that may be negative takes no more away than the car file has."""
    found = []
    values = config.values()
    for p in EFFECTS[effect_id].parameters:
        name = f"effects.{effect_id}.{p.name}"
        size = abs(p.typical) or 1.0
        if p.choices:
            found.append(Free(name, 0.0, 1.0, 0.0, len(p.choices) - 1.0, choice=True))
        elif p.identity is not None and math.isinf(p.identity):
            found.append(Free(name, p.typical, 0.3, max(p.low, 0.02 * p.typical), 50.0 * p.typical, True))
        else:
            origin = float(values.get(p.same_as, 0.0)) if p.identity is None else p.identity
            low = max(p.low, origin - 20.0 * size)
            if p.name == "extra_delay":
                low = max(low, -config.command_delay_s)
            found.append(Free(name, origin, size, low, min(p.high, origin + 20.0 * size)))
    return tuple(found)


@dataclass(frozen=True, slots=True)
class Scale:
    """Standard deviations that whiten the errors, by used step and channel (U, 6), and the steps (U,)."""

    steps: np.ndarray
    sigma: FloatArray

    @classmethod
    def of(cls, error: FloatArray, floor: FloatArray, share: float = 1.0) -> Scale:
        """From errors (S, K + 1, 6) of the best model there is: their robust spread, never below the floor (6,)."""
        last = error.shape[1] - 1
        steps = np.unique(np.linspace(last / USED_STEPS, last, USED_STEPS).round().astype(int))
        spread = 1.4826 * np.median(np.abs(error[:, steps]), axis=0)
        return cls(steps, np.maximum(share * spread, floor))

    def white(self, error: FloatArray) -> FloatArray:
        """Whitened errors (..., U, 6) of errors (..., K + 1, 6)."""
        return error[..., self.steps, :] / self.sigma


def huber(white: FloatArray) -> FloatArray:
    """Huber's loss, element by element."""
    size = np.abs(white)
    return np.where(size <= HUBER, 0.5 * white**2, HUBER * size - 0.5 * HUBER**2)


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted simulator.

    config carries the fitted numbers; loss (S,) is each shot's Huber loss; covariance (n, n) of the coordinates z of
    ``free`` is the sandwich estimate, clustered by block; deflation (n,) its diagonal over that of independent errors.
    """

    config: SimulatorConfig
    free: tuple[Free, ...]
    z: FloatArray
    cost: float
    loss: FloatArray
    covariance: FloatArray | None = None
    deflation: FloatArray | None = None

    @property
    def inflation(self) -> float:
        """How much dependent errors overstate a gain, as a rule: the middle of ``deflation``, at least one."""
        return max(1.0, float(np.median(self.deflation))) if self.deflation is not None and len(self.free) else 1.0

    def values(self) -> dict[str, float]:
        """Fitted numbers by dotted name."""
        return {f.name: float(f.value(np.array(z))) for f, z in zip(self.free, self.z, strict=True)}


class Fitter:
    """Fits numbers of a simulator to shots with a given scale."""

    def __init__(self, shots: Shots, scale: Scale) -> None:
        self.shots = shots
        self.scale = scale

    def white(self, config: SimulatorConfig, free: Sequence[Free], z: FloatArray) -> FloatArray:
        """Whitened errors (P, S, U, 6) at coordinates z (P, n)."""
        values = {f.name: f.value(z[:, k]) for k, f in enumerate(free)}
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a car that has left all sense: below
            predicted = Predictor(self.shots, config)(values)
            white = self.scale.white(errors(predicted, self.shots))
        return np.asarray(np.nan_to_num(white, nan=1e4, posinf=1e4, neginf=-1e4).clip(-1e4, 1e4))

    @staticmethod
    def prior(free: Sequence[Free], z: FloatArray) -> FloatArray:
        """Prior loss (P,) at z (P, n)."""
        return np.asarray(0.5 * ((z / np.array([f.prior_z for f in free])) ** 2).sum(axis=1))

    def loss(
        self,
        config: SimulatorConfig,
        free: Sequence[Free] = (),
        z: FloatArray | None = None,
        *,
        most: float = math.inf,
    ) -> FloatArray:
        """Huber loss of each shot (S,), with whitened errors no larger than ``most``."""
        at = np.zeros((1, len(free))) if z is None else z[None]
        return np.asarray(huber(self.white(config, free, at).clip(-most, most))[0].sum(axis=(1, 2)))

    def best_start(self, config: SimulatorConfig, free: Sequence[Free], starts: FloatArray) -> FloatArray:
        """The start (n,) of (P, n) with the smallest cost."""
        costs = [
            huber(self.white(config, free, part)).sum(axis=(1, 2, 3)) + self.prior(free, part)
            for part in np.array_split(starts, max(1, math.ceil(len(starts) / 8)))
        ]
        return np.asarray(starts[int(np.argmin(np.concatenate(costs)))])

    def fit(
        self,
        config: SimulatorConfig,
        free: Sequence[Free],
        start: FloatArray | None = None,
        *,
        iterations: int = 12,
        tolerance: float = 2e-4,
    ) -> Fit:
        """Minimise Huber loss plus prior from ``start`` (n,) (zeros unless given)."""
        count = len(free)
        z = np.zeros(count) if start is None else np.array(start, dtype=np.float64)
        if count == 0:
            loss = self.loss(config)
            return Fit(config, (), z, float(loss.sum()), loss)
        free = tuple(free)
        precision = np.diag([1.0 / f.prior_z**2 for f in free])
        step = 0.02
        white = self.white(config, free, z[None])[0]
        cost = float(huber(white).sum() + self.prior(free, z[None])[0])
        damping = 1e-2
        for _ in range(iterations):
            nudged = z + step * np.eye(count)
            jacobian = (self.white(config, free, nudged) - white[None]) / step
            flat, residual = jacobian.reshape(count, -1), white.reshape(-1)
            weight = np.minimum(1.0, HUBER / np.maximum(np.abs(residual), 1e-12))
            normal = (flat * weight) @ flat.T + precision
            gradient = flat @ (weight * residual) + precision @ z
            improved = False
            for _ in range(3):
                dampings = damping * np.array([0.1, 1.0, 10.0, 100.0])
                trials = []
                for value in dampings:
                    matrix = normal + value * np.diag(np.diag(normal) + 1e-9)
                    trials.append(z - np.linalg.solve(matrix, gradient))
                tried = np.clip(np.array(trials), z - 8.0, z + 8.0)
                whites = self.white(config, free, tried)
                costs = huber(whites).sum(axis=(1, 2, 3)) + self.prior(free, tried)
                best = int(np.argmin(costs))
                if costs[best] < cost:
                    improved = True
                    gain = cost - float(costs[best])
                    z, white, cost = tried[best], whites[best], float(costs[best])
                    damping = max(float(dampings[best]), 1e-6)
                    break
                damping *= 1e3
            if not improved or gain < tolerance * cost:
                break
        fitted = config.with_values({f.name: float(f.value(np.array(v))) for f, v in zip(free, z, strict=True)})
        loss = huber(white).sum(axis=(1, 2))
        return Fit(fitted, free, z, cost, np.asarray(loss))

    def with_covariance(self, fit: Fit) -> Fit:
        """The same fit with its sandwich covariance, clustered by block (White 1980; Liang and Zeger 1986)."""
        if not fit.free:
            return replace(fit, covariance=np.zeros((0, 0)), deflation=np.zeros(0))
        jacobian, white = self.linear(fit)
        normal, score = self._normal(fit, jacobian, white)
        blocks, index = np.unique(self.shots.block, return_inverse=True)
        clustered = np.stack([np.bincount(index, weights=row, minlength=len(blocks)) for row in score])
        correction = len(blocks) / max(len(blocks) - 1, 1)
        meat = correction * clustered @ clustered.T
        bread = np.linalg.pinv(normal)
        sandwich = bread @ meat @ bread
        deflation = np.diag(sandwich) / np.maximum(np.diag(bread), 1e-30)
        return replace(fit, covariance=sandwich, deflation=deflation)

    def unseen(self, fit: Fit, folds: IndexArray, most: float) -> FloatArray:
        """Loss of every shot (S,) by a fit that has not seen its fold, whitened errors no larger than ``most``.

        Each fold is taken out of ``fit`` by one Gauss-Newton step (Beirami et al. 2017, approximate leave-k-out), which
        costs a few predictions where a refit costs a hundred.

        Args:
            fit: of all shots.
            folds: number of each shot's fold (S,).
            most: bound of the whitened errors.
        """
        if not fit.free:
            return self.loss(fit.config, most=most)
        jacobian, white = self.linear(fit)
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(white), 1e-12))
        normal, score = self._normal(fit, jacobian, white)
        loss = np.zeros(len(self.shots))
        for name in np.unique(folds):
            own = folds == name
            part = jacobian[:, own].reshape(len(fit.free), -1)
            left = normal - (part * weight[own].reshape(-1)) @ part.T
            left = left + 1e-3 * np.diag(np.diag(normal) + 1e-9)
            step = np.linalg.solve(left, score[:, own].sum(axis=1))
            step *= min(1.0, LONGEST / max(float(np.abs(step).max()), 1e-12))
            trials = fit.z + np.array(FRACTIONS)[:, None] * step
            whites = self.white(fit.config, fit.free, trials)
            seen = huber(whites[:, ~own]).sum(axis=(1, 2, 3)) + self.prior(fit.free, trials)
            loss[own] = huber(whites[int(np.argmin(seen)), own].clip(-most, most)).sum(axis=(1, 2))
        return loss

    def linear(self, fit: Fit) -> tuple[FloatArray, FloatArray]:
        """Jacobian (n, S, U, 6) of the whitened errors (S, U, 6) at a fit."""
        count, step = len(fit.free), 0.02
        whites = self.white(fit.config, fit.free, np.vstack([fit.z, fit.z + step * np.eye(count)]))
        return (whites[1:] - whites[0]) / step, whites[0]

    def _normal(self, fit: Fit, jacobian: FloatArray, white: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton matrix (n, n) with the prior, and each shot's score (n, S)."""
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(white), 1e-12))
        flat = jacobian.reshape(len(fit.free), -1)
        normal = (flat * weight.reshape(-1)) @ flat.T + np.diag([1.0 / f.prior_z**2 for f in fit.free])
        return normal, (jacobian * (weight * white)[None]).sum(axis=(2, 3))


def clustered_gain(before: FloatArray, after: FloatArray, shots: Shots) -> tuple[float, float]:
    """Fall of the loss from ``before`` to ``after`` (S,) and its standard error, shots of a block taken together."""
    gain = before - after
    blocks, index = np.unique(shots.block, return_inverse=True)
    sums = np.bincount(index, weights=gain, minlength=len(blocks))
    error = math.sqrt(len(blocks)) * float(sums.std(ddof=1)) if len(blocks) > 1 else math.inf
    return float(gain.sum()), max(error, 1e-9)


def inflation_of(fit: Fit, effect: str) -> float:
    """How much dependent errors overstate the gain by an effect: sandwich over naive variance, at least one.

    Twice the gain of several numbers is a sum of chi-squares weighted by such ratios, so their mean divides it.
    Where the effect's own figure cannot be had (a clip that nothing touches), the middle one of all numbers stands in.
    """
    assert fit.deflation is not None
    own = [
        float(d) for f, d in zip(fit.free, fit.deflation, strict=True)
        if f.name.startswith(f"effects.{effect}.") and d > 1e-9
    ]  # fmt: skip
    return max(fit.inflation, float(np.mean(own)) if own else 0.0)


def with_effect(config: SimulatorConfig, effect_id: str) -> SimulatorConfig:
    """The simulator with one more effect, switched on at its identity or, where that is infinite, far from acting."""
    effect = EFFECTS[effect_id]
    given = {}
    for p in effect.parameters:
        identity = p.typical if p.identity is None else p.identity
        given[p.name] = min(50.0 * p.typical, p.high) if math.isinf(identity) else identity
    return replace(config, effects={**config.effects, effect_id: given})


def describe(values: Mapping[str, float]) -> str:
    """Numbers in one line, for the log."""
    return ", ".join(f"{name} {value:.4g}" for name, value in values.items())
