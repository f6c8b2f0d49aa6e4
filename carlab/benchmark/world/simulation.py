"""Drive of the true car: adaptive integration between switching times."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlab.benchmark.world.integration import DormandPrince
from carlab.benchmark.world.physics import World
from carlab.core.errors import DataError

FloatArray = NDArray[np.float64]
Driver = Callable[[float, FloatArray], tuple[float, float]]
RTOL = 2e-9
"""With it the error of a minute is below 1 um and 1 urad; the edge of a patch of low friction needs most of it."""
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
        rtol: Relative tolerance of the integration (absolute: a tenth of it).

    Raises:
        DataError: the integration fails.
    """
    car = world.car
    period = car.control_period
    count = round(duration_s / period) + 1
    per_row = max(1, round(period * car.mocap_rate))
    row_s = np.arange(count, dtype=np.float64) * period
    capture_s = np.arange((count - 1) * per_row + 1, dtype=np.float64) * (period / per_row)
    capture_s -= car.latency + world.extra_latency_s
    moving = _Moving(world, start, rtol, capture_s.tolist())
    commands = np.empty((count, 2))
    for tick, t in enumerate(row_s.tolist()):
        moving.advance(t)
        commands[tick] = driver(t, np.array(moving.captures[-1] if moving.captures else start))
        moving.acting.issue(t, (float(commands[tick, 0]), float(commands[tick, 1])))
    moving.advance(float(capture_s[-1]))
    return Drive(row_s, commands, capture_s, np.array(moving.captures), per_row)


class _Moving:
    """The moving car, and its states at the times of captures so far."""

    def __init__(self, world: World, start: tuple[float, ...], rtol: float, capture_s: list[float]) -> None:
        self.acting = _Acting(world)
        state = [float(value) for value in start]
        self._solution = DormandPrince(self.acting.rates, [*state, *world.hidden(state[3])], rtol)
        self._capture_s = capture_s
        self.captures = [_before(state, t) for t in capture_s if t <= 0.0]

    def advance(self, end_s: float) -> None:
        """Move until a time, and let the commands act that are due until then."""
        while True:
            self._integrate(min(end_s, self.acting.next_s()))
            if self.acting.next_s() > self._solution.t + SAME_TIME_S:
                return
            self.acting.switch(self._solution.t)
            self._solution.restart()

    def _integrate(self, end_s: float) -> None:
        solution, captures, capture_s = self._solution, self.captures, self._capture_s
        while solution.t < end_s - SAME_TIME_S:
            try:
                solution.extend(end_s)
            except ArithmeticError:
                failed = True
            else:
                failed = abs(solution.state[3]) > TOP_SPEED_MPS
            if failed:
                raise DataError(
                    f"The concealed car cannot be integrated beyond {solution.t:.3f} s; use another size or seed."
                )
            while len(captures) < len(capture_s) and capture_s[len(captures)] <= solution.t + SAME_TIME_S:
                captures.append(solution.at(capture_s[len(captures)])[:6])


def _before(state: list[float], t: float) -> list[float]:
    x, y, psi, vx, vy, r = state
    cos, sin = math.cos(psi), math.sin(psi)
    return [x + t * (vx * cos - vy * sin), y + t * (vx * sin + vy * cos), psi + t * r, vx, vy, r]


def rates_along(world: World, driven: Drive) -> FloatArray:
    """Rates of vx, vy, yaw rate (K, 3) of a car that is forced through the captured states of a drive of another car.

    The car gets the commands of the drive as issued. Hidden states of its effects are integrated by Euler's method with
    steps of at most ``HIDDEN_STEP_S``.

    Args:
        world: The car.
        driven: K captures and the commands.
    """
    acting = _Acting(world)
    states = driven.captures.tolist()
    hidden = world.hidden(states[0][3])
    found = np.empty((len(driven.captures), 3))
    gap_s = float(driven.capture_s[1] - driven.capture_s[0])
    substeps = max(1, math.ceil(gap_s / HIDDEN_STEP_S)) if len(hidden) else 1
    tick = 0
    step_s = gap_s / substeps
    for k, t in enumerate(driven.capture_s.tolist()):
        while tick < len(driven.row_s) and driven.row_s[tick] <= t:
            acting.issue(float(driven.row_s[tick]), (float(driven.commands[tick, 0]), float(driven.commands[tick, 1])))
            tick += 1
        while acting.next_s() <= t:
            acting.switch(acting.next_s())
        for j in range(substeps):
            rates = acting.rates(t, states[k] + hidden)
            if j == 0:
                found[k] = rates[3:6]
            hidden = [value + step_s * rate for value, rate in zip(hidden, rates[6:], strict=True)]
    return found
