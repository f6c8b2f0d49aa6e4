"""Rollouts of NumPy arrays by torch's operators, which evaluate each equation in Python."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch

from sim_backends.batch.array_rollout import IntArray, count_of_sets, number_of_set
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.compiled.machine_code import FloatRow
from sim_backends.effects.base import ModelKind


def operator_rollout(
    kind: ModelKind,
    effects: Iterable[str],
    numbers: Mapping[str, float | FloatRow],
    start: FloatRow,
    commands: FloatRow,
    ticks: int,
    *,
    before: int,
    past_states: FloatRow | None,
    t0_s: FloatRow,
    max_step_s: float,
    every: int = 1,
    returned: IntArray | None = None,
) -> FloatRow:
    """``array_rollout`` by torch's operators; all rows before the first tick are used."""
    shown = slice(None) if returned is None else returned
    config = SimulatorConfig(
        kind=kind, effects={name: {} for name in effects}, control_period_s=float(numbers["timing.control_period"])
    )
    rows = torch.from_numpy(commands).permute(2, 1, 0)
    sets = []
    for k in range(count_of_sets((*numbers.values(), start[0]))):
        given = {name: torch.as_tensor(number_of_set(v, k), dtype=rows.dtype) for name, v in numbers.items()}
        own = start[:, k % start.shape[1]]
        states = rollout(
            config,
            torch.from_numpy(own).T,
            rows[:, before:],
            history=rows[:, :before],
            history_states=None
            if past_states is None
            else _at_each_tick(past_states[:, :, k % past_states.shape[2]], own, every),
            values={name: value for name, value in given.items() if name != "timing.control_period"},
            t0_s=torch.from_numpy(t0_s),
            max_step_s=max_step_s,
            engine="operators",
        ).states
        sets.append(states[:, ::every].permute(1, 2, 0).numpy()[shown])
    return np.stack(sets, axis=2)


def _at_each_tick(past_states: FloatRow, start: FloatRow, every: int) -> torch.Tensor:
    """States (N, H every, 6) at each tick, linear between every-th states (H, 6, N) and the start (6, N)."""
    change = np.diff(past_states, axis=0, append=start[None])[:, None]
    states = past_states[:, None] + change * np.arange(every)[:, None, None] / every
    return torch.from_numpy(states.reshape(-1, *start.shape)).permute(2, 0, 1)
