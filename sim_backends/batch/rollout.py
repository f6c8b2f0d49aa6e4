"""Batched rollouts in torch, differentiable in states, commands and every parameter.

The equations are those of ``single_track``. On a CPU the steps and their derivative are compiled to machine code
(``compiled.advance``) on the memory of the tensors. Without a gradient autograd is not used (``array_rollout``), and
the cars are simulated in chunks that fit the cache. On a GPU, and for second derivatives, torch's operators run.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch

from sim_backends.array_ops import Value
from sim_backends.batch.array_rollout import rollout_of_tensors
from sim_backends.batch.inputs import Past, check_shapes, check_values, total_delays_s, with_effects_of_values
from sim_backends.batch.schedule import Number, PeriodPlan, Piece, plan_period
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.compiled.advance import Key, advance_tensors, trace_step
from sim_backends.dynamics.actuators import ActuatorChain, ActuatorState
from sim_backends.dynamics.integrate import MAX_STEP_S, integrate_held
from sim_backends.dynamics.single_track import SingleTrack, State
from sim_backends.dynamics.torch_ops import torch_ops

CARS_AT_ONCE = 4096
"""Cars per chunk on a CPU without a gradient."""
_COMPILED_TYPES = (torch.float32, torch.float64)
Engine = Literal["fastest", "operators"]


@dataclass(frozen=True, slots=True)
class Rollout:
    """States (N, T + 1, 6) of N cars over T commands.

    They are true x, y [m], yaw [rad] (not wrapped), vx, vy [m/s], yaw rate [rad/s]; the first is the start.
    """

    states: torch.Tensor


def rollout(
    config: SimulatorConfig,
    start: torch.Tensor,
    commands: torch.Tensor,
    *,
    history: torch.Tensor | None = None,
    history_states: torch.Tensor | None = None,
    values: Mapping[str, Number] | None = None,
    t0_s: Number = 0.0,
    max_step_s: float = MAX_STEP_S,
    engine: Engine = "fastest",
) -> Rollout:
    """Simulate N cars from their initial states with commands at control ticks.

    Args:
        config: The simulator.
        start: States at the first tick, shape (N, 6), float32 or float64, on any device; they set dtype and device.
        commands: Steering and throttle in [-1, 1] at ticks 0 to T - 1, shape (N, T, 2).
        history: Commands before the first tick, oldest first, shape (N, H, 2); by default neutral. Hidden states of
            effects start in steady state for its first row.
        history_states: States of the body at the ticks of ``history``, shape (N, H, 6), for hidden states that depend
            on its motion (tyre relaxation, wheel slip, roll); by default the velocities of the start.
        values: Numbers that replace those of ``config``, by dotted name (``tyre.front.mu``), each a number or a
            tensor of shape () or (N,). An effect with a value is added. Not ``timing.control_period``.
        t0_s: Time of the first tick since the first row of the recording [s], a number or of shape () or (N,).
        max_step_s: Longest Runge-Kutta step [s].
        engine: "operators" uses torch's operators only, for ``torch.func`` and for second derivatives; "fastest"
            (first derivatives only) compiles the step if that is faster.

    Returns:
        Trajectories, differentiable in every argument that requires a gradient.

    Raises:
        DataError: A wrong shape.
        ConfigError: An unknown name, or delays that add up to less than zero.
    """
    cars = check_shapes(start, commands, history, history_states)
    commands = commands.to(start)
    past = Past.of(history, history_states, start)
    given = dict(values or {})
    check_values(given, t0_s, cars)
    config = with_effects_of_values(config, given)
    inputs = [start, commands, t0_s, *(past or ()), *given.values()]
    needs_gradient = torch.is_grad_enabled() and any(isinstance(v, torch.Tensor) and v.requires_grad for v in inputs)
    may_compile = engine == "fastest" and start.device.type == "cpu" and start.dtype in _COMPILED_TYPES
    if needs_gradient:
        return Rollout(_Batch(config, start, commands, past, given, t0_s, max_step_s, may_compile).run())
    at_once, parts = CARS_AT_ONCE if start.device.type == "cpu" else max(cars, 1), []
    with torch.no_grad():
        for first in range(0, max(cars, 1), at_once):
            cut = slice(first, first + at_once)
            own = {name: _of_cars(value, cut) for name, value in given.items()}
            chunk = (start[cut], commands[cut], past and past.cut(cut), own, _of_cars(t0_s, cut), max_step_s)
            compiled = may_compile and cars
            parts.append(rollout_of_tensors(config, *chunk) if compiled else _Batch(config, *chunk, may_compile).run())
    return Rollout(parts[0] if len(parts) == 1 else _concatenated(parts))


def _of_cars(value: Number, cars: slice) -> Number:
    return value[cars] if isinstance(value, torch.Tensor) and value.ndim else value


def _concatenated(parts: Sequence[torch.Tensor]) -> torch.Tensor:
    """Parts (N, T + 1, 6) one after the other, in the order of memory of each part: ticks, rows, cars."""
    return torch.cat([part.permute(1, 2, 0) for part in parts], dim=2).permute(2, 0, 1)


class _Moment(NamedTuple):
    state: State
    memory: ActuatorState


class _Segment(NamedTuple):
    """An interval with held commands; each value is a number or a row (cars,)."""

    t_s: Value
    """Time at its start [s]."""
    commands: tuple[Value, Value]
    """Steering and throttle in [-1, 1]."""
    step_s: Value
    """Length of an integration step [s]."""
    steps: int
    body: Value | None = None
    """State of the body (6, cars) at the start; by default that at the end of the segment before."""


class _Batch:
    """One chunk of cars; all values are rows of length N."""

    def __init__(
        self,
        config: SimulatorConfig,
        start: torch.Tensor,
        commands: torch.Tensor,
        past: Past | None,
        given: Mapping[str, Number],
        t0_s: Number,
        max_step_s: float,
        compiled: bool,
    ) -> None:
        self.config = config
        self.period_s = config.control_period_s
        self.max_step_s = max_step_s
        self.rows = tuple(row.contiguous() for row in start.unbind(dim=1))
        like = self.rows[0]
        self.numbers: dict[str, Number] = {**config.values(), **given}
        ops = torch_ops(like)
        self.full = {name: self._row(value, like) for name, value in self.numbers.items()}
        self.model = SingleTrack(ops, config.kind, self.full, config.effects)
        self.chain = ActuatorChain(ops, self.full, config.effects)
        self.is_compiled = compiled
        self.t0_s = self._row(t0_s, like) if isinstance(t0_s, torch.Tensor) else t0_s
        self.past = 0 if past is None else int(past.commands.shape[1])
        self.past_rows: list[State] = []
        if past is not None and past.states is not None:
            self.past_rows = [tuple(tick.contiguous()) for tick in past.states.permute(1, 2, 0)]
        self.ticks = int(commands.shape[1])
        parts = [commands.new_zeros(len(like), 1, 2)] if past is None else [past.commands[:, :1], past.commands]
        # (2, ticks, cars): the command before the history, the history, the commands.
        self.issued = torch.cat([*parts, commands], dim=1).permute(2, 1, 0).contiguous()

    @staticmethod
    def _row(value: Number, like: torch.Tensor) -> torch.Tensor:
        return torch.as_tensor(value, dtype=like.dtype, device=like.device).expand(like.shape).contiguous()

    @staticmethod
    def _stacked(rows: Any) -> torch.Tensor:
        """Rows of six, one for each tick, as a tensor (ticks, 6, cars)."""
        return torch.stack([torch.stack(row) for row in rows])

    def run(self) -> torch.Tensor:
        plan = plan_period(self.period_s, total_delays_s(self.numbers, self.config.effects), self.max_step_s)
        before = self.past if self.chain.has_memory or self.model.extra_states else 0
        acting = self._acting_commands(plan, before)
        extra, memory = self._initial_hidden_states(self.rows, plan.pieces, acting, before)
        start = _Moment((*self.rows, *extra), memory)
        ends = self._advance(start, self._segments(plan.pieces, acting, before))
        at_ticks = (start, *ends[len(plan.pieces) - 1 :: len(plan.pieces)])
        return self._stacked([moment.state[:6] for moment in at_ticks]).permute(2, 0, 1)

    def _initial_hidden_states(
        self, start: State, pieces: Sequence[Piece], acting: list[tuple[Value, ...]], before: int
    ) -> tuple[State, ActuatorState]:
        """Hidden states of body and actuators at the first tick, simulated through the history.

        They start in steady state. The body has the states ``past_rows``, or the velocities of the start.
        """
        oldest = self.issued[:, 0]
        memory = self.chain.settled((oldest[0], oldest[1]))
        if not self.model.extra_states:
            for k in range(before):
                for piece, commands in zip(pieces, acting, strict=True):
                    _, memory = self.chain.step((commands[0][k], commands[1][k]), memory, piece.length_s)
            return (), memory
        ticks = [*self.past_rows[-before:], start] if self.past_rows and before else [start] * (before + 1)
        t_s = self.t0_s - before * self.period_s
        actuation = self.model.actuation(*self.chain.settled_output((oldest[0], oldest[1])))
        extra = self.model.settled(t_s, ticks[0], actuation)
        if not before:
            return extra, memory
        first = _Moment((*ticks[0], *extra), memory)
        end = self._advance(first, self._history_segments(pieces, acting, self._stacked(ticks), t_s))[-1]
        return end.state[6:], end.memory

    def _history_segments(
        self, pieces: Sequence[Piece], acting: list[tuple[Value, ...]], ticks: Value, t_s: Value
    ) -> Iterator[_Segment]:
        """The pieces of the periods between the states ``ticks`` (n, 6, cars), each from the interpolated state."""
        shares = [piece.start_s * (1.0 / self.period_s) for piece in pieces]
        bodies = [ticks[:-1] + (ticks[1:] - ticks[:-1]) * share for share in shares]
        for k in range(len(ticks) - 1):
            for piece, commands, body in zip(pieces, acting, bodies, strict=True):
                begin_s = t_s + k * self.period_s + piece.start_s
                yield _Segment(begin_s, (commands[0][k], commands[1][k]), piece.step_s, piece.steps, body=body[k])

    def _segments(self, pieces: Sequence[Piece], acting: list[tuple[Value, ...]], before: int) -> Iterator[_Segment]:
        """The pieces of all periods."""
        for k in range(self.ticks):
            for piece, commands in zip(pieces, acting, strict=True):
                held = commands[0][before + k], commands[1][before + k]
                yield _Segment(self.t0_s + k * self.period_s + piece.start_s, held, piece.step_s, piece.steps)

    def _advance(self, now: _Moment, segments: Iterable[_Segment]) -> list[_Moment]:
        """Integrate the car; the ends of the segments."""
        by_segment = self._by_compiled_code if self.is_compiled else self._by_operators
        ends = []
        for segment in segments:
            if segment.body is not None:
                now = now._replace(state=(*segment.body, *now.state[6:]))
            now = by_segment(now, segment)
            ends.append(now)
        return ends

    def _by_compiled_code(self, start: _Moment, segment: _Segment) -> _Moment:
        key = Key.of(self.config.kind, self.config.effects)
        parameters = (self.full[name] for name in trace_step(key).parameters)
        given = (*parameters, segment.step_s, *segment.commands, segment.t_s, *start.state, *start.memory)
        end = advance_tensors(key, segment.steps, *given)
        return _Moment(end[: len(start.state)], end[len(start.state) :])

    def _by_operators(self, start: _Moment, segment: _Segment) -> _Moment:
        t_s, commands, step_s, steps, _ = segment
        return _Moment(*integrate_held(self.model, self.chain, t_s, *start, commands, step_s, steps))

    def _acting_commands(self, plan: PeriodPlan, before: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Steering and throttle acting in each piece of each period, each (before + ticks, cars)."""
        period = torch.arange(-before, self.ticks, device=self.issued.device)[:, None] + 1 + self.past
        cars, both = self.issued.shape[2], []
        for issued, delay_periods in zip(self.issued, plan.command_periods, strict=True):
            newer = (period - delay_periods).clamp_min(0)
            indices = (newer, (newer - 1).clamp_min(0))
            both.append([torch.gather(issued, 0, index.expand(-1, cars)) for index in indices])
        steering, throttle = both
        return [
            (_either(piece.new_command[0], *steering), _either(piece.new_command[1], *throttle))
            for piece in plan.pieces
        ]


def _either(which: bool | torch.Tensor, yes: torch.Tensor, no: torch.Tensor) -> torch.Tensor:
    if isinstance(which, bool):
        return yes if which else no
    return torch.where(which, yes, no)
