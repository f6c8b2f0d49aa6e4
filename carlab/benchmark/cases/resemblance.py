"""How much of an unknown effect's influence a single effect of the catalogue can imitate.

The influence is the mean residual acceleration over blocks of 0.3 s along one noise-free drive: what an effect adds to
the rates of vx, vy and yaw rate, divided by their noise floors. What base parameters can imitate is projected out. The
resemblance to an effect of the catalogue is the share of the remaining squares that a least-squares combination of the
effect's own influences explains (R squared), at two sizes and several directions and places.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from carlab.benchmark.effects.catalogue import EFFECT_IDS, Draw, Form, Parameters
from carlab.benchmark.effects.forms import all_forms
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.measurement import body_velocity
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import Drive, FloatArray, rates_along

BLOCK_S = 0.3
PARAMETER_STEP = 0.02
SIZES = (1.0, 4.0)
"""Sizes of an effect of the catalogue, in typical sizes (excess about 1 and 4)."""
SHARES = (0.1, 0.35, 0.6, 0.85)
"""Random shares of the compared draws: directions a quarter turn apart, four places."""
VELOCITY_WINDOW_ROWS = 9
"""Captures of the local parabola that differentiates a changed pose."""
COVERED_BY_PARAMETERS = ("tyre_saturation",)
"""Effects that change the shape of a tyre curve, as B, C and mu do."""


@dataclass(frozen=True)
class Resemblance:
    """The effect of the catalogue that imitates an influence best, and the share of squares that it explains."""

    effect: str
    share: float


class CatalogueInfluence:
    """Influences of base parameters and of all effects of the catalogue along one drive.

    Args:
        car: The car of the drive.
        driven: Noise-free drive of this car without effects.
        places: Points of its track (N, 2).
        floor: Noise floors of vx, vy and yaw rate (3,).
    """

    def __init__(self, car: BaseCar, driven: Drive, places: FloatArray, floor: FloatArray) -> None:
        self._car, self._driven, self._floor = car, driven, floor
        self._rates = rates_along(World(car), driven)
        base = np.stack([self._of_parameter(name) for name in car.free()], axis=1)
        self._base = np.linalg.qr(base / np.maximum(np.linalg.norm(base, axis=0), 1e-12))[0]
        self._effects = {
            form.id: np.linalg.qr(self._columns(form, places))[0]
            for form in _one_form_each()
            if form.id not in COVERED_BY_PARAMETERS
        }

    def of(self, form: Form, parameters: Parameters) -> FloatArray:
        """Influence of an effect with the part that base parameters can imitate projected out (3 K,)."""
        world = World(self._car)
        form.attach(world, parameters)
        dynamic = rates_along(world, self._driven) - self._rates
        influence = self._blocks(dynamic + self._observed(world))
        return np.asarray(influence - self._base @ (self._base.T @ influence), dtype=np.float64)

    def closest(self, influence: FloatArray) -> Resemblance:
        """The effect of the catalogue that explains most of an influence (3 K,) from ``of``."""
        total = float(influence @ influence)
        shares = {name: float(((q.T @ influence) ** 2).sum()) / total for name, q in self._effects.items()}
        name = max(shares, key=lambda effect: shares[effect])
        return Resemblance(name, shares[name])

    def _columns(self, form: Form, places: FloatArray) -> FloatArray:
        drawn: list[dict[str, float]] = []
        for k, share in enumerate(SHARES):
            place = places[k * len(places) // len(SHARES)]
            draw = Draw(self._car, 1.0, (share, share, share), (float(place[0]), float(place[1])))
            for size in SIZES:
                parameters = form.sized(min(max(size * form.typical, form.smallest), form.largest), draw)
                drawn += [] if parameters in drawn else [parameters]
        columns = np.stack([self.of(form, parameters) for parameters in drawn], axis=1)
        lengths = np.linalg.norm(columns, axis=0)
        return np.asarray(columns[:, lengths > 0.0] / lengths[lengths > 0.0], dtype=np.float64)

    def _of_parameter(self, name: str) -> FloatArray:
        values = self._car.free()
        moved = self._car.with_free({**values, name: (1.0 + PARAMETER_STEP) * values[name]})
        return self._blocks(rates_along(World(moved), self._driven) - self._rates)

    def _observed(self, world: World) -> FloatArray | float:
        """Apparent accelerations of changed observations (K, 3): d/dt v' - f(v') less the same without a change."""
        if not (world.pose_changes or world.velocity_changes or world.extra_latency_s):
            return 0.0
        t, states = self._driven.capture_s, self._driven.captures
        gap = float(t[1] - t[0])
        late = np.stack([np.interp(t - world.extra_latency_s, t, column) for column in states.T], axis=1)
        pose = late[:, :3]
        for change in world.pose_changes:
            pose = change(t, pose)
        velocity = (
            late[:, 3:]
            + body_velocity(pose, gap, VELOCITY_WINDOW_ROWS)
            - body_velocity(late[:, :3], gap, VELOCITY_WINDOW_ROWS)
        )
        for change in world.velocity_changes:
            velocity = change(t, velocity)
        seen = dataclasses.replace(self._driven, captures=np.concatenate([pose, velocity], axis=1))
        apparent = np.gradient(velocity - states[:, 3:], gap, axis=0)
        return np.asarray(apparent - rates_along(World(self._car), seen) + self._rates)

    def _blocks(self, accelerations: FloatArray) -> FloatArray:
        gap = float(self._driven.capture_s[1] - self._driven.capture_s[0])
        length = round(BLOCK_S / gap)
        count = len(accelerations) // length
        means = accelerations[: count * length].reshape(count, length, 3).mean(axis=1)
        return np.asarray((means / self._floor).ravel(), dtype=np.float64)


def _one_form_each() -> Sequence[Form]:
    """The catalogue's form of each effect, or its other form."""
    known = all_forms()
    return [known.get((name, "catalogue")) or known[(name, "other")] for name in EFFECT_IDS]
