"""The car simulator as a prior over one-step models: any car file, its ranges, and all that its effects do.

Rows are those of ``learning.transitions``. A recording's states are ``mocap.latency`` old, so seen from them every
command acts that much later; with that the prior speaks of what is measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from carlab.core.errors import ConfigError
from learning.domain_models import draw_parameters, within
from sim_backends.batch_rollout import rollout
from sim_backends.car_parameters import SimulatorConfig

DELAY = "timing.command_delay"
LATENCY = "mocap.latency"
FASTEST_MPS = 3.0
ROWS_A_DRIVE = 10
TICKS_APART = 3
HELD_TICKS = 8
"""Mean time for which a command of a random drive is held."""


@dataclass(frozen=True, slots=True)
class CarModel:
    """One step of a simulated car in its own frame, with parameters that are known as ranges.

    Attributes:
        config: the simulator.
        history: commands before the one at the step's start that a row holds.
        ranges: (low, high) by dotted name; those of the car file are ``config.priors``.
    """

    config: SimulatorConfig
    history: int
    ranges: Mapping[str, tuple[float, float]]

    def __post_init__(self) -> None:
        known = self.config.values()
        for name in self.ranges:
            if name not in known:
                raise ConfigError(f"'{name}' is no number of this simulator; give a range to one that it has.")

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters in the order of the columns of a draw."""
        return tuple(self.ranges)

    @property
    def size(self) -> int:
        """One for each range."""
        return len(self.ranges)

    def parameters(self, normal: Tensor) -> Tensor:
        """Parameters (P, K) of standard normal numbers, uniform in their ranges."""
        return within(tuple(self.ranges.values()), torch.special.ndtr(normal))

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """Inputs (N, 3 + 2 (H + 1)) of random drives: commands held for a while, cars drawn from the ranges."""
        cars = -(-count // ROWS_A_DRIVE)
        ticks = self.history + 1 + TICKS_APART * ROWS_A_DRIVE
        fresh = 2.0 * torch.rand((cars, ticks, 2), generator=generator) - 1.0
        renewed = torch.rand((cars, ticks), generator=generator) < 1.0 / HELD_TICKS
        renewed[:, 0] = True
        last = torch.where(renewed, torch.arange(ticks), 0).cummax(dim=1).values
        commands = fresh.gather(1, last[:, :, None].expand(-1, -1, 2))
        start = torch.zeros((cars, 6))
        start[:, 3] = FASTEST_MPS * torch.rand(cars, generator=generator)
        states = self._roll(start, commands, None, draw_parameters(self, cars, generator))
        rows = self.history + 1 + TICKS_APART * torch.arange(ROWS_A_DRIVE)
        past = rows[:, None] + torch.arange(-self.history, 1)
        found = torch.cat([states[:, rows, 3:], commands[:, past].flatten(2)], dim=2).flatten(0, 1)
        return found[torch.randperm(len(found), generator=generator)[:count]]

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Changes (P, N, 6) over one step for inputs (N, D) and parameters (P, K)."""
        sets, count = len(parameters), len(inputs)
        start = torch.cat([torch.zeros_like(inputs[:, :3]), inputs[:, :3]], dim=1)
        commands = inputs[:, 3:].view(count, self.history + 1, 2)
        many = [t.repeat(sets, *[1] * (t.ndim - 1)) for t in (start, commands)]
        past = many[1][:, :-1] if self.history else None
        states = self._roll(many[0], many[1][:, -1:], past, parameters.repeat_interleave(count, dim=0))
        return (states[:, 1] - states[:, 0]).view(sets, count, 6)

    def _roll(self, start: Tensor, commands: Tensor, past: Tensor | None, parameters: Tensor) -> Tensor:
        values = {name: parameters[:, k].to(start) for k, name in enumerate(self.names)}
        own = self.config.values()
        delay, latency = (
            values[name] if name in values else torch.full_like(start[:, 0], own[name]) for name in (DELAY, LATENCY)
        )
        inner = {name: v for name, v in values.items() if not name.startswith("mocap.")} | {DELAY: delay + latency}
        return rollout(replace(self.config, priors={}), start, commands, history=past, values=inner).states


__all__ = ["CarModel"]
