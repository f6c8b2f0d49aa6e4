"""Drive of the true car: adaptive integration between switching times."""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import ode

from carlab.benchmark.world.physics import World
from carlab.core.errors import DataError

FloatArray = NDArray[np.float64]
Driver = Callable[[float, FloatArray], tuple[float, float]]
RTOL = 1e-8
SAME_TIME_S = 1e-12
TOP_SPEED_MPS = 50.0
"""A faster car has an unstable effect."""
HIDDEN_STEP_S = 1e-3
"""Step for hidden states along given states; a wheel with longitudinal slip has the shortest time constant, 1.4 ms."""


@dataclass(frozen=True)
class Drive:
    """A noise-free drive.

    row_s     (N,)       times of the control ticks [s], 0 the first
    commands  (N, 2)     steering and throttle as issued at the ticks
    capture_s (N s - s + 1,)   capture times [s]; row k was captured at index k s
    captures  (N s - s + 1, 6) true state there
    per_row   s, captures a row
    """

    row_s: FloatArray
    commands: FloatArray
    capture_s: FloatArray
    captures: FloatArray
    per_row: int

    @property
    def rows(self) -> FloatArray:
        """True state as captured for each row, (N, 6)."""
        return self.captures[:: self.per_row]


class _Acting:
    """Queue of delayed commands, and the right-hand side that they act on."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.rates = world.derivative()
        self.queues: tuple[deque[tuple[float, float]], ...] = (deque(), deque())
        self._act(0.0)

    def issue(self, t: float, command: tuple[float, float]) -> None:
        for queue, arrival, value in zip(self.queues, self.world.arrival, command, strict=True):
            acts = arrival(t)
            while queue and queue[-1][0] > acts:  # the newer command replaces a command that it overtakes
                queue.pop()
            queue.append((acts, value))

    def next_s(self) -> float:
        return min((queue[0][0] for queue in self.queues if queue), default=np.inf)

    def switch(self, t: float) -> None:
        due = False
        for channel, queue in enumerate(self.queues):
            while queue and queue[0][0] <= t + SAME_TIME_S:
                value = queue.popleft()[1]
                due = True
                if channel == 0:
                    angle = self.world.car.max_angle * value
                    for change in self.world.steering_maps:
                        angle = change(angle)
                    self.rates.angle = angle
                else:
                    for change in self.world.throttle_maps:
                        value = change(value)
                    self.rates.throttle = value
        if due:
            self._act(t)

    def _act(self, t: float) -> None:
        for listener in self.world.switch_listeners:
            listener(t, self.rates.angle, self.rates.throttle)


def drive(
    world: World,
    driver: Driver,
    duration_s: float,
    *,
    start: tuple[float, ...] = (0.0,) * 6,
    rtol: float = RTOL,
) -> Drive:
    """Drive the car with neutral commands before the start.

    Args:
        world: The true car.
        driver: Called at every tick with its time and the newest captured state; returns (steering, throttle).
        duration_s: Length; the last row is the last tick not after it.
        start: x, y, psi, vx, vy, r at time 0; before it the car moves at its initial velocity.
        rtol: Relative tolerance of the integrator (absolute: a tenth of it).

    Raises:
        DataError: the integration fails.
    """
    car = world.car
    period = car.control_period
    count = round(duration_s / period) + 1
    per_row = max(1, round(period * car.mocap_rate))
    gap = period / per_row
    latency = car.latency + world.extra_latency_s
    acting = _Acting(world)
    solver = ode(lambda t, y: acting.rates(t, y.tolist()))
    # Between two captures or commands one step is usually accurate enough: the first one is tried over all this time.
    solver.set_integrator("dopri5", rtol=rtol, atol=0.1 * rtol, nsteps=4000, first_step=period)
    t, state = 0.0, np.concatenate([np.asarray(start, dtype=np.float64), world.hidden(start[3])])
    capture_s = np.arange((count - 1) * per_row + 1, dtype=np.float64) * gap - latency
    captures = np.empty((len(capture_s), 6))
    commands = np.empty((count, 2))
    captured, tick = 0, 0
    while captured < len(capture_s) or tick < count:
        next_capture = capture_s[captured] if captured < len(capture_s) else np.inf
        next_tick = tick * period if tick < count else np.inf
        due = min(next_capture, next_tick, acting.next_s())
        if due > t + SAME_TIME_S:
            solver.set_initial_value(state, t)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # checked below and raised as an error
                state = solver.integrate(due)
            if not solver.successful() or not np.isfinite(state).all() or abs(state[3]) > TOP_SPEED_MPS:
                raise DataError(f"The concealed car cannot be integrated beyond {t:.3f} s; use another size or seed.")
            t = due
        if acting.next_s() <= t + SAME_TIME_S:
            acting.switch(t)
        if next_capture <= max(t, due) + SAME_TIME_S:
            captures[captured] = state[:6] if next_capture >= 0.0 else _before(state, next_capture)
            captured += 1
        if next_tick <= t + SAME_TIME_S:
            commands[tick] = driver(next_tick, captures[max(captured - 1, 0)] if captured else state[:6])
            acting.issue(next_tick, (float(commands[tick, 0]), float(commands[tick, 1])))
            tick += 1
    return Drive(np.arange(count, dtype=np.float64) * period, commands, capture_s, captures, per_row)


def _before(state: FloatArray, t: float) -> FloatArray:
    """The state (6,) at ``t`` < 0 of a car that has moved with the velocities of its start."""
    early = state[:6].copy()
    cos, sin = np.cos(early[2]), np.sin(early[2])
    early[0] += t * (early[3] * cos - early[4] * sin)
    early[1] += t * (early[3] * sin + early[4] * cos)
    early[2] += t * early[5]
    return early


def rates_along(world: World, driven: Drive) -> FloatArray:
    """Rates of vx, vy, yaw rate (K, 3) of a car that is forced through the captured states of a drive of another car.

    The car gets the commands of the drive as issued. Hidden states of its effects are integrated by Euler's method with
    steps of at most ``HIDDEN_STEP_S``.

    Args:
        world: The car.
        driven: K captures and the commands.
    """
    acting = _Acting(world)
    hidden = np.array(world.hidden(float(driven.captures[0, 3])))
    found = np.empty((len(driven.captures), 3))
    gap_s = float(driven.capture_s[1] - driven.capture_s[0])
    substeps = max(1, math.ceil(gap_s / HIDDEN_STEP_S)) if len(hidden) else 1
    tick = 0
    for k, t in enumerate(driven.capture_s.tolist()):
        while tick < len(driven.row_s) and driven.row_s[tick] <= t:
            acting.issue(float(driven.row_s[tick]), (float(driven.commands[tick, 0]), float(driven.commands[tick, 1])))
            tick += 1
        while acting.next_s() <= t:
            acting.switch(acting.next_s())
        for j in range(substeps):
            rates = acting.rates(t, [*driven.captures[k].tolist(), *hidden.tolist()])
            if j == 0:
                found[k] = rates[3:6]
            hidden = hidden + gap_s / substeps * np.array(rates[6:])
    return found
