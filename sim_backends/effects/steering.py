"""What stands between the steering command and the wheel angle, lags and delays apart. Angles in rad.

Acting order: dead band (the servo's electronics), rate limit, lag (its motor), backlash, asymmetry, nonlinearity (the
linkage), offset (how it is mounted).
"""

from __future__ import annotations

import math

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import ActuatorEffect, EffectParameter, Parameters, Triple

FASTEST_RADPS = 1e6
"""A rate limit above this is none."""
LARGEST_RAD = 1e6
"""A saturation above this is none."""


class SteeringDeadband(ActuatorEffect):
    """``d = d_cmd - clip(d_cmd, -width/2, width/2)``."""

    id = "steering_deadband"
    sentence = "The steering servo ignores small commands around straight ahead."
    channel = "steering"
    order = 10
    parameters = (EffectParameter("width", "rad", 0.0, 0.0, 1.0, 0.06),)
    look_alikes = ("steering_backlash",)

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Nothing within the band, shifted towards zero outside."""
        half = 0.5 * values["width"]
        return ops.where(ops.abs(command) < half, 0.0 * command, command - ops.sign(command) * half)


class SteeringRateLimit(ActuatorEffect):
    """``|dd/dt| <= rate``: the wheel angle turns towards its command at no more than ``rate``.

    Over a step with a held command this is exact; the angle that counts at its start is chosen as for a lag (see
    ``LagWeights.start``), so that the mean over the step tends to the command as the rate grows.
    """

    id = "steering_rate_limit"
    sentence = "The steering servo turns no faster than a certain rate."
    channel = "steering"
    has_state = True
    order = 20
    parameters = (EffectParameter("rate", "rad/s", math.inf, 0.0, math.inf, 3.0, positive=True),)
    look_alikes = ("steering_lag",)

    def step(
        self, ops: Ops, command: Triple, state: Value, duration_s: Value, values: Parameters
    ) -> tuple[Triple, Value]:
        """Ramp towards the command."""
        start, middle, end = command
        limited = values["rate"] < FASTEST_RADPS
        # Where there is no limit nothing infinite may enter: it would make the gradient not a number.
        rate = ops.where(limited, values["rate"], 1.0)
        reach = 0.5 * rate * duration_s
        gap = start - state
        first = start - gap * ops.clip(1.5 * ops.abs(gap) / ops.floor(reach, 1e-12), 0.0, 1.0)
        central = _towards(ops, state, middle, reach)
        last = _towards(ops, central, end, reach)
        out = tuple(ops.where(limited, a, b) for a, b in zip((first, central, last), command, strict=True))
        return (out[0], out[1], out[2]), out[2]


def _towards(ops: Ops, state: Value, target: Value, reach: Value) -> Value:
    gap = target - state
    return ops.where(ops.abs(gap) <= reach, target, state + ops.sign(gap) * reach)


class SteeringBacklash(ActuatorEffect):
    """Play operator: ``d`` stays until ``d_cmd`` has taken up the play, ``|d - d_cmd| <= play/2``.

    Source: Krasnosel'skii and Pokrovskii, "Systems with Hysteresis", ch. 2 (the play).
    """

    id = "steering_backlash"
    sentence = "The steering linkage has play: the wheels follow only when it is taken up."
    channel = "steering"
    has_state = True
    order = 40
    parameters = (EffectParameter("play", "rad", 0.0, 0.0, 1.0, 0.06),)
    look_alikes = ("steering_deadband",)

    def step(
        self, ops: Ops, command: Triple, state: Value, duration_s: Value, values: Parameters
    ) -> tuple[Triple, Value]:
        """Exact for commands that are monotone over each half of the step."""
        start, middle, end = command
        half = 0.5 * values["play"]
        first = _with_play(ops, state, start, half)
        if start is middle and middle is end:
            return (first, first, first), first
        central = _with_play(ops, first, middle, half)
        last = _with_play(ops, central, end, half)
        return (first, central, last), last


def _with_play(ops: Ops, state: Value, command: Value, half: Value) -> Value:
    gap = state - command
    return ops.where(ops.abs(gap) < half, state, command + ops.sign(gap) * half)


class SteeringAsymmetry(ActuatorEffect):
    """``d = d_cmd (1 + gain sign(d_cmd))``."""

    id = "steering_asymmetry"
    sentence = "The wheels turn farther to one side than to the other."
    channel = "steering"
    order = 50
    parameters = (EffectParameter("gain", "1", 0.0, -1.0, 1.0, 0.1),)
    look_alikes = ("steering_offset",)

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """More to the left for a positive gain."""
        return command + values["gain"] * ops.abs(command)


class SteeringNonlinearity(ActuatorEffect):
    """``d = saturation tanh(d_cmd / saturation)``."""

    id = "steering_nonlinearity"
    sentence = "The wheel angle grows less than the command towards full lock."
    channel = "steering"
    order = 60
    parameters = (EffectParameter("saturation", "rad", math.inf, 0.0, math.inf, 0.5, positive=True),)
    look_alikes = ("tyre_saturation",)

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Saturate smoothly."""
        saturates = values["saturation"] < LARGEST_RAD
        saturation = ops.where(saturates, values["saturation"], 1.0)
        return ops.where(saturates, saturation * ops.tanh(command / saturation), command)


class SteeringOffset(ActuatorEffect):
    """``d = d_cmd + angle``."""

    id = "steering_offset"
    sentence = "The wheels are not straight when the steering command is zero."
    channel = "steering"
    order = 70
    parameters = (EffectParameter("angle", "rad", 0.0, -1.0, 1.0, 0.05),)
    look_alikes = ("lateral_bias", "mocap_yaw_misalignment")

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Shift."""
        return command + values["angle"]
