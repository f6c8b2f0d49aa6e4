"""Compiled advance of a batch of cars: actuators, dynamics and the filter of measured velocities in one function.

The equations (``ActuatorChain.step``, ``rk4_step``, ``filter_step``) are traced once for each kind of model and set of
effects, and compiled to machine code: loops over segments and integration steps, and the derivative of one step.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
import torch

from sim_backends.array_ops import Ops, Value
from sim_backends.compiled.machine_code import (
    FloatRow,
    MachineCode,
    compile_function,
    compile_segments,
    vector_length,
)
from sim_backends.compiled.tracing import Node, Tracer, gradients, needed_nodes
from sim_backends.dynamics.actuators import ActuatorChain
from sim_backends.dynamics.integrate import integrate_held
from sim_backends.dynamics.single_track import SingleTrack
from sim_backends.effects import EFFECTS, Effect
from sim_backends.effects.base import ModelKind
from sim_backends.measurement import MeasurementModel, filter_step
from sim_backends.registry import REGISTRY

BODY_ROWS = 6
"""Rows of the state of the body: x, y, yaw, vx, vy, yaw rate."""


class Key(NamedTuple):
    """What a compiled function depends on."""

    kind: ModelKind
    effects: tuple[Effect, ...]
    has_filter: bool
    """Whether measured velocities are filtered."""


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
    """Trace one step: carried are the state of the car, of its actuators, and the filtered velocities if any."""
    tracer = Tracer()
    ops = cast(Ops, tracer)
    ids = [effect.id for effect in key.effects]
    names = [n for n in REGISTRY if not n.startswith("effects.") or n.split(".")[1] in ids]
    values = {name: tracer.input(name) for name in names}
    step_s, steering, throttle, t_s = (tracer.input(name) for name in ("step", "steering", "throttle", "t"))
    model, chain = SingleTrack(ops, key.kind, values, ids), ActuatorChain(ops, values, ids)
    state = tuple(tracer.input(f"state{i}") for i in range(6 + len(model.extra_states)))
    memory = tuple(tracer.input(f"memory{i}") for i in range(len(chain.settled((steering, throttle)))))
    filtered = tuple(tracer.input(f"filtered{i}") for i in range(3 if key.has_filter else 0))
    after, memory_after = integrate_held(model, chain, t_s, state, memory, (steering, throttle), step_s, 1)
    outputs = [*after, *memory_after]
    if key.has_filter:
        measurement = MeasurementModel(ops, values, ids)
        first, last = (measurement.observe(s[:6])[3:6] for s in (state, after))
        outputs += filter_step(ops, filtered, first, last, step_s, measurement.velocity_time_constant_s)
    used = {node.index for node in needed_nodes(outputs)}
    parameters = {name: node for name, node in values.items() if node.index in used}
    commands, uses_time = (steering, throttle), t_s.index in used
    return Graph(tracer, parameters, step_s, commands, t_s, uses_time, [*state, *memory, *filtered], outputs)


@functools.lru_cache(maxsize=256)
def compile_advance(key: Key, dtype: np.dtype[Any]) -> MachineCode:
    """Compile the loops over segments and steps."""
    graph = trace_step(key)
    parameters = list(graph.parameters.values())
    clock = graph.step_s, graph.t_s
    return compile_segments(parameters, graph.commands, *clock, graph.carried, BODY_ROWS, graph.outputs, dtype)


@functools.lru_cache(maxsize=512)
def compile_gradient(key: Key, wanted: tuple[bool, ...], dtype: np.dtype[Any]) -> MachineCode:
    """Compile the derivative of one step: inputs are those of the step, then one seed for each of its outputs.

    ``wanted`` selects the inputs to differentiate by; there is one output for each True.
    """
    graph = trace_step(key)
    tracer = Tracer(list(graph.tracer.nodes), dict(graph.tracer._known))
    moved = {node.index: Node(tracer, node.index, node.operation, node.arguments) for node in tracer.nodes}
    for index, node in moved.items():
        node.arguments = tuple(moved[a.index] if isinstance(a, Node) else a for a in node.arguments)
        tracer.nodes[index] = node
    tracer._known = {k: moved[node.index] for k, node in tracer._known.items()}
    seeds = [tracer.input(f"seed{i}") for i in range(len(graph.outputs))]
    inputs = [moved[node.index] for node in graph.inputs]
    sources = [node for node, want in zip(inputs, wanted, strict=True) if want]
    results = gradients([moved[o.index] if isinstance(o, Node) else o for o in graph.outputs], seeds, sources)
    return compile_function([*inputs, *seeds], results, dtype)


class Row(NamedTuple):
    """A row of a matrix (rows, cars), or a block of (blocks, 6, cars); its address follows from that of the whole."""

    matrix: Value
    number: int

    @property
    def value(self) -> Value:
        """The row (cars,), or the block (6, cars)."""
        return self.matrix[self.number]


class Segment(NamedTuple):
    """An interval with held commands."""

    t_s: Value
    """Time at its start [s], () or (cars,)."""
    commands: tuple[Row, Row]
    """Steering and throttle in [-1, 1]."""
    step_s: Value
    """Length of an integration step [s], () or (cars,)."""
    steps: int
    for_measurement: bool = False
    """Whether the segment only leads to a capture: the next one starts where this one started."""
    body: Row | None = None
    """Block (6, cars) of the state of the body at the start; by default that at the end of the segment before."""


class CompiledCars:
    """Advances one batch of cars: NumPy arrays in, arrays out; tensors in, tensors with a gradient out.

    Args:
        kind: Form of the model.
        effects: Ids of its effects.
        values: Numbers by dotted name, rows (cars,).
        has_filter: Whether measured velocities are filtered.
    """

    def __init__(self, kind: ModelKind, effects: Iterable[str], values: Mapping[str, Value], has_filter: bool) -> None:
        self._key = Key(kind, tuple(EFFECTS[name] for name in effects), has_filter)
        self._parameters = [values[name] for name in trace_step(self._key).parameters]
        mass = values["vehicle.mass"]
        self._on_arrays = isinstance(mass, np.ndarray)
        self._cars = len(mass)
        self._dtype = mass.dtype if self._on_arrays else np.dtype(str(mass.dtype).removeprefix("torch."))
        self._rows = _Rows(max(self._cars, vector_length(self._dtype)), self._dtype)

    def run(self, carried: Sequence[Value], segments: Sequence[Segment]) -> list[tuple[Value, ...]]:
        """Advance ``carried`` through the segments, and return it at the end of each.

        Args:
            carried: Rows (cars,): the state of the car, of its actuators, and the filtered velocities if any.
            segments: In the order of time.
        """
        if self._on_arrays:
            ends = _run(self._key, self._parameters, carried, segments, self._rows)
            return [tuple(block) for block in ends[:, :, : self._cars]]
        found = []
        for segment in segments:
            commands = (row.value for row in segment.commands)
            if segment.body is not None:
                carried = (*segment.body.value, *carried[BODY_ROWS:])
            given = (*self._parameters, segment.step_s, *commands, segment.t_s, *carried)
            after = tuple(_Advance.apply(self._key, segment.steps, *given))  # type: ignore[no-untyped-call]
            found.append(after)
            carried = carried if segment.for_measurement else after
        return found


def _run(
    key: Key,
    parameters: Sequence[Value],
    carried: Sequence[Value],
    segments: Sequence[Segment],
    rows: _Rows,
) -> FloatRow:
    """Carried rows at the ends of the segments, shape (segments, carried, length of ``rows``)."""
    code = compile_advance(key, rows.dtype)
    inputs = np.array([rows.address(value) for value in (*parameters, *carried)], np.uint64)
    results = np.empty((len(segments), len(carried), rows.length), rows.dtype)
    uses_time = trace_step(key).uses_time
    out, size = results.ctypes.data, results.strides[0]
    lines = []
    for k, (t_s, (steering, throttle), step_s, steps, for_measurement, body) in enumerate(segments):
        step = rows.address(step_s)
        time = rows.address(t_s) if uses_time else step
        commands = rows.address_in(*steering), rows.address_in(*throttle)
        end = out + k * size
        start = end if body is None else rows.address_in(*body)  # without a body the code ignores the numbers
        lines.append((steps, for_measurement, body is not None, step, time, *commands, start, end))
    table = np.array(lines, np.uint64)
    if segments:
        code.call(rows.length, len(segments), inputs.ctypes.data, table.ctypes.data)
    return results


class _Rows:
    """Addresses of contiguous rows of numbers and arrays; keeps the rows in memory. Short rows are repeated."""

    def __init__(self, length: int, dtype: np.dtype[Any]) -> None:
        self.length, self.dtype = length, dtype
        self._known: dict[float | int, tuple[Value, int]] = {}

    def address(self, value: Value) -> int:
        """Address of the row of ``value``, which is made once."""
        key = value if isinstance(value, float) else id(value)
        if key not in self._known:
            row = _as_row(value, self.length, self.dtype)
            self._known[key] = ((value, row), row.__array_interface__["data"][0])
        return self._known[key][1]

    def address_in(self, matrix: Value, index: int) -> int:
        """Address of a row of a matrix (rows, cars), or of a block of (blocks, 6, cars)."""
        shape: tuple[int, ...] = matrix.shape
        if shape[-1] != self.length:
            return self.address(matrix[index])
        return self.address(matrix) + index * self.dtype.itemsize * math.prod(shape[1:])


def _as_row(value: Value, cars: int, dtype: np.dtype[Any]) -> FloatRow:
    """A number, array or tensor as a contiguous row, or an array (..., cars) of such rows; short rows are repeated."""
    if isinstance(value, torch.Tensor):
        value = value.detach().numpy()
    if isinstance(value, np.ndarray) and value.ndim:
        if value.shape[-1] not in (0, cars):
            value = value[..., np.arange(cars) % value.shape[-1]]
        return np.ascontiguousarray(value if value.size else np.zeros((*value.shape[:-1], cars)), dtype)
    return np.full(cars, value, dtype)


class _Advance(torch.autograd.Function):
    """A segment with its compiled derivative; keeps its inputs and the carried values before each step."""

    @staticmethod
    def forward(ctx: Any, key: Key, steps: int, *inputs: Any) -> tuple[torch.Tensor, ...]:
        graph = trace_step(key)
        last: torch.Tensor = inputs[-1]
        cars, dtype = len(last), np.dtype(str(last.dtype).removeprefix("torch."))
        length = max(cars, vector_length(dtype))
        rows = [_as_row(value, length, dtype) for value in inputs]
        parameters, (step, steering, throttle, t_s), carried = _cut(rows, len(graph.parameters))
        times = [t_s + k * step for k in range(steps)]
        commands = Row(steering[None], 0), Row(throttle[None], 0)
        segments = [Segment(t, commands, step, 1) for t in times]
        after = _run(key, parameters, carried, segments, _Rows(length, dtype))
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


def _cut(rows: list[FloatRow], parameters: int) -> tuple[list[FloatRow], list[FloatRow], list[FloatRow]]:
    """Input rows as parameters, the four rows of a segment, and carried rows."""
    return rows[:parameters], rows[parameters : parameters + 4], rows[parameters + 4 :]
