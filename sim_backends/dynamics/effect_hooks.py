"""Hooks of a car's dynamics effects, called in their order during the evaluation of the forces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from sim_backends.array_ops import Ops, Value
from sim_backends.effects import EFFECTS
from sim_backends.effects.base import DynamicsEffect, Forces, ModelKind, Parameters, StepStart, StiffStep

HOOKS = (
    "front_slip", "on_load", "on_grip", "on_drive", "on_traction", "on_body", "on_transfer", "on_tyre", "on_motion",
)  # fmt: skip
_N_ITERATIONS = 2
"""Iterations of load transfer and limits of the driven axle if both are present."""


class _Bound(NamedTuple):
    effect: DynamicsEffect
    hook: Callable[..., Any]
    values: Parameters


class EffectHooks:
    """Dynamics effects of a model with their parameters, by hook.

    Args:
        ops: Functions of the array library of ``values``.
        values: Numbers by dotted name.
        effects: Ids of effects; those of class DynamicsEffect are used.
    """

    def __init__(self, ops: Ops, values: Mapping[str, Value], effects: Iterable[str]) -> None:
        chosen = [EFFECTS[effect_id] for effect_id in effects]
        dynamics = sorted((e for e in chosen if isinstance(e, DynamicsEffect)), key=lambda e: (e.order, e.id))
        self._ops = ops
        self.values: dict[str, Parameters] = {e.id: e.numbers(values) for e in dynamics}
        self._by_hook = {
            name: [_Bound(e, getattr(e, name), self.values[e.id]) for e in dynamics if _overrides(e, name)]
            for name in HOOKS
        }
        self.any = any(self._by_hook.values())
        self.changes_tyre_input = any(self._by_hook[name] for name in ("on_load", "on_grip", "on_transfer"))
        self.has_transfer = bool(self._by_hook["on_transfer"])
        self.needs_position = any("place" in e.depends_on for e in dynamics)
        self.has_stiff = any(e.stiff for e in dynamics)
        self._effects = dynamics
        self.states = tuple(f"{e.id}.{name}" for e in dynamics for name in e.states)

    def base_model(self, kind: ModelKind, tyre: Mapping[str, Value]) -> tuple[ModelKind, Mapping[str, Value]]:
        """Kind of the base model and its tyre parameters (``front.mu`` ...), as changed by the effects."""
        for effect in self._effects:
            kind, tyre = effect.base_model(kind, tyre, self.values[effect.id])
        return kind, tyre

    def stiff_steps(self, start: StepStart) -> dict[str, StiffStep]:
        """A step of each effect with stiff states, by effect id."""
        return {e.id: e.stiff_step(self._ops, start, self.values[e.id]) for e in self._effects if e.stiff}

    def front_slip(self, slip_rad: Value) -> Value:
        """Slip angle of the front tyres [rad] from that of wheels at the angle of the servo."""
        for _, hook, values in self._by_hook["front_slip"]:
            slip_rad = hook(self._ops, slip_rad, values)
        return slip_rad

    def run(self, name: str, forces: Forces) -> None:
        """Call one hook of every effect that overrides it."""
        for _, hook, values in self._by_hook[name]:
            hook(self._ops, forces, values)

    def before_tyres(self, forces: Forces, damping: Value, settle: bool) -> None:
        """Evaluate all forces except the tyres' side forces.

        Args:
            forces: Inputs; the forces are written into it.
            damping: Decrease of the motor force per speed [N s/m].
            settle: Compute the steady extra states instead of reading them.
        """
        for name in ("on_load", "on_grip", "on_drive"):
            self.run(name, forces)
        if self.has_transfer:  # until here it is the shape of the front's side force
            forces.front_per_load = -forces.grip_front * forces.front_per_load
        demand = self._ops.fms(damping, forces.vx, forces.drive)
        self._traction(forces, demand, settle)
        forces.force_x = forces.axle_force
        self.run("on_body", forces)
        if not self.has_transfer:
            return
        load_front, load_rear = forces.load_front, forces.load_rear
        self.run("on_transfer", forces)
        for _ in range(_N_ITERATIONS if self._by_hook["on_traction"] else 0):
            before = forces.axle_force
            self._traction(forces, demand, settle)
            forces.force_x = forces.force_x + (forces.axle_force - before)
            forces.load_front, forces.load_rear = load_front, load_rear
            self.run("on_transfer", forces)

    def _traction(self, forces: Forces, demand: Value, settle: bool) -> None:
        forces.axle_force = demand
        for effect, hook, values in self._by_hook["on_traction"]:
            if settle:
                forces.states.update(effect.settled(self._ops, forces, values))
            forces.demand = forces.axle_force
            hook(self._ops, forces, values)

    def on_tyres(self, forces: Forces, settle: bool) -> None:
        """Change the side forces."""
        for effect, hook, values in self._by_hook["on_tyre"]:
            if settle:
                forces.states.update(effect.settled(self._ops, forces, values))
            hook(self._ops, forces, values)

    def on_motion(self, forces: Forces, acceleration_mps2: Value) -> None:
        """Set the rates of states that depend on dvx/dt [m/s2]."""
        for _, hook, values in self._by_hook["on_motion"]:
            hook(self._ops, forces, acceleration_mps2, values)


def _overrides(effect: DynamicsEffect, hook: str) -> bool:
    return getattr(type(effect), hook) is not getattr(DynamicsEffect, hook)
