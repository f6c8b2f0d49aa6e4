"""Friction and side force of the tyres."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from carlab.core.quantities import FloatArray
from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import (
    Confusable,
    DynamicsEffect,
    EffectParameter,
    Forces,
    ModelKind,
    Parameters,
    ScreeningProbe,
    StepStart,
)
from sim_backends.effects.first_order import LagWeights, lag_weights

RIM_WIDTH_M = 0.05
"""Width of a patch's rim, centred on its radius, so that position and size have derivatives [m]."""
RELAXATION_FLOOR_MPS = 0.3
MIN_LENGTH_M = 1e-9
"""Relaxation lengths below this value are inactive [m]."""
SCREENING_GRIPS = (0.4, 0.65, 0.95, 1.4)
"""Friction coefficients of each axle at which saturating tyres are screened."""
SCREENING_SHAPE = 1.5
"""Pacejka's C at these screening points."""
SCREENING_SPACING_M, SCREENING_RADIUS_M = 0.5, 0.8
"""Spacing and radius of the discs at which a patch is screened [m]."""
MAX_SHARE = 0.98
"""Maximum share of friction used by the longitudinal force in the ellipse."""


class TyreSaturation(DynamicsEffect):
    """Pacejka tyres for a car file of kind kinematic or linear_tyre: the car becomes of kind "dynamic".

    ``F = -mu F_z sin(C atan(B a))`` (Pacejka 2012, "Tire and Vehicle Dynamics", ch. 4) with these numbers; each is
    the car file's own where it is not given. There is no value that switches it off; in a car file that has Pacejka
    tyres already it does nothing.
    """

    id = "tyre_saturation"
    name = "the limit of tyre grip"
    summary = "The tyres' side force saturates at large slip angles."
    sentence = (
        "the side force of the tyres saturates, with a friction coefficient of {mu_front} in front and {mu_rear} at "
        "the rear"
    )
    refuted_if = "even at walking pace, turns tighten less than in proportion to the command (then it is the steering)"
    parameters = (
        EffectParameter("mu_front", "1", None, 0.0, 5.0, 0.43, same_as="tyre.front.mu"),
        EffectParameter("B_front", "1/rad", None, 0.0, 100.0, 2.75, positive=True, same_as="tyre.front.B"),
        EffectParameter("C_front", "1", None, 0.0, 10.0, 1.45, positive=True, same_as="tyre.front.C"),
        EffectParameter("mu_rear", "1", None, 0.0, 5.0, 0.42, same_as="tyre.rear.mu"),
        EffectParameter("B_rear", "1/rad", None, 0.0, 100.0, 5.0, positive=True, same_as="tyre.rear.B"),
        EffectParameter("C_rear", "1", None, 0.0, 10.0, 1.3, positive=True, same_as="tyre.rear.C"),
    )
    base_models = ("linear_tyre", "kinematic", "blend")
    screening_scaled = ()

    def base_model(
        self, kind: ModelKind, tyre: Mapping[str, Value], values: Parameters
    ) -> tuple[ModelKind, Mapping[str, Value]]:
        """Pacejka's tyres with these numbers."""
        if kind not in ("kinematic", "linear_tyre"):
            return kind, tyre
        return "dynamic", {f"{axle}.{n}": values[f"{n}_{axle}"] for axle in ("front", "rear") for n in ("mu", "B", "C")}

    def screening_points(self, probe: ScreeningProbe) -> FloatArray:
        """Tyres of several grips with the stiffness B C mu that the linear ones have."""
        stiffness = {a: math.prod(probe.values[f"tyre.{a}.{k}"] for k in ("B", "C", "mu")) for a in ("front", "rear")}
        return probe.points(
            {
                "mu_front": front,
                "mu_rear": rear,
                "C_front": SCREENING_SHAPE,
                "C_rear": SCREENING_SHAPE,
                "B_front": stiffness["front"] / (SCREENING_SHAPE * front),
                "B_rear": stiffness["rear"] / (SCREENING_SHAPE * rear),
            }
            for front in SCREENING_GRIPS
            for rear in SCREENING_GRIPS
        )


class FrontWheelPlay(DynamicsEffect):
    """``a_f - clip(a_f, -angle, angle)`` in place of the slip angle a_f of the front wheels.

    The side force turns the wheels within the play of their linkage, until they reach its end. The play operator of
    ``steering_backlash`` acts between servo and wheels instead, and the side force does not turn its wheels.
    """

    id = "front_wheel_play"
    represented_by = ("front_tyre_map",)
    name = "play of the front wheels"
    summary = "The side force turns the front wheels within the play of their linkage."
    sentence = "the side force turns the front wheels by {angle} against the steering, within the play of their linkage"
    refuted_if = "the front wheels of the parked car cannot be turned by hand while the servo is powered"
    command = "steering"
    base_models = ("dynamic", "linear_tyre", "blend")
    parameters = (EffectParameter("angle", "rad", 0.0, 0.0, 0.3, 0.03),)
    confusable = (
        Confusable(
            "steering_deadband",
            "steering_chirp",
            "a dead band follows the sign of the command, play that of the side force; they differ in fast weaving",
        ),
        Confusable(
            "steering_backlash",
            "steering_chirp",
            "backlash waits after each reversal of the command, play after each reversal of the side force",
        ),
    )

    def front_slip(self, ops: Ops, slip_rad: Value, values: Parameters) -> Value:
        """Nothing within the play."""
        return ops.sign(slip_rad) * ops.at_least(ops.abs(slip_rad) - values["angle"], 0.0)


class FrictionDrift(DynamicsEffect):
    """``mu (1 + rate t)`` of both axles, t since the first row of the recording; not below zero."""

    id = "friction_drift"
    depends_on = frozenset({"time"})
    name = "a grip that changes with time"
    summary = "Grip changes with time, as tyres warm up or wear."
    sentence = "grip {rate:grows|falls} by {rate:size each minute}"
    refuted_if = "only the drive changes with time and cornering does not (then it is the battery)"
    order = 10
    parameters = (EffectParameter("rate", "1/s", 0.0, -1.0, 1.0, -0.003),)

    def on_grip(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Multiply the grip of both axles."""
        factor = ops.at_least(1.0 + values["rate"] * forces.t_s, 0.0)
        forces.grip_front, forces.grip_rear = forces.grip_front * factor, forces.grip_rear * factor


class LowFrictionPatch(DynamicsEffect):
    """``mu (1 - loss)`` of both axles while the centre of mass is inside a disc around (x, y).

    The loss grows in a straight line over 5 cm across the rim.
    """

    id = "low_friction_patch"
    name = "a low-friction patch"
    summary = "There is a place on the floor where grip is low."
    sentence = "grip falls by {loss:percent} within {radius} of the place x = {x:place}, y = {y:place}"
    refuted_if = "the car also slides elsewhere at the same speed and turn, or does not slide there on another lap"
    order = 20
    depends_on = frozenset({"place"})
    disc_parameters = ("x", "y", "radius")
    screening_scaled = ("loss",)
    parameters = (
        EffectParameter("x", "m", 0.0, -1e4, 1e4, 1.0),
        EffectParameter("y", "m", 0.0, -1e4, 1e4, 0.5),
        EffectParameter("radius", "m", 0.5, 0.0, 1e4, 0.8),
        EffectParameter("loss", "1", 0.0, 0.0, 1.0, 0.5),
    )

    def screening_points(self, probe: ScreeningProbe) -> FloatArray:
        """Discs along the driven path."""
        cells = np.unique(np.round(probe.path_m / SCREENING_SPACING_M).astype(np.int64), axis=0) * SCREENING_SPACING_M
        return probe.points({"x": x, "y": y, "radius": SCREENING_RADIUS_M, "loss": 0.1} for x, y in cells.tolist())

    def on_grip(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Scale inside."""
        distance = ops.hypot(forces.x - values["x"], forces.y - values["y"])
        inside = ops.clip((values["radius"] - distance) * (1.0 / RIM_WIDTH_M) + 0.5, 0.0, 1.0)
        factor = 1.0 - values["loss"] * inside
        forces.grip_front, forces.grip_rear = forces.grip_front * factor, forces.grip_rear * factor


class FrictionEllipse(DynamicsEffect):
    """``F_rear = k F`` (action "scales") or ``clip(F, -k G, k G)`` (action "limits"), F the side force without it.

    ``k = sqrt(1 - clip(scale F_x / (mu F_z), -0.98, 0.98)^2)``: the ellipse scales the side force at every slip angle,
    or only limits it. G is the grip ``mu F_z``, or |F| where that is larger (linear tyres). F_x is that of the rear
    axle (drive less damping, after a traction limit or wheel slip). With all-wheel drive, the front axle has the same
    ellipse with its own F_x. Source: the friction ellipse, Pacejka 2012, "Tire
    and Vehicle Dynamics", ch. 1.
    """

    id = "friction_ellipse"
    represented_by = ("rear_tyre_map",)
    name = "a friction ellipse of the driven tyres"
    summary = "Driving and braking take side force from the rear tyres."
    sentence = (
        "driving and braking reduce the grip for cornering: a friction ellipse {action:choice scales|limits} the side "
        "force of the rear tyres, with {scale} times the drive force"
    )
    refuted_if = (
        "driving and braking change the handling balance in opposite directions (then load moves between axles)"
    )
    order = 10
    parameters = (
        EffectParameter("scale", "1", 0.0, 0.0, 10.0, 0.6),
        EffectParameter("action", "1", 0.0, 0.0, 1.0, 0.0, choices=("scales", "limits")),
    )
    confusable = (
        Confusable(
            "load_transfer",
            "throttle_steps",
            (
                "shared grip is lost both in driving and in braking; load transfer raises the grip of the rear axle in "
                "one and lowers it in the other"
            ),
        ),
    )

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Scale or limit the side force of the driven axles."""
        rear_force = forces.axle_force
        if forces.front_force is not None:
            rear_force = rear_force - forces.front_force
            peak = forces.grip_front * forces.load_front
            forces.side_front = self._side_force(ops, forces.side_front, peak, forces.front_force, values)
        peak = forces.grip_rear * forces.load_rear
        forces.side_rear = self._side_force(ops, forces.side_rear, peak, rear_force, values)

    def _side_force(self, ops: Ops, side: Value, peak: Value, force_x: Value, values: Parameters) -> Value:
        """Side force of an axle with the side force ``side``, the grip ``peak`` and the drive force ``force_x`` [N]."""
        peak = ops.at_least(peak, 1e-6)
        share = ops.clip(values["scale"] * force_x / peak, -MAX_SHARE, MAX_SHARE)
        factor = ops.sqrt(1.0 - share * share)
        limit = factor * ops.at_least(ops.abs(side), peak)
        return ops.where(values["action"] < 0.5, factor * side, ops.clip(side, -limit, limit))

    def screening_points(self, probe: ScreeningProbe) -> FloatArray:
        """Both actions at several scales."""
        directions = ({"scale": 1.0, "action": float(k)} for k in range(2))
        return probe.points(probe.sized(directions, held=("action",)))


class TyreRelaxation(DynamicsEffect):
    """``(length / max(|vx|, 0.3 m/s)) dF/dt = F_steady - F`` for the side force of each axle, in its wheels' frame.

    Source: Pacejka 2012, "Tire and Vehicle Dynamics", ch. 7 (first-order relaxation in distance travelled). A step
    uses the closed form of the lag (``RelaxedSides``): stable for every length, and the base model at length 0.
    """

    id = "tyre_relaxation"
    name = "the relaxation of the tyres' side force"
    summary = "The tyres must roll some way before their side force has built up."
    sentence = "the tyres roll {length} before their side force has built up"
    refuted_if = "the side force is late by the same time, rather than by the same distance, at two speeds"
    order = 90
    states = ("front", "rear")
    stiff = True
    parameters = (EffectParameter("length", "m", 0.0, 0.0, 5.0, 0.15),)

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """The lagging forces instead of the steady ones."""
        front, rear = forces.side_front, forces.side_rear
        if self.id in forces.stiff:
            forces.side_front, forces.side_rear = forces.stiff[self.id].at_stage(forces.vx, front, rear)
            return
        rate = ops.at_least(ops.abs(forces.vx), RELAXATION_FLOOR_MPS) / ops.at_least(values["length"], MIN_LENGTH_M)
        lags = values["length"] >= MIN_LENGTH_M
        for name, steady in (("front", front), ("rear", rear)):
            force = forces.states[f"{self.id}.{name}"]
            forces.rates[f"{self.id}.{name}"] = (steady - force) * rate
            setattr(forces, f"side_{name}", ops.where(lags, force, steady))

    def settled(self, ops: Ops, forces: Forces, values: Parameters) -> dict[str, Value]:
        """The steady side forces by name [N]."""
        return {f"{self.id}.front": forces.side_front, f"{self.id}.rear": forces.side_rear}

    def stiff_step(self, ops: Ops, start: StepStart, values: Parameters) -> RelaxedSides:
        """The lag's closed form at each stage."""
        return RelaxedSides(ops, self.id, start, values["length"])


class RelaxedSides:
    """Side forces at the four stages of one Runge-Kutta step, from the steady forces of each stage.

    Between stages the steady force goes in straight lines and the lag is exact (an exponential integrator: Hochbruck
    and Ostermann 2010, "Exponential integrators"), at the speed of the start and then of the middle of the step.
    """

    def __init__(self, ops: Ops, effect_id: str, start: StepStart, length: Value) -> None:
        self._ops, self._length, self._step_s = ops, length, start.step_s
        self._names = (f"{effect_id}.front", f"{effect_id}.rear")
        before = (start.states[self._names[0]], start.states[self._names[1]])
        self._before = self._steady = before
        self._stage = 0
        self._weights: LagWeights | None = None
        self.last = before
        """Forces at the latest stage; after the fourth, at the end of the step."""

    def at_stage(self, vx: Value, front: Value, rear: Value) -> tuple[Value, Value]:
        """Front and rear force [N] at the next stage, from vx [m/s] and the steady forces [N] there."""
        now = (front, rear)
        if self._weights is None or self._stage == 1:
            speed = self._ops.at_least(self._ops.abs(vx), RELAXATION_FLOOR_MPS)
            self._weights = lag_weights(self._ops, self._length / speed, self._step_s)
        weights = self._weights
        if self._stage == 0:
            self.last = _both(lambda k: now[k] + (self._before[k] - now[k]) * weights.start)
            self._steady = now
        elif self._stage < 3:
            self.last = _both(lambda k: weights.after_half(self._before[k], self._steady[k], now[k]))
            if self._stage == 2:
                self._steady = now
        else:
            central = self.last
            self.last = _both(lambda k: weights.after_half(central[k], self._steady[k], now[k]))
        self._stage += 1
        return self.last

    def finish(self) -> dict[str, Value]:
        """The side forces at the end of the step by name [N]."""
        return dict(zip(self._names, self.last, strict=True))


def _both(of: Callable[[int], Value]) -> tuple[Value, Value]:
    return of(0), of(1)
