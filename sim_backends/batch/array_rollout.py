"""Rollouts of cars on NumPy arrays without a gradient, by compiled code.

All segments of all control periods are one call of the compiled function: a table has the addresses of their commands.
Parameter sets whose commands act at the same instants share this table.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sim_backends.array_ops import ARRAYS, Value
from sim_backends.batch.inputs import Past, as_array, total_delays_s
from sim_backends.batch.schedule import Number, PeriodPlan, Piece, plan_period
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.compiled.advance import BODY_ROWS, Key, address, advance_rows, segment_table, trace_step
from sim_backends.compiled.machine_code import FloatRow, SegmentTable, vector_length
from sim_backends.dynamics.actuators import ActuatorChain
from sim_backends.dynamics.single_track import SingleTrack
from sim_backends.effects import EFFECTS, ActuatorEffect, DelayEffect, DynamicsEffect
from sim_backends.effects.base import ModelKind
from sim_backends.measurement import COMMAND_DELAY

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
    returned: IntArray | None = None,
) -> FloatRow:
    """Simulate N cars with each of P parameter sets from their initial states with commands at control ticks.

    Args:
        kind: Kind of the model.
        effects: Ids of its effects.
        numbers: All numbers of the simulator by dotted name, each a number, (P, 1) or (P, N), but one control period.
        start: States at the first tick (6, 1 or P, N), float32 or float64, which sets the type.
        commands: Steering and throttle in [-1, 1], of the same type (2, H + T, N); the first H act before the first
            tick, and the first of all acts before it.
        ticks: T.
        before: Number of periods before the first tick, at most H, through which hidden states are simulated; they
            start in steady state.
        past_states: States of the body (``before // every``, 6, 1 or P, N) at each of these ticks whose number is a
            multiple of ``every``, linear in between; by default the velocities of the start.
        t0_s: Time of the first tick since the first row of the recording [s], a number or a row (N,).
        max_step_s: Longest Runge-Kutta step [s].
        every: States are returned at each tick whose number is a multiple of this.
        returned: Ascending indices (U,) of these states that are returned; by default all T // every + 1.

    Returns:
        States (U, 6, P, N): true x, y [m], yaw [rad] (not wrapped), vx, vy [m/s], yaw rate [rad/s].
    """
    cars, min_cars = start.shape[-1], vector_length(start.dtype)
    if 0 < cars < min_cars:
        repeated = np.arange(min_cars) % cars
        numbers = {name: _of_cars(value, repeated) for name, value in numbers.items()}
        past_states = None if past_states is None else past_states[..., repeated]
        t0_s = t0_s[repeated] if isinstance(t0_s, np.ndarray) else t0_s
        start, commands = (np.ascontiguousarray(array[..., repeated]) for array in (start, commands))
    sets = count_of_sets((*numbers.values(), start[0]))
    shown = np.arange(ticks // every + 1) if returned is None else returned
    states = np.empty((len(shown), BODY_ROWS, sets, start.shape[-1]), start.dtype)
    if states.size and shown[0] == 0:
        states[0] = start
    for delays_s, chosen in _sets_by_delay(numbers, effects, sets) if states.size else ():
        own = {name: _of_sets(value, chosen) for name, value in numbers.items()}
        plan = plan_period(float(numbers["timing.control_period"]), delays_s, max_step_s)
        rollout = _ArrayRollout(kind, effects, own, commands, ticks, t0_s, plan, every, len(chosen))
        past = None if past_states is None else _of_sets(past_states.swapaxes(0, 2), chosen).swapaxes(0, 2)
        rollout.write(_of_sets(start.swapaxes(0, 1), chosen).swapaxes(0, 1), past, before, shown, chosen, states)
    return states[..., :cars]


def _of_cars(value: float | FloatRow, cars: IntArray) -> float | FloatRow:
    """The values (P, n) of cars (n,) of (P, N); a number or (P, 1) is unchanged."""
    return value[:, cars] if isinstance(value, np.ndarray) and value.shape[1] > 1 else value


def _of_sets(value: Any, chosen: IntArray) -> Any:
    """The values of chosen parameter sets (G,) of (P, ...); a number or (1, ...) is unchanged."""
    return value[chosen] if isinstance(value, np.ndarray) and len(value) > 1 else value


def _sets_by_delay(
    numbers: Mapping[str, float | FloatRow], effects: Iterable[str], sets: int
) -> Iterator[tuple[tuple[Number, Number], IntArray]]:
    """Delays of steering and throttle [s], numbers or tensors (N,), and the parameter sets (G,) that have them."""
    delays = [effect for effect in effects if isinstance(EFFECTS[effect], DelayEffect)]
    names = [COMMAND_DELAY, *(f"effects.{e}.{p.name}" for e in delays for p in EFFECTS[e].parameters)]
    groups: dict[Any, tuple[tuple[Number, Number], list[int]]] = {}
    for k in range(sets):
        delays_s = total_delays_s({name: number_of_set(numbers[name], k) for name in names}, delays)
        has_rows = any(isinstance(delay_s, torch.Tensor) for delay_s in delays_s)
        groups.setdefault(k if has_rows else delays_s, (delays_s, []))[1].append(k)
    return ((delays_s, np.array(chosen)) for delays_s, chosen in groups.values())


def count_of_sets(values: Iterable[float | FloatRow]) -> int:
    """Number P of parameter sets of numbers, (P, 1) and (P, N)."""
    return max(len(value) if isinstance(value, np.ndarray) else 1 for value in values)


def number_of_set(value: float | FloatRow, k: int) -> Number:
    """The number of parameter set k, or its tensor (N,), of a number, (P, 1) or (P, N)."""
    if not isinstance(value, np.ndarray):
        return value
    own = value[k % len(value)]
    return float(own[0]) if len(own) == 1 else torch.from_numpy(own)


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
    own = {
        name: np.atleast_2d(v) if isinstance(v := as_array(value), np.ndarray) else v for name, value in given.items()
    }
    states = array_rollout(
        config.kind,
        config.effects,
        {**config.values(), **own},
        as_array(start.T.contiguous())[:, None],
        as_array(torch.cat([earlier, commands], dim=1).permute(2, 1, 0).contiguous()),
        int(commands.shape[1]),
        before=0 if past is None else int(earlier.shape[1]),
        past_states=None if past is None or past.states is None else as_array(past.states.permute(1, 2, 0))[:, :, None],
        t0_s=as_array(t0_s),
        max_step_s=max_step_s,
    )
    return torch.from_numpy(states[:, :, 0]).permute(2, 0, 1)


class _ArrayRollout:
    """Rollouts of N cars with G parameter sets whose commands act at the same instants.

    ``numbers`` are numbers, (G, 1) or (G, N); other arguments are those of ``array_rollout``.
    """

    def __init__(
        self,
        kind: ModelKind,
        effects: Iterable[str],
        numbers: Mapping[str, float | FloatRow],
        commands: FloatRow,
        ticks: int,
        t0_s: float | FloatRow,
        plan: PeriodPlan,
        every: int,
        sets: int,
    ) -> None:
        self.commands, self.ticks, self.t0_s, self.numbers, self.every = commands, ticks, t0_s, numbers, every
        self.kind, self.effects, self.plan, self.sets = kind, tuple(effects), plan, sets
        self.period_s = float(numbers["timing.control_period"])
        self.key = Key.of(kind, self.effects)

    def write(
        self,
        start: FloatRow,
        past_states: FloatRow | None,
        before: int,
        shown: IntArray,
        chosen: IntArray,
        states: FloatRow,
    ) -> None:
        """Simulate, and write the states ``shown`` (U,) but the first to those of the sets ``chosen`` (G,)."""
        later = shown[shown > 0] * self.every
        blocks = np.full(later[-1] if len(later) else 0, len(later), np.int64)
        blocks[later - 1] = np.arange(len(later))
        carried = self.carried_at_start(start, past_states, before)
        for k, ends in self.advance(self.key, carried, len(later), blocks):
            states[len(shown) - len(later) :, :, chosen[k]] = ends[:, :BODY_ROWS]

    def carried_at_start(self, start: FloatRow, past_states: FloatRow | None, before: int) -> FloatRow:
        """Carried rows (carried, G, N) at the first tick, simulated through the periods before it from steady state."""
        steering, throttle = self.commands[:, 0]
        chain = ActuatorChain(ARRAYS, self.numbers, self.effects)
        memory = chain.settled((steering, throttle))
        if not any(isinstance(effect, DynamicsEffect) and effect.states for effect in self.key.effects):
            if memory and before:
                inputs = tuple(effect for effect in self.key.effects if isinstance(effect, ActuatorEffect))
                memory = self._after_history(Key("dynamic", inputs, has_body=False), memory, before, None)
            return self._rows((*start, *memory))
        past_states = np.repeat(start[None], before // self.every, axis=0) if past_states is None else past_states
        bodies = np.concatenate([past_states, np.broadcast_to(start, (1, *past_states.shape[1:]))])
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
        """Carried rows (G, N) after the periods before the first tick, with given states of the body if any."""
        rows = self._rows(carried)
        after = np.empty_like(rows)
        for k, ends in self.advance(key, rows, 1, np.zeros(before, np.int64), first=-before, bodies=bodies):
            after[:, k] = ends[0]
        return tuple(after)

    def advance(
        self,
        key: Key,
        carried: FloatRow,
        stored: int,
        blocks: IntArray,
        *,
        first: int = 0,
        bodies: FloatRow | None = None,
    ) -> Iterator[tuple[int, FloatRow]]:
        """Advance carried rows through n periods, one parameter set after the other.

        Args:
            key: Of the compiled function.
            carried: Rows at the start (carried, G, N).
            stored: Number of ends of periods that are stored.
            blocks: Index (n,) of each end among these, or ``stored``.
            first: Number of the first period; the first tick begins period 0.
            bodies: States of the body (n // every + 1, 6, 1 or G, N), interpolated at the start of each piece.

        Yields:
            Index of the parameter set, and its carried rows at the ends (stored, carried, N), valid until the next.
        """
        parameters = self._rows(tuple(self.numbers[name] for name in trace_step(key).parameters))
        ends = np.empty((stored + 1, len(carried), carried.shape[2]), carried.dtype)
        used, starts = list[FloatRow](), list[FloatRow]()  # the compiled code has their addresses only
        table = self._table(key, ends, blocks, first, bodies is not None, used)
        for k in range(self.sets):
            if bodies is not None and (k == 0 or bodies.shape[2] > 1):
                starts = self._bodies_at_pieces(bodies[:, :, k % bodies.shape[2]])
                table[:, SegmentTable.START] = np.stack([_addresses(rows) for rows in starts], axis=1).reshape(-1)
            inputs = np.concatenate([_addresses(rows[:, k]) for rows in (parameters, carried)])
            advance_rows(key, inputs, carried[0, k], table)
            yield k, ends[:-1]

    def _table(
        self, key: Key, ends: FloatRow, blocks: IntArray, first: int, has_bodies: bool, used: list[FloatRow]
    ) -> IntArray:
        """The table of segments, period by period, without the addresses of bodies; new rows are added to ``used``."""
        periods, pieces = first + np.arange(len(blocks)), self.plan.pieces
        steps = self._rows(tuple(as_array(piece.step_s) for piece in pieces), shared=True)[:, 0]
        used.append(steps)
        tables = []
        for k, piece in enumerate(pieces):
            where = blocks if k == len(pieces) - 1 else np.full_like(blocks, len(ends) - 1)
            commands = [self._command_rows(channel, piece, periods, used) for channel in range(2)]
            time: Any = address(steps)
            if trace_step(key).uses_time:
                begin_s = self.t0_s + self.period_s * periods[:, None] + as_array(piece.start_s)
                used.append(self._rows(begin_s, shared=True)[:, 0])
                time = _addresses(used[-1])
            step = address(steps) + k * steps.strides[0]
            block = address(ends) + ends.strides[0] * where
            tables.append(segment_table(block, piece.steps, step, time, (commands[0], commands[1]), has_bodies))
        return np.stack(tables, axis=1).reshape(-1, tables[0].shape[1])

    def _bodies_at_pieces(self, bodies: FloatRow) -> list[FloatRow]:
        """States of the body (n, 6, N) at the start of each piece of n periods, from (n // every + 1, 6, N)."""
        change, starts = np.diff(bodies, axis=0)[:, None], []
        for piece in self.plan.pieces:
            share = np.add.outer(np.arange(self.every), as_array(piece.start_s) / self.period_s) / self.every
            between = change * share.reshape(self.every, 1, -1).astype(bodies.dtype)
            between += bodies[:-1, None]
            starts.append(between.reshape(-1, *bodies.shape[1:]))
        return starts

    def _command_rows(self, channel: int, piece: Piece, periods: IntArray, used: list[FloatRow]) -> IntArray:
        """Addresses (n,) of the commands that act in a piece of n periods; new rows are added to ``used``."""
        rows = self.commands[channel]
        delay_periods, is_new = (as_array(each[channel]) for each in (self.plan.command_periods, piece.new_command))
        newest = periods + (len(rows) - self.ticks)
        if isinstance(delay_periods, np.ndarray):
            index = np.maximum(newest[:, None] - delay_periods - ~is_new, 0)
            used.append(np.take_along_axis(rows, index, axis=0))
            return _addresses(used[-1])
        return np.asarray(address(rows) + rows.strides[0] * np.maximum(newest - delay_periods - (not is_new), 0))

    def _rows(self, values: Any, *, shared: bool = False) -> FloatRow:
        """Numbers, (N,), (G, 1) or (G, N) as rows (values, G, N) of the type of the commands; G is 1 if ``shared``."""
        rows = np.empty((len(values), 1 if shared else self.sets, self.commands.shape[2]), self.commands.dtype)
        for k, value in enumerate(values):
            rows[k] = value
        return rows


def _addresses(rows: FloatRow) -> IntArray:
    """Addresses (n,) of contiguous rows or blocks (n, ...)."""
    return address(rows) + rows.strides[0] * np.arange(len(rows))
