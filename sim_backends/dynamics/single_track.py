"""The base model: a single-track car with Pacejka tyres, its linear-tyre, kinematic and blended forms.

Sources: Kabzan et al., "AMZ Driverless: the full autonomous racing system" (single-track model, kinematic form and
blend); Pacejka and Bakker, "The magic formula tyre model" (lateral force). Slip is taken in each wheel's own frame, so
the model holds in reverse, and its denominator has a floor, so it is regular at rest.

State: x, y [m], yaw [rad] of the centre of mass in the world; vx, vy [m/s], yaw rate [rad/s] in the body frame. The
equations are written once, for floats, NumPy arrays and torch tensors (``array_ops``).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from sim_backends.array_ops import Ops, Value
from sim_backends.dynamics.effect_hooks import EffectHooks
from sim_backends.effects import axle_distances_m
from sim_backends.effects.base import GRAVITY_MPS2, SLIP_FLOOR_MPS, Forces, ModelKind, StiffStep

RELAXATION_S = 0.05
"""Time constant with which the kinematic car's side speed and yaw rate settle [s]."""
BLEND_FROM_MPS, BLEND_OVER_MPS = 0.3, 0.2
"""The blend is kinematic below the first speed and dynamic above their sum, by speed over ground [m/s]."""

AXLES = ("front", "rear")

NO_STIFF_STEPS: Mapping[str, StiffStep] = MappingProxyType({})
State = tuple[Value, ...]
"""x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s], then the extra states of effects; each shape () or (cars,)."""


class Actuation(NamedTuple):
    """Input of the dynamics at one instant; each shape () or (cars,).

    Attributes:
        angle, sin, cos: front wheel angle [rad], its sine and cosine.
        throttle: [1].
    """

    angle: Value
    sin: Value
    cos: Value
    throttle: Value


class SingleTrack:
    """Derivative of the state for one set of parameters, which may hold one value per car.

    Args:
        ops: Functions of the array library of ``values``.
        kind: Kind of the model.
        values: Numbers by dotted name (``vehicle.mass``), as of ``SimulatorConfig.values``.
        effects: Ids of effects; those of class DynamicsEffect are used.
    """

    def __init__(self, ops: Ops, kind: ModelKind, values: Mapping[str, Value], effects: Iterable[str] = ()) -> None:
        self.hooks = EffectHooks(ops, values, effects)
        self._has_hooks = self.hooks.any
        self.extra_states = self.hooks.states
        self.needs_position = self.hooks.needs_position
        tyre: Mapping[str, Value] = {
            f"{axle}.{name}": values[f"tyre.{axle}.{name}"] for axle in AXLES for name in ("mu", "B", "C")
        }
        kind, tyre = self.hooks.base_model(kind, tyre)
        self.ops = ops
        self.kind: ModelKind = kind
        self.mass = values["vehicle.mass"]
        self.inertia = values["vehicle.yaw_inertia"]
        self.front_axle, self.rear_axle = axle_distances_m(ops, values, effects)
        self.drive_gain, self.damping = values["motor.drive_gain"], values["motor.damping"]
        self.front_b, self.front_c = tyre["front.B"], tyre["front.C"]
        self.rear_b, self.rear_c = tyre["rear.B"], tyre["rear.C"]
        self.front_mu, self.rear_mu = tyre["front.mu"], tyre["rear.mu"]
        wheelbase = self.front_axle + self.rear_axle
        self.front_load = self.mass * GRAVITY_MPS2 * self.rear_axle / wheelbase
        self.rear_load = self.mass * GRAVITY_MPS2 * self.front_axle / wheelbase
        self.per_mass = 1.0 / self.mass
        self.front_arm, self.rear_arm = self.front_axle / self.inertia, self.rear_axle / self.inertia
        self.per_inertia = 1.0 / self.inertia
        self.per_wheelbase = 1.0 / wheelbase
        self.front_peak, self.rear_peak = -self.front_mu * self.front_load, -self.rear_mu * self.rear_load
        if not self._has_hooks:  # forces are not needed: use forces per mass
            self.drive_gain, self.damping = self.drive_gain * self.per_mass, self.damping * self.per_mass
            self.front_peak, self.rear_peak = self.front_peak * self.per_mass, self.rear_peak * self.per_mass
            self.front_arm, self.rear_arm = self.front_arm * self.mass, self.rear_arm * self.mass
            self.per_mass = 1.0
        self.front_stiffness = self.front_b * self.front_c
        self.rear_stiffness = self.rear_b * self.rear_c

    def actuation(self, angle: Value, throttle: Value) -> Actuation:
        """Bundle a wheel angle [rad] and a throttle [1] with the angle's sine and cosine."""
        return Actuation(angle, self.ops.sin(angle), self.ops.cos(angle), throttle)

    def derivative(
        self, t_s: Value, state: State, actuation: Actuation, stiff: Mapping[str, StiffStep] = NO_STIFF_STEPS
    ) -> State:
        """Time derivative of ``state``, in the same order and shapes."""
        return self.evaluate(t_s, state, actuation, stiff)[0]

    def settled(self, t_s: Value, body: State, actuation: Actuation) -> State:
        """Steady extra states at ``t_s`` [s] for a constant motion of the body (six values) and constant actuation."""
        if not self.extra_states:
            return ()
        _, forces = self.evaluate(t_s, body, actuation, settle=True)
        found = {} if forces is None else forces.states
        return tuple(found.get(name, 0.0 * body[3]) for name in self.extra_states)

    def evaluate(
        self,
        t_s: Value,
        state: State,
        actuation: Actuation,
        stiff: Mapping[str, StiffStep] = NO_STIFF_STEPS,
        settle: bool = False,
    ) -> tuple[State, Forces | None]:
        """The derivative and, if there are dynamics effects, all forces.

        Args:
            t_s: Time since the first row of the recording [s].
            state: State; with ``settle`` its first six values.
            actuation: Wheel angle and throttle.
            stiff: Within a Runge-Kutta step: the steps of stiff states by effect id.
            settle: Compute the steady extra states instead of reading them.
        """
        ops = self.ops
        _, _, yaw, vx, vy, r = state[:6]
        drive = self.drive_gain * actuation.throttle
        shapes: tuple[Value, Value] = (0.0, 0.0)
        if self.kind != "kinematic":
            shapes = self._side_shapes(vx, vy, r, actuation.sin, actuation.cos)
        forces: Forces | None = None
        if self._has_hooks:
            forces = self._forces(t_s, state, actuation, drive, stiff)
            if self.kind != "kinematic" and self.hooks.has_transfer:
                forces.front_per_load = shapes[0]
            self.hooks.before_tyres(forces, self.damping, settle)
        force_x = ops.fms(self.damping, vx, drive) if forces is None else forces.force_x
        if self.kind == "kinematic":
            accelerations = self._kinematic(force_x, vx, vy, r, actuation.sin, actuation.cos)
        else:
            accelerations = self._with_tyres(state, actuation, force_x, shapes, forces, settle)
        sin_yaw, cos_yaw = ops.sin(yaw), ops.cos(yaw)
        rates = (
            ops.fms(vy, sin_yaw, vx * cos_yaw),
            ops.fma(vy, cos_yaw, vx * sin_yaw),
            r,
            *accelerations,
        )
        if forces is None or not self.extra_states:
            return rates, forces
        self.hooks.on_motion(forces, accelerations[0])
        still = 0.0 * vx  # rate of an unused state (tyres of a kinematic car) or of a stiff state
        return (*rates, *(forces.rates.get(name, still) for name in self.extra_states)), forces

    def _with_tyres(
        self,
        state: State,
        actuation: Actuation,
        force_x: Value,
        shapes: tuple[Value, Value],
        forces: Forces | None,
        settle: bool,
    ) -> tuple[Value, Value, Value]:
        """dvx/dt, dvy/dt and the yaw acceleration of a car whose tyres slip sideways."""
        ops = self.ops
        _, sin_d, cos_d, _ = actuation
        vx, vy, r = state[3:6]
        side_front, side_rear = self._side_forces(*shapes, forces, settle)
        front_across = side_front * cos_d
        force_y = front_across + side_rear
        yaw_acceleration = ops.fms(self.rear_arm, side_rear, self.front_arm * front_across)
        if forces is not None:
            force_y = force_y + forces.force_y
            yaw_acceleration = yaw_acceleration + self.per_inertia * forces.moment
        along = ops.fma(vy, r, ops.fms(side_front, sin_d, force_x) * self.per_mass)
        across = ops.fms(vx, r, force_y * self.per_mass)
        if self.kind != "blend":
            return along, across, yaw_acceleration
        weight = ops.clip((ops.hypot(vx, vy) - BLEND_FROM_MPS) * (1.0 / BLEND_OVER_MPS), 0.0, 1.0)
        slow = self._kinematic(force_x, vx, vy, r, sin_d, cos_d)
        fast = (along, across, yaw_acceleration)
        blended = [ops.fma(weight, a - b, b) for a, b in zip(fast, slow, strict=True)]
        return blended[0], blended[1], blended[2]

    def _side_shapes(self, vx: Value, vy: Value, r: Value, sin_d: Value, cos_d: Value) -> tuple[Value, Value]:
        """Lateral force of each axle divided by its maximum, positive to the right."""
        ops = self.ops
        front = ops.fma(self.front_axle, r, vy)
        rear = ops.fms(self.rear_axle, r, vy)
        along = ops.fma(front, sin_d, vx * cos_d)
        across = ops.fms(vx, sin_d, front * cos_d)
        front_slip = self.hooks.front_slip(ops.slope_angle(across, ops.at_least(ops.abs(along), SLIP_FLOOR_MPS)))
        rear_slip = ops.slope_angle(rear, ops.at_least(ops.abs(vx), SLIP_FLOOR_MPS))
        if self.kind == "linear_tyre":
            return self.front_stiffness * front_slip, self.rear_stiffness * rear_slip
        return (
            ops.sin(self.front_c * ops.atan(self.front_b * front_slip)),
            ops.sin(self.rear_c * ops.atan(self.rear_b * rear_slip)),
        )

    def _side_forces(
        self, front_shape: Value, rear_shape: Value, forces: Forces | None, settle: bool
    ) -> tuple[Value, Value]:
        """Lateral force of each axle [N] in its wheels' frame, positive left."""
        if forces is None:
            return self.front_peak * front_shape, self.rear_peak * rear_shape
        front_peak, rear_peak = self.front_peak, self.rear_peak
        if self.hooks.changes_tyre_input:
            front_peak = -forces.grip_front * forces.load_front
            rear_peak = -forces.grip_rear * forces.load_rear
        forces.side_front, forces.side_rear = front_peak * front_shape, rear_peak * rear_shape
        self.hooks.on_tyres(forces, settle)
        return forces.side_front, forces.side_rear

    def _kinematic(
        self, force_x: Value, vx: Value, vy: Value, r: Value, sin_d: Value, cos_d: Value
    ) -> tuple[Value, Value, Value]:
        """Accelerations of the kinematic car: the wheels roll without slip.

        ``tan(beta) = l_r tan(d) / (l_f + l_r)``. The tyres' constraint forces do no work, so the forward acceleration
        is ``force_x / m``; with the ``vy r`` of the dynamic model the car would gain energy in curves.
        """
        curvature = sin_d / cos_d * self.per_wheelbase
        yaw_rate = vx * curvature
        return (
            force_x * self.per_mass,
            (self.rear_axle * yaw_rate - vy) * (1.0 / RELAXATION_S),
            (yaw_rate - r) * (1.0 / RELAXATION_S),
        )

    def _forces(
        self, t_s: Value, state: State, actuation: Actuation, drive: Value, stiff: Mapping[str, StiffStep]
    ) -> Forces:
        x, y, yaw, vx, vy, r = state[:6]
        return Forces(
            t_s=t_s,
            x=x,
            y=y,
            yaw=yaw,
            vx=vx,
            vy=vy,
            yaw_rate=r,
            wheel_angle=actuation.angle,
            wheel_sin=actuation.sin,
            wheel_cos=actuation.cos,
            throttle=actuation.throttle,
            mass=self.mass,
            front_axle=self.front_axle,
            rear_axle=self.rear_axle,
            load_front=self.front_load,
            load_rear=self.rear_load,
            grip_front=self.front_mu,
            grip_rear=self.rear_mu,
            full_drive=self.drive_gain,
            damping=self.damping,
            rear_stiffness=self.rear_stiffness,
            drive=drive,
            states=dict(zip(self.extra_states, state[6:], strict=False)),
            stiff=stiff,
        )
