"""Measurement model of a simulator on batches of tensors, with one parameter draw for each row."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sim_backends.car_parameters import SimulatorConfig
from sim_backends.dynamics.torch_ops import torch_ops
from sim_backends.measurement import MeasurementModel, delay_as_recorded_s, filter_velocities


class DrawnMeasurement:
    """The measurement model of a simulator, with one set of parameters for each row of a batch.

    Args:
        config: the simulator.
        drawn: parameters that replace those of ``config``, by dotted name, each (rows,).
        like: a tensor (rows, ...) that determines dtype and device.
        velocity_delay_s: delay of the velocities [s]; added to the time constant of the filter.
    """

    def __init__(
        self, config: SimulatorConfig, drawn: Mapping[str, Tensor], like: Tensor, velocity_delay_s: float = 0.0
    ) -> None:
        first = like.reshape(len(like), -1)[:, 0]
        self._like, self._ops, self._effects = first, torch_ops(first), tuple(config.effects)
        self._numbers = {**config.values(), **drawn}
        rows = {name: torch.full_like(first, value) for name, value in config.values().items()} | dict(drawn)
        self._model = MeasurementModel(self._ops, rows, self._effects)
        if velocity_delay_s > 0.0:
            lag_s = self._model.velocity_time_constant_s
            filter_s = torch.zeros_like(first) if lag_s is None else lag_s
            self._model.velocity_time_constant_s = velocity_delay_s + filter_s

    @property
    def has_filter(self) -> bool:
        """Whether the velocities are filtered."""
        return self._model.velocity_time_constant_s is not None

    @property
    def command_delay_s(self) -> Tensor:
        """Delay of commands in recorded time [s]: the true delay plus the measurement latency; () or (rows,)."""
        latency_s = MeasurementModel(self._ops, self._numbers, self._effects).latency_s
        delay_s = delay_as_recorded_s(self._ops, self._numbers, self._effects, latency_s)
        return torch.as_tensor(delay_s).to(self._like)

    def inverse(self, measured: Tensor) -> Tensor:
        """True states (rows, 6) of measured ones, without inversion of the velocity filter."""
        return torch.stack(self._model.invert(tuple(measured.unbind(dim=1))), dim=1)

    def measured(self, states: Tensor, period_s: float, filtered: Tensor) -> Tensor:
        """Measured states (rows, T + 1, 6) of true ones; ``filtered`` is the initial filter output (rows, 3)."""
        measured = self._model.measure(_ticks(states), period_s, filtered=tuple(filtered.unbind(dim=1)))
        return torch.stack([torch.stack(tick, dim=1) for tick in measured], dim=1)

    def filter_lag(self, states: Tensor, period_s: float) -> Tensor:
        """True minus filtered velocities (rows, 3) at the last of true states (rows, T + 1, 6).

        The initial filter output assumes a constant rate of change.
        """
        lag_s = self._model.velocity_time_constant_s
        inputs = [self._model.observe(tick)[3:6] for tick in _ticks(states)]
        begin = tuple(u0 - lag_s * (u1 - u0) / period_s for u0, u1 in zip(inputs[0], inputs[1], strict=True))
        output = filter_velocities(self._ops, inputs, period_s, lag_s, begin)[-1]
        return torch.stack([u - y for u, y in zip(inputs[-1], output, strict=True)], dim=1)


def _ticks(states: Tensor) -> list[tuple[Tensor, ...]]:
    return [tuple(tick.unbind(dim=1)) for tick in states.unbind(dim=1)]
