"""Alternative forms of command effects, closer to hardware: packet queues, second-order servos, soft edges."""

from __future__ import annotations

import math

import numpy as np

from carlab.benchmark.effects.catalogue import Attach, Draw, Form, Parameters, factor, inverse, plain
from carlab.benchmark.world.physics import Instant, World


def packet_queue(world: World, p: Parameters) -> None:
    """Both commands are sent in packets over a bus with jitter that keeps their order."""
    mean, seed = p["extra_delay"], int(p["seed"])
    rng = np.random.default_rng(seed)
    last_issue, last_arrival, extra = -1.0, 0.0, 0.0
    before = world.arrival[0]

    def arrive(t: float) -> float:
        nonlocal last_issue, last_arrival, extra
        if t != last_issue:  # one packet for both channels
            last_issue = t
            extra = mean * (0.6 + 0.8 * float(rng.random()))
            last_arrival = max(before(t) + extra, last_arrival + 1e-4)
        return last_arrival

    world.arrival[0] = world.arrival[1] = arrive


def polled(channel: int) -> Attach:
    """A receiver that polls every 2 / 3 of the mean delay and forwards a command one poll later."""

    def attach(world: World, p: Parameters) -> None:
        period_s = max(2.0 * p["delay"] / 3.0, 1e-6)
        before = world.arrival[channel]

        def arrive(t: float) -> float:
            acts = before(t)
            return (math.floor(acts / period_s) + 2.0) * period_s if p["delay"] > 0.0 else acts

        world.arrival[channel] = arrive

    return attach


def limited_servo(world: World, p: Parameters) -> None:
    """A servo of second order whose motor current, so its angular acceleration, is limited."""
    lag = p["time_constant"]
    if lag <= 0.0:
        return
    z = 0.9
    w = 2.0 * z / lag
    top = p["current_share"] * 0.5 * w * w  # share of the acceleration of a step of 0.5 rad
    angle, rate = world.add_state(), world.add_state()

    def servo(now: Instant) -> None:
        wanted = w * w * (now.d - now.extra[angle]) - 2.0 * z * w * now.extra[rate]
        now.rates[angle] = now.extra[rate]
        now.rates[rate] = min(max(wanted, -top), top)
        now.d = now.extra[angle]

    world.hooks["steer"].append(servo)


def soft_rate_limit(world: World, p: Parameters) -> None:
    """A servo whose speed saturates softly with the error: a motor with back-EMF behind a proportional controller."""
    rate, gain = p["rate"], 150.0
    if rate > 1e4:
        return
    k = world.add_state()

    def servo(now: Instant) -> None:
        now.rates[k] = rate * math.tanh(gain * (now.d - now.extra[k]) / rate)
        now.d = now.extra[k]

    world.hooks["steer"].append(servo)


def sprung_play(world: World, p: Parameters) -> None:
    """Play with elastic flanks: the wheel moves slowly until it is inside the play."""
    half = 0.5 * p["play"]
    if half <= 0.0:
        return
    k = world.add_state()

    def follow(now: Instant) -> None:
        gap = now.d - now.extra[k]
        now.rates[k] = (gap - min(max(gap, -half), half)) / 0.006
        now.d = now.extra[k]

    world.hooks["steer"].append(follow)


def soft_dead_band(value: float, half: float) -> float:
    """A dead band with rounded edges: the result grows from zero with the third power."""
    half = max(half, 1e-9)
    return value - half * math.tanh(value / half)


def soft_steering_deadband(world: World, p: Parameters) -> None:
    """A dead band with rounded edges."""
    half = 0.5 * p["width"]
    world.steering_maps.append(lambda d: soft_dead_band(d, half))


def linkage(world: World, p: Parameters) -> None:
    """A steering linkage: the wheel angle is proportional to the sine of the servo angle."""
    top = max(p["saturation"], 0.45)
    world.steering_maps.append(lambda d: top * math.sin(min(max(d / top, -1.5), 1.5)))


def soft_throttle_deadband(world: World, p: Parameters) -> None:
    """An edge rounded by a hyperbola; full throttle is unchanged."""
    width = p["width"]
    top = math.sqrt(1.0 + width * width) - width
    world.throttle_maps.append(lambda u: math.copysign((math.sqrt(u * u + width * width) - width) / top, u))


def two_lags(world: World, p: Parameters) -> None:
    """Winding and rotor: two lags in series with half of the time constant each."""
    half = 0.5 * p["time_constant"]
    if half <= 0.0:
        return
    first, second = world.add_state(), world.add_state()

    def push(now: Instant) -> None:
        now.rates[first] = (now.u - now.extra[first]) / half
        now.rates[second] = (now.extra[first] - now.extra[second]) / half
        now.u = now.extra[second]

    world.hooks["throttle"].append(push)


def throttle_curve(world: World, p: Parameters) -> None:
    """A speed controller with the exponential curve ``u = sign(u_t) expm1(bend |u_t|) / expm1(bend)``."""
    bend = max(p["bend"], 1e-9)
    world.throttle_maps.append(lambda u: math.copysign(math.expm1(bend * abs(u)) / math.expm1(bend), u))


def soft_throttle_asymmetry(world: World, p: Parameters) -> None:
    """A gain that changes gradually between forward and reverse, over a tenth of full throttle."""
    change = p["gain_ratio"] - 1.0
    world.throttle_maps.append(lambda u: u * (1.0 + 0.5 * change * (1.0 - math.tanh(u / 0.1))))


def packet_parameters(size: float, draw: Draw) -> dict[str, float]:
    """Mean delay [s], and a seed for jitter."""
    return {"extra_delay": size, "seed": math.floor(1e6 * draw.shares[0])}


def servo_parameters(size: float, draw: Draw) -> dict[str, float]:
    """Time constant [s], and the largest share of the acceleration that the time constant needs."""
    return {"time_constant": size, "current_share": 0.3 + 0.4 * draw.shares[0]}


FORMS = (
    Form("command_delay", "other", packet_parameters, packet_queue, 0.01, 0.15),
    Form("steering_delay", "other", plain("delay"), polled(0), 0.01, 0.2),
    Form("throttle_delay", "other", plain("delay"), polled(1), 0.03, 0.4),
    Form("steering_lag", "other", servo_parameters, limited_servo, 0.01, 0.4),
    Form("steering_rate_limit", "other", inverse("rate"), soft_rate_limit, 0.1, 1.5),
    Form("steering_backlash", "other", plain("play"), sprung_play, 0.01, 0.4),
    Form("steering_deadband", "other", plain("width"), soft_steering_deadband, 0.01, 0.4),
    Form("steering_nonlinearity", "other", inverse("saturation"), linkage, 0.7, 2.2),
    Form("throttle_deadband", "other", plain("width"), soft_throttle_deadband, 0.01, 0.4),
    Form("throttle_nonlinearity", "other", plain("bend"), throttle_curve, 0.2, 4.0),
    Form("throttle_asymmetry", "other", factor("gain_ratio"), soft_throttle_asymmetry, 0.1, 1.5),
    Form("motor_lag", "other", plain("time_constant"), two_lags, 0.03, 1.0),
)
