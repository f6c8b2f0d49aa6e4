"""States too fast for steps of 10 ms, treated within a Runge-Kutta step by methods of their own.

* Wheel slip: before the step, the pair of slip and forward speed by the implicit Euler rule with all other forces held;
  the car is then driven with the mean force.
* Tyre relaxation: at each stage the lag's closed form, from the steady forces that the stages find.

Where a model has neither, nothing here runs.
"""

from __future__ import annotations

from sim_backends.array_ops import Value
from sim_backends.effects.tyres import RelaxedSides
from sim_backends.effects.wheel_slip import step_wheels
from sim_backends.single_track import Actuation, SingleTrack, State

_SLIP = "longitudinal_slip.slip_speed"
_SIDES = ("tyre_relaxation.front", "tyre_relaxation.rear")


class StiffStep:
    """One step of the stiff states of a model; it is ``StiffValues`` for the effects.

    Args:
        model: The car.
        t_s: Time at the start.
        state: State at the start.
        step_s: Length of the step.
        actuations: At start, middle and end.
    """

    def __init__(
        self,
        model: SingleTrack,
        t_s: Value,
        state: State,
        step_s: Value,
        actuations: tuple[Actuation, Actuation, Actuation],
    ) -> None:
        ops = model.ops
        extra = dict(zip(model.extra_states, state[6:], strict=True))
        self._names = model.extra_states
        self.axle_force: Value | None = None
        self._slip_after: Value = None
        self._sides: RelaxedSides | None = None
        if "longitudinal_slip" in model.hooks.stiff:
            start, middle, end = actuations
            throttle = start.throttle
            if not (start is middle and middle is end):
                throttle = (start.throttle + 4.0 * middle.throttle + end.throttle) * (1.0 / 6.0)
            rates, forces = model.evaluate(t_s, state, start._replace(throttle=throttle))
            if forces is None:  # it has at least the effect's own hook
                raise RuntimeError("A model with wheel slip must have forces.")
            rest = forces.mass * rates[3] - forces.axle_force
            values = model.hooks.values["longitudinal_slip"]
            self.axle_force, self._slip_after = step_wheels(
                ops, forces, values, forces.demand, model.damping, rest, step_s
            )
        if "tyre_relaxation" in model.hooks.stiff:
            length = model.hooks.values["tyre_relaxation"]["length"]
            before = (extra[_SIDES[0]], extra[_SIDES[1]])
            self._sides = RelaxedSides(ops, before, length, step_s)

    def lagging_sides(self, vx: Value, steady_front: Value, steady_rear: Value) -> tuple[Value, Value]:
        """Side forces of the axles at the next stage [N]."""
        if self._sides is None:
            return steady_front, steady_rear
        return self._sides.at_stage(vx, steady_front, steady_rear)

    def finish(self, state: State) -> State:
        """The state after the step with the stiff states put in."""
        after = dict(zip(self._names, state[6:], strict=True))
        if self._slip_after is not None:
            after[_SLIP] = self._slip_after
        if self._sides is not None and _SIDES[0] in after:
            after[_SIDES[0]], after[_SIDES[1]] = self._sides.last
        return (*state[:6], *(after[name] for name in self._names))
