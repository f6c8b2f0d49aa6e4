"""The base model: a single-track car with Pacejka tyres, its linear-tyre, kinematic and blended forms.

Sources: Kabzan et al., "AMZ Driverless: the full autonomous racing system" (single-track model, kinematic form and
blend); Pacejka and Bakker, "The magic formula tyre model" (lateral force). Slip is taken in each wheel's own frame, so
the model holds in reverse, and its denominator has a floor, so it is regular at rest.

State: x, y [m], yaw [rad] of the centre of mass in the world; vx, vy [m/s], yaw rate [rad/s] in the body frame. The
equations are written once, for floats, NumPy arrays and torch tensors (``array_ops``).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from sim_backends.array_ops import Ops, Value
from sim_backends.car_parameters import GRAVITY_MPS2, ModelKind
from sim_backends.effects import EFFECTS
from sim_backends.effects.base import DynamicsEffect, Forces, Parameters

SLIP_FLOOR_MPS = 0.3
"""Least speed in the denominator of the slip angle [m/s]."""
RELAXATION_S = 0.05
"""Time constant with which the kinematic car's side speed and yaw rate settle [s]."""
BLEND_FROM_MPS, BLEND_OVER_MPS = 0.3, 0.2
"""The blend is kinematic below the first speed and dynamic above their sum, by speed over ground [m/s]."""

State = tuple[Value, ...]
"""x, y, yaw, vx, vy, yaw rate, then the extra states of effects; each shape () or (cars,)."""


class Actuation(NamedTuple):
    """What drives the car at one instant: the front wheel angle [rad], its sine and cosine, the throttle [1]."""

    angle: Value
    sin: Value
    cos: Value
    throttle: Value


class SingleTrack:
    """Derivative of the state for one set of parameters, which may hold one value per car.

    Args:
        ops: Functions of the array library of ``values``.
        kind: Which form of the model.
        values: Numbers by dotted name (``vehicle.mass``), as of ``SimulatorConfig.values``.
        effects: Ids of effects; those of the dynamics are used here.
    """

    def __init__(self, ops: Ops, kind: ModelKind, values: Mapping[str, Value], effects: Iterable[str] = ()) -> None:
        chosen = [EFFECTS[effect_id] for effect_id in effects]
        dynamics = sorted((e for e in chosen if isinstance(e, DynamicsEffect)), key=lambda e: (e.order, e.id))
        own: dict[str, Parameters] = {
            e.id: {p.name: values[f"effects.{e.id}.{p.name}"] for p in e.parameters} for e in dynamics
        }
        self._hooks = {
            name: [(getattr(e, name), own[e.id]) for e in dynamics if _overrides(e, name)]
            for name in ("on_load", "on_grip", "on_drive", "on_tyre", "on_body")
        }
        self._has_hooks = any(self._hooks.values())
        self._changes_tyre_input = bool(self._hooks["on_load"] or self._hooks["on_grip"])
        self.ops = ops
        self.kind = kind
        self.mass = values["vehicle.mass"]
        self.inertia = values["vehicle.yaw_inertia"]
        self.front_axle, self.rear_axle = values["vehicle.front_axle"], values["vehicle.rear_axle"]
        self.drive_gain, self.damping = values["motor.drive_gain"], values["motor.damping"]
        self.front_b, self.front_c = values["tyre.front.B"], values["tyre.front.C"]
        self.rear_b, self.rear_c = values["tyre.rear.B"], values["tyre.rear.C"]
        self.front_mu, self.rear_mu = values["tyre.front.mu"], values["tyre.rear.mu"]
        wheelbase = self.front_axle + self.rear_axle
        self.front_load = self.mass * GRAVITY_MPS2 * self.rear_axle / wheelbase
        self.rear_load = self.mass * GRAVITY_MPS2 * self.front_axle / wheelbase
        self.per_mass = 1.0 / self.mass
        self.front_arm, self.rear_arm = self.front_axle / self.inertia, self.rear_axle / self.inertia
        self.per_inertia = 1.0 / self.inertia
        self.per_wheelbase = 1.0 / wheelbase
        self.front_peak, self.rear_peak = -self.front_mu * self.front_load, -self.rear_mu * self.rear_load
        if not self._has_hooks:  # then forces are needed by nobody: work with forces per mass
            self.drive_gain, self.damping = self.drive_gain * self.per_mass, self.damping * self.per_mass
            self.front_peak, self.rear_peak = self.front_peak * self.per_mass, self.rear_peak * self.per_mass
            self.front_arm, self.rear_arm = self.front_arm * self.mass, self.rear_arm * self.mass
            self.per_mass = 1.0
        self.front_stiffness = self.front_b * self.front_c
        self.rear_stiffness = self.rear_b * self.rear_c
        self.needs_position = any(e.needs_position for e in dynamics)
        self.extra_states: tuple[str, ...] = tuple(f"{e.id}.{name}" for e in dynamics for name in e.states)

    def actuation(self, angle: Value, throttle: Value) -> Actuation:
        """Bundle a wheel angle [rad] and a throttle with the angle's sine and cosine."""
        return Actuation(angle, self.ops.sin(angle), self.ops.cos(angle), throttle)

    def derivative(self, t_s: Value, state: State, actuation: Actuation) -> State:
        """Time derivative of ``state``, in the same order and shapes."""
        ops = self.ops
        _, _, yaw, vx, vy, r = state[:6]
        angle, sin_d, cos_d, throttle = actuation
        drive = self.drive_gain * throttle
        forces: Forces | None = None
        if self._has_hooks:
            forces = self._forces(t_s, state, angle, throttle, drive)
            drive = forces.drive
        force_x = ops.fms(self.damping, vx, drive)
        side_front: Value = 0.0
        side_rear: Value = 0.0
        if self.kind != "kinematic":
            side_front, side_rear = self._side_forces(vx, vy, r, sin_d, cos_d, forces)
        push: Forces | None = None
        if forces is not None and self._hooks["on_body"]:
            push = forces
            push.side_front, push.side_rear, push.force_x = side_front, side_rear, force_x
            for hook, values in self._hooks["on_body"]:
                hook(ops, push, values)
            force_x = push.force_x

        accelerations: State
        if self.kind == "kinematic":
            accelerations = self._kinematic(force_x, vx, vy, r, sin_d, cos_d)
        else:
            front_across = side_front * cos_d
            force_y = front_across + side_rear
            yaw_acceleration = ops.fms(self.rear_arm, side_rear, self.front_arm * front_across)
            if push is not None:
                force_y = force_y + push.force_y
                yaw_acceleration = yaw_acceleration + self.per_inertia * push.moment
            accelerations = (
                ops.fma(vy, r, ops.fms(side_front, sin_d, force_x) * self.per_mass),
                ops.fms(vx, r, force_y * self.per_mass),
                yaw_acceleration,
            )
            if self.kind == "blend":
                weight = ops.clip((ops.hypot(vx, vy) - BLEND_FROM_MPS) * (1.0 / BLEND_OVER_MPS), 0.0, 1.0)
                slow = self._kinematic(force_x, vx, vy, r, sin_d, cos_d)
                accelerations = tuple(ops.fma(weight, a - b, b) for a, b in zip(accelerations, slow, strict=True))

        sin_yaw, cos_yaw = ops.sin(yaw), ops.cos(yaw)
        rates = (
            ops.fms(vy, sin_yaw, vx * cos_yaw),
            ops.fma(vy, cos_yaw, vx * sin_yaw),
            r,
            *accelerations,
        )
        if forces is not None and self.extra_states:
            return (*rates, *(forces.rates[name] for name in self.extra_states))
        return rates

    def _side_forces(
        self, vx: Value, vy: Value, r: Value, sin_d: Value, cos_d: Value, forces: Forces | None
    ) -> tuple[Value, Value]:
        """Lateral force of each axle [N] in its wheels' frame, positive left."""
        ops = self.ops
        front = ops.fma(self.front_axle, r, vy)
        rear = ops.fms(self.rear_axle, r, vy)
        along = ops.fma(front, sin_d, vx * cos_d)
        across = ops.fms(vx, sin_d, front * cos_d)
        front_slip = ops.slope_angle(across, ops.floor(ops.abs(along), SLIP_FLOOR_MPS))
        rear_slip = ops.slope_angle(rear, ops.floor(ops.abs(vx), SLIP_FLOOR_MPS))
        front_peak, rear_peak = self.front_peak, self.rear_peak
        if forces is not None and self._changes_tyre_input:
            front_peak = -forces.grip_front * forces.load_front
            rear_peak = -forces.grip_rear * forces.load_rear
        if self.kind == "linear_tyre":
            side_front = front_peak * (self.front_stiffness * front_slip)
            side_rear = rear_peak * (self.rear_stiffness * rear_slip)
        else:
            side_front = front_peak * ops.sin(self.front_c * ops.atan(self.front_b * front_slip))
            side_rear = rear_peak * ops.sin(self.rear_c * ops.atan(self.rear_b * rear_slip))
        if forces is not None and self._hooks["on_tyre"]:
            forces.side_front, forces.side_rear = side_front, side_rear
            for hook, values in self._hooks["on_tyre"]:
                hook(ops, forces, values)
            side_front, side_rear = forces.side_front, forces.side_rear
        return side_front, side_rear

    def _kinematic(
        self, force_x: Value, vx: Value, vy: Value, r: Value, sin_d: Value, cos_d: Value
    ) -> tuple[Value, Value, Value]:
        """Accelerations of the kinematic car: the wheels roll without slip.

        ``tan(beta) = l_r tan(d) / (l_f + l_r)``. The tyres' constraint forces do no work, so the forward speed
        changes by ``force_x / m`` alone: with the ``vy r`` of the dynamic model it would gain energy in each curve.
        """
        curvature = sin_d / cos_d * self.per_wheelbase
        yaw_rate = vx * curvature
        return (
            force_x * self.per_mass,
            (self.rear_axle * yaw_rate - vy) * (1.0 / RELAXATION_S),
            (yaw_rate - r) * (1.0 / RELAXATION_S),
        )

    def _forces(self, t_s: Value, state: State, angle: Value, throttle: Value, drive: Value) -> Forces:
        x, y, yaw, vx, vy, r = state[:6]
        forces = Forces(
            t_s=t_s,
            x=x,
            y=y,
            yaw=yaw,
            vx=vx,
            vy=vy,
            yaw_rate=r,
            wheel_angle=angle,
            throttle=throttle,
            mass=self.mass,
            front_axle=self.front_axle,
            rear_axle=self.rear_axle,
            load_front=self.front_load,
            load_rear=self.rear_load,
            grip_front=self.front_mu,
            grip_rear=self.rear_mu,
            drive=drive,
            states=dict(zip(self.extra_states, state[6:], strict=True)),
        )
        for name in ("on_load", "on_grip", "on_drive"):
            for hook, values in self._hooks[name]:
                hook(self.ops, forces, values)
        return forces


def _overrides(effect: DynamicsEffect, hook: str) -> bool:
    return getattr(type(effect), hook) is not getattr(DynamicsEffect, hook)
