"""What a batched rollout is given: checked, and its delays and latency added up over the effects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import torch

from carlab.core.errors import ConfigError, DataError
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS, DelayEffect, ObservationEffect
from sim_backends.schedule import Number


class Past(NamedTuple):
    """What happened before the first tick: commands (N, H, 2), and states (N, H, 6) where they are known."""

    commands: torch.Tensor
    states: torch.Tensor | None

    def cut(self, cars: slice) -> Past:
        """The same for some of the cars."""
        return Past(self.commands[cars], None if self.states is None else self.states[cars])


def plain_number(value: Number) -> Number:
    """A number where a tensor holds one without a gradient, or the same for all cars."""
    if isinstance(value, torch.Tensor) and not value.requires_grad:
        first = value.reshape(-1)[0] if value.numel() else value.new_zeros(())
        if bool((value == first).all()):
            return float(first)
    return value


def total_delays_s(numbers: Mapping[str, Number], effects: Iterable[str]) -> tuple[Number, Number]:
    """Delay of steering and of throttle with all effects [s]. Raises ConfigError for less than zero."""
    steering = throttle = numbers["timing.command_delay"]
    for effect in (EFFECTS[name] for name in effects):
        if isinstance(effect, DelayEffect):
            own = {p.name: numbers[f"effects.{effect.id}.{p.name}"] for p in effect.parameters}
            extra_steering, extra_throttle = effect.extra_delays_s(own)
            if steering is throttle and extra_steering is extra_throttle:  # keep what is one number one number
                steering = throttle = steering + extra_steering
            else:
                steering, throttle = steering + extra_steering, throttle + extra_throttle
    for channel, delay in (("steering", steering), ("throttle", throttle)):
        if bool((delay < 0).any()) if isinstance(delay, torch.Tensor) else delay < 0:
            raise ConfigError(f"The delay of {channel} adds up to less than 0 s; raise command_delay or extra_delay.")
    first = plain_number(steering)
    return first, first if steering is throttle else plain_number(throttle)


def total_latency_s(
    numbers: Mapping[str, Number], observers: Iterable[tuple[ObservationEffect, dict[str, Number]]]
) -> Number:
    """Age of what is measured, with all effects [s]."""
    latency = numbers["mocap.latency"]
    for effect, values in observers:
        if (instead := effect.latency_s(values)) is not None:
            latency = instead
    return latency


def with_effects_of(config: SimulatorConfig, given: Mapping[str, Number]) -> SimulatorConfig:
    """The simulator with the effects that ``given`` names switched on."""
    named = {name.split(".")[1] for name in given if name.startswith("effects.")}
    missing = named - set(config.effects)
    return replace(config, effects={**config.effects, **{name: {} for name in sorted(missing)}}) if missing else config


def check_shapes(
    start: torch.Tensor,
    commands: torch.Tensor,
    history: torch.Tensor | None,
    history_states: torch.Tensor | None,
) -> int:
    """Number of cars. Raises DataError where a shape does not fit."""
    cars = int(start.shape[0])
    if start.ndim != 2 or start.shape[1] != 6:
        raise DataError(f"start has shape {tuple(start.shape)}; it must be (cars, 6).")
    for name, sequence in (("commands", commands), ("history", history)):
        if sequence is not None and (sequence.ndim != 3 or sequence.shape[0] != cars or sequence.shape[2] != 2):
            raise DataError(f"{name} has shape {tuple(sequence.shape)}; it must be ({cars}, ticks, 2).")
    if history_states is not None:
        expected = (cars, 0 if history is None else history.shape[1], 6)
        if tuple(history_states.shape) != expected:
            raise DataError(f"history_states has shape {tuple(history_states.shape)}; it must be {expected}.")
    return cars
