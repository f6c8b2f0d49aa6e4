"""Rollouts of cars on NumPy arrays without a gradient, by compiled code.

All segments of all control periods are one call of the compiled function: a table has the addresses of their commands.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sim_backends.array_ops import ARRAYS, Value
from sim_backends.batch.inputs import Past, as_array, total_delays_s
from sim_backends.batch.schedule import Number, PeriodPlan, Piece, plan_period
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.compiled.advance import BODY_ROWS, Key, address, advance_rows, segment_table, trace_step
from sim_backends.compiled.machine_code import FloatRow, vector_length
from sim_backends.dynamics.actuators import ActuatorChain
from sim_backends.dynamics.single_track import SingleTrack
from sim_backends.effects import ActuatorEffect, DynamicsEffect
from sim_backends.effects.base import ModelKind

IntArray = NDArray[np.int64]


def array_rollout(
    kind: ModelKind,
    effects: Iterable[str],
    numbers: Mapping[str, float | FloatRow],
    start: FloatRow,
    commands: FloatRow,
    ticks: int,
    *,
    before: int,
    past_states: FloatRow | None = None,
    t0_s: float | FloatRow = 0.0,
    max_step_s: float,
    every: int = 1,
) -> FloatRow:
    """Simulate N cars from their initial states with commands at control ticks.

    Args:
        kind: Kind of the model.
        effects: Ids of its effects.
        numbers: All numbers of the simulator by dotted name, each a number or a row (N,), but one control period.
        start: States at the first tick (6, N), float32 or float64, which sets the type.
        commands: Steering and throttle in [-1, 1], of the same type (2, H + T, N); the first H act before the first
            tick, and the first of all acts before it.
        ticks: T.
        before: Number of periods before the first tick, at most H, through which hidden states are simulated; they
            start in steady state.
        past_states: States of the body (``before // every``, 6, N) at each of these ticks whose number is a multiple of
            ``every``, linear in between; by default the velocities of the start.
        t0_s: Time of the first tick since the first row of the recording [s], a number or a row (N,).
        max_step_s: Longest Runge-Kutta step [s].
        every: States are returned at each tick whose number is a multiple of this.

    Returns:
        States (T // every + 1, 6, N): true x, y [m], yaw [rad] (not wrapped), vx, vy [m/s], yaw rate [rad/s].
    """
    cars, min_cars = start.shape[1], vector_length(start.dtype)
    if not cars:
        return np.empty((ticks // every + 1, BODY_ROWS, 0), start.dtype)
    if cars < min_cars:
        repeated = np.arange(min_cars) % cars
        numbers = {name: v[repeated] if isinstance(v, np.ndarray) else v for name, v in numbers.items()}
        past_states = None if past_states is None else past_states[..., repeated]
        t0_s = t0_s[repeated] if isinstance(t0_s, np.ndarray) else t0_s
        start, commands = (np.ascontiguousarray(array[..., repeated]) for array in (start, commands))
    rollout = _ArrayRollout(kind, effects, numbers, commands, ticks, t0_s, max_step_s, every)
    carried = rollout.carried_at_start(start, past_states, before)
    ends = np.empty((ticks // every + 2, len(carried), start.shape[1]), start.dtype)
    ends[0, :BODY_ROWS] = start
    tick = np.arange(1, ticks + 1)
    rollout.advance(rollout.key, carried, ends, np.where(tick % every == 0, tick // every, len(ends) - 1))
    return ends[:-1, :BODY_ROWS, :cars]


def rollout_of_tensors(
    config: SimulatorConfig,
    start: torch.Tensor,
    commands: torch.Tensor,
    past: Past | None,
    given: Mapping[str, Number],
    t0_s: Number,
    max_step_s: float,
) -> torch.Tensor:
    """States (N, T + 1, 6) of a rollout without a gradient, by compiled code on arrays."""
    earlier = commands.new_zeros(len(start), 1, 2) if past is None else past.commands
    states = array_rollout(
        config.kind,
        config.effects,
        {**config.values(), **{name: as_array(value) for name, value in given.items()}},
        as_array(start.T.contiguous()),
        as_array(torch.cat([earlier, commands], dim=1).permute(2, 1, 0).contiguous()),
        int(commands.shape[1]),
        before=0 if past is None else int(earlier.shape[1]),
        past_states=None if past is None or past.states is None else as_array(past.states.permute(1, 2, 0)),
        t0_s=as_array(t0_s),
        max_step_s=max_step_s,
    )
    return torch.from_numpy(states).permute(2, 0, 1)


class _ArrayRollout:
    def __init__(
        self,
        kind: ModelKind,
        effects: Iterable[str],
        numbers: Mapping[str, float | FloatRow],
        commands: FloatRow,
        ticks: int,
        t0_s: float | FloatRow,
        max_step_s: float,
        every: int,
    ) -> None:
        self.commands, self.ticks, self.t0_s, self.numbers, self.every = commands, ticks, t0_s, numbers, every
        self.kind, self.effects = kind, tuple(effects)
        self.period_s = float(numbers["timing.control_period"])
        self.key = Key.of(kind, self.effects)
        as_tensors = {n: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for n, v in numbers.items()}
        delays_s = total_delays_s(as_tensors, self.effects)
        self.plan: PeriodPlan = plan_period(self.period_s, delays_s, max_step_s)

    def carried_at_start(self, start: FloatRow, past_states: FloatRow | None, before: int) -> FloatRow:
        """Carried rows at the first tick, hidden states simulated through the periods before it from steady state."""
        steering, throttle = self.commands[:, 0]
        chain = ActuatorChain(ARRAYS, self.numbers, self.effects)
        memory = chain.settled((steering, throttle))
        if not any(isinstance(effect, DynamicsEffect) and effect.states for effect in self.key.effects):
            if memory and before:
                inputs = tuple(effect for effect in self.key.effects if isinstance(effect, ActuatorEffect))
                memory = self._after_history(Key("dynamic", inputs, has_body=False), memory, before, None)
            return self._rows((*start, *memory))
        past_states = np.repeat(start[None], before // self.every, axis=0) if past_states is None else past_states
        bodies = np.concatenate([past_states, start[None]])
        model = SingleTrack(ARRAYS, self.kind, self.numbers, self.effects)
        actuation = model.actuation(*chain.settled_output((steering, throttle)))
        extra = model.settled(self.t0_s - before * self.period_s, tuple(bodies[0]), actuation)
        carried = (*bodies[0], *extra, *memory)
        if before:
            carried = (*start, *self._after_history(self.key, carried, before, bodies)[BODY_ROWS:])
        return self._rows(carried)

    def _after_history(
        self, key: Key, carried: tuple[Value, ...], before: int, bodies: FloatRow | None
    ) -> tuple[FloatRow, ...]:
        """Carried rows after the periods before the first tick, with given states of the body if any."""
        ends = np.empty((1, len(carried), self.commands.shape[2]), self.commands.dtype)
        self.advance(key, self._rows(carried), ends, np.zeros(before, np.int64), first=-before, bodies=bodies)
        return tuple(ends[0])

    def advance(
        self,
        key: Key,
        carried: FloatRow,
        ends: FloatRow,
        blocks: IntArray,
        *,
        first: int = 0,
        bodies: FloatRow | None = None,
    ) -> None:
        """Advance carried rows through n periods.

        Args:
            key: Of the compiled function.
            carried: Rows at the start (carried, cars).
            ends: Blocks to which carried rows are written (blocks, carried, cars).
            blocks: Index (n,) of the block for the end of each period; ends of its other pieces go to the last block.
            first: Number of the first period; the first tick begins period 0.
            bodies: States of the body (n // every + 1, 6, cars), interpolated at the start of each piece.
        """
        graph, periods, pieces = trace_step(key), first + np.arange(len(blocks)), self.plan.pieces
        parameters = self._rows(tuple(self.numbers[name] for name in graph.parameters))
        steps = self._rows(tuple(as_array(piece.step_s) for piece in pieces))
        used: list[FloatRow] = [steps]  # the compiled code has their addresses only
        tables = []
        for k, piece in enumerate(pieces):
            where = blocks if k == len(pieces) - 1 else np.full_like(blocks, len(ends) - 1)
            steering, throttle = (self._command_rows(channel, piece, periods, used) for channel in range(2))
            begin_s = as_array(piece.start_s)
            time: Any = address(steps)
            if graph.uses_time:
                time = self._addresses(self._rows(self.t0_s + self.period_s * periods[:, None] + begin_s), used)
            starts = None
            if bodies is not None:
                share = np.add.outer(np.arange(self.every), begin_s / self.period_s) / self.every
                share = share.reshape(self.every, 1, -1).astype(ends.dtype)
                between = np.diff(bodies, axis=0)[:, None] * share
                between += bodies[:-1, None]
                starts = self._addresses(between.reshape(-1, *bodies.shape[1:]), used)
            step = address(steps) + k * steps.strides[0]
            block = address(ends) + ends.strides[0] * where
            tables.append(segment_table(block, piece.steps, step, time, (steering, throttle), starts))
        table = np.stack(tables, axis=1).reshape(-1, tables[0].shape[1])
        advance_rows(key, [*parameters, *carried], table)

    def _command_rows(self, channel: int, piece: Piece, periods: IntArray, used: list[FloatRow]) -> IntArray:
        """Addresses (n,) of the commands that act in a piece of n periods; new rows are added to ``used``."""
        rows = self.commands[channel]
        delay_periods, is_new = (as_array(each[channel]) for each in (self.plan.command_periods, piece.new_command))
        newest = periods + (len(rows) - self.ticks)
        if isinstance(delay_periods, np.ndarray):
            index = np.maximum(newest[:, None] - delay_periods - ~is_new, 0)
            return self._addresses(np.take_along_axis(rows, index, axis=0), used)
        return np.asarray(address(rows) + rows.strides[0] * np.maximum(newest - delay_periods - (not is_new), 0))

    @staticmethod
    def _addresses(rows: FloatRow, used: list[FloatRow]) -> IntArray:
        used.append(rows)
        return address(rows) + rows.strides[0] * np.arange(len(rows))

    def _rows(self, values: Any) -> FloatRow:
        """Numbers or rows (cars,) as an array (values, cars) of the type of the commands."""
        rows = np.empty((len(values), self.commands.shape[2]), self.commands.dtype)
        for k, value in enumerate(values):
            rows[k] = value
        return rows
