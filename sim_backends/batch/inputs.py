"""Inputs of a batched rollout: checks, and the sums of delays and latency over the effects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import torch

from carlab.core.errors import ConfigError, DataError
from carlab.core.tables import check_keys
from sim_backends.batch.schedule import Number
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import delays_s
from sim_backends.registry import REGISTRY


class Past(NamedTuple):
    """History before the first tick: commands (N, H, 2), and states (N, H, 6) or None."""

    commands: torch.Tensor
    states: torch.Tensor | None

    @classmethod
    def of(cls, commands: torch.Tensor | None, states: torch.Tensor | None, like: torch.Tensor) -> Past | None:
        """Create a history from commands (N, H, 2) and states (N, H, 6), in the dtype of ``like``; None if H is 0."""
        if commands is None or not commands.shape[1]:
            return None
        return cls(commands.to(like), None if states is None else states.to(like))

    def cut(self, cars: slice) -> Past:
        """The history of a slice of the cars."""
        return Past(self.commands[cars], None if self.states is None else self.states[cars])


def number_if_shared(value: Number) -> Number:
    """Convert a tensor () or (N,) without gradient and with equal values to a float; otherwise return it."""
    if isinstance(value, torch.Tensor) and not value.requires_grad:
        first = value.reshape(-1)[0] if value.numel() else value.new_zeros(())
        if bool((value == first).all()):
            return float(first)
    return value


def as_array(value: Number) -> Any:
    """A tensor as an array, or as a float if it has the shape (); numbers are unchanged."""
    if not isinstance(value, torch.Tensor):
        return value
    return value.numpy() if value.ndim else float(value)


def total_delays_s(numbers: Mapping[str, Number], effects: Iterable[str]) -> tuple[Number, Number]:
    """Total delay of steering and of throttle with all effects [s]. Raises ConfigError if it is negative."""
    steering, throttle = delays_s(numbers["timing.command_delay"], numbers, effects)
    for channel, delay in (("steering", steering), ("throttle", throttle)):
        if bool((delay < 0).any()) if isinstance(delay, torch.Tensor) else delay < 0:
            raise ConfigError(f"The total delay of {channel} is less than 0 s; raise command_delay.")
    first = number_if_shared(steering)
    return first, first if steering is throttle else number_if_shared(throttle)


def with_effects_of_values(config: SimulatorConfig, given: Iterable[str]) -> SimulatorConfig:
    """The simulator with all effects added whose numbers (dotted names) are ``given``."""
    named = {name.split(".")[1] for name in given if name.startswith("effects.")}
    missing = named - set(config.effects)
    return replace(config, effects={**config.effects, **{name: {} for name in sorted(missing)}}) if missing else config


def check_shapes(
    start: torch.Tensor,
    commands: torch.Tensor,
    history: torch.Tensor | None,
    history_states: torch.Tensor | None,
) -> int:
    """Check shapes and return the number of cars N.

    Args:
        start: (N, 6).
        commands: (N, T, 2).
        history: (N, H, 2).
        history_states: (N, H, 6).

    Raises:
        DataError: A wrong shape.
    """
    if start.ndim != 2 or start.shape[1] != 6:
        raise DataError(f"start has shape {tuple(start.shape)}; it must be (cars, 6).")
    cars = len(start)
    for name, sequence in (("commands", commands), ("history", history)):
        if sequence is not None and (sequence.ndim != 3 or sequence.shape[0] != cars or sequence.shape[2] != 2):
            raise DataError(f"{name} has shape {tuple(sequence.shape)}; it must be ({cars}, ticks, 2).")
    if history_states is not None:
        expected = (cars, 0 if history is None else history.shape[1], 6)
        if tuple(history_states.shape) != expected:
            raise DataError(f"history_states has shape {tuple(history_states.shape)}; it must be {expected}.")
    return cars


def check_values(given: Mapping[str, Number], t0_s: Number, cars: int) -> None:
    """Raise ConfigError for unknown or unsupported names, DataError for shapes other than () and (cars,)."""
    check_keys(given, REGISTRY, "the values of a rollout")
    if "timing.control_period" in given:
        raise ConfigError("timing.control_period is shared by all cars; change it in the simulator instead.")
    for name, value in {**given, "t0_s": t0_s}.items():
        if isinstance(value, torch.Tensor) and value.shape not in ((), (cars,)):
            raise DataError(f"{name} has shape {tuple(value.shape)}; it must be () or ({cars},).")
