"""Fixed-step Runge-Kutta integration of the single-track model over a stretch of time with held commands."""

from __future__ import annotations

import functools
import math
from typing import Protocol

from sim_backends.actuators import ActuatorChain, ActuatorState
from sim_backends.array_ops import Value
from sim_backends.single_track import Actuation, SingleTrack, State
from sim_backends.stiff_step import StiffStep

MAX_STEP_S = 0.01
"""Longest Runge-Kutta step [s]: the model's fastest eigenvalue at rest is about -76 1/s."""


def substeps_for(duration_s: float, max_step_s: float = MAX_STEP_S) -> int:
    """Number of equal steps of at most ``max_step_s`` (1e-6 of slack for rounding); at least one."""
    return max(1, math.ceil(duration_s / max_step_s - 1e-6))


def rk4_step(
    model: SingleTrack, t_s: Value, state: State, step_s: Value, start: Actuation, middle: Actuation, end: Actuation
) -> State:
    """One classical fourth-order Runge-Kutta step with the actuation given at its start, middle and end.

    ``step_s`` is a number or one per car. Where no effect depends on the place, x and y are not carried through the
    stages: they are pure integrals. Stiff states of effects are stepped by ``StiffStep``.
    """
    ops = model.ops
    half_s = 0.5 * step_s
    first = 0 if model.needs_position else 2
    fixed = state[:first]

    def ahead(rates: State, by_s: Value) -> State:
        return (*fixed, *(ops.fma(by_s, k, s) for s, k in zip(state[first:], rates[first:], strict=True)))

    stiff = StiffStep(model, t_s, state, step_s, (start, middle, end)) if model.hooks.stiff else None
    k1 = model.derivative(t_s, state, start, stiff)
    k2 = model.derivative(t_s + half_s, ahead(k1, half_s), middle, stiff)
    k3 = model.derivative(t_s + half_s, ahead(k2, half_s), middle, stiff)
    k4 = model.derivative(t_s + step_s, ahead(k3, step_s), end, stiff)
    sixth_s = step_s / 6.0
    after = tuple(
        ops.fma(sixth_s, ops.fma(2.0, b + c, a + d), s) for s, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)
    )
    return after if stiff is None else stiff.finish(after)


class Stepper(Protocol):
    """What advances a state by one step: ``rk4_step`` of a model, or its compiled form."""

    def __call__(
        self, t_s: Value, state: State, step_s: Value, start: Actuation, middle: Actuation, end: Actuation
    ) -> State:
        """State after ``step_s``, with the actuation at start, middle and end (the same object where it is held)."""


def integrate_held(
    model: SingleTrack,
    chain: ActuatorChain,
    t_s: Value,
    state: State,
    memory: ActuatorState,
    commands: tuple[Value, Value],
    step_s: Value,
    steps: int,
    stepper: Stepper | None = None,
) -> tuple[State, ActuatorState]:
    """Advance by ``steps`` steps of ``step_s`` each while the delayed commands stay as they are.

    Args:
        model: The car.
        chain: Its actuators.
        t_s: Time at the start [s].
        state: State at the start.
        memory: State of the actuators at the start.
        commands: Steering and throttle that act, in [-1, 1].
        step_s: A number or one per car.
        steps: Number of Runge-Kutta steps.
        stepper: What takes a step; ``rk4_step`` of ``model`` unless given.

    Returns:
        State of car and actuators at the end.
    """
    advance = functools.partial(rk4_step, model) if stepper is None else stepper
    if not chain.has_memory:
        held = model.actuation(*chain.held(commands))
        for i in range(steps):
            state = advance(t_s + i * step_s, state, step_s, held, held, held)
        return state, memory
    for i in range(steps):
        (angles, throttles), memory = chain.step(commands, memory, step_s)
        start, middle, end = (model.actuation(a, u) for a, u in zip(angles, throttles, strict=True))
        state = advance(t_s + i * step_s, state, step_s, start, middle, end)
    return state, memory
