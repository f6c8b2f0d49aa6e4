"""Disturbances: slow or short changes of a car that an adaptive prediction estimates from the recent past.

A diagnosis neither names them nor compares them with effects, because their numbers change along a recording. They act
after the effects and measured curves that they change: a share of the drive force, of the grip, an angle of the
steering, and a force with a moment on the body.
"""

from __future__ import annotations

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import ActuatorEffect, DynamicsEffect, Effect, EffectParameter, Forces, Parameters


class Disturbance(Effect):
    """Base of disturbances; all are 0 for a car like its simulator."""

    catalogued = False
    is_general_rival = False


class DriveChange(Disturbance, DynamicsEffect):
    """``F_drive *= 1 + share``, after the measured drive map and the saturation of the motor."""

    id = "drive_change"
    order = 95
    command = "throttle"
    summary = "The drive force differs from that of the simulator by a share."
    class_statement = "a share of the drive force"
    parameters = (EffectParameter("share", "1", 0.0, -1.0, 10.0, -0.2),)

    def on_drive(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Multiply the drive force."""
        forces.drive = forces.drive * (1.0 + values["share"])


class GripChange(Disturbance, DynamicsEffect):
    """``F_y *= 1 + share`` of both axles, after the measured tyre curves."""

    id = "grip_change"
    order = 7
    base_models = ("dynamic", "linear_tyre", "blend")
    summary = "The side force of all tyres differs from that of the simulator by a share."
    class_statement = "a share of the side force of all tyres"
    parameters = (EffectParameter("share", "1", 0.0, -1.0, 10.0, -0.2),)

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Multiply the side forces."""
        factor = 1.0 + values["share"]
        forces.side_front, forces.side_rear = forces.side_front * factor, forces.side_rear * factor


class SteeringTrim(Disturbance, ActuatorEffect):
    """``d += angle``, after all other effects of the steering."""

    id = "steering_trim"
    command = "steering"
    order = 75
    summary = "The wheels point to one side of where the simulator has them."
    class_statement = "an angle of the front wheels in addition to the commanded one"
    parameters = (EffectParameter("angle", "rad", 0.0, -1.0, 1.0, 0.05),)

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Add the angle to the steering angle."""
        return command + values["angle"]


class BodyForce(Disturbance, DynamicsEffect):
    """A force ``forward``, ``left`` at the centre of mass and a moment ``moment`` in the body frame."""

    id = "body_force"
    summary = "A force and a moment act on the body."
    class_statement = "a force and a moment on the body whatever the commands"
    parameters = (
        EffectParameter("forward", "N", 0.0, -100.0, 100.0, 0.5),
        EffectParameter("left", "N", 0.0, -100.0, 100.0, 0.5),
        EffectParameter("moment", "N m", 0.0, -20.0, 20.0, 0.05),
    )

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Add force and moment to the body."""
        forces.force_x = forces.force_x + values["forward"]
        forces.force_y = forces.force_y + values["left"]
        forces.moment = forces.moment + values["moment"]


def _names(*effects: Effect) -> tuple[str, ...]:
    return tuple(f"effects.{e.id}.{p.name}" for e in effects for p in e.parameters)


DISTURBANCES: tuple[Effect, ...] = (DriveChange(), SteeringTrim(), GripChange(), BodyForce())
DRIFTING_PARAMETERS = _names(DriveChange(), SteeringTrim(), GripChange())
"""Dotted names of the numbers that drift slowly: drive force [1], steering [rad], grip [1]."""
BODY_FORCE_PARAMETERS = _names(BodyForce())
"""Dotted names of the force forward and left [N], and of the moment [N m]."""
