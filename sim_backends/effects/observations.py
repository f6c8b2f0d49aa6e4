"""Observation effects: motion capture and velocity filter."""

from __future__ import annotations

import numpy as np

from carlab.core.quantities import FloatArray
from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import Confusable, EffectParameter, ObservationEffect, Parameters, ScreeningProbe


class MarkerOffset(ObservationEffect):
    """The tracked point is not the centre of mass: ``p_meas = p + R(yaw) [ahead, left]``.

    So ``vx_meas = vx - left r`` and ``vy_meas = vy + ahead r``.
    """

    id = "marker_offset"
    order = 40
    name = "an offset of the tracked point from the centre of mass"
    summary = "Motion capture tracks a point that is not the centre of mass."
    sentence = (
        "motion capture tracks a point {ahead:size} {ahead:ahead of|behind} and {left:size} to the {left:left|right} "
        "of the centre of mass"
    )
    refuted_if = "on a slow circle the tracked point has the lateral velocity of the centre of mass"
    parameters = (
        EffectParameter("ahead", "m", 0.0, -1.0, 1.0, 0.03),
        EffectParameter("left", "m", 0.0, -1.0, 1.0, 0.01),
    )

    def screening_points(self, probe: ScreeningProbe) -> FloatArray:
        """Eight directions around the centre of mass."""
        angles = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
        return probe.points(probe.sized({"ahead": float(np.cos(a)), "left": float(np.sin(a))} for a in angles))

    def observe(self, ops: Ops, state: tuple[Value, ...], values: Parameters) -> tuple[Value, ...]:
        """Shift the point."""
        x, y, yaw, vx, vy, yaw_rate = state
        ahead, left = values["ahead"], values["left"]
        sin, cos = ops.sin(yaw), ops.cos(yaw)
        return (
            x + cos * ahead - sin * left,
            y + sin * ahead + cos * left,
            yaw,
            vx - left * yaw_rate,
            vy + ahead * yaw_rate,
            yaw_rate,
        )

    def invert(self, ops: Ops, measured: tuple[Value, ...], values: Parameters) -> tuple[Value, ...]:
        """Shift the point back."""
        x, y, yaw, vx, vy, yaw_rate = measured
        ahead, left = values["ahead"], values["left"]
        sin, cos = ops.sin(yaw), ops.cos(yaw)
        return (
            x - (cos * ahead - sin * left),
            y - (sin * ahead + cos * left),
            yaw,
            vx + left * yaw_rate,
            vy - ahead * yaw_rate,
            yaw_rate,
        )


class MocapYawMisalignment(ObservationEffect):
    """``yaw_meas = yaw + angle``: the axes of the tracked body are rotated relative to the car's.

    So ``vx_meas = vx cos(angle) + vy sin(angle)`` and ``vy_meas = vy cos(angle) - vx sin(angle)``, for small angles
    ``vx + angle vy`` and ``vy - angle vx``. Acts after ``marker_offset``, which is given in the car's own axes.
    """

    id = "mocap_yaw_misalignment"
    fitted_with_curves = True
    name = "a yaw misalignment of motion capture"
    summary = "The forward axis of the rigid body in motion capture differs from the forward axis of the car."
    sentence = "motion capture measures a heading {angle:size} to the {angle:left|right} of the true heading"
    refuted_if = "driving straight with the steering centred, the measured lateral velocity does not grow with speed"
    order = 60
    parameters = (EffectParameter("angle", "rad", 0.0, -3.2, 3.2, 0.03),)

    def observe(self, ops: Ops, state: tuple[Value, ...], values: Parameters) -> tuple[Value, ...]:
        """Rotate the axes."""
        x, y, yaw, vx, vy, yaw_rate = state
        sin, cos = ops.sin(values["angle"]), ops.cos(values["angle"])
        return x, y, yaw + values["angle"], vx * cos + vy * sin, vy * cos - vx * sin, yaw_rate

    def invert(self, ops: Ops, measured: tuple[Value, ...], values: Parameters) -> tuple[Value, ...]:
        """Rotate the axes back."""
        x, y, yaw, vx, vy, yaw_rate = measured
        sin, cos = ops.sin(values["angle"]), ops.cos(values["angle"])
        return x, y, yaw - values["angle"], cos * vx - sin * vy, sin * vx + cos * vy, yaw_rate


class MocapLatency(ObservationEffect):
    """Every measured channel is ``latency`` old."""

    id = "mocap_latency"
    name = "a motion-capture latency that differs from the car file"
    summary = "The latency of motion capture differs from the car file."
    sentence = "motion capture measures with a latency of {latency}"
    refuted_if = "a latency measured against a known event, such as a tap on the car, equals that of the car file"
    lag_parameter = "latency"
    split_into = (("steering_delay", "steering_lag"), ("throttle_delay", "motor_lag"))
    parameters = (EffectParameter("latency", "s", None, 0.0, 1.0, 0.03, same_as="mocap.latency", is_delay=True),)
    confusable = (
        Confusable(
            "command_delay",
            reason=(
                "No manoeuvre separates a command delay from a measurement latency. Measure the latency of the "
                "motion capture by itself, against an event at a known time, and write it into the car file."
            ),
        ),
    )

    def latency_s(self, values: Parameters) -> Value | None:
        """The effect's latency replaces the car file's [s]."""
        return values["latency"]


class VelocityFilterLag(ObservationEffect):
    """``time_constant dv_meas/dt = v - v_meas`` on the velocity columns only."""

    id = "velocity_filter_lag"
    name = "a filter in the recorded velocities"
    summary = "The recorded velocities went through a filter with a lag."
    sentence = "the recorded velocities went through a filter that lags by {time_constant}"
    refuted_if = "the poses are as late as the velocities (then the car, or the commands, are late)"
    lag_parameter = "time_constant"
    parameters = (EffectParameter("time_constant", "s", 0.0, 0.0, 5.0, 0.04),)
    confusable = (
        Confusable(
            "motor_lag",
            "throttle_steps",
            "compare velocity with the derivative of the position: a filter delays only the velocity",
        ),
        Confusable(
            "steering_lag",
            "steering_steps",
            "compare yaw rate with the derivative of the yaw: a filter delays only the yaw rate",
        ),
    )

    def velocity_time_constant_s(self, values: Parameters) -> Value | None:
        """Time constant of the filter [s]."""
        return values["time_constant"]
