"""Car, track, driver and noise of a case, driven with any concealed effects, and the search for a strength."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from carlab.benchmark.cases.refit import Refit, Windows, cut_windows, refit
from carlab.benchmark.cases.resemblance import SIZES, CatalogueInfluence, Resemblance
from carlab.benchmark.effects.catalogue import Draw, Form
from carlab.benchmark.world.base_car import draw_nominal
from carlab.benchmark.world.driver import HumanDriver, Track
from carlab.benchmark.world.measurement import Noise, Recording, record
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import Drive, drive
from carlab.core.errors import DataError

MAX_TRIALS, STRENGTH_TOLERANCE = 8, 0.10
"""Maximum number of trials and relative tolerance of the search for a strength."""
MAX_RESEMBLANCE = 0.5
"""Random physics is drawn again if one effect of the catalogue explains a larger share of it. Other forms of an effect
reach 0.88 to 1.0 with their own effect."""
MAX_DRAWS = 30
RESEMBLANCE_DRIVE_S = 20.0


@dataclass(frozen=True)
class Concealed:
    """A concealed effect of the true car; random physics with its resemblance to the catalogue."""

    form: Form
    parameters: dict[str, float]
    resemblance: Resemblance | None = None


Driven = tuple[Refit, tuple[Recording, ...], Windows]
"""Refit, recordings and held-out windows of one set of concealed effects."""


class Scene:
    """Random draws of a case that do not depend on the strength; it can be driven with any effects.

    With ``is_null`` the true car is the nominal car; otherwise its base parameters differ.
    """

    def __init__(
        self,
        seed: int,
        model: Literal["dynamic", "linear_tyre"],
        lengths_s: tuple[float, float],
        period_s: float,
        feedback_only: bool = False,
        is_null: bool = False,
    ) -> None:
        draws = np.random.default_rng((seed, 1))
        self.nominal = draw_nominal(draws, period_s, model)
        moved = self.nominal.perturbed(draws)
        self.car = self.nominal if is_null else moved
        self.track = Track(draws)
        self.noise = Noise(self.nominal.position_std, self.nominal.yaw_std, float(draws.choice((0.06, 0.075, 0.09))))
        self.seed, self.lengths_s = seed, lengths_s
        self.draws, self.feedback_only = draws, feedback_only
        self._last: tuple[tuple[Concealed, ...], Driven] | None = None

    def human(self, part: int) -> HumanDriver:
        """The driver of a recording (0: to fit, 1: held out)."""
        rng = np.random.default_rng((self.seed, 2, part))
        return HumanDriver(self.car, self.track, rng, feedback_only=self.feedback_only)

    def drive(self, concealed: Sequence[Concealed]) -> Driven:
        """Drive both recordings with the effects; returns the refit, the recordings and the held-out windows.

        The last result is stored: a case of one effect is driven again with the size of the last trial.
        """
        if self._last is None or self._last[0] != tuple(concealed):
            self._last = tuple(concealed), self._drive(concealed)
        return self._last[1]

    def _drive(self, concealed: Sequence[Concealed]) -> Driven:
        recordings: list[Recording] = []
        windows: list[Windows] = []
        for part, length_s in enumerate(self.lengths_s):
            world = World(self.car)
            changes_car_first = sorted(concealed, key=lambda c: not c.form.changes_car)
            for c in changes_car_first:
                c.form.attach(world, c.parameters)
            human = self.human(part)
            what = drive(world, human, length_s, start=human.start())
            recordings.append(record(what, world, self.noise, np.random.default_rng((self.seed, 3, part))))
            windows.append(cut_windows(recordings[-1], self.car))
        fitted = refit(windows[0], windows[1], self.nominal)
        return fitted, tuple(recordings), windows[1]

    def sized(self, form: Form, target: float) -> tuple[Concealed, float]:
        """Scale the effect until its excess is ``target``, or as near as possible. Returns it and its excess.

        Raises:
            DataError: the car cannot be driven with any size, or every draw resembles the catalogue.
        """
        draw, resemblance = self._draw(form)
        low, high, best, best_miss, best_excess = 0.0, math.inf, None, math.inf, 0.0
        size, last = min(max(form.typical * target, form.smallest), form.largest), (0.0, 0.0)
        for _ in range(MAX_TRIALS):
            candidate = Concealed(form, form.sized(size, draw), resemblance)
            try:
                ratio = self.drive([candidate])[0].excess / target
            except DataError:
                ratio = math.inf
            miss = abs(math.log(max(ratio, 1e-3))) if math.isfinite(ratio) else math.inf
            if miss < best_miss:
                best, best_miss, best_excess = candidate, miss, ratio * target
            if (
                miss < STRENGTH_TOLERANCE
                or (ratio < 1.0 and size >= form.largest)
                or (ratio > 1.0 and size <= form.smallest)
            ):
                break
            low, high = (size, high) if ratio < 1.0 else (low, min(high, size))
            slope = 1.0
            if math.isfinite(ratio) and ratio > 0.05 and last[1] > 0.05 and size != last[0]:
                slope = min(max(math.log(ratio / last[1]) / math.log(size / last[0]), 0.3), 4.0)
            last = (size, ratio if math.isfinite(ratio) else 0.0)
            usable = min(max(ratio, 0.05), 20.0)
            size *= min(max(usable ** (-1.0 / slope), 0.2), 5.0)
            if size <= low or size >= high:
                size = math.sqrt(low * high) if low > 0.0 else 0.3 * high
            size = min(max(size, form.smallest), form.largest)
        if best is None:
            raise DataError(
                f"The car cannot be driven with {form.id} of any size at seed {self.seed}; use another seed."
            )
        return best, best_excess

    def _draw(self, form: Form) -> tuple[Draw, Resemblance | None]:
        """Random draws of a form; random physics is drawn until it is unlike every effect of the catalogue."""
        draw = Draw.from_rng(self.draws, self.car, self.track.points)
        if form.form != "random":
            return draw, None
        for _ in range(MAX_DRAWS):
            found = self._resemblance(form, draw)
            if found.share <= MAX_RESEMBLANCE:
                return draw, found
            draw = Draw.from_rng(self.draws, self.car, self.track.points)
        raise DataError(f"All of {MAX_DRAWS} draws of {form.id} resemble the catalogue; use another seed.")

    def _resemblance(self, form: Form, draw: Draw) -> Resemblance:
        """The larger resemblance of a weak and a strong size."""
        influences = [self._catalogue.of(form, form.sized(size * form.typical, draw)) for size in SIZES]
        return max((self._catalogue.closest(influence) for influence in influences), key=lambda found: found.share)

    @cached_property
    def _catalogue(self) -> CatalogueInfluence:
        human = self.human(0)
        driven: Drive = drive(World(self.car), human, RESEMBLANCE_DRIVE_S, start=human.start())
        floor = self.drive(())[2].floor[3:]
        return CatalogueInfluence(self.car, driven, self.track.points, floor)
