"""One car in continuous time, on plain floats: the physics of the simulated and of the emulated car."""

from __future__ import annotations

import bisect
from collections import deque
from dataclasses import astuple
from typing import NamedTuple

from carlab.core.angles import wrap
from carlab.core.quantities import Action, CarState
from sim_backends.array_ops import FLOATS
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.dynamics.actuators import ActuatorChain, ActuatorState
from sim_backends.dynamics.integrate import MAX_STEP_S, integrate_held, substeps_for
from sim_backends.dynamics.single_track import SingleTrack, State
from sim_backends.measurement import MeasurementModel

MEMORY_S = 1.0
"""Time span of stored poses [s]."""


class Pose(NamedTuple):
    """Position and heading of the tracked point: x, y [m], yaw [rad] in [-pi, pi)."""

    x_m: float
    y_m: float
    yaw_rad: float


class _Node(NamedTuple):
    t_s: float
    state: State
    memory: ActuatorState
    commands: tuple[float, float]
    """Acting commands between the previous node and this one."""


class Plant:
    """Simulation of one car with delayed commands.

    A command given at ``t`` acts exactly from ``t + delay`` on: integration steps end where a command begins to act.
    Not thread-safe; the caller supplies the time. Effects that depend on time count it from ``reset``.

    Args:
        config: The car.
    """

    def __init__(self, config: SimulatorConfig) -> None:
        values = config.values()
        self._model = SingleTrack(FLOATS, config.kind, values, config.effects)
        self._chain = ActuatorChain(FLOATS, values, config.effects)
        self._delays_s = config.delays_s()
        self._measurement = MeasurementModel(FLOATS, values, config.effects)
        self._t_s = self._start_s = 0.0
        self._state: State = (0.0,) * 6
        self._memory: ActuatorState = ()
        self._acting = [0.0, 0.0]
        self._pending: tuple[deque[tuple[float, float]], ...] = (deque(), deque())
        self._nodes: deque[_Node] = deque()
        self.reset(CarState(), 0.0)

    def reset(self, state: CarState, t_s: float) -> None:
        """Set the state at ``t_s``, with neutral commands acting, none pending, and hidden states in steady state."""
        self._t_s = self._start_s = t_s
        body = tuple(float(v) for v in astuple(state))
        neutral = self._model.actuation(*self._chain.settled_output((0.0, 0.0)))
        self._state = (*body, *self._model.settled(0.0, body, neutral))
        self._acting = [0.0, 0.0]
        self._memory = self._chain.settled((0.0, 0.0))
        for queue in self._pending:
            queue.clear()
        self._nodes.clear()
        self._remember()

    @property
    def t_s(self) -> float:
        """Time up to which the car was simulated [s]."""
        return self._t_s

    @property
    def state(self) -> CarState:
        """True state at ``t_s``; the yaw is wrapped to [-pi, pi)."""
        x, y, yaw, vx, vy, yaw_rate = self._state[:6]
        return CarState(x, y, wrap(yaw), vx, vy, yaw_rate)

    def command(self, t_s: float, action: Action) -> None:
        """Issue a command at ``t_s``; it acts from ``t_s`` plus each channel's delay until the next one does.

        Commands must be in order of time. A command due before the plant's ``t_s`` acts at once.
        """
        for queue, delay_s, value in zip(
            self._pending, self._delays_s, (action.steering, action.throttle), strict=True
        ):
            queue.append((t_s + delay_s, value))

    def advance(self, t_s: float) -> CarState:
        """Simulate up to ``t_s`` (never back) and return the true state."""
        while self._t_s < t_s:
            self._apply_due()
            until_s = min([t_s, *(queue[0][0] for queue in self._pending if queue)])
            commands = (self._acting[0], self._acting[1])
            steps = substeps_for(until_s - self._t_s, MAX_STEP_S)
            step_s = (until_s - self._t_s) / steps
            for i in range(steps):
                end_s = until_s if i == steps - 1 else self._t_s + step_s
                self._state, self._memory = integrate_held(
                    self._model,
                    self._chain,
                    self._t_s - self._start_s,
                    self._state,
                    self._memory,
                    commands,
                    end_s - self._t_s,
                    1,
                )
                self._t_s = end_s
                self._remember()
        return self.state

    def measured_pose(self, t_s: float) -> Pose:
        """Pose of the tracked point at ``t_s`` with the observation effects (marker offset) but no noise or latency."""
        state = self._measurement.observe(self._true_at(t_s)[:6])
        return Pose(state[0], state[1], wrap(state[2]))

    def _apply_due(self) -> None:
        for channel, queue in enumerate(self._pending):
            while queue and queue[0][0] <= self._t_s:
                self._acting[channel] = queue.popleft()[1]

    def _remember(self) -> None:
        self._nodes.append(_Node(self._t_s, self._state, self._memory, (self._acting[0], self._acting[1])))
        while self._nodes[0].t_s < self._t_s - MEMORY_S:
            self._nodes.popleft()

    def _rates(self, node: _Node, commands: tuple[float, float]) -> State:
        (angles, throttles), _ = self._chain.step(commands, node.memory, 1e-6)
        actuation = self._model.actuation(angles[0], throttles[0])
        return self._model.derivative(node.t_s - self._start_s, node.state, actuation)

    def _true_at(self, t_s: float) -> State:
        if t_s >= self._t_s:
            self.advance(t_s)
            return self._state
        if t_s <= self._nodes[0].t_s:
            return self._nodes[0].state
        index = bisect.bisect_right(self._nodes, t_s, key=lambda node: node.t_s)
        before, after = self._nodes[index - 1], self._nodes[index]
        return _hermite(
            (before.t_s, before.state, self._rates(before, after.commands)),
            (after.t_s, after.state, self._rates(after, after.commands)),
            t_s,
        )


def _hermite(before: tuple[float, State, State], after: tuple[float, State, State], t_s: float) -> State:
    """Cubic through time, values and slopes of two neighbouring nodes."""
    span_s = after[0] - before[0]
    u = (t_s - before[0]) / span_s
    a, b = (1.0 + 2.0 * u) * (1.0 - u) ** 2, u * (1.0 - u) ** 2 * span_s
    c, d = u * u * (3.0 - 2.0 * u), u * u * (u - 1.0) * span_s
    return tuple(
        a * s0 + b * k0 + c * s1 + d * k1
        for s0, k0, s1, k1 in zip(before[1], before[2], after[1], after[2], strict=True)
    )
