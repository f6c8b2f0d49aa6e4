"""Events that no command causes: blows on the car, and a hand that lifts it and puts it down elsewhere."""

from __future__ import annotations

import math
from dataclasses import dataclass

from carlab.benchmark.world.physics import Instant, World

CRITICAL_RATE_PER_S = 40.0
"""[1/s] The hand follows its path as a critically damped spring of this rate: within 0.1 s."""


@dataclass(frozen=True)
class Blow:
    """An impulse: a constant force and moment over ``duration_s``, beside those of the tyres.

    start_s         begin
    duration_s      contact time
    velocity_mps    change of the velocity (x, y) in the world frame
    yaw_rate_radps  change of the yaw rate
    """

    start_s: float
    duration_s: float
    velocity_mps: tuple[float, float]
    yaw_rate_radps: float = 0.0

    def attach(self, world: World) -> None:
        """Add the blow to a car."""
        force = [world.car.mass * v / self.duration_s for v in self.velocity_mps]
        moment = world.car.yaw_inertia * self.yaw_rate_radps / self.duration_s

        def push(now: Instant) -> None:
            if self.start_s <= now.t < self.start_s + self.duration_s:
                cos, sin = math.cos(now.psi), math.sin(now.psi)
                now.push_x += cos * force[0] + sin * force[1]
                now.push_y += cos * force[1] - sin * force[0]
                now.moment += moment

        world.hooks["body"].append(push)


@dataclass(frozen=True)
class Lift:
    """A hand takes the car off the floor, moves it on a path of minimum jerk, and puts it down at rest.

    start_s     begin
    duration_s  time off the floor
    move_m      displacement (x, y) in the world frame
    turn_rad    rotation
    """

    start_s: float
    duration_s: float
    move_m: tuple[float, float]
    turn_rad: float

    def attach(self, world: World) -> None:
        """Add the hand to a car; the wheels have no contact while it holds the car."""
        origin: list[float] = []

        def is_held(now: Instant) -> bool:
            return self.start_s <= now.t < self.start_s + self.duration_s

        def release_tyres(now: Instant) -> None:
            if is_held(now):
                now.ff = now.fr = now.fx = 0.0

        def hold(now: Instant) -> None:
            if not is_held(now):
                return
            if not origin:
                origin.extend((now.x, now.y, now.psi))
            s = (now.t - self.start_s) / self.duration_s
            share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
            rate = 30.0 * s * s * (1.0 - s) ** 2 / self.duration_s
            cos, sin = math.cos(now.psi), math.sin(now.psi)
            speed = (now.vx * cos - now.vy * sin, now.vx * sin + now.vy * cos, now.r)
            k = CRITICAL_RATE_PER_S
            pull = [
                k * k * (start + share * way - place) + 2.0 * k * (rate * way - v)
                for start, way, place, v in zip(
                    origin, (*self.move_m, self.turn_rad), (now.x, now.y, now.psi), speed, strict=True
                )
            ]
            now.push_x += world.car.mass * (cos * pull[0] + sin * pull[1])
            now.push_y += world.car.mass * (cos * pull[1] - sin * pull[0])
            now.moment += world.car.yaw_inertia * pull[2]

        world.hooks["tyre"].append(release_tyres)
        world.hooks["body"].append(hold)
