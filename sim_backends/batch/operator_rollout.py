"""Rollouts of NumPy arrays by torch's operators, which evaluate each equation in Python."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch

from sim_backends.batch.rollout import rollout
from sim_backends.batch.schedule import Number
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.compiled.machine_code import FloatRow
from sim_backends.effects.base import ModelKind


def operator_rollout(
    kind: ModelKind,
    effects: Iterable[str],
    numbers: Mapping[str, Number],
    start: FloatRow,
    commands: FloatRow,
    ticks: int,
    *,
    before: int,
    past_states: FloatRow | None,
    t0_s: FloatRow,
    max_step_s: float,
    every: int = 1,
) -> FloatRow:
    """``array_rollout`` by torch's operators, for ``report_evaluations``; all rows before the first tick are used."""
    given = {name: torch.as_tensor(value, dtype=torch.from_numpy(start).dtype) for name, value in numbers.items()}
    period_s = float(given.pop("timing.control_period"))
    config = SimulatorConfig(kind=kind, effects={name: {} for name in effects}, control_period_s=period_s)
    rows = torch.from_numpy(commands).permute(2, 1, 0)
    states = rollout(
        config,
        torch.from_numpy(start).T,
        rows[:, before:],
        history=rows[:, :before],
        history_states=None if past_states is None else _at_each_tick(past_states, start, every),
        values=given,
        t0_s=torch.from_numpy(t0_s),
        max_step_s=max_step_s,
        engine="operators",
    ).states
    return states[:, ::every].permute(1, 2, 0).numpy()


def _at_each_tick(past_states: FloatRow, start: FloatRow, every: int) -> torch.Tensor:
    """States (N, H every, 6) at each tick, linear between every-th states (H, 6, N) and the start (6, N)."""
    change = np.diff(past_states, axis=0, append=start[None])[:, None]
    states = past_states[:, None] + change * np.arange(every)[:, None, None] / every
    return torch.from_numpy(states.reshape(-1, *start.shape)).permute(2, 0, 1)
