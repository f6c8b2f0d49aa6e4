"""Simulated cars drawn from a prior over parameters and plausible effects, for rollouts of a policy.

Each car has the parameters of the prior simulator (``CarModel.parameters``), a further spread of those without an
estimate, and a few effects of the catalogue that the prior does not have. The prior alone assumes that no such effect
exists, so the returns that it predicts are too similar.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from carlab.core.angles import wrap
from carlab.core.episode_data import EpisodeData
from carlab.core.observation import decode_history, decode_state, encode, push_action
from learning.priors.simulator_model import CarModel, known_ranges
from learning.rollouts import StatelessModel
from learning.transitions import whole_steps
from sim_backends.array_ops import FLOATS
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE, Effect
from sim_backends.measurement import COMMAND_DELAY, LATENCY, MeasurementModel
from sim_backends.registry import REGISTRY

HISTORY = 8
"""Minimum number of past commands from which hidden states (delays, lags) of a drawn car follow."""
MEAN_EFFECTS = 1.5
"""Mean number of unknown effects of a car."""
MEAN_SIZE = 1.5
"""Mean size of an unknown effect in typical sizes (exponential distribution)."""
PARAMETER_SPREAD = 0.15
"""Standard deviation of the logarithm of a parameter without an estimate, in addition to its range."""
WINDOW_TICKS, MAX_WINDOWS = 24, 24
"""Length and number of the recorded windows that select cars."""
MAX_ERROR = 10.0
"""Bound of an error of a window, in median errors of all cars."""


@dataclass(frozen=True, slots=True)
class DrawnCars(StatelessModel):
    """N simulated cars; a rollout of the world that a policy drives in. Its states are exact, without noise.

    Attributes:
        config: the simulator, with the effects of all cars.
        values: numbers that replace those of ``config``, by dotted name, each (N,); an absent effect has its identity.
        history: H, number of past commands in the features.
    """

    config: SimulatorConfig
    values: dict[str, Tensor]
    history: int = HISTORY

    def __len__(self) -> int:
        """N, the number of cars."""
        return len(next(iter(self.values.values())))

    def take(self, cars: Tensor) -> DrawnCars:
        """The cars with indices (M,)."""
        return replace(self, values={name: value[cars] for name, value in self.values.items()})

    def rollouts(self, count: int, generator: torch.Generator) -> DrawnCars:
        """Start rollouts of ``count`` cars, in turn; hidden states of a car follow from the features."""
        return self.take(torch.arange(count) % len(self))

    def after(self, states: Tensor, commands: Tensor, past: Tensor) -> Tensor:
        """States (N, T + 1, 6) of the cars from states (N, 6) by commands (N, T, 2) after past ones (N, H, 2)."""
        return rollout(self.config, states, commands, history=past, values=self.values).states

    def step(self, features: Tensor, action: Tensor, generator: torch.Generator) -> Tensor:
        """Features (N, 7 + 2 H) one step after ``action`` (N, 2)."""
        past = decode_history(features)
        state = self.after(decode_state(features), action[:, None], past)[:, 1]
        state = torch.cat([state[:, :2], wrap(state[:, 2:3]), state[:, 3:]], dim=1)
        encoded: Tensor = encode(torch.nan_to_num(state, nan=1e3), push_action(past, action))
        return encoded


def draw_cars(prior: SimulatorConfig, count: int, generator: torch.Generator, history: int = HISTORY) -> DrawnCars:
    """Draw cars from the prior and from plausible effects that it does not have.

    Args:
        prior: simulator with ranges, standard deviations and effects.
        count: number of cars.
        generator: of all draws.
        history: number of past commands in the features; values below ``HISTORY`` are raised to it.
    """
    model = CarModel(prior, HISTORY, known_ranges(prior))
    drawn = model.parameters(torch.randn((count, model.size), generator=generator))
    values = {}
    for k, name in enumerate(model.names):
        value, info = drawn[:, k], REGISTRY[name]
        if name not in prior.parameter_std:
            value = value * torch.exp(PARAMETER_SPREAD * torch.randn(count, generator=generator))
        values[name] = value.clamp(max(info.low, 1e-6) if info.positive else info.low, info.high)
    delay_s = values.get(COMMAND_DELAY, torch.full((count,), prior.command_delay_s))
    values[COMMAND_DELAY] = delay_s + MeasurementModel(FLOATS, {**prior.values(), **values}, prior.effects).latency_s
    values.pop(LATENCY, None)
    unknown = [e for e in CATALOGUE.values() if e.id not in prior.effects and _is_plausible(e, prior)]
    for effect in unknown:
        values[f"effects.{effect.id}.{effect.parameters[0].name}"] = _sizes(
            effect, count, MEAN_EFFECTS / len(unknown), values, generator
        )
    return DrawnCars(prior, values, max(history, HISTORY))


def _is_plausible(effect: Effect, prior: SimulatorConfig) -> bool:
    """Whether the effect acts on the motion, is constant in time, and has one number with a finite identity."""
    number = effect.parameters[0]
    is_single = len(effect.parameters) == 1 and number.identity is not None and math.isfinite(number.identity)
    return is_single and effect.kind != "observation" and not effect.depends_on and prior.kind in effect.base_models


def _sizes(
    effect: Effect, count: int, probability: float, values: dict[str, Tensor], generator: torch.Generator
) -> Tensor:
    """The effect's number in each car (count,): its identity, or with ``probability`` a random size."""
    number = effect.parameters[0]
    assert number.identity is not None
    size = MEAN_SIZE * torch.empty(count).exponential_(generator=generator)
    if number.low < number.identity:
        size = size * (2.0 * torch.randint(2, (count,), generator=generator) - 1.0)
    size = size * (torch.rand(count, generator=generator) < probability)
    low = torch.full((count,), number.low) if not number.reduces else -values[number.reduces]
    result: Tensor = (number.identity + (number.typical - number.identity) * size).clamp(max=number.high)
    return torch.maximum(result, low)


def select_cars(cars: DrawnCars, episodes: Sequence[EpisodeData], count: int) -> DrawnCars:
    """The ``count`` cars with the smallest prediction errors over recorded windows.

    Rejection ABC (Beaumont, Zhang and Balding 2002, "Approximate Bayesian computation in population genetics").

    Args:
        cars: drawn from the prior.
        episodes: recordings; without a complete window all cars are equally plausible, and the first are returned.
        count: number of cars.
    """
    windows = _windows(episodes, cars.history)
    if windows is None:
        return cars.take(torch.arange(count))
    start, past, commands, end = windows
    errors = []
    for k in range(len(start)):
        first, issued, earlier = (t[k].expand(len(cars), *t[k].shape) for t in (start, commands, past))
        error = cars.after(first, issued, earlier)[:, -1] - end[k]
        error[:, 2] = wrap(error[:, 2])
        errors.append(torch.nan_to_num(error, nan=1e3).abs())
    stacked = torch.stack(errors, dim=1)
    scaled = stacked / stacked.median(dim=0).values.mean(dim=0).clamp_min(1e-6)
    cost = scaled.clamp_max(MAX_ERROR).square().mean(dim=(1, 2))
    return cars.take(cost.argsort()[:count])


def _windows(episodes: Sequence[EpisodeData], history: int) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
    """Initial states (S, 6), past commands (S, H, 2), commands (S, T, 2) and final states (S, 6) of windows.

    No window and no history spans a gap in time, and no window spans a jump of the poses (``segment`` of an imported
    recording changes).
    """
    rows = []
    for episode in episodes:
        whole = whole_steps(episode)
        segment = episode.extra.get("segment", np.zeros(episode.ticks + 1))
        for first in range(history, episode.ticks - WINDOW_TICKS + 1, WINDOW_TICKS // 2):
            last = first + WINDOW_TICKS
            if not whole[first - history : last].all() or np.ptp(segment[first : last + 1]) > 0:
                continue
            parts = (
                episode.states[first], episode.sent[first - history : first], episode.sent[first:last],
                episode.states[last],
            )  # fmt: skip
            row = [torch.from_numpy(part.copy()).float() for part in parts]
            if all(bool(torch.isfinite(part).all()) for part in row):
                rows.append(row)
    if not rows:
        return None
    chosen = torch.linspace(0, len(rows) - 1, min(len(rows), MAX_WINDOWS)).round().long().tolist()
    start, past, commands, end = (torch.stack(parts) for parts in zip(*(rows[k] for k in chosen), strict=True))
    return start, past, commands, end
