"""Effects: physics beyond the base model. Each effect is one class with its equation, parameters and texts.

To add your own effect, write its class and call ``sim_backends.registry.register``. To add an effect to the package,
list it here.

Acting order: axle distances (wheelbase, centre of mass; before the first step) -> command -> delays -> steering (dead
band, rate limit, lag, backlash, asymmetry, nonlinearity, offset) and throttle (dead band, nonlinearity, asymmetry, lag)
-> front slip angle (play) -> loads (downforce) -> friction (drift, patch) -> drive (sag, brake asymmetry, drag brake,
saturation) -> driven axle (combined slip, speed controller, traction limit, wheel slip) -> body (resistances, slope,
bias, moments) -> load transfer -> side forces (ellipse, roll, relaxation) -> motion -> what is measured (marker offset,
yaw misalignment, velocity filter, latency). Within a group: by ``order``, then by id.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import (
    ActuatorEffect,
    Confusable,
    DelayEffect,
    DynamicsEffect,
    Effect,
    EffectParameter,
    Forces,
    ObservationEffect,
)
from sim_backends.effects.body import LateralBias, RoadSlope, TorqueSteer, YawDamping
from sim_backends.effects.combined_slip import CombinedSlip
from sim_backends.effects.curves import (
    DriveMap,
    FrontTyreMap,
    MeasuredCurve,
    RearTyreMap,
    SteeringCurve,
    ThrottleCurve,
)
from sim_backends.effects.delays import CommandDelay, SteeringDelay, ThrottleDelay
from sim_backends.effects.disturbances import BODY_FORCE_PARAMETERS, DISTURBANCES, DRIFTING_PARAMETERS, Disturbance
from sim_backends.effects.drive import (
    AllWheelDrive,
    BatterySag,
    BrakeAsymmetry,
    DragBrake,
    MotorSaturation,
    SpeedController,
    TractionLimit,
)
from sim_backends.effects.force_curves import (
    SideForceOverSlip,
    SideForceOverSpeed,
    YawMomentOverSlip,
    YawMomentOverSpeed,
)
from sim_backends.effects.geometry import CentreOfMass, Wheelbase
from sim_backends.effects.lags import MotorLag, SteeringLag
from sim_backends.effects.loads import AerodynamicDownforce, LoadTransfer, RollDynamics
from sim_backends.effects.observations import MarkerOffset, MocapLatency, MocapYawMisalignment, VelocityFilterLag
from sim_backends.effects.resistances import AerodynamicDrag, CorneringDrag, RollingResistance
from sim_backends.effects.steering import (
    SteeringAsymmetry,
    SteeringBacklash,
    SteeringDeadband,
    SteeringNonlinearity,
    SteeringOffset,
    SteeringRateLimit,
)
from sim_backends.effects.throttle import ThrottleAsymmetry, ThrottleDeadband, ThrottleNonlinearity
from sim_backends.effects.tyres import (
    FrictionDrift,
    FrictionEllipse,
    FrontWheelPlay,
    LowFrictionPatch,
    TyreRelaxation,
    TyreSaturation,
)
from sim_backends.effects.uncatalogued import UNCATALOGUED
from sim_backends.effects.wheel_slip import LongitudinalSlip

_ALL: tuple[Effect, ...] = (
    CommandDelay(),
    SteeringDelay(),
    ThrottleDelay(),
    SteeringLag(),
    SteeringRateLimit(),
    SteeringDeadband(),
    SteeringBacklash(),
    SteeringOffset(),
    SteeringAsymmetry(),
    SteeringNonlinearity(),
    ThrottleDeadband(),
    ThrottleNonlinearity(),
    ThrottleAsymmetry(),
    MotorLag(),
    MotorSaturation(),
    TractionLimit(),
    AllWheelDrive(),
    SpeedController(),
    DragBrake(),
    BrakeAsymmetry(),
    BatterySag(),
    RollingResistance(),
    AerodynamicDrag(),
    CorneringDrag(),
    Wheelbase(),
    CentreOfMass(),
    TyreSaturation(),
    FrontWheelPlay(),
    FrictionEllipse(),
    CombinedSlip(),
    LongitudinalSlip(),
    TyreRelaxation(),
    LoadTransfer(),
    RollDynamics(),
    FrictionDrift(),
    LowFrictionPatch(),
    AerodynamicDownforce(),
    YawDamping(),
    TorqueSteer(),
    LateralBias(),
    RoadSlope(),
    MocapLatency(),
    MarkerOffset(),
    MocapYawMisalignment(),
    VelocityFilterLag(),
)
CATALOGUE: dict[str, Effect] = {effect.id: effect for effect in _ALL}
"""The effects that a diagnosis names, by id, in the order of the catalogue."""
CURVES: tuple[MeasuredCurve, ...] = (
    DriveMap(),
    ThrottleCurve(),
    SteeringCurve(),
    FrontTyreMap(),
    RearTyreMap(),
    SideForceOverSpeed(),
    YawMomentOverSpeed(),
    SideForceOverSlip(),
    YawMomentOverSlip(),
)
EFFECTS: dict[str, Effect] = {**CATALOGUE, **{effect.id: effect for effect in (*UNCATALOGUED, *CURVES, *DISTURBANCES)}}
"""All effects: the catalogue, then uncatalogued physics, measured curves and disturbances. ``register`` adds to
both."""


def separation(one: str, other: str) -> Confusable | None:
    """The ``Confusable`` entry of a pair of effects, from either effect; None if neither lists the pair."""
    for effect_id, confused in ((one, other), (other, one)):
        for entry in EFFECTS[effect_id].confusable if effect_id in EFFECTS else ():
            if entry.effect == confused:
                return entry
    return None


def axle_distances_m(ops: Ops, values: Mapping[str, Value], effects: Iterable[str]) -> tuple[Value, Value]:
    """Distances of the front and of the rear axle from the centre of mass [m], each () or (cars,).

    Args:
        ops: functions of the array library of ``values``.
        values: numbers by dotted name.
        effects: ids of effects; those of class DynamicsEffect are used.
    """
    front_m, rear_m = values["vehicle.front_axle"], values["vehicle.rear_axle"]
    dynamics = (e for e in (EFFECTS[name] for name in effects) if isinstance(e, DynamicsEffect))
    for effect in sorted(dynamics, key=lambda e: (e.order, e.id)):
        front_m, rear_m = effect.axle_distances_m(ops, front_m, rear_m, effect.numbers(values))
    return front_m, rear_m


def delays_s(base_s: Value, values: Mapping[str, Value], effects: Iterable[str]) -> tuple[Value, Value]:
    """Delays of steering and of throttle with all delay effects [s]; the same object if they are equal by definition.

    Args:
        base_s: delay of both without effects [s], () or (cars,).
        values: numbers by dotted name.
        effects: ids of effects; those of class DelayEffect are used.
    """
    steering_s = throttle_s = base_s
    for effect in (EFFECTS[name] for name in effects):
        if isinstance(effect, DelayEffect):
            extra_steering_s, extra_throttle_s = effect.extra_delays_s(effect.numbers(values))
            is_same = steering_s is throttle_s and extra_steering_s is extra_throttle_s
            steering_s = steering_s + extra_steering_s
            throttle_s = steering_s if is_same else throttle_s + extra_throttle_s
    return steering_s, throttle_s


def confusable_effects() -> dict[str, tuple[str, ...]]:
    """Confusable effects of each effect of the catalogue; symmetric, in the catalogue's order."""
    pairs = {(e.id, entry.effect) for e in CATALOGUE.values() for entry in e.confusable}
    pairs |= {(b, a) for a, b in pairs}
    return {name: tuple(other for other in CATALOGUE if (name, other) in pairs) for name in CATALOGUE}


__all__ = [
    "BODY_FORCE_PARAMETERS",
    "CATALOGUE",
    "CURVES",
    "DRIFTING_PARAMETERS",
    "EFFECTS",
    "ActuatorEffect",
    "Confusable",
    "DelayEffect",
    "Disturbance",
    "DynamicsEffect",
    "Effect",
    "EffectParameter",
    "Forces",
    "MeasuredCurve",
    "ObservationEffect",
    "confusable_effects",
    "delays_s",
    "separation",
]
