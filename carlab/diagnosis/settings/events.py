"""Settings of the detection of events."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class EventSettings:
    """When a motion is an event. Chosen on a real recording and on simulated drives that no test uses."""

    widths_s: tuple[float, ...] = (0.034, 0.068)
    """Widths [s] over which the velocities before and after a row are averaged: one and two rows at 30 Hz. A collision
    with a wall lasts 0.03 to 0.15 s."""
    grip_factors: tuple[float, float] = (2.5, 1.6)
    """Minimum change of velocity and of yaw rate, over those that tyres with the grip of the car file cause in the same
    time. That grip is often a guess, and drive and side force add up in simulators without a friction ellipse: without
    an event, full braking in a curve with noise reaches 2.3 and 1.35."""
    usual_quantile: float = 0.98
    """Quantile of the changes of a recording that counts as usual driving: its hardest braking and steering. The same
    quantile of its steady accelerations is its grip. If that is above the grip of the car file, which may be too small,
    an event must also exceed ``grip_factors`` with the grip of the recording. The same holds for yaw accelerations,
    which are above those of the car file if its yaw inertia is too large."""
    usual_factor: float = 1.45
    """Minimum change, over the usual one. The car may brake and drive with more than the grip of its car file, and turn
    in faster than its yaw inertia there allows."""
    noise_z: float = 6.0
    """Minimum change [standard deviations of its noise]. Errors of stamps have long tails."""
    steady_widths: int = 9
    """Widths of a running median of the changes: the steady acceleration. What it leaves of them is their noise. An
    impulse changes the rows of two widths, a contact those of four."""
    lasting_width_s: float = 0.068
    """Width [s] of the velocities that show whether a change lasts: those before and after the widths above, so that no
    jump of the pose is in both."""
    lasting_share: float = 0.5
    """Minimum share of a change that lasts, with and without the steady acceleration of the rows around it. A pose that
    jumps, and stays there or returns, changes no velocity."""
    moving_mps: float = 0.2
    """Rows in which the car is faster [m/s] count for the usual change."""
    min_moving_rows: int = 100
    """Minimum number of such rows for a usual change."""
    slide_mps: float = 0.3
    """Minimum speed [m/s] of a car that moves more sideways than forward, both axles to the same side."""
    slide_friction_share: float = 0.25
    """Such a car is carried if its tyres brake with less than this share of their grip. Wheels that slide sideways
    brake with nearly all of it."""
    slide_s: float = 0.1
    """Minimum time [s] of such a motion."""
    slide_half_width_s: float = 0.1
    """Half the width [s] of the local parabola that gives its velocity and acceleration."""
    carry_s: float = 1.0
    """A car is carried from its last stop to its next one, at most this long [s] before and after it moves sideways."""
    merge_s: float = 0.25
    """Events that are nearer than this [s] are one."""
    max_period_s: float = 0.06
    """Maximum period [s] of a recording; with a longer one, hard braking and a collision look alike."""
