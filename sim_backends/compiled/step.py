"""A Runge-Kutta step of the model, and its derivative, compiled to straight-line NumPy code.

The equations (``rk4_step`` of ``SingleTrack``) are traced once for each kind of model and set of effects. The generated
function calls only NumPy functions on a few reused buffers, without temporaries, dispatch or autograd.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from sim_backends.array_ops import Ops, Value
from sim_backends.car_parameters import ModelKind
from sim_backends.compiled.simd import OF_ROWS, OF_TENSORS, faster_in_torch
from sim_backends.compiled.tracing import Node, Tracer, fold, gradients
from sim_backends.dynamics.integrate import rk4_step
from sim_backends.dynamics.single_track import Actuation, SingleTrack
from sim_backends.effects import Effect
from sim_backends.registry import REGISTRY

FloatRow = NDArray[np.floating[Any]]
_NUMPY = {
    "add": "add",
    "sub": "subtract",
    "mul": "multiply",
    "div": "divide",
    "neg": "negative",
    "atan": "arctan",
    "atan2": "arctan2",
    "abs": "abs",
}
_NO_OUTPUT = ("less", "less_equal", "where")
"""Operations whose result is a new array: boolean results, or no ``out`` argument in NumPy."""
_NO_SCALARS = ("maximum", "minimum")
"""Operations that are slow in NumPy with a scalar and take ``out`` by keyword only."""
FEW_CARS = 2048
"""Number of cars up to which each result has a separate buffer; above, results overwrite unused arguments."""
CHUNK_CARS = 2048
"""Cars per chunk of the derivative, so that its intermediate results fit the cache."""


@dataclass(frozen=True, slots=True)
class Graph:
    """The traced step: inputs by group, outputs, and nodes that are constant over the steps.

    ``fixed`` are the nodes that depend on parameters and the step length alone; the step takes them as inputs.
    """

    tracer: Tracer
    values: dict[str, Node]
    step_s: Node
    varying: list[Node]
    fixed: list[Node]
    outputs: list[Any]

    def fixed_values(self, ops: Ops, values: Mapping[str, Value], step_s: Value) -> list[Value]:
        """Compute ``fixed`` for given parameters and step length."""
        known: dict[int, Value] = {self.step_s.index: step_s}
        known |= {node.index: values[name] for name, node in self.values.items() if name in values}

        def compute(node: Any) -> Value:
            if not isinstance(node, Node):
                return node
            if node.index not in known:
                arguments = [compute(a) for a in node.arguments]
                known[node.index] = _apply(ops, node.operation, arguments)
            return known[node.index]

        return [compute(node) for node in self.fixed]


def _apply(ops: Ops, operation: str, arguments: list[Value]) -> Value:
    if all(isinstance(a, float) for a in arguments):  # depends on the step length only
        return fold(operation, *arguments)
    match operation:
        case "add":
            return arguments[0] + arguments[1]
        case "sub":
            return arguments[0] - arguments[1]
        case "mul":
            return arguments[0] * arguments[1]
        case "div":
            return arguments[0] / arguments[1]
        case "neg":
            return -arguments[0]
        case "maximum":
            return ops.floor(arguments[0], arguments[1])
        case "minimum":
            return -ops.floor(-arguments[0], -arguments[1])
        case "less":
            return arguments[0] < arguments[1]
        case "less_equal":
            return arguments[0] <= arguments[1]
        case _:
            return getattr(ops, operation)(*arguments)


@functools.lru_cache(maxsize=256)
def trace_step(kind: ModelKind, effects: tuple[Effect, ...], held: bool) -> Graph:
    """Trace one step. With ``held`` the actuation is the same at its start, middle and end.

    The varying inputs are: time, state, extra states, then angle, sine, cosine and throttle of each actuation.
    """
    tracer = Tracer()
    ids = [effect.id for effect in effects]
    names = [n for n in REGISTRY if not n.startswith("effects.") or n.split(".")[1] in ids]
    values = {name: tracer.input(name) for name in names}
    step_s = tracer.input("step")
    model = SingleTrack(tracer.as_ops(), kind, values, ids)
    first_varying = len(tracer.nodes)
    t_s = tracer.input("t")
    state = tuple(tracer.input(f"state{i}") for i in range(6 + len(model.extra_states)))
    actuations = [
        Actuation(*(tracer.input(f"{name}{i}") for name in ("angle", "sin", "cos", "throttle")))
        for i in range(1 if held else 3)
    ]
    start, middle, end = actuations * 3 if held else actuations
    outputs = list(rk4_step(model, t_s, state, step_s, start, middle, end))
    varying = [t_s, *state, *(node for actuation in actuations for node in actuation)]

    depends = {node.index for node in varying}
    fixed: dict[int, Node] = {}
    for node in tracer.nodes:
        if any(isinstance(a, Node) and a.index in depends for a in node.arguments):
            depends.add(node.index)
    for node in tracer.nodes[first_varying:]:
        if node.index in depends:
            fixed |= {a.index: a for a in node.arguments if isinstance(a, Node) and a.index not in depends}
    return Graph(tracer, values, step_s, varying, list(fixed.values()), outputs)


Step = Callable[
    [Sequence[Value], Sequence[FloatRow], Sequence[torch.Tensor], Sequence[FloatRow], Sequence[FloatRow]], None
]
"""Inputs, buffers, the same buffers as tensors, outputs and constants of a generated function."""


_SHARED = threading.local()
_MAX_BUFFER_SIZES = 4


def _shared_buffers(count: int, cars: int, dtype: np.dtype[Any]) -> list[FloatRow]:
    """Scratch rows of this thread, shared by all functions since one runs at a time."""
    pools: dict[tuple[int, np.dtype[Any]], list[FloatRow]] = _SHARED.__dict__.setdefault("pools", {})
    pool = pools.pop((cars, dtype), [])
    pool += [np.empty(cars, dtype) for _ in range(count - len(pool))]
    pools[cars, dtype] = pool
    while len(pools) > _MAX_BUFFER_SIZES:
        del pools[next(iter(pools))]
    return pool[:count]


@dataclass(frozen=True, slots=True)
class GeneratedFunction:
    """A generated function, the number of its buffers, and its constants: each, and whether as a row of cars."""

    step: Step
    buffers: int
    constants: tuple[tuple[float, bool], ...]


@dataclass(frozen=True, slots=True)
class Code:
    """Generated functions for few and for many cars, and the scratch memory that they work in."""

    function: Callable[[bool, frozenset[str]], GeneratedFunction]
    """The function for few (False) or many (True) cars, with these functions of torch, generated by its first call."""
    operands: int
    """Number of rows read and written in one run, over all operations."""
    _scratch: threading.local = field(default_factory=threading.local)

    def run(self, inputs: Sequence[Value], outputs: Sequence[FloatRow]) -> None:
        """Compute ``outputs`` (rows of equal length and dtype) from ``inputs`` (such rows, or numbers)."""
        cars, dtype = outputs[0].shape[0], outputs[0].dtype
        kept = getattr(self._scratch, "kept", None)
        if kept is None or kept[0] != (cars, dtype):
            function = self.function(cars > FEW_CARS, faster_in_torch(cars, dtype))
            buffers = _shared_buffers(function.buffers, cars, dtype)
            tensors = [torch.from_numpy(b) for b in buffers]
            constants = [np.full(cars if row else (), value, dtype) for value, row in function.constants]
            kept = ((cars, dtype), function.step, buffers, tensors, constants)
            self._scratch.kept = kept
        _, step, buffers, tensors, constants = kept
        step(inputs, buffers, tensors, outputs, constants)


@functools.lru_cache(maxsize=256)
def compile_step(kind: ModelKind, effects: tuple[Effect, ...], held: bool) -> Code:
    """Compile the step: inputs are the fixed and the varying ones, outputs the rows of the new state."""
    graph = trace_step(kind, effects, held)
    return _generate([*graph.fixed, *graph.varying], graph.outputs)


@functools.lru_cache(maxsize=512)
def compile_gradient(kind: ModelKind, effects: tuple[Effect, ...], held: bool, wanted: tuple[bool, ...]) -> Code:
    """Compile the derivative of the step: inputs are those of the step, then one seed for each of its outputs.

    ``wanted`` selects the inputs to differentiate by; the function has one output for each True.
    """
    graph = trace_step(kind, effects, held)
    inputs = [*graph.fixed, *graph.varying]
    tracer = Tracer(list(graph.tracer.nodes), dict(graph.tracer._known))
    moved = {node.index: Node(tracer, node.index, node.operation, node.arguments) for node in tracer.nodes}
    for index, node in moved.items():
        node.arguments = tuple(moved[a.index] if isinstance(a, Node) else a for a in node.arguments)
        tracer.nodes[index] = node
    tracer._known = {key: moved[node.index] for key, node in tracer._known.items()}
    seeds = [tracer.input(f"seed{i}") for i in range(len(graph.outputs))]
    sources = [moved[node.index] for node, want in zip(inputs, wanted, strict=True) if want]
    # Fixed nodes are inputs; the caller differentiates them by the parameters.
    for node in graph.fixed:
        moved[node.index].operation, moved[node.index].arguments = "input", ()
    results = gradients([moved[o.index] if isinstance(o, Node) else o for o in graph.outputs], seeds, sources)
    return _generate([*(moved[node.index] for node in inputs), *seeds], results)


def _generate(inputs: Sequence[Node], outputs: Sequence[Any]) -> Code:
    """Code of ``outputs``: straight-line functions for few and for many cars, each compiled when it is first used.

    For many cars a result overwrites an argument that is not needed any more, which saves memory traffic; for few cars
    NumPy's check for overlap costs more than it saves.
    """
    given = {node.index: f"i{k}" for k, node in enumerate(inputs)}
    order: dict[int, Node] = {}
    stack = [o for o in outputs if isinstance(o, Node)]
    while stack:
        node = stack.pop()
        if node.index not in order and node.index not in given:
            order[node.index] = node
            stack += [a for a in node.arguments if isinstance(a, Node)]
    nodes = [order[index] for index in sorted(order)]
    operands = sum(1 + sum(isinstance(a, Node) for a in node.arguments) for node in nodes)

    @functools.cache
    def function(in_place: bool, in_torch: frozenset[str]) -> GeneratedFunction:
        return _Writer(given, nodes, outputs, in_place, in_torch).function()

    return Code(function, operands)


class _Writer:
    """Generates the code of a list of nodes with a small number of buffers.

    Torch computes the functions ``in_torch``. Their calls on buffers use the tensors of the buffers, which saves a few
    microseconds each.
    """

    def __init__(
        self,
        given: Mapping[int, str],
        nodes: Sequence[Node],
        outputs: Sequence[Any],
        in_place: bool,
        in_torch: frozenset[str],
    ) -> None:
        self.buffers = 0
        self.constants: dict[tuple[float, bool], int] = {}
        self._names = dict(given)
        self._lines: list[str] = []
        self._in_torch = in_torch
        self._scope: dict[str, Any] = {}
        self._tensors: dict[str, str] = {}
        self._given, self._outputs = given, outputs
        self._free: list[int] = []
        self._places = {o.index: k for k, o in enumerate(outputs) if isinstance(o, Node)}
        last_use = {a.index: n.index for n in nodes for a in n.arguments if isinstance(a, Node)}
        held_by: dict[int, int] = {}
        for node in nodes:
            arguments = [self._argument(a, node) for a in node.arguments]
            done = {a.index for a in node.arguments if isinstance(a, Node) and last_use[a.index] == node.index}
            freed = [held_by.pop(index) for index in sorted(done) if index in held_by]
            if in_place:
                self._free += freed
            if (buffer := self._write(node, arguments)) is not None:
                held_by[node.index] = buffer
            if not in_place:
                self._free += freed

    def _argument(self, argument: Any, node: Node) -> str:
        if isinstance(argument, Node):
            return self._names[argument.index]
        key = (float(argument), node.operation in _NO_SCALARS)
        return f"c{self.constants.setdefault(key, len(self.constants))}"

    def _write(self, node: Node, arguments: list[str]) -> int | None:
        function = _NUMPY.get(node.operation, node.operation)
        name = self._names[node.index] = f"v{node.index}"
        if node.operation in _NO_OUTPUT:
            self._lines.append(f"{name} = {self._of_rows(function)}({', '.join(arguments)})")
            return None
        buffer = None
        if node.index in self._places:
            target = f"o{self._places[node.index]}"
        else:
            if not self._free:
                self._free.append(self.buffers)
                self.buffers += 1
            buffer = self._free.pop()
            target = f"b{buffer}"
            self._tensors[name] = f"t{buffer}"
        if function in self._in_torch and {name, *arguments} <= self._tensors.keys():
            tensors = ", ".join(self._tensors[a] for a in arguments)
            self._lines.append(f"{self._of_tensors(function)}({tensors}, out={self._tensors[name]})")
            self._lines.append(f"{name} = {target}")
            return buffer
        keyword = "out=" if node.operation in _NO_SCALARS else ""
        self._lines.append(f"{name} = {self._of_rows(function)}({', '.join(arguments)}, {keyword}{target})")
        return buffer

    def _of_rows(self, function: str) -> str:
        """Name in the generated code of a function of rows."""
        self._scope[function] = OF_ROWS[function] if function in self._in_torch else getattr(np, function)
        return function

    def _of_tensors(self, function: str) -> str:
        """Name in the generated code of a function of tensors."""
        name = f"torch_{function}"
        self._scope[name] = OF_TENSORS[function]
        return name

    def function(self) -> GeneratedFunction:
        """Compile the generated code."""
        unpack = []
        for letter, count in (
            ("i", len(self._given)),
            ("b", self.buffers),
            ("t", self.buffers if self._in_torch else 0),
            ("o", len(self._outputs)),
        ):
            unpack += [f"{''.join(f'{letter}{k}, ' for k in range(count))} = {letter}"] if count else []
        if self.constants:
            unpack.append(f"{''.join(f'c{k}, ' for k in range(len(self.constants)))} = c")
        copies = []
        for k, o in enumerate(self._outputs):
            if not isinstance(o, Node):
                copies.append(f"o{k}[...] = {float(o)!r}")
            elif o.index in self._given or self._places[o.index] != k or o.operation in _NO_OUTPUT:
                copies.append(f"o{k}[...] = {self._names[o.index]}")
        lines = [*unpack, *self._lines, *copies]
        source = "def step(i, b, t, o, c):\n" + "".join(f"    {line}\n" for line in lines)
        exec(compile(source, "<compiled step>", "exec"), self._scope)
        return GeneratedFunction(cast(Step, self._scope["step"]), self.buffers, tuple(self.constants))
