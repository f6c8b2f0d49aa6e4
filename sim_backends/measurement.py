"""The measurement model: motion capture and velocity filter applied to true states, for all engines.

    y(t) = F( W( h( x(t - latency) ) ) )

with the true state ``x``, the observation effects ``h`` in their order (``ObservationEffect.observe``), the window
``W`` over which velocities were differentiated, and the first-order filter ``F`` on the velocities. It runs on floats,
NumPy arrays and torch tensors; a value may hold one number for each car or parameter set, of a shape that broadcasts
with the states.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeAlias

from sim_backends.array_ops import Ops, Value
from sim_backends.effects import EFFECTS, ObservationEffect, delays_s
from sim_backends.effects.base import Parameters
from sim_backends.effects.first_order import LagWeights, lag_weights

State: TypeAlias = tuple[Value, ...]
"""x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s], or the velocities alone; of shapes that broadcast."""
LATENCY = "mocap.latency"
COMMAND_DELAY = "timing.command_delay"


def is_measurement_parameter(name: str) -> bool:
    """Whether a parameter belongs to the measurement: motion capture, or an observation effect."""
    table, _, rest = name.partition(".")
    return table == "mocap" or (table == "effects" and EFFECTS[rest.partition(".")[0]].kind == "observation")


def filters_velocities(effect_id: str) -> bool:
    """Whether an effect is a filter on the measured velocities."""
    effect, plain = EFFECTS[effect_id], ObservationEffect.velocity_time_constant_s
    return isinstance(effect, ObservationEffect) and type(effect).velocity_time_constant_s is not plain


class MeasurementModel:
    """Measures true states and inverts the measurement.

    Args:
        ops: Functions of the array library of ``values``.
        values: Numbers by dotted name, ``mocap.latency`` and those of the effects among them.
        effects: Ids of effects; those of class ObservationEffect are used.
    """

    def __init__(self, ops: Ops, values: Mapping[str, Value], effects: Iterable[str]) -> None:
        self._ops = ops
        self.latency_s: Value = values[LATENCY]
        """Latency of the measurement [s]."""
        self.velocity_time_constant_s: Value | None = None
        """Time constant of the filter on the velocities [s]; None without a filter."""
        self._static: list[tuple[ObservationEffect, Parameters]] = []
        found = [e for e in (EFFECTS[name] for name in effects) if isinstance(e, ObservationEffect)]
        for effect in sorted(found, key=lambda e: (e.order, e.id)):
            own = effect.numbers(values)
            if (latency_s := effect.latency_s(own)) is not None:
                self.latency_s = latency_s
            if (lag_s := effect.velocity_time_constant_s(own)) is not None:
                others_s: Value | None = self.velocity_time_constant_s
                self.velocity_time_constant_s = lag_s if others_s is None else others_s + lag_s
            if type(effect).observe is not ObservationEffect.observe:
                self._static.append((effect, own))

    def observe(self, state: State) -> State:
        """``h(x)``: the measured state at one instant, without latency, window and filter."""
        for effect, values in self._static:
            state = effect.observe(self._ops, state, values)
        return state

    def invert(self, measured: State) -> State:
        """The true state that ``observe`` maps to ``measured``."""
        for effect, values in reversed(self._static):
            measured = effect.invert(self._ops, measured, values)
        return measured

    def invert_poses(self, measured: State) -> State:
        """The true state of measured poses and of velocities differentiated from them."""
        for effect, values in reversed(self._static):
            if not effect.velocities_only:
                measured = effect.invert(self._ops, measured, values)
        return measured

    def observe_velocities(self, from_poses: State) -> State:
        """The measured state for measured poses and velocities differentiated from them."""
        for effect, values in self._static:
            if effect.velocities_only:
                from_poses = effect.observe(self._ops, from_poses, values)
        return from_poses

    def ticks_in_use(self, ticks: Iterable[int] | None, last: int, window_s2: float) -> list[int]:
        """Ascending ticks of the true states on which ``measure`` depends, of those from 0 to ``last``.

        ``ticks`` and ``window_s2`` are those of ``measure``.
        """
        if ticks is None or self.velocity_time_constant_s is not None:
            return list(range(last + 1))
        if window_s2 <= 0.0 or last < 2:
            return sorted({int(k) for k in ticks})
        inner = ((int(k), min(max(int(k), 1), last - 1)) for k in ticks)
        return sorted({tick for k, m in inner for tick in (k, m - 1, m, m + 1)})

    def measure(
        self,
        trajectory: Sequence[State] | Mapping[int, State],
        period_s: Value,
        *,
        window_s2: float = 0.0,
        velocities_before: Sequence[State] = (),
        filtered: State | None = None,
        ticks: Sequence[int] | None = None,
    ) -> list[State]:
        """Measured states of a trajectory at even ticks, in the recording's own time (latency is not applied).

        Args:
            trajectory: True states by tick, at least those of ``ticks_in_use``.
            period_s: From one tick to the next [s].
            window_s2: Variance [s2] of the window over which velocities were differentiated; not used for fewer than
                three ticks.
            velocities_before: Unfiltered measured velocities (vx, vy, yaw rate) at the ticks before the trajectory,
                from the first of which the filter starts settled.
            filtered: Output of the filter at the first tick; by default the filter starts settled.
            ticks: Indices of the ticks to return; all by default.
        """
        last = max(trajectory, default=-1) if isinstance(trajectory, Mapping) else len(trajectory) - 1
        wanted = range(last + 1) if ticks is None else ticks
        observed = functools.cache(lambda k: self.observe(trajectory[k]))

        def shown(k: int) -> State:
            if window_s2 <= 0.0 or last < 2:
                return observed(k)
            inner = min(max(k, 1), last - 1)
            around = observed(inner - 1), observed(inner), observed(inner + 1)
            return windowed(self._ops, observed(k), around, period_s, window_s2)

        if self.velocity_time_constant_s is None:
            return [shown(k) for k in wanted]
        every = [shown(k) for k in range(last + 1)]
        inputs = [*velocities_before, *(state[3:6] for state in every)]
        outputs = filter_velocities(self._ops, inputs, period_s, self.velocity_time_constant_s, filtered)
        return [(*every[k][:3], *outputs[len(velocities_before) + k]) for k in wanted]


def filter_step(ops: Ops, output: State, first: State, last: State, step_s: Value, lag_s: Value) -> State:
    """First-order filter over one step, exact for an input that goes from ``first`` to ``last`` in a straight line.

    ``lag_s dy/dt = u - y``, with ``lag_s`` and ``step_s`` [s]; with a time constant of 0 the output is the input.
    """
    return _filtered(lag_weights(ops, lag_s, 2.0 * step_s), output, first, last)


def _filtered(weights: LagWeights, output: State, first: State, last: State) -> State:
    return tuple(weights.after_half(y, u0, u1) for y, u0, u1 in zip(output, first, last, strict=True))


def filter_velocities(
    ops: Ops, inputs: Sequence[State], period_s: Value, lag_s: Value, begin: State | None = None
) -> list[State]:
    """Outputs of ``filter_step`` at ticks with a period [s], one for each of the inputs.

    It starts at ``begin``, by default at the first input.
    """
    outputs = [inputs[0] if begin is None else begin]
    weights = lag_weights(ops, lag_s, 2.0 * period_s)
    for first, last in itertools.pairwise(inputs):
        outputs.append(_filtered(weights, outputs[-1], first, last))
    return outputs


def windowed(ops: Ops, state: State, around: tuple[State, State, State], period_s: Value, variance_s2: float) -> State:
    """A state, its velocities averaged over a symmetric window with a variance [s2]; ticks have a period [s].

    The average is ``v + variance / 2 d2v/dt2``, to fourth order. ``around`` are three states at even ticks, the middle
    one ``state`` itself, or its neighbour at an end of a trajectory, where the average is to third order.
    """
    curvature = velocity_curvature(ops, *around, period_s)
    if state is not around[1]:
        turn = state[2] - around[1][2]
        cos, sin = ops.cos(turn), ops.sin(turn)
        along, across, turning = curvature
        curvature = (cos * along + sin * across, cos * across - sin * along, turning)
    return (*state[:3], *(v + 0.5 * variance_s2 * c for v, c in zip(state[3:6], curvature, strict=True)))


def velocity_curvature(ops: Ops, before: State, now: State, after: State, period_s: Value) -> State:
    """Second time derivative of the world velocities [m/s3, rad/s3] in the body frame of ``now``, by differences.

    The neighbours' velocities are turned into the present body frame first.
    """
    ahead, behind = after[2] - now[2], now[2] - before[2]
    cos_a, sin_a, cos_b, sin_b = ops.cos(ahead), ops.sin(ahead), ops.cos(behind), ops.sin(behind)
    along = cos_a * after[3] - sin_a * after[4] - 2.0 * now[3] + (cos_b * before[3] + sin_b * before[4])
    across = sin_a * after[3] + cos_a * after[4] - 2.0 * now[4] + (cos_b * before[4] - sin_b * before[3])
    turning = after[5] - 2.0 * now[5] + before[5]
    return tuple(value / period_s**2 for value in (along, across, turning))


def delay_as_recorded_s(ops: Ops, values: Mapping[str, Value], effects: Iterable[str], latency_s: Value) -> Value:
    """The ``timing.command_delay`` [s] relative to a recording, () or (cars,).

    Measured states are old by the latency [s], so commands act later by it. It is raised if its sum with the
    delay effects would be negative.
    """
    base = values[COMMAND_DELAY] + latency_s
    for extra in delays_s(0.0, values, effects):
        negative = base + extra < 0.0
        if isinstance(negative, bool):  # both are floats
            base = -extra if negative else base
        else:
            base = ops.where(negative, 0.0 * base - extra, base)
    return base
