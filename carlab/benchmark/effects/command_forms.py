"""Effects between the command and the wheels, in the catalogue's form."""

from __future__ import annotations

import math
from collections.abc import Callable

from carlab.benchmark.effects.catalogue import Attach, Draw, Form, Parameters, factor, hook, inverse, plain, signed
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.physics import Instant, World


def delay(key: str, *channels: int) -> Attach:
    """Delay of channels (0 steering, 1 throttle) in addition to that of the car file; may be negative."""

    def attach(world: World, p: Parameters) -> None:
        for channel in channels:

            def later(t: float, before: Callable[[float], float] = world.arrival[channel]) -> float:
                return before(t) + p[key]

            world.arrival[channel] = later

    return attach


def first_order(stage: str, name: str) -> Attach:
    """First-order lag T dy/dt = input - y of a variable (``d`` wheel angle, ``u`` throttle) at a stage."""

    def attach(world: World, p: Parameters) -> None:
        time_constant_s = p["time_constant"]
        if time_constant_s <= 0.0:
            return
        k = world.add_state()

        def lag(now: Instant) -> None:
            now.rates[k] = (getattr(now, name) - now.extra[k]) / time_constant_s
            setattr(now, name, now.extra[k])

        world.hooks[stage].append(lag)

    return attach


def steering_rate_limit(world: World, p: Parameters) -> None:
    """The wheel moves towards the desired angle at most at ``rate``; exact, because the desired angle is held."""
    rate = p["rate"]
    since, begin, wanted = 0.0, 0.0, 0.0

    def at(t: float) -> float:
        reach = rate * (t - since) if t > since else 0.0
        return begin + min(max(wanted - begin, -reach), reach)

    def switched(t: float, angle: float, throttle: float) -> None:
        nonlocal since, begin, wanted
        begin, since, wanted = at(t), t, angle

    def limit(now: Instant) -> None:
        now.d = at(now.t)

    world.switch_listeners.append(switched)
    world.hooks["steer"].insert(0, limit)


def dead_band(value: float, half: float) -> float:
    """Nothing within ``half``, which is subtracted from larger values."""
    return value - min(max(value, -half), half)


def steering_deadband(world: World, p: Parameters) -> None:
    """Angles below half the width have no influence; half the width is subtracted from larger angles."""
    half = 0.5 * p["width"]
    world.steering_maps.append(lambda d: dead_band(d, half))


def play(width: float) -> Callable[[float], float]:
    """Play operator: the output moves only to stay within half the width of the input."""
    held = 0.0

    def follow(value: float) -> float:
        nonlocal held
        held = min(max(held, value - 0.5 * width), value + 0.5 * width)
        return held

    return follow


def steering_backlash(world: World, p: Parameters) -> None:
    """Play of the steering."""
    world.steering_maps.append(play(p["play"]))


@hook("steer")
def steering_offset(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Trim: constant offset angle."""
    now.d += p["angle"]


def steering_asymmetry(world: World, p: Parameters) -> None:
    """Different gain to each side."""
    gain = p["gain"]
    world.steering_maps.append(lambda d: d + gain * abs(d))


def steering_nonlinearity(world: World, p: Parameters) -> None:
    """Saturating linkage."""
    top = p["saturation"]
    if math.isfinite(top):
        world.steering_maps.append(lambda d: top * math.tanh(d / top))


def throttle_deadband(world: World, p: Parameters) -> None:
    """Small throttle has no influence; full throttle is unchanged."""
    width = p["width"]
    world.throttle_maps.append(lambda u: math.copysign(max(abs(u) - width, 0.0) / (1.0 - width), u))


def throttle_nonlinearity(world: World, p: Parameters) -> None:
    """Throttle curve."""
    exponent = p["exponent"]
    world.throttle_maps.append(lambda u: math.copysign(abs(u) ** exponent, u))


def throttle_asymmetry(world: World, p: Parameters) -> None:
    """A reverse with another gain."""
    ratio = p["gain_ratio"]
    world.throttle_maps.append(lambda u: u if u > 0.0 else ratio * u)


def extra_delay(size: float, draw: Draw) -> dict[str, float]:
    """An additional delay [s] of either sign that leaves a twentieth of the delay of the car file."""
    return {"extra_delay": max(draw.sign * size, -0.95 * draw.car.command_delay)}


FORMS = (
    Form("command_delay", "catalogue", extra_delay, delay("extra_delay", 0, 1), 0.01, 0.15),
    Form("steering_delay", "catalogue", plain("delay"), delay("delay", 0), 0.01, 0.2),
    Form("throttle_delay", "catalogue", plain("delay"), delay("delay", 1), 0.03, 0.4),
    Form("steering_lag", "catalogue", plain("time_constant"), first_order("steer", "d"), 0.01, 0.4),
    Form("motor_lag", "catalogue", plain("time_constant"), first_order("throttle", "u"), 0.03, 1.0),
    Form("steering_rate_limit", "catalogue", inverse("rate"), steering_rate_limit, 0.1, 1.5),
    Form("steering_deadband", "catalogue", plain("width"), steering_deadband, 0.01, 0.4),
    Form("steering_backlash", "catalogue", plain("play"), steering_backlash, 0.01, 0.4),
    Form("steering_offset", "catalogue", signed("angle"), steering_offset, 0.003, 0.2),
    Form("steering_asymmetry", "catalogue", signed("gain"), steering_asymmetry, 0.02, 0.7),
    Form("steering_nonlinearity", "catalogue", inverse("saturation"), steering_nonlinearity, 0.7, 8.0),
    Form("throttle_deadband", "catalogue", plain("width"), throttle_deadband, 0.01, 0.4),
    Form("throttle_nonlinearity", "catalogue", factor("exponent"), throttle_nonlinearity, 0.05, 1.2),
    Form("throttle_asymmetry", "catalogue", factor("gain_ratio"), throttle_asymmetry, 0.1, 1.5),
)
