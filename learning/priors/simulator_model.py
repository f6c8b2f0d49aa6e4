"""The car simulator as a prior over one-step models: any car file, its ranges and its effects.

Inputs and outputs are the measured ones of ``learning.transitions``. Recorded states are ``mocap.latency`` old,
so that every command acts later by this. The measurement model is inverted at the start of a step and applied at its
end. Hidden states of actuators and tyres follow from the past commands of a row. A row has neither place nor time:
effects of the place are ignored, and drifting effects act as at one time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from carlab.core.errors import ConfigError, DataError
from learning.priors.domain_models import MAX_PLAUSIBLE_OUTPUT, NO_FINITE_OUTPUT, draw_parameters, within
from learning.priors.measured_states import DrawnMeasurement
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS, Effect
from sim_backends.measurement import COMMAND_DELAY
from sim_backends.registry import REGISTRY

DELAY = COMMAND_DELAY
CAUCHY_SCALE_STD, MIN_CAUCHY_SCALE_SHARE = 2.0, 0.02
"""Scale of a diagnosed number's Cauchy prior: in standard deviations of the diagnosis, and at least of its value."""
MAX_CAUCHY_DEVIATION = 10.0
"""Bound of a deviation from the diagnosed value, in these scales."""
MIN_SHARE = 0.05
"""Lower bound of a positive number, relative to its diagnosed value."""
LAG_TICKS = 2
"""Memory of a velocity filter that is simulated."""
MAX_START_SPEED_MPS = 3.0
ROWS_A_DRIVE = 10
TICKS_APART = 3
MEAN_HOLD_TICKS = 8
"""Mean time for which a command of a random drive is held."""


def known_ranges(config: SimulatorConfig) -> dict[str, tuple[float, float]]:
    """Ranges of all uncertain numbers of a car file; the physical bounds of those with only a standard deviation."""
    known = config.values()
    bounds = {name: REGISTRY[name] for name in config.parameter_std if name in known}
    return {name: (info.low, info.high) for name, info in bounds.items()} | dict(config.priors)


@dataclass(frozen=True, slots=True)
class CarModel:
    """One step of a simulated car in its own frame, with parameters that are known as ranges.

    Attributes:
        config: the simulator.
        history: commands before the one at the step's start that a row holds.
        ranges: (low, high) by dotted name, effects' numbers among them; ``known_ranges`` has those of a car file.
            Everything else is held at its value.
        at_s: time since a recording's first row at which effects that drift act [s].
        velocity_delay_s: by how much measured velocities lag behind measured poses, as differences do [s].
    """

    config: SimulatorConfig
    history: int
    ranges: Mapping[str, tuple[float, float]]
    at_s: float = 0.0
    velocity_delay_s: float = 0.0

    def __post_init__(self) -> None:
        known = self.config.values()
        for name in self.ranges:
            if name not in known:
                raise ConfigError(f"'{name}' is no number of this simulator; give a range to one that it has.")
            if REGISTRY[name].choices:
                raise ConfigError(f"'{name}' is one of {', '.join(REGISTRY[name].choices)}; it has no range.")

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters in the order of the columns of a draw."""
        return tuple(self.ranges)

    @property
    def size(self) -> int:
        """One for each range."""
        return len(self.ranges)

    def parameters(self, normal: Tensor) -> Tensor:
        """Parameters (P, K) for standard normal numbers (P, K): uniform in their ranges, or around a diagnosed value.

        A number with a standard deviation (``config.parameter_std``) has a Cauchy distribution within its range: half
        of its mass lies within ``CAUCHY_SCALE_STD`` deviations, and its tails let data overrule a diagnosis,
        whose standard deviations hold only if its model is complete.
        """
        shares = torch.special.ndtr(normal)
        uniform = within(tuple(self.ranges.values()), shares)
        about = [
            self._about(name, shares[:, k]) if name in self.config.parameter_std else uniform[:, k]
            for k, name in enumerate(self.names)
        ]
        return torch.stack(about, dim=1) if about else shares

    def _about(self, name: str, shares: Tensor) -> Tensor:
        value, (low, high) = self.config.values()[name], self.ranges[name]
        scale = max(CAUCHY_SCALE_STD * self.config.parameter_std[name], MIN_CAUCHY_SCALE_SHARE * abs(value))
        least = MIN_SHARE * value if REGISTRY[name].positive else -math.inf
        low, high = (
            max(low, least, value - MAX_CAUCHY_DEVIATION * scale),
            min(high, value + MAX_CAUCHY_DEVIATION * scale),
        )
        first, last = (math.atan((end - value) / scale) for end in (low, high))
        return (value + scale * torch.tan(first + (last - first) * shares.double())).clamp(low, high).to(shares)

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """Inputs (N, 3 + 2 (H + 1)) of random drives: commands held for a while, cars drawn from the ranges.

        Rows with implausible numbers are replaced by others.

        Raises:
            DataError: most rows are implausible.
        """
        cars = -(-count // ROWS_A_DRIVE)
        ticks = self.history + 1 + TICKS_APART * ROWS_A_DRIVE
        fresh = 2.0 * torch.rand((cars, ticks, 2), generator=generator) - 1.0
        renewed = torch.rand((cars, ticks), generator=generator) < 1.0 / MEAN_HOLD_TICKS
        renewed[:, 0] = True
        last = torch.where(renewed, torch.arange(ticks), 0).cummax(dim=1).values
        commands = fresh.gather(1, last[:, :, None].expand(-1, -1, 2))
        start = torch.zeros((cars, 6))
        start[:, 3] = MAX_START_SPEED_MPS * torch.rand(cars, generator=generator)
        states = self._roll(start, commands, None, draw_parameters(self, cars, generator), 1)
        rows = self.history + 1 + TICKS_APART * torch.arange(ROWS_A_DRIVE)
        past = rows[:, None] + torch.arange(-self.history, 1)
        found = torch.cat([states[:, rows, 3:], commands[:, past].flatten(2)], dim=2).flatten(0, 1)
        found = found[torch.randperm(len(found), generator=generator)]
        plausible = found[(found.abs() < MAX_PLAUSIBLE_OUTPUT).all(dim=1)]
        if 2 * len(plausible) < len(found):
            raise DataError(NO_FINITE_OUTPUT)
        return plausible[torch.arange(count) % len(plausible)] if len(plausible) < count else plausible[:count]

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Changes (P, N, 6) over one step for inputs (N, D) and parameters (P, K)."""
        sets, count = len(parameters), len(inputs)
        start = torch.cat([torch.zeros_like(inputs[:, :3]), inputs[:, :3]], dim=1)
        commands = inputs[:, 3:].view(count, self.history + 1, 2)
        many = [t.repeat(sets, *[1] * (t.ndim - 1)) for t in (start, commands)]
        past = many[1][:, :-1] if self.history else None
        states = self._roll(many[0], many[1][:, -1:], past, parameters, count)
        change: Tensor = states[:, 1] - states[:, 0]
        return change.view(sets, count, 6)

    def _roll(self, start: Tensor, commands: Tensor, past: Tensor | None, parameters: Tensor, each: int) -> Tensor:
        """Measured states (rows, T + 1, 6) of drives that begin at (0, 0, 0), ``each`` of them for every draw."""
        values = {name: parameters[:, k].to(start).repeat_interleave(each) for k, name in enumerate(self.names)}
        seen = DrawnMeasurement(self.config, values, start, self.velocity_delay_s)
        effects = {name: v for name, v in self.config.effects.items() if not _is_left_out(EFFECTS[name])}
        config = replace(self.config, priors={}, parameter_std={}, effects=effects)
        inner = {name: v for name, v in values.items() if name in config.values() and not name.startswith("mocap.")}
        inner[DELAY] = seen.command_delay_s

        def driven(begin: Tensor, given: Tensor, earlier: Tensor | None) -> Tensor:
            return rollout(config, begin, given, history=earlier, values=inner, t0_s=self.at_s).states

        period_s, true = self.config.control_period_s, seen.inverse(start)
        if seen.has_filter and past is not None:
            # The filter lags by as much as for a car at about these velocities that was commanded alike.
            back = min(LAG_TICKS, past.shape[1])
            lag = seen.filter_lag(driven(true, past[:, -back:], past[:, :-back]), period_s)
            true = seen.inverse(torch.cat([start[:, :3], start[:, 3:] + lag], dim=1))
        return seen.measured(driven(true, commands, past), period_s, start[:, 3:])


def _is_left_out(effect: Effect) -> bool:
    """Whether the measurement model has the effect, or a row, which has no pose in the world, cannot have it."""
    return effect.kind == "observation" or bool(effect.depends_on & {"place", "heading"})


__all__ = ["CarModel", "known_ranges"]
