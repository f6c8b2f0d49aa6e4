"""Score test of every candidate effect before its fit, with the free parameters projected out.

A candidate at a finite size changes the errors by a secant g. The Jacobian of the free parameters is projected out of
g, as in a score test (Rao 1948). The sizes are finite because a dead band or a clipped force has no slope at its
identity value. Sizes are chosen by the change of the errors that they cause, not by a typical size of the effect.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.bounded_step import coordinate_bounds
from carlab.diagnosis.identification.error_scale import huber_weight
from carlab.diagnosis.identification.fit import Fit, Fitter
from carlab.diagnosis.identification.fit_parameters import FitParameter, effect_parameters, with_effect
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem
from carlab.diagnosis.settings import SCREENING, ScreeningSettings
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS


@dataclass(frozen=True, slots=True)
class ScreeningResult:
    """A candidate's screening score and initial points.

    score           predicted fall of the loss over all windows
    starts  (k, n)  coordinates to start its fit from, the best first
    """

    effect: str
    score: float
    starts: FloatArray


class Screen:
    """Screens candidates that are added to the fit ``best`` of ``config``.

    Args:
        fitter: windows and scale.
        config: simulator with the effects of ``best``.
        best: fit to which candidates are added.
        max_windows: maximum number of windows, thinned evenly; scores refer to all windows. Default: all.
        settings: settings of the screening.
    """

    def __init__(
        self,
        fitter: Fitter,
        config: SimulatorConfig,
        best: Fit,
        max_windows: int | None = None,
        settings: ScreeningSettings = SCREENING,
    ) -> None:
        count = len(fitter.windows)
        if max_windows is not None:
            fitter = Fitter(fitter.windows.thinned(max_windows), fitter.scale)
        self.settings = settings
        self.share = len(fitter.windows) / count
        self.fitter = fitter
        self.config = config
        self.best = best
        slopes, white = fitter.linearised(best)
        self.white = white.reshape(-1)
        self.weight = np.sqrt(huber_weight(self.white))
        jacobian = (slopes.reshape(len(best.free), len(self.white)) * self.weight).T
        prior = np.diag([1.0 / f.prior_z for f in best.free])
        basis, _ = np.linalg.qr(np.vstack([jacobian, prior]))
        self._inside = basis[: len(self.white)]
        self.residual = self.projected(self.white)

    def projected(self, change: FloatArray) -> FloatArray:
        """A change of the whitened errors (S, U, 6), flat, with the span of the free parameters projected out."""
        weighted = self.weight * change.reshape(-1)
        return np.asarray(weighted - self._inside @ (self._inside.T @ weighted))

    def score(self, effect: str) -> ScreeningResult:
        """Score of a candidate: the maximum over its sizes, signs and places."""
        settings, free = self.settings, effect_parameters(effect, self.config)
        config = with_effect(self.config, effect)
        points = self.points(effect, free)
        gains = np.full(len(points), -math.inf)
        along = np.zeros(len(points))
        for part in np.array_split(np.arange(len(points)), max(1, math.ceil(len(points) / settings.batch_size))):
            for k, moved in zip(part, self._moved(config, free, points[part]), strict=True):
                gains[k], along[k] = self.gain(moved)
        order = np.argsort(-gains)[: settings.max_starts]
        order = order[gains[order] >= settings.min_start_score_share * gains[order[0]]]
        scalable = np.array([not f.logarithmic and not f.choice for f in free])
        if (scaled := EFFECTS[effect].screening_scaled) is not None:
            scalable = np.array([f.name.rpartition(".")[2] in scaled for f in free])
        factor = np.clip(along[order], *settings.step_range)[:, None]
        low, high = coordinate_bounds(free)
        starts = np.where(scalable, points[order] * factor, points[order]).clip(low, high)
        return ScreeningResult(effect, float(gains[order[0]]) / self.share, starts)

    def gain(self, moved: FloatArray) -> tuple[float, float]:
        """Fall of the loss along the secant to the whitened errors ``moved`` (S, U, 6), and the best step along it."""
        secant = self.projected(self._change(moved))
        size = float(secant @ secant)
        slope = -float(secant @ self.residual)
        along = min(max(slope / max(size, 1e-12), 0.0), self.settings.max_step)
        return along * slope - 0.5 * along**2 * size, along

    def _moved(self, config: SimulatorConfig, free: tuple[FitParameter, ...], points: FloatArray) -> FloatArray:
        full = np.hstack([np.tile(self.best.z, (len(points), 1)), points])
        return self.fitter.white(config, (*self.best.free, *free), full)

    def points(self, effect: str, free: Sequence[FitParameter]) -> FloatArray:
        """Coordinates (P, n) at which the candidate is evaluated."""
        config, free = with_effect(self.config, effect), tuple(free)
        own = EFFECTS[effect].screening_points(_Probe(self, config, free))
        if effect in self.config.effects:
            around = self._around_stated(config, free)
            return around if own is None else np.vstack([own, around])
        if own is not None:
            return own
        if len(free) == 1 and not free[0].logarithmic:
            return self.sized(config, free, np.array([[1.0], [-1.0]] if free[0].low < free[0].origin else [[1.0]]))
        grids = np.meshgrid(*(_grid(f, self.settings) for f in free), indexing="ij")
        return np.stack([g.ravel() for g in grids], axis=1)

    def _around_stated(self, config: SimulatorConfig, free: tuple[FitParameter, ...]) -> FloatArray:
        """Points (P, n) to both sides of each number that the car file states; choices stay."""
        choices = tuple(k for k, f in enumerate(free) if f.choice)
        axes = np.delete(np.eye(len(free)), choices, axis=0)
        return self.sized(config, free, np.vstack([axes, -axes]), choices)

    def sized(
        self,
        config: SimulatorConfig,
        free: tuple[FitParameter, ...],
        directions: FloatArray,
        held: tuple[int, ...] = (),
    ) -> FloatArray:
        """Directions (D, n) scaled to the settings' changes of the errors; coordinates in ``held`` are not scaled."""
        settings = self.settings
        is_scaled = np.array([k not in held for k in range(len(free))])
        probes = _points_along(free, directions, is_scaled, np.tile(settings.probe_sizes, (len(directions), 1)))
        moved = self._moved(config, free, probes.reshape(-1, len(free)))
        changes = np.array([np.sqrt(np.mean(self._change(each) ** 2)) for each in moved]).reshape(probes.shape[:2])
        wanted = np.array(settings.error_rms_changes)
        sizes = [
            size_of_change(wanted, *each, settings.probe_exponents)
            for each in zip(_sizes_along(probes, directions, is_scaled), changes, strict=True)
        ]
        return _points_along(free, directions, is_scaled, np.array(sizes)).reshape(-1, len(free))

    def _change(self, moved: FloatArray) -> FloatArray:
        """Clipped change (S U 6,) to the whitened errors ``moved`` (S, U, 6)."""
        limit = self.settings.max_whitened_change
        return np.asarray(np.clip(moved.reshape(-1) - self.white, -limit, limit))


def _points_along(
    free: Sequence[FitParameter], directions: FloatArray, is_scaled: NDArray[np.bool_], sizes: FloatArray
) -> FloatArray:
    """Points (D, W, n) along each of the directions (D, n) at its sizes (D, W), within the bounds of the parameters."""
    low, high = coordinate_bounds(free)
    return np.where(is_scaled, sizes[:, :, None] * directions[:, None], directions[:, None]).clip(low, high)


def _sizes_along(points: FloatArray, directions: FloatArray, is_scaled: NDArray[np.bool_]) -> FloatArray:
    """Sizes (D, W) of points (D, W, n) along their directions (D, n); smaller than intended at a bound."""
    steps = np.where(is_scaled & (directions != 0.0), directions, np.inf)
    return np.asarray(np.abs(points / steps[:, None]).max(axis=2))


def size_of_change(
    wanted: FloatArray, sizes: FloatArray, changes: FloatArray, exponents: tuple[float, float]
) -> FloatArray:
    """Sizes (W,) that cause the changes ``wanted`` (W,), by power laws between known sizes (K,) and changes (K,).

    Beyond the known sizes the exponent is that of the nearest two, within the bounds ``exponents``. Sizes may be equal
    at a bound of a parameter; changes are taken as not decreasing.
    """
    order = 1e-9 * np.arange(len(sizes))
    x = np.log(np.maximum(sizes, 1e-9)) + order
    y = np.log(np.maximum.accumulate(np.maximum(changes, 1e-6))) + order
    first, last = np.clip([(y[k + 1] - y[k]) / (x[k + 1] - x[k]) for k in (0, -2)], *exponents)
    at = np.log(wanted)
    inside = np.interp(at, y, x)
    below, above = x[0] + (at - y[0]) / first, x[-1] + (at - y[-1]) / last
    return np.asarray(np.exp(np.where(at < y[0], below, np.where(at > y[-1], above, inside))))


def _grid(free: FitParameter, settings: ScreeningSettings) -> FloatArray:
    if free.logarithmic:
        return np.array([math.log(r) / free.size for r in settings.typical_size_ratios])
    if free.choice:
        return np.arange(free.low, free.high + 1.0) - free.origin
    signs = (1.0, -1.0) if free.low < free.origin else (1.0,)
    return np.array([s * sign for s in (0.3, 1.0, 3.0) for sign in signs])


class _Probe:
    """Implements ``ScreeningProbe``: a screen in the effect's parameter values instead of coordinates."""

    def __init__(self, screen: Screen, config: SimulatorConfig, free: tuple[FitParameter, ...]) -> None:
        self._screen, self._config, self._free = screen, config, free
        self._names = [f.name.rpartition(".")[2] for f in free]

    @property
    def values(self) -> Mapping[str, float]:
        return self._screen.best.config.values()

    @property
    def path_m(self) -> FloatArray:
        return self._screen.fitter.windows.measured[:, :, :2].reshape(-1, 2)

    def points(self, rows: Iterable[Mapping[str, float]]) -> FloatArray:
        pairs = list(zip(self._names, self._free, strict=True))
        return np.array([[f.coordinate(float(row[name])) for name, f in pairs] for row in rows])

    def sized(self, directions: Iterable[Mapping[str, float]], held: Sequence[str] = ()) -> list[dict[str, float]]:
        pairs = list(zip(self._names, self._free, strict=True))
        steps = [[f.coordinate(row[name]) if name in held else row[name] for name, f in pairs] for row in directions]
        still = tuple(k for k, name in enumerate(self._names) if name in held)
        sized = self._screen.sized(self._config, self._free, np.array(steps), still)
        return [{name: float(f.value(np.array(z))) for (name, f), z in zip(pairs, p, strict=True)} for p in sized]


def screen_of(problem: SearchProblem, model: Model) -> Screen:
    """The screen of candidates that are added to a model."""
    config = problem.config_with(model.effects)
    return Screen(problem.fitter(model.scale), config, model.fit, SCREENING.max_windows)


def screen_candidates(
    problem: SearchProblem, model: Model, names: Sequence[str], control: RunControl
) -> tuple[ScreeningResult, ...]:
    """Screening scores of effects added to a model, the highest first."""
    screen = screen_of(problem, model)
    scored = control.workers.map(screen.score, [(name,) for name in names])
    return tuple(sorted((each for each in scored if each is not None), key=lambda result: -result.score))
