"""What motion capture and the velocity filter make of the true state."""

from __future__ import annotations

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import EffectParameter, ObservationEffect, Parameters


class MarkerOffset(ObservationEffect):
    """The tracked point is not the centre of mass: ``p_meas = p + R(yaw) [ahead, left]``.

    So ``vx_meas = vx - left r`` and ``vy_meas = vy + ahead r``.
    """

    id = "marker_offset"
    order = 40
    sentence = "Motion capture tracks a point that is not the centre of mass."
    parameters = (
        EffectParameter("ahead", "m", 0.0, -1.0, 1.0, 0.03),
        EffectParameter("left", "m", 0.0, -1.0, 1.0, 0.01),
    )

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


class MocapYawMisalignment(ObservationEffect):
    """``yaw_meas = yaw + angle``: the tracked body's axes are turned against the car's.

    So ``vx_meas = vx cos(angle) + vy sin(angle)`` and ``vy_meas = vy cos(angle) - vx sin(angle)``, for small angles
    ``vx + angle vy`` and ``vy - angle vx``. Acts after ``marker_offset``, which is given in the car's own axes.
    """

    id = "mocap_yaw_misalignment"
    sentence = "Motion capture's forward axis of the car is not the car's."
    order = 60
    parameters = (EffectParameter("angle", "rad", 0.0, -3.2, 3.2, 0.03),)
    look_alikes = ("steering_offset",)

    def observe(self, ops: Ops, state: tuple[Value, ...], values: Parameters) -> tuple[Value, ...]:
        """Turn the axes."""
        x, y, yaw, vx, vy, yaw_rate = state
        sin, cos = ops.sin(values["angle"]), ops.cos(values["angle"])
        return x, y, yaw + values["angle"], vx * cos + vy * sin, vy * cos - vx * sin, yaw_rate


class MocapLatency(ObservationEffect):
    """Every measured channel is ``latency`` old."""

    id = "mocap_latency"
    sentence = "Motion capture is older than the car file says."
    parameters = (EffectParameter("latency", "s", None, 0.0, 1.0, 0.03, same_as="mocap.latency"),)
    look_alikes = ("command_delay",)

    def latency_s(self, values: Parameters) -> Value | None:
        """Instead of the car file's."""
        return values["latency"]


class VelocityFilterLag(ObservationEffect):
    """``time_constant dv_meas/dt = v - v_meas`` on the velocity columns only."""

    id = "velocity_filter_lag"
    sentence = "The recorded velocities went through a filter with a lag."
    parameters = (EffectParameter("time_constant", "s", 0.0, 0.0, 5.0, 0.04),)
    look_alikes = ("motor_lag", "steering_lag")

    def velocity_time_constant_s(self, values: Parameters) -> Value | None:
        """Of the filter."""
        return values["time_constant"]
