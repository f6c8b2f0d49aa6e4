"""Actuators: input effects from delayed commands to wheel angle and throttle, in their order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from sim_backends.array_ops import Ops, Value
from sim_backends.effects import EFFECTS, ActuatorEffect
from sim_backends.effects.base import Parameters, Triple

MAX_STORED_LENGTHS = 8
"""Number of step lengths whose numbers are stored; a rollout has at most three pieces a period."""
ActuatorState = tuple[Value, ...]
"""One value per effect with memory, steering's first: a wheel angle [rad] or a throttle [1], shape () or (cars,)."""


class ActuatorChain:
    """Steering and motor of a car as chains of input effects. Holds parameters, not state.

    Args:
        ops: Functions of the array library of ``values``.
        values: Numbers by dotted name, as of ``SimulatorConfig.values``.
        effects: Ids of effects; those of class ActuatorEffect are used.
    """

    def __init__(self, ops: Ops, values: Mapping[str, Value], effects: Iterable[str] = ()) -> None:
        self._ops = ops
        self._max_angle = values["steering.max_angle"]
        chosen = [e for e in (EFFECTS[effect_id] for effect_id in effects) if isinstance(e, ActuatorEffect)]
        chosen.sort(key=lambda e: (e.command != "steering", e.order, e.id))
        self._links: list[tuple[ActuatorEffect, Parameters]] = [(e, e.numbers(values)) for e in chosen]
        self.has_memory = any(e.has_state for e in chosen)
        self._by_length: dict[Any, tuple[Value, list[Parameters]]] = {}

    def settled(self, commands: tuple[Value, Value]) -> ActuatorState:
        """Steady state of the actuators for constant commands of steering and throttle in [-1, 1]."""
        signals = {"steering": self._max_angle * commands[0], "throttle": commands[1]}
        memory = []
        for effect, values in self._links:
            signal = signals[effect.command]
            if effect.has_state:
                memory.append(effect.settled(signal))
            else:
                signals[effect.command] = effect.apply(self._ops, signal, values)
        return tuple(memory)

    def settled_output(self, commands: tuple[Value, Value]) -> tuple[Value, Value]:
        """Steady wheel angle [rad] and throttle [1] for constant commands of steering and throttle in [-1, 1]."""
        signals = {"steering": self._max_angle * commands[0], "throttle": commands[1]}
        for effect, values in self._links:
            if not effect.has_state:
                signals[effect.command] = effect.apply(self._ops, signals[effect.command], values)
        return signals["steering"], signals["throttle"]

    def step(
        self, commands: tuple[Value, Value], memory: ActuatorState, step_s: Value
    ) -> tuple[tuple[Triple, Triple], ActuatorState]:
        """Wheel angle [rad] and throttle [1] at start, middle and end of a step with held commands; state at its end.

        Args:
            commands: Steering and throttle in [-1, 1].
            memory: State at the start.
            step_s: Length of the step [s].
        """
        angle = self._max_angle * commands[0]
        signals: dict[str, Triple] = {"steering": (angle, angle, angle), "throttle": (commands[1],) * 3}
        left = iter(memory)
        after: list[Value] = []
        for (effect, _), values in zip(self._links, self._step_numbers(step_s), strict=True):
            start, middle, end = signals[effect.command]
            if effect.has_state:
                out, state = effect.step(self._ops, (start, middle, end), next(left), step_s, values)
                after.append(state)
            elif start is middle and middle is end:
                out = (effect.apply(self._ops, start, values),) * 3
            else:
                out = (
                    effect.apply(self._ops, start, values),
                    effect.apply(self._ops, middle, values),
                    effect.apply(self._ops, end, values),
                )
            signals[effect.command] = out
        return (signals["steering"], signals["throttle"]), tuple(after)

    def _step_numbers(self, step_s: Value) -> list[Parameters]:
        """Numbers of each effect for steps of ``step_s``, computed once for each of the last lengths."""
        key = step_s if isinstance(step_s, float) else id(step_s)  # the stored length keeps its id
        if key not in self._by_length:
            if len(self._by_length) == MAX_STORED_LENGTHS:
                self._by_length.clear()
            own = [e.step_numbers(self._ops, step_s, values) if e.has_state else values for e, values in self._links]
            self._by_length[key] = step_s, own
        return self._by_length[key][1]
