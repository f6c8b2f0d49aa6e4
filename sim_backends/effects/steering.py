"""Effects between the steering command and the wheel angle, except lags and delays. Angles in rad.

Acting order: dead band (the servo's electronics), rate limit, lag (its motor), backlash, asymmetry, nonlinearity (the
linkage), offset (how it is mounted).
"""

from __future__ import annotations

import math

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import ActuatorEffect, Confusable, EffectParameter, Parameters, Triple

MAX_RATE_RADPS = 1e6
"""Rate limits above this value are inactive [rad/s]."""
MAX_SATURATION_RAD = 1e6
"""Saturations above this value are inactive [rad]."""


class SteeringDeadband(ActuatorEffect):
    """``d = d_cmd - clip(d_cmd, -width/2, width/2)``."""

    id = "steering_deadband"
    represented_by = ("steering_curve",)
    name = "a dead band of the steering"
    summary = "The steering servo ignores small commands around straight ahead."
    sentence = "the steering ignores small commands around straight ahead, in a band {width} wide"
    refuted_if = "the wheels also stand still for a moment when the steering turns back far from straight ahead"
    command = "steering"
    order = 10
    parameters = (EffectParameter("width", "rad", 0.0, 0.0, 1.0, 0.06),)
    confusable = (
        Confusable(
            "steering_backlash",
            "steering_chirp",
            "play acts at each reversal, a dead band only around straight ahead",
        ),
    )

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Nothing within the band, shifted towards zero outside."""
        half = 0.5 * values["width"]
        return ops.where(ops.abs(command) < half, 0.0 * command, command - ops.sign(command) * half)


class SteeringRateLimit(ActuatorEffect):
    """``|dd/dt| <= rate``: the wheel angle turns towards its command at no more than ``rate``.

    Over a step with a held command this is exact; the effective angle at its start is chosen as for a lag (see
    ``LagWeights.start``), so that the mean over the step tends to the command as the rate grows.
    """

    id = "steering_rate_limit"
    name = "a limit of the steering servo's speed"
    summary = "The steering servo turns no faster than a certain rate."
    sentence = "the steering servo turns the wheels no faster than {rate}"
    refuted_if = "small steps of steering are as late as large ones"
    command = "steering"
    has_state = True
    order = 20
    parameters = (EffectParameter("rate", "rad/s", math.inf, 0.0, math.inf, 3.0, positive=True),)

    def step(
        self, ops: Ops, command: Triple, state: Value, duration_s: Value, values: Parameters
    ) -> tuple[Triple, Value]:
        """Ramp towards the command."""
        start, middle, end = command
        limited = values["rate"] < MAX_RATE_RADPS
        # Without a limit the infinite rate is replaced, since it would make the gradient NaN.
        rate = ops.where(limited, values["rate"], 1.0)
        reach = 0.5 * rate * duration_s
        gap = start - state
        first = start - gap * ops.clip(1.5 * ops.abs(gap) / ops.at_least(reach, 1e-12), 0.0, 1.0)
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
    name = "play in the steering"
    summary = "The steering linkage has play: the wheels follow only when it is taken up."
    sentence = "the steering linkage has {play} of play, which is taken up at each reversal"
    refuted_if = "commands are ignored around straight ahead only, whichever way the wheels moved before"
    command = "steering"
    has_state = True
    order = 40
    parameters = (EffectParameter("play", "rad", 0.0, 0.0, 1.0, 0.06),)

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
    represented_by = ("steering_curve",)
    name = "an asymmetry of the steering"
    summary = "The wheels turn farther to one side than to the other."
    sentence = (
        "the wheels turn {gain:size percent} farther to the {gain:left|right} than commanded, and as much less to "
        "the other side"
    )
    refuted_if = "left and right circles at the same command have the same radius"
    command = "steering"
    order = 50
    parameters = (EffectParameter("gain", "1", 0.0, -1.0, 1.0, 0.1),)
    confusable = (
        Confusable(
            "steering_offset",
            "figure_eight",
            "the effect of an offset is equal at any command; the effect of an asymmetry grows with the command",
        ),
    )

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """More to the left for a positive gain."""
        return command + values["gain"] * ops.abs(command)


class SteeringNonlinearity(ActuatorEffect):
    """``d = saturation tanh(d_cmd / saturation)``."""

    id = "steering_nonlinearity"
    represented_by = ("steering_curve",)
    name = "a nonlinearity of the steering towards full lock"
    summary = "The wheel angle grows less than the command towards full lock."
    sentence = "the wheel angle grows less than in proportion to its command and stays below {saturation}"
    refuted_if = "a slow circle at full lock, where tyres do not slip, has the radius of the linear steering"
    command = "steering"
    order = 60
    parameters = (EffectParameter("saturation", "rad", math.inf, 0.0, math.inf, 0.5, positive=True),)
    confusable = (
        Confusable(
            "tyre_saturation",
            "slow_circle",
            "at walking pace tyres do not slip, so a circle that is too wide at full lock is caused by the steering",
        ),
    )

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Saturate smoothly."""
        saturates = values["saturation"] < MAX_SATURATION_RAD
        saturation = ops.where(saturates, values["saturation"], 1.0)
        return ops.where(saturates, saturation * ops.tanh(command / saturation), command)


class SteeringOffset(ActuatorEffect):
    """``d = d_cmd + angle``."""

    id = "steering_offset"
    fitted_with_curves = True
    name = "an offset of the steering"
    summary = "The wheels are not straight when the steering command is zero."
    sentence = "with a steering command of zero the wheels point {angle:size} to the {angle:left|right}"
    refuted_if = "the pull to one side falls as speed grows, or the heading has an error although the path is straight"
    command = "steering"
    order = 70
    parameters = (EffectParameter("angle", "rad", 0.0, -1.0, 1.0, 0.05),)
    confusable = (
        Confusable(
            "lateral_bias",
            "throttle_ramp",
            "a steering offset curves the path alike at any speed; the curvature by a side force falls as speed grows",
        ),
        Confusable(
            "mocap_yaw_misalignment",
            "throttle_ramp",
            (
                "a steering offset curves the path; a yaw misalignment appears only as a lateral velocity proportional "
                "to speed"
            ),
        ),
    )

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Add the angle to the steering angle."""
        return command + values["angle"]
