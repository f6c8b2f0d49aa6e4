"""Drive, resistance and body forces in the catalogue's form."""

from __future__ import annotations

import math

from carlab.benchmark.effects.catalogue import Form, Parameters, factor, plain, signed
from carlab.benchmark.world.base_car import GRAVITY_MPS2
from carlab.benchmark.world.physics import Instant, World

STICTION_MPS = 0.05


def motor_saturation(world: World, p: Parameters) -> None:
    """Drive force clipped."""
    top = p["force"]

    def clip(now: Instant) -> None:
        now.drive = min(max(now.drive, -top), top)

    world.hooks["drive"].append(clip)


def brake_asymmetry(world: World, p: Parameters) -> None:
    """Different gain if the drive force opposes the motion (braking)."""
    ratio = p["gain_ratio"]

    def brake(now: Instant) -> None:
        if now.drive * now.vx < 0.0:
            now.drive *= ratio

    world.hooks["drive"].append(brake)


def battery_sag(world: World, p: Parameters) -> None:
    """Drive gain falls with time since the first row."""
    rate = p["rate"]

    def sag(now: Instant) -> None:
        now.drive *= 1.0 - rate * now.t

    world.hooks["drive"].append(sag)


def traction_limit(world: World, p: Parameters) -> None:
    """F_x at the driven rear axle at most a share of its friction."""
    share = p["share"]

    def limit(now: Instant) -> None:
        top = now.mu_r * now.fz_r
        now.fx = min(max(now.fx, -share * top), share * top)

    world.hooks["limit"].append(limit)


def rolling_resistance(world: World, p: Parameters) -> None:
    """Constant force against the motion."""
    force = p["force"]

    def resist(now: Instant) -> None:
        now.push_x -= force * math.tanh(now.vx / STICTION_MPS)

    world.hooks["body"].append(resist)


def aerodynamic_drag(world: World, p: Parameters) -> None:
    """Resistance quadratic in speed."""
    c = p["coefficient"]

    def resist(now: Instant) -> None:
        now.push_x -= c * now.vx * abs(now.vx)

    world.hooks["body"].append(resist)


def cornering_drag(world: World, p: Parameters) -> None:
    """Resistance that grows with the wheel angle."""
    c = p["coefficient"]

    def resist(now: Instant) -> None:
        now.push_x -= c * abs(now.d) * math.tanh(now.vx / STICTION_MPS)

    world.hooks["body"].append(resist)


def yaw_damping(world: World, p: Parameters) -> None:
    """Moment that opposes the yaw rate."""
    c = p["coefficient"]

    def resist(now: Instant) -> None:
        now.moment -= c * now.r

    world.hooks["body"].append(resist)


def torque_steer(world: World, p: Parameters) -> None:
    """Moment proportional to the throttle."""
    c = p["coefficient"]

    def pull(now: Instant) -> None:
        now.moment += c * now.u

    world.hooks["body"].append(pull)


def lateral_bias(world: World, p: Parameters) -> None:
    """Constant side force at the centre of mass."""
    force = p["force"]

    def pull(now: Instant) -> None:
        now.push_y += force

    world.hooks["body"].append(pull)


def road_slope(world: World, p: Parameters) -> None:
    """Weight down the slope; ``direction`` is the world heading of steepest ascent."""
    force, direction = world.car.mass * GRAVITY_MPS2 * math.sin(p["angle"]), p["direction"]

    def pull(now: Instant) -> None:
        now.push_x -= force * math.cos(direction - now.psi)
        now.push_y -= force * math.sin(direction - now.psi)

    world.hooks["body"].append(pull)


FORMS = (
    Form(
        "motor_saturation",
        "catalogue",
        lambda size, draw: {"force": draw.car.drive_gain * math.exp(-size)},
        motor_saturation,
        0.7,
        3.0,
    ),
    Form(
        "traction_limit",
        "catalogue",
        lambda size, draw: {
            "share": (2.0 * draw.car.drive_gain / (draw.car.mu_rear * draw.car.load_rear)) * math.exp(-size)
        },
        traction_limit,
        1.2,
        3.5,
        fixed={"axle": "rear"},
    ),
    Form("brake_asymmetry", "catalogue", factor("gain_ratio"), brake_asymmetry, 0.1, 1.5),
    Form("battery_sag", "catalogue", plain("rate"), battery_sag, 0.0004, 0.008),
    Form("rolling_resistance", "catalogue", plain("force"), rolling_resistance, 0.05, 2.0),
    Form("aerodynamic_drag", "catalogue", plain("coefficient"), aerodynamic_drag, 0.05, 1.5),
    Form("cornering_drag", "catalogue", plain("coefficient"), cornering_drag, 0.2, 8.0),
    Form("yaw_damping", "catalogue", plain("coefficient"), yaw_damping, 0.005, 0.5),
    Form("torque_steer", "catalogue", signed("coefficient"), torque_steer, 0.01, 0.6),
    Form("lateral_bias", "catalogue", signed("force"), lateral_bias, 0.1, 3.0),
    Form(
        "road_slope",
        "catalogue",
        lambda size, draw: {"angle": size, "direction": math.pi * (2.0 * draw.shares[0] - 1.0)},
        road_slope,
        0.005,
        0.2,
    ),
)
