"""What a search for missing effects works on, and the fitted models that its stages hand on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.decisions import Decision
from carlab.diagnosis.identification.fit import (
    Fit,
    FitParameter,
    Fitter,
    Scale,
    base_parameters,
    effect_parameters,
    with_effect,
)
from carlab.diagnosis.settings import DEFAULT, DiagnosisSettings
from carlab.prediction.windows import IndexArray, PredictionWindows
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE, EFFECTS


@dataclass(frozen=True, slots=True)
class SearchProblem:
    """A simulator that lacks effects, and prediction windows that show it.

    nominal       the car file's simulator; its own effects stay, with their numbers fitted
    windows       of the recordings to fit
    floor   (6,)  standard deviation of each channel's error that a perfect simulator would leave
    confusable    by effect id, the effects that may be taken for it
    candidates    effects that may be accepted
    """

    nominal: SimulatorConfig
    windows: PredictionWindows
    floor: FloatArray
    confusable: Mapping[str, Sequence[str]]
    candidates: tuple[str, ...] = field(default_factory=lambda: tuple(CATALOGUE))
    settings: DiagnosisSettings = DEFAULT

    def free_parameters(self, effects: Sequence[str]) -> tuple[FitParameter, ...]:
        """The numbers that a fit with ``effects`` moves."""
        own = [f for name in self.nominal.effects for f in effect_parameters(name, self.nominal)]
        added = [f for name in effects for f in effect_parameters(name, self.nominal)]
        return (*base_parameters(self.nominal, self.settings.identification), *own, *added)

    def fitter(self, scale: Scale) -> Fitter:
        """A fitter of the windows with a scale of errors."""
        return Fitter(self.windows, scale, self.settings.identification)

    def config_with(self, effects: Sequence[str]) -> SimulatorConfig:
        """The simulator with ``effects`` switched on at their identities."""
        config = self.nominal
        for name in effects:
            config = with_effect(config, name)
        return config

    def nominal_coordinates(self, free: Sequence[FitParameter]) -> FloatArray:
        """Coordinates of ``free`` at the car file's numbers; 0 where it has none."""
        values = self.nominal.values()
        return np.array([f.coordinate(values[f.name]) if f.name in values else 0.0 for f in free])

    def is_candidate(self, effect: str) -> bool:
        """Whether the effect may be accepted at all."""
        known = effect in self.candidates and effect not in self.nominal.effects
        return known and is_applicable(self.nominal, effect)

    def folds(self) -> IndexArray:
        """Number of each window's fold (S,); windows of a block share it."""
        blocks = np.unique(self.windows.block)
        count = min(self.settings.selection.folds, max(len(blocks), 1))
        return np.asarray(np.searchsorted(blocks, self.windows.block) % count)

    def perfect_loss(self) -> float:
        """Expected loss of a perfect simulator: one half for each whitened error."""
        return 0.5 * len(self.windows) * 6 * self.settings.identification.loss_steps

    def required_chi2(self, effect: str) -> float:
        """What an effect's chi2 must exceed: more for more numbers and for an infinite identity."""
        settings = self.settings.selection
        numbers = [p for p in EFFECTS[effect].parameters if not p.choices]
        infinite = any(p.identity is not None and math.isinf(p.identity) for p in numbers)
        return settings.accept_chi2_min + settings.accept_chi2_per_number * (len(numbers) - 1 + infinite)


@dataclass(frozen=True, slots=True)
class Model:
    """A fit with ``effects`` added to the nominal simulator, and the scale of its errors."""

    effects: tuple[str, ...]
    fit: Fit
    scale: Scale


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect added to a model.

    gain            fall of the loss on the windows that are fitted
    chi2            twice the gain over its design effect
    unseen_gain     fall of the loss on blocks that are not fitted; -inf where not tested
    unseen_error    its clustered standard error
    unseen_loss     of each window (S,); empty where not tested
    """

    effect: str
    fit: Fit
    gain: float
    chi2: float = 0.0
    unseen_gain: float = -math.inf
    unseen_error: float = math.inf
    unseen_loss: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def is_tested(self) -> bool:
        """Whether it was tested on unseen blocks."""
        return len(self.unseen_loss) > 0

    @property
    def standard_errors(self) -> float:
        """Unseen gain in standard errors."""
        return self.unseen_gain / self.unseen_error if math.isfinite(self.unseen_error) else 0.0


@dataclass(frozen=True, slots=True)
class SearchResult:
    """What a search found.

    base      refit without effects
    best      fit with the accepted effects
    effects   accepted, the strongest first
    chi2      of each accepted effect when it is removed from ``best``
    rivals    effects that unseen blocks do not distinguish from each accepted effect
    history   (effect, fit) in the order of acceptance
    tried     candidates for the first effect
    scale     of the errors of ``best``
    """

    base: Fit
    best: Fit
    effects: tuple[str, ...]
    chi2: Mapping[str, float]
    rivals: Mapping[str, tuple[str, ...]]
    history: tuple[tuple[str, Fit], ...]
    tried: tuple[Candidate, ...]
    scale: Scale

    @property
    def model(self) -> Model:
        """The accepted effects, their fit and its scale."""
        return Model(self.effects, self.best, self.scale)

    def without_effects(self) -> SearchResult:
        """The same search where no effect is accepted."""
        return replace(self, best=self.base, effects=(), chi2={}, rivals={}, history=())


@dataclass(frozen=True, slots=True)
class RunControl:
    """Who is informed of a run, and who ends it.

    progress    called with the activity and the share that is done, in [0, 1]
    stop        asked between fits; once true, a stage ends with what it has
    record      called with each decision about a name
    """

    progress: Callable[[str, float], None] = lambda activity, share: None
    stop: Callable[[], bool] = lambda: False
    record: Callable[[Decision], None] = lambda decision: None


def is_applicable(config: SimulatorConfig, effect: str) -> bool:
    """Whether the effect can be identified beside this simulator's base model and what a fit estimates of it."""
    of_unknown = any(p.same_as in config.unknown for p in EFFECTS[effect].parameters)
    return config.kind in EFFECTS[effect].base_models and not of_unknown


__all__ = ["Candidate", "Model", "RunControl", "SearchProblem", "SearchResult", "is_applicable"]
