"""The car simulator as a prior over one-step models: any car file, its ranges and its effects.

Inputs and outputs are the measured ones of ``learning.transitions``. Recorded states are delayed by ``mocap.latency``,
which is added to the command delay. The measurement model is inverted at the start of a step and applied at its end.
Hidden states of actuators and tyres follow from the past commands of a row. A row has neither position nor time:
position-dependent effects are ignored, and time-dependent effects are evaluated at a fixed time.
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
"""Scale of a diagnosed parameter's Cauchy prior: in standard deviations of the diagnosis; lower bound of the scale,
relative to the value."""
MAX_CAUCHY_DEVIATION = 10.0
"""Bound of a deviation from the diagnosed value, in these scales."""
MIN_SHARE = 0.05
"""Lower bound of a positive parameter, relative to its diagnosed value."""
LAG_TICKS = 2
"""Ticks over which the velocity filter is simulated."""
MAX_START_SPEED_MPS = 3.0
ROWS_PER_DRIVE = 10
TICKS_BETWEEN_ROWS = 3
MEAN_HOLD_TICKS = 8
"""Mean duration for which a command of a random drive is held."""


def known_ranges(config: SimulatorConfig) -> dict[str, tuple[float, float]]:
    """Ranges of all uncertain parameters of a car file; physical bounds for those with only a standard deviation.

    A number that reduces another one (an extra delay) reduces it at most to zero.
    """
    known = config.values()
    reduced = {
        f"effects.{name}.{p.name}": p.reduces for name in config.effects for p in EFFECTS[name].parameters if p.reduces
    }
    ranges = {}
    for name in config.parameter_std:
        if name in known:
            low, other = REGISTRY[name].low, reduced.get(name, "")
            smallest = config.priors[other][0] if other in config.priors else known.get(other, 0.0)
            ranges[name] = (max(low, -smallest) if other else low, REGISTRY[name].high)
    return ranges | dict(config.priors)


@dataclass(frozen=True, slots=True)
class CarModel:
    """One step of a simulated car in the body frame, with parameters in ranges.

    Attributes:
        config: the simulator.
        history: number of commands in a row before the command at the step's start.
        ranges: (low, high) by dotted name, including parameters of effects; ``known_ranges`` has those of a car file.
            All other parameters are fixed.
        at_s: time since a recording's first row at which time-dependent effects are evaluated [s].
        velocity_delay_s: delay of measured velocities relative to measured poses [s].

    Raises:
        ConfigError: a range of an unknown parameter, or of a choice.
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
                raise ConfigError(f"'{name}' is not a parameter of this simulator; remove its range.")
            if REGISTRY[name].choices:
                raise ConfigError(f"'{name}' is one of {', '.join(REGISTRY[name].choices)}; remove its range.")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of the columns of a draw."""
        return tuple(self.ranges)

    @property
    def size(self) -> int:
        """K, the number of ranges."""
        return len(self.ranges)

    def parameters(self, normal: Tensor) -> Tensor:
        """Parameters (P, K) for standard normal draws (P, K): uniform in their ranges, or about a diagnosed value.

        A parameter with a standard deviation (``config.parameter_std``) has a Cauchy distribution within its range:
        half of its mass lies within ``CAUCHY_SCALE_STD`` deviations. Its heavy tails allow for a biased diagnosed
        value, because standard deviations of a diagnosis are valid only for a complete model.
        """
        shares = torch.special.ndtr(normal)
        uniform = within(tuple(self.ranges.values()), shares)
        columns = [
            self._cauchy(name, shares[:, k]) if name in self.config.parameter_std else uniform[:, k]
            for k, name in enumerate(self.names)
        ]
        return torch.stack(columns, dim=1) if columns else shares

    def _cauchy(self, name: str, shares: Tensor) -> Tensor:
        """Quantiles of a parameter's truncated Cauchy distribution at shares (P,)."""
        value, (low, high) = self.config.values()[name], self.ranges[name]
        scale = max(CAUCHY_SCALE_STD * self.config.parameter_std[name], MIN_CAUCHY_SCALE_SHARE * abs(value))
        minimum = MIN_SHARE * value if REGISTRY[name].positive else -math.inf
        low, high = (
            max(low, minimum, value - MAX_CAUCHY_DEVIATION * scale),
            min(high, value + MAX_CAUCHY_DEVIATION * scale),
        )
        first, last = (math.atan((end - value) / scale) for end in (low, high))
        return (value + scale * torch.tan(first + (last - first) * shares.double())).clamp(low, high).to(shares)

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """Inputs (N, 3 + 2 (H + 1)) of random drives: piecewise constant commands, parameters drawn from the ranges.

        Plausible rows replace implausible ones.

        Raises:
            DataError: most rows are implausible.
        """
        cars = -(-count // ROWS_PER_DRIVE)
        ticks = self.history + 1 + TICKS_BETWEEN_ROWS * ROWS_PER_DRIVE
        random_commands = 2.0 * torch.rand((cars, ticks, 2), generator=generator) - 1.0
        changes = torch.rand((cars, ticks), generator=generator) < 1.0 / MEAN_HOLD_TICKS
        changes[:, 0] = True
        last = torch.where(changes, torch.arange(ticks), 0).cummax(dim=1).values
        commands = random_commands.gather(1, last[:, :, None].expand(-1, -1, 2))
        start = torch.zeros((cars, 6))
        start[:, 3] = MAX_START_SPEED_MPS * torch.rand(cars, generator=generator)
        states = self._roll(start, commands, None, draw_parameters(self, cars, generator), 1)
        rows = self.history + 1 + TICKS_BETWEEN_ROWS * torch.arange(ROWS_PER_DRIVE)
        past = rows[:, None] + torch.arange(-self.history, 1)
        inputs = torch.cat([states[:, rows, 3:], commands[:, past].flatten(2)], dim=2).flatten(0, 1)
        inputs = inputs[torch.randperm(len(inputs), generator=generator)]
        plausible = inputs[(inputs.abs() < MAX_PLAUSIBLE_OUTPUT).all(dim=1)]
        if 2 * len(plausible) < len(inputs):
            raise DataError(NO_FINITE_OUTPUT)
        return plausible[torch.arange(count) % len(plausible)] if len(plausible) < count else plausible[:count]

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Changes (P, N, 6) over one step for inputs (N, D) and parameters (P, K), in ``transitions.OUTPUTS``."""
        return self.steps_of_draws(inputs.expand(len(parameters), *inputs.shape), parameters)

    def steps_of_draws(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Changes (P, N, 6) over one step for inputs of each draw (P, N, D) and parameters (P, K)."""
        sets, count = inputs.shape[:2]
        rows = inputs.flatten(0, 1)
        start = torch.cat([torch.zeros_like(rows[:, :3]), rows[:, :3]], dim=1)
        commands = rows[:, 3:].view(len(rows), self.history + 1, 2)
        past = commands[:, :-1] if self.history else None
        states = self._roll(start, commands[:, -1:], past, parameters, count)
        change: Tensor = states[:, 1] - states[:, 0]
        return change.view(sets, count, 6)

    def _roll(self, start: Tensor, commands: Tensor, past: Tensor | None, parameters: Tensor, each: int) -> Tensor:
        """Measured states (rows, T + 1, 6) of drives from pose (0, 0, 0), ``each`` of them for every draw."""
        values = {name: parameters[:, k].to(start).repeat_interleave(each) for k, name in enumerate(self.names)}
        measurement = DrawnMeasurement(self.config, values, start, self.velocity_delay_s)
        effects = {name: v for name, v in self.config.effects.items() if not _is_excluded(EFFECTS[name])}
        config = replace(self.config, priors={}, parameter_std={}, effects=effects)
        inner = {name: v for name, v in values.items() if name in config.values() and not name.startswith("mocap.")}
        inner[DELAY] = measurement.command_delay_s

        def simulated(initial: Tensor, given: Tensor, earlier: Tensor | None) -> Tensor:
            return rollout(config, initial, given, history=earlier, values=inner, t0_s=self.at_s).states

        period_s, true = self.config.control_period_s, measurement.inverse(start)
        if measurement.has_filter and past is not None:
            # The filter's lag is that of a car with about these velocities after the same past commands.
            back = min(LAG_TICKS, past.shape[1])
            lag = measurement.filter_lag(simulated(true, past[:, -back:], past[:, :-back]), period_s)
            true = measurement.inverse(torch.cat([start[:, :3], start[:, 3:] + lag], dim=1))
        return measurement.measured(simulated(true, commands, past), period_s, start[:, 3:])


def _is_excluded(effect: Effect) -> bool:
    """Whether the measurement model covers the effect, or it depends on the pose, which a row does not hold."""
    return effect.kind == "observation" or bool(effect.depends_on & {"place", "heading"})
