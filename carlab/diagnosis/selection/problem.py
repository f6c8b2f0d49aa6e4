"""Data of a search for missing effects: the problem, fitted models, candidates and the result."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.decisions import Alternatives, Decision, passes
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fit, Fitter, Linearisation
from carlab.diagnosis.identification.fit_parameters import (
    FitParameter,
    base_parameters,
    effect_parameters,
    tyre_effects,
    with_effect,
)
from carlab.diagnosis.identification.free_initial_states import loss_of_free_initial_states
from carlab.diagnosis.settings import DEFAULT, IDENTIFICATION, DiagnosisSettings
from carlab.jobs.function_workers import FunctionWorkers
from carlab.prediction.errors import simulation_errors
from carlab.prediction.windows import IndexArray, PredictionWindows
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE, EFFECTS, EffectParameter
from sim_backends.measurement import COMMAND_DELAY, LATENCY


@dataclass(frozen=True, slots=True)
class SearchProblem:
    """A simulator, prediction windows of recordings, and candidate effects.

    nominal       simulator of the car file; its effects keep their values, unless they are accepted as wrong
    windows       windows of the recordings to fit
    floor   (6,)  standard deviation of each channel's error of a perfect simulator, in SI units
    measured_std  standard deviations (6,) of the noise of the measured channels, in SI units
    confusable    confusable effects by effect id
    candidates    effects that may be accepted
    refits        models of earlier refits (``selection.refit``)
    """

    nominal: SimulatorConfig
    windows: PredictionWindows
    floor: FloatArray
    measured_std: FloatArray
    confusable: Mapping[str, Sequence[str]]
    candidates: tuple[str, ...] = field(default_factory=lambda: tuple(CATALOGUE))
    settings: DiagnosisSettings = DEFAULT
    refits: dict[Hashable, Model] = field(init=False, default_factory=dict, compare=False, repr=False)

    def __reduce__(self) -> tuple[type[SearchProblem], tuple[Any, ...]]:
        """Pickle without earlier refits, which another process does not need."""
        return SearchProblem, tuple(getattr(self, f.name) for f in fields(self) if f.init)

    def free_parameters(self, effects: Sequence[str]) -> tuple[FitParameter, ...]:
        """Free parameters of a fit with ``effects``."""
        base = base_parameters(self.nominal, uses_std=True)
        fitted = (*tyre_effects(self.nominal), *effects)
        return (*base, *(f for name in fitted for f in effect_parameters(name, self.nominal)))

    def fitter(self, scale: Scale) -> Fitter:
        """A fitter for the windows with an error scale."""
        return Fitter(self.windows, scale)

    def scale_of(self, config: SimulatorConfig, values: Mapping[str, FloatArray] | None = None) -> Scale:
        """Scale of the errors of a simulator on the windows, with other ``values`` (1,) by dotted name."""
        return Scale.of(simulation_errors(self.windows, config, values), self.floor)

    def config_with(self, effects: Sequence[str]) -> SimulatorConfig:
        """The simulator with ``effects`` added, at the values of the car file or else at their identity values.

        An effect of the car file that one of the added curves contains is omitted.
        """
        stated = self.nominal.effects
        config = replace(
            self.nominal,
            effects={e: stated[e] for e in stated if not set(EFFECTS[e].represented_by).intersection(effects)},
        )
        for name in effects:
            config = with_effect(config, name)
        return config

    def is_candidate(self, effect: str) -> bool:
        """Whether the effect may be accepted."""
        known = effect in self.candidates and effect not in tyre_effects(self.nominal)
        return known and is_applicable(self.nominal, effect)

    def folds(self) -> IndexArray:
        """Index of each window's fold (S,); the windows of a block are in one fold."""
        blocks = np.unique(self.windows.block)
        count = min(self.settings.selection.folds, max(len(blocks), 1))
        return np.asarray(np.searchsorted(blocks, self.windows.block) % count)

    def left_out_loss(self, fit: Fit, scale: Scale, linearisation: Linearisation | None = None) -> FloatArray:
        """Loss of each window (S,) by a fit without its fold; ``linearisation`` as in ``Fitter``."""
        limit = self.settings.selection.max_left_out_error
        return self.fitter(scale).leave_fold_out_loss(fit, self.folds(), limit, linearisation)

    def left_out_loss_of_free_states(
        self, fit: Fit, scale: Scale, linearisation: Linearisation | None = None
    ) -> FloatArray:
        """Loss as ``left_out_loss``, at the initial state of each window that minimises it."""
        z = self.fitter(scale).leave_fold_out_coordinates(fit, self.folds(), linearisation)
        limit = self.settings.selection.max_left_out_error
        return loss_of_free_initial_states(self.windows, fit.config, fit.free, z, self.measured_std, max_error=limit)

    def excess_of(self, scale: Scale) -> float:
        """Mean squared error of a model with this scale in noise floors, less that of a perfect simulator."""
        return float(np.mean((scale.sigma / self.floor) ** 2)) - 1.0

    def perfect_loss(self) -> float:
        """Expected loss of a perfect simulator: one half for each whitened error."""
        return 0.5 * len(self.windows) * 6 * IDENTIFICATION.loss_steps

    def required_chi2(self, effect: str) -> float:
        """Minimum chi2 of an effect; it grows with the number of parameters and for an infinite identity value."""
        settings = self.settings.selection
        numbers = numbers_of(effect)
        infinite = any(map(has_infinite_identity, numbers))
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

    gain                 fall of the loss on the windows that are fitted
    chi2                 twice the gain over its design effect
    left_out_gain        fall of the loss on left-out blocks in cross-validation; -inf if not tested
    left_out_gain_error  its clustered standard error
    left_out_loss        of each window (S,), by the fit without its fold; empty if not tested
    """

    effect: str
    fit: Fit
    gain: float
    chi2: float = 0.0
    left_out_gain: float = -math.inf
    left_out_gain_error: float = math.inf
    left_out_loss: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def is_tested(self) -> bool:
        """Whether it was tested on left-out blocks."""
        return len(self.left_out_loss) > 0

    @property
    def standard_errors(self) -> float:
        """Gain on left-out blocks in standard errors."""
        return self.left_out_gain / self.left_out_gain_error if math.isfinite(self.left_out_gain_error) else 0.0


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Result of a search.

    base               refit without effects
    best               fit with the accepted effects
    effects            accepted, the strongest first
    chi2               chi2 of the removal of each accepted effect from ``best``
    indistinguishable  effects that left-out blocks do not distinguish from each accepted effect
    history            (effect, fit) in the order of acceptance
    first_candidates   candidates for the first effect
    scale              error scale of ``best``
    is_complete        whether the search ended by itself and was not cut short
    """

    base: Fit
    best: Fit
    effects: tuple[str, ...]
    chi2: Mapping[str, float]
    indistinguishable: Mapping[str, tuple[str, ...]]
    history: tuple[tuple[str, Fit], ...]
    first_candidates: tuple[Candidate, ...]
    scale: Scale
    is_complete: bool = True

    @property
    def model(self) -> Model:
        """The accepted effects, their fit and its scale."""
        return Model(self.effects, self.best, self.scale)

    @property
    def possible_effects(self) -> tuple[str, ...]:
        """The accepted effects and those that are indistinguishable from them."""
        return (*self.effects, *(other for name in self.effects for other in self.indistinguishable.get(name, ())))

    def without_effects(self) -> SearchResult:
        """The result with no accepted effect."""
        return replace(self, best=self.base, effects=(), chi2={}, indistinguishable={}, history=())


@dataclass(frozen=True, slots=True)
class RunControl:
    """Callbacks of a run.

    progress    called with the activity and the completed share in [0, 1]
    stop        called between fits; if it returns true, a stage ends with its present result
    record      called with each decision about an effect
    omit        called with the name of a requested stage that ``stop`` ended without a result
    ends_search called between fits of the search; if it returns true, no further effect is added, but all checks of the
                accepted effects follow
    workers     processes that share independent fits
    """

    progress: Callable[[str, float], None] = lambda activity, share: None
    stop: Callable[[], bool] = lambda: False
    record: Callable[[Decision], None] = lambda decision: None
    omit: Callable[[str], None] = lambda stage: None
    ends_search: Callable[[], bool] = lambda: False
    workers: FunctionWorkers = field(default_factory=FunctionWorkers)

    def part(self, first: float, last: float, label: str = "") -> RunControl:
        """The control of a part of the run, from progress ``first`` to ``last``; ``label`` precedes its activities."""

        def progress(activity: str, share: float) -> None:
            self.progress(f"{label}{activity}", first + (last - first) * share)

        return replace(self, progress=progress)

    def are_confirmed(self, effects: Sequence[str], alternatives: Alternatives, count: int) -> bool:
        """Whether one of the alternatives holds for accepted effects (of ``count``); records this for each of them."""
        confirmed = passes(alternatives)
        for name in effects:
            self.record(Decision("confirm", name, alternatives, confirmed, count))
        return confirmed


def numbers_of(effect: str) -> list[EffectParameter]:
    """Parameters of an effect that are numbers, not choices."""
    return [p for p in EFFECTS[effect].parameters if not p.choices]


def has_infinite_identity(parameter: EffectParameter) -> bool:
    """Whether the effect is absent at an infinite value, as a limit is."""
    return parameter.identity is not None and math.isinf(parameter.identity)


def is_applicable(config: SimulatorConfig, effect: str) -> bool:
    """Whether the effect can be identified with this base model and its free parameters."""
    of_unknown = any(p.same_as in config.unknown for p in EFFECTS[effect].parameters)
    if COMMAND_DELAY in config.unknown and delays_all_commands(effect):
        return False
    return config.kind in EFFECTS[effect].base_models and not of_unknown


def delays_all_commands(effect: str) -> bool:
    """Whether the effect has the influence of the command delay; a latency of motion capture has it too."""
    return any(p.reduces == COMMAND_DELAY or p.same_as == LATENCY for p in EFFECTS[effect].parameters)
