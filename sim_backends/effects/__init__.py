"""Physics beyond the base model, by the ids of the catalogue. To add an effect, write its class and list it here."""

from __future__ import annotations

from sim_backends.effects.base import (
    ActuatorEffect,
    DelayEffect,
    DynamicsEffect,
    Effect,
    EffectParameter,
    Forces,
    ObservationEffect,
)
from sim_backends.effects.delays import CommandDelay, SteeringDelay
from sim_backends.effects.lags import MotorLag, SteeringLag
from sim_backends.effects.observations import MarkerOffset, MocapLatency, VelocityFilterLag
from sim_backends.effects.resistances import AerodynamicDrag, RollingResistance

_ALL: tuple[Effect, ...] = (
    CommandDelay(),
    SteeringDelay(),
    SteeringLag(),
    MotorLag(),
    RollingResistance(),
    AerodynamicDrag(),
    MocapLatency(),
    MarkerOffset(),
    VelocityFilterLag(),
)
EFFECTS: dict[str, Effect] = {effect.id: effect for effect in _ALL}

__all__ = [
    "EFFECTS",
    "ActuatorEffect",
    "DelayEffect",
    "DynamicsEffect",
    "Effect",
    "EffectParameter",
    "Forces",
    "ObservationEffect",
]
