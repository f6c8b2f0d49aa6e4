"""What every candidate effect promises, before it is fitted: a score test with the present parameters projected out.

The error changes by a secant g when a candidate is switched on at some size. What the parameters that are already free
could do themselves (their Jacobian) is projected out of it, as in a score test (Rao 1948), here at finite sizes because
a dead band or a clipped force has no slope at its identity. Sizes are chosen by what they do to the errors, so that
nothing depends on a guess of how large an effect usually is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.fit import HUBER, Fit, Fitter, Free, with_effect
from carlab.diagnosis.shots import Shots
from sim_backends.car_parameters import SimulatorConfig

SIZES = (0.15, 0.6, 2.4)
"""Root mean square change of the whitened errors at which a candidate is tried."""
RATIOS = (0.15, 0.25, 0.4, 0.6, 0.9, 1.3, 2.0, 3.0, 5.0)
"""Shares of the typical size at which a candidate whose identity is infinite is tried."""
STARTS = 3
SCREENED_SHOTS = 180
"""Enough shots to tell which candidates deserve a fit."""
NEARLY = 0.75
"""Further starts promise at least this share of the best."""
_PROBE = 0.03
_CLIP = 50.0
_AT_A_TIME = 8
TYRE_GRIPS = (0.4, 0.65, 0.95, 1.4)
TYRE_SHAPE = 1.5
WIND_COEFFICIENT = 0.15
PATCH_SPACING_M = 0.5
PATCH_RADIUS_M = 0.8


@dataclass(frozen=True, slots=True)
class Promise:
    """A candidate's predicted fall of the loss, and coordinates (k, n) to start its fit from, the best first."""

    effect: str
    gain: float
    starts: FloatArray


class Screen:
    """Screens candidates beside the fit ``best`` of ``config``, on at most ``most`` shots, evenly taken.

    Gains are given for all shots.
    """

    def __init__(self, fitter: Fitter, config: SimulatorConfig, best: Fit, most: int | None = None) -> None:
        count = len(fitter.shots)
        if most is not None and count > most:
            few = np.unique(np.linspace(0, count - 1, most).round().astype(np.int64))
            fitter = Fitter(fitter.shots.take(few), fitter.scale)
        self.share = len(fitter.shots) / count
        self.fitter = fitter
        self.config = config
        self.best = best
        slopes, white = fitter.linear(best)
        self.white = white.reshape(-1)
        self.weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(np.abs(self.white), 1e-12)))
        jacobian = (slopes.reshape(len(best.free), len(self.white)) * self.weight).T
        prior = np.diag([1.0 / f.prior_z for f in best.free])
        basis, _ = np.linalg.qr(np.vstack([jacobian, prior]))
        self._inside = basis[: len(self.white)]
        self.residual = self.projected(self.white)

    def projected(self, change: FloatArray) -> FloatArray:
        """A change of the whitened errors (S, U, 6), flat, less what the free parameters could do themselves."""
        weighted = self.weight * change.reshape(-1)
        return np.asarray(weighted - self._inside @ (self._inside.T @ weighted))

    def promise(self, effect: str, free: Sequence[Free]) -> Promise:
        """Try the candidate at several sizes, signs and places."""
        config = with_effect(self.config, effect)
        points = self._points(config, effect, tuple(free))
        gains = np.full(len(points), -math.inf)
        along = np.zeros(len(points))
        for part in np.array_split(np.arange(len(points)), max(1, math.ceil(len(points) / _AT_A_TIME))):
            for k, moved in zip(part, self._moved(config, tuple(free), points[part]), strict=True):
                gains[k], along[k] = self.gain(moved)
        order = np.argsort(-gains)[:STARTS]
        order = order[gains[order] >= NEARLY * gains[order[0]]]
        scalable = np.array([not f.logarithmic and not f.choice for f in free])
        if effect == "tyre_saturation":
            scalable[:] = False
        elif effect == "wind":
            scalable = np.array([f.name.endswith(".speed") for f in free])
        elif effect == "low_friction_patch":
            scalable = np.array([f.name.endswith(".loss") for f in free])
        factor = np.clip(along[order], 0.3, 1.5)[:, None]
        starts = np.where(scalable, points[order] * factor, points[order])
        return Promise(effect, float(gains[order[0]]) / self.share, starts)

    def gain(self, moved: FloatArray) -> tuple[float, float]:
        """Fall of the loss along the way to the whitened errors ``moved`` (S, U, 6), and how far along it is best."""
        left = self.projected(np.clip(moved.reshape(-1) - self.white, -_CLIP, _CLIP))
        size = float(left @ left)
        slope = -float(left @ self.residual)
        along = min(max(slope / max(size, 1e-12), 0.0), 2.0)
        return along * slope - 0.5 * along**2 * size, along

    def _moved(self, config: SimulatorConfig, free: tuple[Free, ...], points: FloatArray) -> FloatArray:
        full = np.hstack([np.tile(self.best.z, (len(points), 1)), points])
        return self.fitter.white(config, (*self.best.free, *free), full)

    def _points(self, config: SimulatorConfig, effect: str, free: tuple[Free, ...]) -> FloatArray:
        """Coordinates (P, n) at which the candidate is tried."""
        if effect == "low_friction_patch":
            return _places(self.fitter.shots, free)
        if len(free) == 1 and not free[0].logarithmic:
            return self._sized(config, free, np.array([[1.0], [-1.0]] if free[0].low < free[0].origin else [[1.0]]))
        if effect == "marker_offset":
            angle = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
            return self._sized(config, free, np.stack([np.cos(angle), np.sin(angle)], axis=1))
        if effect == "road_slope":
            angle = np.linspace(-np.pi, np.pi, 8, endpoint=False)
            heading = np.array([free[1].coordinate(a) for a in angle])
            sized = self._sized(config, free, np.array([[1.0, heading[0]]]), held=(1,))[:, 0]
            return np.array([(s, h) for s in np.unique(sized) for h in heading])
        if effect == "wind":
            start = np.array([[1.0, 0.0, free[2].coordinate(WIND_COEFFICIENT)]])
            sized = self._sized(config, free, start, held=(1, 2))
            headings = [free[1].coordinate(a) for a in np.linspace(-np.pi, np.pi, 8, endpoint=False)]
            return np.array([(s, h, c) for s, _, c in sized for h in headings])
        if effect == "tyre_saturation":
            return _tyres(self.best.config, free)
        grids = np.meshgrid(*(_grid(f) for f in free), indexing="ij")
        return np.stack([g.ravel() for g in grids], axis=1)

    def _sized(
        self, config: SimulatorConfig, free: tuple[Free, ...], directions: FloatArray, held: tuple[int, ...] = ()
    ) -> FloatArray:
        """Directions (D, n) scaled so that the errors change by ``SIZES``; coordinates in ``held`` stay as they are."""
        scale = np.ones(len(free))
        moving = [k for k in range(len(free)) if k not in held]
        probe = directions.copy()
        probe[:, moving] *= _PROBE
        points = []
        for direction, moved in zip(directions, self._moved(config, free, probe), strict=True):
            change = np.clip(moved.reshape(-1) - self.white, -_CLIP, _CLIP)
            unit = _PROBE / max(float(np.sqrt(np.mean(change**2))), 1e-3 * _PROBE)
            for size in SIZES:
                point = direction * scale
                point[moving] *= size * unit
                low = np.array([f.coordinate(f.low) for f in free])
                high = np.array([f.coordinate(f.high) for f in free])
                points.append(np.clip(point, np.minimum(low, high), np.maximum(low, high)))
        return np.array(points)


def _grid(free: Free) -> FloatArray:
    if free.logarithmic:
        return np.array([math.log(r) / free.size for r in RATIOS])
    if free.choice:
        return np.arange(free.low, free.high + 1.0)
    signs = (1.0, -1.0) if free.low < free.origin else (1.0,)
    return np.array([s * sign for s in (0.3, 1.0, 3.0) for sign in signs])


def _places(shots: Shots, free: tuple[Free, ...]) -> FloatArray:
    """Discs over the ground that the shots drive on."""
    paths = shots.measured[:, :, :2].reshape(-1, 2)
    cells = np.unique(np.round(paths / PATCH_SPACING_M).astype(np.int64), axis=0) * PATCH_SPACING_M
    values = {"x": cells[:, 0], "y": cells[:, 1], "radius": PATCH_RADIUS_M, "loss": 0.1}
    columns = []
    for f in free:
        value = np.broadcast_to(np.asarray(values[f.name.rsplit(".", 1)[1]], dtype=np.float64), (len(cells),))
        columns.append([f.coordinate(float(v)) for v in value])
    return np.array(columns).T


def _tyres(config: SimulatorConfig, free: tuple[Free, ...]) -> FloatArray:
    """Saturating tyres of several grips with the stiffness B C mu that the linear ones have."""
    values = config.values()
    stiffness = {axle: math.prod(values[f"tyre.{axle}.{k}"] for k in ("B", "C", "mu")) for axle in ("front", "rear")}
    points = []
    for mu_front in TYRE_GRIPS:
        for mu_rear in TYRE_GRIPS:
            wanted = {"mu_front": mu_front, "mu_rear": mu_rear, "C_front": TYRE_SHAPE, "C_rear": TYRE_SHAPE}
            wanted["B_front"] = stiffness["front"] / (TYRE_SHAPE * mu_front)
            wanted["B_rear"] = stiffness["rear"] / (TYRE_SHAPE * mu_rear)
            points.append([f.coordinate(wanted[f.name.rsplit(".", 1)[1]]) for f in free])
    return np.array(points)


def usable(config: SimulatorConfig, effect: str) -> bool:
    """Whether the effect says anything new about this simulator."""
    if effect == "tyre_saturation":
        return config.kind != "dynamic"
    # Where tyres do not saturate, the loss of grip by roll would stand for that.
    return not (effect == "roll_dynamics" and config.kind == "linear_tyre")
