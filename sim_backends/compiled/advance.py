"""Compiled advance of cars: actuators and dynamics in one function.

The equations (``ActuatorChain.step``, ``rk4_step``) are traced once for each kind of model and set of effects, and
compiled to machine code: loops over segments and integration steps, and the derivative of one step.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from sim_backends.array_ops import Ops, Value
from sim_backends.compiled.machine_code import (
    FloatRow,
    MachineCode,
    SegmentTable,
    addresses,
    compile_function,
    compile_segments,
    vector_length,
)
from sim_backends.compiled.tracing import Node, Tracer, gradients, needed_nodes
from sim_backends.dynamics.actuators import ActuatorChain
from sim_backends.dynamics.integrate import integrate_held
from sim_backends.dynamics.single_track import SingleTrack
from sim_backends.effects import EFFECTS, DelayEffect, Effect
from sim_backends.effects.base import ModelKind
from sim_backends.registry import REGISTRY

BODY_ROWS = 6
"""Rows of the state of the body: x, y, yaw, vx, vy, yaw rate."""


class Key(NamedTuple):
    """What a compiled function depends on."""

    kind: ModelKind
    effects: tuple[Effect, ...]
    has_body: bool = True
    """Whether the dynamics are simulated, and not the actuators alone."""

    @classmethod
    def of(cls, kind: ModelKind, effects: Iterable[str]) -> Key:
        """The key of effects (ids), which act in an order of their own; delays are no part of a step."""
        chosen = [e for e in map(EFFECTS.__getitem__, sorted(effects)) if not isinstance(e, DelayEffect)]
        return cls(kind, tuple(chosen))


@dataclass(frozen=True, slots=True)
class Graph:
    """The traced step. ``carried`` are the inputs that the step changes, in the order of ``outputs``."""

    tracer: Tracer
    parameters: dict[str, Node]
    """Parameters of the car that the step uses, by dotted name."""
    step_s: Node
    commands: tuple[Node, Node]
    t_s: Node
    uses_time: bool
    """Whether an output depends on the time."""
    carried: list[Node]
    outputs: list[Any]

    @property
    def given(self) -> list[Node]:
        """Inputs that are the same for all steps, except the time."""
        return [*self.parameters.values(), self.step_s, *self.commands]

    @property
    def inputs(self) -> list[Node]:
        """All inputs, in the order of the compiled functions."""
        return [*self.given, self.t_s, *self.carried]


@functools.lru_cache(maxsize=256)
def trace_step(key: Key) -> Graph:
    """The traced step of a key; nothing may be added to its graph."""
    return _trace(key)


def _trace(key: Key) -> Graph:
    """Trace one step: carried are the states of the body and of the actuators."""
    tracer = Tracer()
    ops = cast(Ops, tracer)
    ids = [effect.id for effect in key.effects]
    names = [n for n in REGISTRY if not n.startswith("effects.") or n.split(".")[1] in ids]
    values = {name: tracer.input(name) for name in names}
    step_s, steering, throttle, t_s = (tracer.input(name) for name in ("step", "steering", "throttle", "t"))
    model, chain = SingleTrack(ops, key.kind, values, ids), ActuatorChain(ops, values, ids)
    state = tuple(tracer.input(f"state{i}") for i in range(6 + len(model.extra_states) if key.has_body else 0))
    memory = tuple(tracer.input(f"memory{i}") for i in range(len(chain.settled((steering, throttle)))))
    if key.has_body:
        after, memory_after = integrate_held(model, chain, t_s, state, memory, (steering, throttle), step_s, 1)
    else:
        after, memory_after = (), chain.step((steering, throttle), memory, step_s)[1]
    outputs = [*after, *memory_after]
    used = {node.index for node in needed_nodes(outputs)}
    parameters = {name: node for name, node in values.items() if node.index in used}
    commands, uses_time = (steering, throttle), t_s.index in used
    return Graph(tracer, parameters, step_s, commands, t_s, uses_time, [*state, *memory], outputs)


@functools.lru_cache(maxsize=256)
def compile_advance(key: Key, dtype: np.dtype[Any]) -> MachineCode:
    """Compile the loops over segments and steps."""
    graph = trace_step(key)
    parameters = list(graph.parameters.values())
    clock = graph.step_s, graph.t_s
    body_rows = BODY_ROWS if key.has_body else 0
    return compile_segments(parameters, graph.commands, *clock, graph.carried, body_rows, graph.outputs, dtype)


@functools.lru_cache(maxsize=512)
def compile_gradient(key: Key, wanted: tuple[bool, ...], dtype: np.dtype[Any]) -> MachineCode:
    """Compile the derivative of one step: inputs are those of the step, then one seed for each of its outputs.

    ``wanted`` selects the inputs to differentiate by; there is one output for each True.
    """
    graph = _trace(key)
    seeds = [graph.tracer.input(f"seed{i}") for i in range(len(graph.outputs))]
    sources = [node for node, want in zip(graph.inputs, wanted, strict=True) if want]
    return compile_function([*graph.inputs, *seeds], gradients(graph.outputs, seeds, sources), dtype)


def address(row: FloatRow) -> int:
    """Address of the first number of an array."""
    start: int = row.__array_interface__["data"][0]
    return start


def segment_table(
    ends: NDArray[np.int64],
    steps: int,
    step: int,
    time: ArrayLike,
    commands: tuple[ArrayLike, ArrayLike],
    has_bodies: bool = False,
) -> NDArray[np.int64]:
    """The table (segments, columns) of a compiled advance; addresses are () or (segments,).

    Args:
        ends: Addresses (segments,) of the blocks of the carried rows at the end.
        steps: Number of steps of each segment.
        step: Address of the row of the step length.
        time: Addresses of the rows of the time at the start.
        commands: Addresses of the rows of steering and throttle.
        has_bodies: Whether the state of the body at the start is given, by addresses of blocks in the column ``START``
            (by default of ``ends``), and not that at the end before.
    """
    table = np.empty((len(ends), SegmentTable.OUT + 1), np.int64)
    columns = (steps, has_bodies, step, time, *commands, ends, ends)
    for k, column in enumerate(columns):
        table[:, k] = column
    return table


def advance_rows(key: Key, inputs: NDArray[np.integer[Any]], row: FloatRow, table: NDArray[np.int64]) -> None:
    """Advance cars through the segments of a table, and write the carried rows to the addresses of their ends.

    Args:
        key: Of the compiled function.
        inputs: Addresses of contiguous rows (cars,): the parameters of the graph, and the carried rows at the start.
        row: One of these rows, which has their length and type.
        table: As of ``segment_table``.
    """
    if len(table):
        compile_advance(key, row.dtype).call(len(row), len(table), inputs.ctypes.data, table.ctypes.data)


def advance_tensors(key: Key, steps: int, *inputs: Any) -> tuple[torch.Tensor, ...]:
    """Carried rows after a number of steps, differentiable in the inputs: numbers or tensors (cars,) as of ``Graph``.

    The last input is a tensor.
    """
    return tuple(_Advance.apply(key, steps, *inputs))  # type: ignore[no-untyped-call]


def _as_row(value: Value, cars: int, dtype: np.dtype[Any]) -> FloatRow:
    """A number or tensor as a contiguous row; short rows are repeated, an empty row becomes zeros."""
    if isinstance(value, torch.Tensor):
        value = value.detach().numpy()
    if not isinstance(value, np.ndarray) or not value.ndim:
        return np.full(cars, value, dtype)
    if len(value) not in (0, cars):
        value = value.take(np.arange(cars), mode="wrap")  # np.resize takes five times as long
    return np.ascontiguousarray(value if len(value) else np.zeros(cars), dtype)


class _Advance(torch.autograd.Function):
    """A segment with its compiled derivative; keeps its inputs and the carried values before each step."""

    @staticmethod
    def forward(ctx: Any, key: Key, steps: int, *inputs: Any) -> tuple[torch.Tensor, ...]:
        graph = trace_step(key)
        last: torch.Tensor = inputs[-1]
        cars, dtype = len(last), np.dtype(str(last.dtype).removeprefix("torch."))
        length = max(cars, vector_length(dtype))
        rows = [_as_row(value, length, dtype) for value in inputs]
        count = len(graph.parameters)
        parameters, (step, steering, throttle, t_s), carried = rows[:count], rows[count : count + 4], rows[count + 4 :]
        times = np.array([t_s + k * step for k in range(steps)])
        after = np.empty((steps, len(carried), length), dtype)
        numbers = np.arange(steps)
        table = segment_table(
            address(after) + after.strides[0] * numbers,
            1,
            address(step),
            address(times) + times.strides[0] * numbers,
            (address(steering), address(throttle)),
        )
        advance_rows(key, addresses([*parameters, *carried]), carried[0], table)
        ctx.key, ctx.given, ctx.times = key, [*parameters, step, steering, throttle], times
        ctx.befores = [carried, *after[:-1]]
        return tuple(torch.from_numpy(row[:cars]) for row in after[-1])

    @staticmethod
    def backward(ctx: Any, *seeds: torch.Tensor) -> tuple[Any, ...]:
        if torch.is_grad_enabled():  # create_graph=True: a second derivative would be wrong
            raise NotImplementedError("The compiled step has first derivatives only; call rollout(engine='operators').")
        given, needed, cars = ctx.given, ctx.needs_input_grad[2:], len(seeds[0])
        time_index, step_index = len(given), len(given) - 3
        # A step's time depends on the step length, and its carried values on all inputs.
        wanted = [*needed[:time_index], needed[time_index] or needed[step_index], *(True for _ in seeds)]
        code = compile_gradient(ctx.key, tuple(wanted), given[0].dtype)
        sums: list[Any] = [0.0] * (time_index + 1)
        adjoints: list[Any] = [_as_row(seed, len(given[0]), given[0].dtype) for seed in seeds]
        for k in reversed(range(len(ctx.times))):
            results = iter(code.run([*given, ctx.times[k], *ctx.befores[k], *adjoints], sum(wanted)))
            by_input: list[Any] = [next(results) if want else 0.0 for want in wanted]
            sums = [a + b for a, b in zip(sums, by_input, strict=False)]
            sums[step_index] = sums[step_index] + k * by_input[time_index]
            adjoints = by_input[time_index + 1 :]
        found = zip([*sums, *adjoints], needed, strict=True)
        return (None, None, *(torch.from_numpy(gradient[:cars]) if need else None for gradient, need in found))
