"""Stepper with the compiled step: NumPy arrays without gradients, CPU tensors with first derivatives."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch

from sim_backends.array_ops import Ops, Value
from sim_backends.car_parameters import ModelKind
from sim_backends.compiled.step import CHUNK_CARS, compile_gradient, compile_step, trace_step
from sim_backends.dynamics.single_track import Actuation, State
from sim_backends.effects import EFFECTS, Effect

Key = tuple[ModelKind, tuple[Effect, ...], bool]


class CompiledStepper:
    """A ``Stepper`` for one batch: NumPy arrays in, arrays out; tensors in, tensors with a gradient out.

    Args:
        ops: Functions of the library of ``values``.
        kind: Form of the model.
        effects: Ids of its effects.
        values: Numbers by dotted name, rows of one value per car.
    """

    def __init__(self, ops: Ops, kind: ModelKind, effects: Iterable[str], values: Mapping[str, Value]) -> None:
        self._ops = ops
        self._kind: ModelKind = kind
        self._effects = tuple(EFFECTS[name] for name in effects)
        self._values = values
        mass = values["vehicle.mass"]
        self._dtype = mass.dtype if isinstance(mass, np.ndarray) else np.dtype(str(mass.dtype).removeprefix("torch."))
        self._fixed: dict[tuple[bool, Any], tuple[Value, list[Value]]] = {}

    def __call__(
        self, t_s: Value, state: State, step_s: Value, start: Actuation, middle: Actuation, end: Actuation
    ) -> State:
        """One Runge-Kutta step."""
        held = start is middle and middle is end
        key: Key = (self._kind, self._effects, held)
        actuation = start if held else (*start, *middle, *end)
        inputs = (*self._fixed_for(key, step_s), t_s, *state, *actuation)
        if isinstance(state[0], torch.Tensor):
            return tuple(_Step.apply(key, *inputs))  # type: ignore[no-untyped-call]
        outputs = [np.empty_like(row) for row in state]
        compile_step(*key).run(inputs, outputs)
        return tuple(outputs)

    def _fixed_for(self, key: Key, step_s: Value) -> list[Value]:
        """Values that depend on parameters and step length only, computed once for each length."""
        name = (key[2], step_s if isinstance(step_s, float) else id(step_s))
        if name not in self._fixed:
            fixed = trace_step(*key).fixed_values(self._ops, self._values, step_s)
            # NumPy is slower for a Python number than for a zero-dimensional array.
            self._fixed[name] = (step_s, [np.asarray(v, self._dtype) if isinstance(v, float) else v for v in fixed])
        return self._fixed[name][1]


class _Step(torch.autograd.Function):
    """The compiled step with its compiled derivative; keeps only its inputs."""

    @staticmethod
    def forward(ctx: Any, key: Key, *inputs: Any) -> tuple[torch.Tensor, ...]:
        rows = len(inputs) - len(trace_step(*key).varying)
        state = inputs[rows + 1 : rows + 1 + len(trace_step(*key).outputs)]
        outputs = tuple(torch.empty_like(row, memory_format=torch.contiguous_format) for row in state)
        compile_step(*key).run([_plain(v) for v in inputs], [o.numpy() for o in outputs])
        ctx.key = key
        ctx.numbers = [None if isinstance(v, torch.Tensor) else v for v in inputs]
        ctx.save_for_backward(*(v for v in inputs if isinstance(v, torch.Tensor)))
        return outputs

    @staticmethod
    def backward(ctx: Any, *seeds: torch.Tensor) -> tuple[Any, ...]:
        if torch.is_grad_enabled():  # create_graph=True: a second derivative would be wrong
            raise NotImplementedError("The compiled step has first derivatives only; call rollout(engine='operators').")
        saved = iter(ctx.saved_tensors)
        inputs = [_plain(next(saved) if v is None else v) for v in ctx.numbers]
        seeds_given = [_plain(s.contiguous()) for s in seeds]
        wanted = tuple(bool(w) for w in ctx.needs_input_grad[1:])
        code = compile_gradient(*ctx.key, wanted)
        cars = len(seeds_given[0])
        results = [torch.empty_like(seeds[0], memory_format=torch.contiguous_format) for w in wanted if w]
        views = [r.numpy() for r in results]
        for first in range(0, cars, CHUNK_CARS):
            cut = slice(first, first + CHUNK_CARS)
            given = [v[cut] if isinstance(v, np.ndarray) and v.ndim else v for v in (*inputs, *seeds_given)]
            code.run(given, [v[cut] for v in views])
        left = iter(results)
        return (None, *(next(left) if w else None for w in wanted))


def _plain(value: Any) -> Any:
    return value.detach().numpy() if isinstance(value, torch.Tensor) else value
