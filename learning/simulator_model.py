"""The car simulator as a prior over one-step models: any car file, its ranges, and all that its effects do.

Rows are those of ``learning.transitions``, so the model speaks of what is measured. A recording's states are
``mocap.latency`` old: seen from them every command acts that much later. Effects on what is measured are undone at the
start of a step and done again at its end. A row says what was commanded before it, and hidden states of actuators and
tyres are carried through that; it does not say where in the world the car was: effects of the place are left out. Nor
does it say when: effects that drift act as at one time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from carlab.core.errors import ConfigError, DataError
from learning.domain_models import ABSURD, BROKEN_DOWN, draw_parameters, within
from learning.measured_states import LATENCY_EFFECT, Measured
from sim_backends.batch_rollout import rollout
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.registry import REGISTRY

DELAY = "timing.command_delay"
LATENCY = "mocap.latency"
EXTRA_DELAY = "effects.command_delay.extra_delay"
OF_THE_PLACE = frozenset({"low_friction_patch", "road_slope", "wind"})
"""Effects that depend on where in the world a car is, or on its heading there."""
DOUBT, LEAST_DOUBT = 2.0, 0.02
"""Half of what is believed of a diagnosed number lies within so many standard deviations, or shares of itself."""
FARTHEST = 10.0
LEAST_SHARE = 0.05
"""Of its value, what a number that must be above zero is at least."""
LAG_TICKS = 2
"""Ticks over which a filter on the velocities is taken to remember."""
FASTEST_MPS = 3.0
ROWS_A_DRIVE = 10
TICKS_APART = 3
HELD_TICKS = 8
"""Mean time for which a command of a random drive is held."""


def known_ranges(config: SimulatorConfig) -> dict[str, tuple[float, float]]:
    """Ranges of all numbers of a car file that are not certain; of those with a deviation alone, what is possible."""
    known = config.values()
    bounds = {name: REGISTRY[name] for name in config.doubts if name in known}
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
        """Parameters (P, K) of standard normal numbers: uniform in their ranges, or about what was diagnosed.

        A number with a standard deviation (``config.doubts``) has Cauchy's distribution within its range: half of it
        within ``DOUBT`` deviations, and tails (``FARTHEST`` times as far) that let data overrule a diagnosis, which is
        only as sure as it says if it left nothing out.
        """
        shares = torch.special.ndtr(normal)
        uniform = within(tuple(self.ranges.values()), shares)
        about = [
            self._about(name, shares[:, k]) if name in self.config.doubts else uniform[:, k]
            for k, name in enumerate(self.names)
        ]
        return torch.stack(about, dim=1) if about else shares

    def _about(self, name: str, shares: Tensor) -> Tensor:
        value, (low, high) = self.config.values()[name], self.ranges[name]
        scale = max(DOUBT * self.config.doubts[name], LEAST_DOUBT * abs(value))
        least = LEAST_SHARE * value if REGISTRY[name].positive else -math.inf
        low, high = max(low, least, value - FARTHEST * scale), min(high, value + FARTHEST * scale)
        first, last = (math.atan((end - value) / scale) for end in (low, high))
        return (value + scale * torch.tan(first + (last - first) * shares.double())).clamp(low, high).to(shares)

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """Inputs (N, 3 + 2 (H + 1)) of random drives: commands held for a while, cars drawn from the ranges.

        Where the simulator breaks down in some of them, others stand twice.

        Raises:
            DataError: it breaks down in most.
        """
        cars = -(-count // ROWS_A_DRIVE)
        ticks = self.history + 1 + TICKS_APART * ROWS_A_DRIVE
        fresh = 2.0 * torch.rand((cars, ticks, 2), generator=generator) - 1.0
        renewed = torch.rand((cars, ticks), generator=generator) < 1.0 / HELD_TICKS
        renewed[:, 0] = True
        last = torch.where(renewed, torch.arange(ticks), 0).cummax(dim=1).values
        commands = fresh.gather(1, last[:, :, None].expand(-1, -1, 2))
        start = torch.zeros((cars, 6))
        start[:, 3] = FASTEST_MPS * torch.rand(cars, generator=generator)
        states = self._roll(start, commands, None, draw_parameters(self, cars, generator), 1)
        rows = self.history + 1 + TICKS_APART * torch.arange(ROWS_A_DRIVE)
        past = rows[:, None] + torch.arange(-self.history, 1)
        found = torch.cat([states[:, rows, 3:], commands[:, past].flatten(2)], dim=2).flatten(0, 1)
        found = found[torch.randperm(len(found), generator=generator)]
        sound = found[(found.abs() < ABSURD).all(dim=1)]
        if 2 * len(sound) < len(found):
            raise DataError(BROKEN_DOWN)
        return sound[torch.arange(count) % len(sound)] if len(sound) < count else sound[:count]

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Changes (P, N, 6) over one step for inputs (N, D) and parameters (P, K)."""
        sets, count = len(parameters), len(inputs)
        start = torch.cat([torch.zeros_like(inputs[:, :3]), inputs[:, :3]], dim=1)
        commands = inputs[:, 3:].view(count, self.history + 1, 2)
        many = [t.repeat(sets, *[1] * (t.ndim - 1)) for t in (start, commands)]
        past = many[1][:, :-1] if self.history else None
        states = self._roll(many[0], many[1][:, -1:], past, parameters, count)
        change = states[:, 1] - states[:, 0]
        turned = states[:, 0, 2]  # motion capture may see the car turned, and a row is in the frame that it sees
        sin, cos = torch.sin(turned), torch.cos(turned)
        ahead, left = cos * change[:, 0] + sin * change[:, 1], cos * change[:, 1] - sin * change[:, 0]
        return torch.cat([ahead[:, None], left[:, None], change[:, 2:]], dim=1).view(sets, count, 6)

    def _roll(self, start: Tensor, commands: Tensor, past: Tensor | None, parameters: Tensor, each: int) -> Tensor:
        """Measured states (rows, T + 1, 6) of drives that begin at (0, 0, 0), ``each`` of them for every draw."""
        drawn = {name: parameters[:, k].to(start) for k, name in enumerate(self.names)}
        seen = Measured.of(self.config, drawn, len(parameters), start, self.velocity_delay_s)
        values = {name: value.repeat_interleave(each) for name, value in drawn.items()}

        def number(name: str) -> Tensor | float:
            return values[name] if name in values else own.get(name, 0.0)

        own = self.config.values()
        latency = number(LATENCY_EFFECT if LATENCY_EFFECT in own else LATENCY)
        delay = torch.as_tensor(number(DELAY) + latency + number(EXTRA_DELAY)).to(start).clamp_min(0.0)
        left_out = {*seen.effects, *OF_THE_PLACE, "command_delay"}
        effects = {name: v for name, v in self.config.effects.items() if name not in left_out}
        config = replace(self.config, priors={}, doubts={}, effects=effects)
        inner = {
            name: v for name, v in values.items()
            if not name.startswith("mocap.") and not (name.startswith("effects.") and name.split(".")[1] in left_out)
        } | {DELAY: delay}  # fmt: skip

        def driven(velocity: Tensor, given: Tensor, earlier: Tensor | None) -> Tensor:
            from_here = torch.cat([start[:, :3], velocity], dim=1)
            return rollout(config, from_here, given, history=earlier, values=inner, t0_s=self.at_s).states

        velocity, period_s = seen.undone(start[:, 3:], each), self.config.control_period_s
        true = velocity
        if seen.lag_s is not None and past is not None:
            # By how much the filter lags: that of a car at about these velocities which was commanded alike.
            back = min(LAG_TICKS, past.shape[1])
            lately = driven(velocity, past[:, -back:], past[:, :-back])
            settled = seen.lag_s.repeat_interleave(each)[:, None] * (lately[:, 1, 3:] - lately[:, 0, 3:]) / period_s
            shown = seen.filtered(lately, lately[:, 0, 3:] - settled, period_s, each)
            true = velocity + lately[:, -1, 3:] - shown[:, -1]
        return seen.done(driven(true, commands, past), velocity, period_s, each)


__all__ = ["OF_THE_PLACE", "CarModel", "known_ranges"]
