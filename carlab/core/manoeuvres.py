"""Scripted excitation manoeuvres for system identification: commands as functions of time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from carlab.core.quantities import NEUTRAL, Action


@dataclass(frozen=True, slots=True)
class Manoeuvre:
    """A command sequence: ``at`` maps seconds since the start to an action, for ``duration_s`` seconds."""

    name: str
    duration_s: float
    at: Callable[[float], Action]

    def command(self, elapsed_s: float) -> Action | None:
        """The action at a time [s]; None after the end, neutral before the start."""
        if elapsed_s >= self.duration_s:
            return None
        return self.at(elapsed_s) if elapsed_s >= 0.0 else NEUTRAL


def steering_steps(throttle: float = 0.3, small: float = 0.3, large: float = 0.8, hold_s: float = 0.8) -> Manoeuvre:
    """Steps of two sizes to both sides at constant throttle: separates delay, lag and rate limit."""
    levels = (0.0, small, 0.0, -small, 0.0, large, 0.0, -large, 0.0)

    def at(elapsed_s: float) -> Action:
        return Action(levels[min(int(elapsed_s / hold_s), len(levels) - 1)], throttle)

    return Manoeuvre("steering_steps", hold_s * len(levels), at)


def throttle_steps(
    levels: tuple[float, ...] = (0.2, 0.5, 0.0, -0.3, 0.0), hold_s: float = 0.8, steering: float = 0.5
) -> Manoeuvre:
    """Steps of throttle on a circle, so that the car stays in a small area."""

    def at(elapsed_s: float) -> Action:
        return Action(steering, levels[min(int(elapsed_s / hold_s), len(levels) - 1)])

    return Manoeuvre("throttle_steps", hold_s * len(levels), at)


def steering_chirp(
    throttle: float = 0.3, amplitude: float = 0.5, low_hz: float = 0.3, high_hz: float = 4.0, duration_s: float = 10.0
) -> Manoeuvre:
    """A steering sine whose frequency grows linearly: phase = 2 pi (f0 t + (f1 - f0) t^2 / (2 T))."""

    def at(elapsed_s: float) -> Action:
        phase = 2 * math.pi * (low_hz * elapsed_s + (high_hz - low_hz) * elapsed_s**2 / (2 * duration_s))
        return Action(amplitude * math.sin(phase), throttle)

    return Manoeuvre("steering_chirp", duration_s, at)


def figure_eight(throttle: float = 0.3, amplitude: float = 0.7, lap_s: float = 5.0, laps: int = 2) -> Manoeuvre:
    """Left circle, right circle."""

    def at(elapsed_s: float) -> Action:
        return Action(amplitude * math.sin(2 * math.pi * elapsed_s / lap_s), throttle)

    return Manoeuvre("figure_eight", lap_s * laps, at)


def throttle_ramp(top: float = 0.6, duration_s: float = 6.0, steering: float = 0.5) -> Manoeuvre:
    """Throttle from zero to ``top`` on a circle: motor curve, then the limit of grip."""
    return Manoeuvre("throttle_ramp", duration_s, lambda t: Action(steering, top * t / duration_s))


def coast_down(throttle: float = 0.5, push_s: float = 1.0, coast_s: float = 3.0, steering: float = 0.5) -> Manoeuvre:
    """Accelerate, then coast: shows the resistances without the motor."""
    return Manoeuvre("coast_down", push_s + coast_s, lambda t: Action(steering, throttle if t < push_s else 0.0))


def slow_circle(throttle: float = 0.12, steering: float = 1.0, duration_s: float = 10.0) -> Manoeuvre:
    """Full lock at walking pace: steering geometry without tyre slip."""
    return Manoeuvre("slow_circle", duration_s, lambda t: Action(steering, throttle))


MANOEUVRES: dict[str, Callable[[], Manoeuvre]] = {
    "steering_steps": steering_steps,
    "throttle_steps": throttle_steps,
    "steering_chirp": steering_chirp,
    "figure_eight": figure_eight,
    "throttle_ramp": throttle_ramp,
    "coast_down": coast_down,
    "slow_circle": slow_circle,
}
