"""Fixed-step Runge-Kutta integration of the single-track model over an interval with held commands."""

from __future__ import annotations

import math
from collections.abc import Mapping

from sim_backends.array_ops import Value
from sim_backends.dynamics.actuators import ActuatorChain, ActuatorState
from sim_backends.dynamics.single_track import NO_STIFF_STEPS, Actuation, SingleTrack, State
from sim_backends.effects.base import Forces, StepStart, StiffStep

MAX_STEP_S = 0.01
"""Longest Runge-Kutta step [s]: the model's fastest eigenvalue at rest is about -76 1/s."""


def substeps_for(duration_s: float, max_step_s: float = MAX_STEP_S) -> int:
    """Number of equal steps of at most ``max_step_s`` (relative tolerance 1e-6); at least one."""
    return max(1, math.ceil(duration_s / max_step_s - 1e-6))


def rk4_step(
    model: SingleTrack, t_s: Value, state: State, step_s: Value, start: Actuation, middle: Actuation, end: Actuation
) -> State:
    """One classical fourth-order Runge-Kutta step with the actuation given at its start, middle and end.

    ``t_s`` and ``step_s`` [s] are numbers or one per car (cars,). If no effect depends on the position, x and y are
    omitted in the stages, since they are pure integrals. Effects with stiff states integrate these by their own
    methods.
    """
    ops = model.ops
    half_s = 0.5 * step_s
    first = 0 if model.needs_position else 2
    fixed = state[:first]

    def ahead(rates: State, by_s: Value) -> State:
        return (*fixed, *(ops.fma(by_s, k, s) for s, k in zip(state[first:], rates[first:], strict=True)))

    stiff = _stiff_steps(model, t_s, state, step_s, (start, middle, end)) if model.hooks.has_stiff else NO_STIFF_STEPS
    k1 = model.derivative(t_s, state, start, stiff)
    k2 = model.derivative(t_s + half_s, ahead(k1, half_s), middle, stiff)
    k3 = model.derivative(t_s + half_s, ahead(k2, half_s), middle, stiff)
    k4 = model.derivative(t_s + step_s, ahead(k3, step_s), end, stiff)
    sixth_s = step_s / 6.0
    after = tuple(
        ops.fma(sixth_s, ops.fma(2.0, b + c, a + d), s) for s, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)
    )
    if not stiff:
        return after
    extra = dict(zip(model.extra_states, after[6:], strict=True))
    for step in stiff.values():
        extra |= step.finish()
    return (*after[:6], *(extra[name] for name in model.extra_states))


def _stiff_steps(
    model: SingleTrack, t_s: Value, state: State, step_s: Value, actuations: tuple[Actuation, Actuation, Actuation]
) -> Mapping[str, StiffStep]:
    def forces() -> tuple[Forces, Value]:
        start, middle, end = actuations
        throttle = start.throttle
        if not (start is middle and middle is end):
            throttle = (start.throttle + 4.0 * middle.throttle + end.throttle) * (1.0 / 6.0)
        rates, found = model.evaluate(t_s, state, start._replace(throttle=throttle))
        if found is None:
            raise RuntimeError("A model with stiff states must have forces.")
        return found, rates[3]

    states = dict(zip(model.extra_states, state[6:], strict=True))
    return model.hooks.stiff_steps(StepStart(states, step_s, model.damping, forces))


def integrate_held(
    model: SingleTrack,
    chain: ActuatorChain,
    t_s: Value,
    state: State,
    memory: ActuatorState,
    commands: tuple[Value, Value],
    step_s: Value,
    steps: int,
) -> tuple[State, ActuatorState]:
    """Advance by ``steps`` steps of ``step_s`` each with constant delayed commands.

    Args:
        model: The car.
        chain: Its actuators.
        t_s: Time at the start [s].
        state: State at the start.
        memory: State of the actuators at the start.
        commands: Acting steering and throttle in [-1, 1].
        step_s: Length of a step [s], a number or one per car (cars,).
        steps: Number of Runge-Kutta steps.

    Returns:
        State of car and actuators at the end.
    """
    if not chain.has_memory:
        held = model.actuation(*chain.settled_output(commands))
        for i in range(steps):
            state = rk4_step(model, t_s + i * step_s, state, step_s, held, held, held)
        return state, memory
    for i in range(steps):
        (angles, throttles), memory = chain.step(commands, memory, step_s)
        start, middle, end = (model.actuation(a, u) for a, u in zip(angles, throttles, strict=True))
        state = rk4_step(model, t_s + i * step_s, state, step_s, start, middle, end)
    return state, memory
