"""Drive, resistance and body forces in the catalogue's form."""

from __future__ import annotations

import math

from carlab.benchmark.effects.catalogue import Draw, Form, Parameters, factor, heading, hook, plain, signed
from carlab.benchmark.world.base_car import GRAVITY_MPS2, BaseCar
from carlab.benchmark.world.physics import Instant

STICTION_MPS = 0.05


@hook("drive")
def motor_saturation(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Drive force clipped."""
    top = p["force"]
    now.drive = min(max(now.drive, -top), top)


@hook("drive")
def brake_asymmetry(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Different gain if the drive force opposes the motion (braking)."""
    if now.drive * now.vx < 0.0:
        now.drive *= p["gain_ratio"]


@hook("drive")
def drag_brake(now: Instant, p: Parameters, car: BaseCar) -> None:
    """A constant braking force where the throttle is released; it ends at a twentieth of full throttle."""
    released = max(1.0 - 20.0 * abs(now.u), 0.0)
    now.drive -= p["force"] * released * math.tanh(now.vx / STICTION_MPS)


@hook("drive")
def battery_sag(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Drive gain falls with time since the first row."""
    now.drive *= 1.0 - p["rate"] * now.t


@hook("limit")
def traction_limit(now: Instant, p: Parameters, car: BaseCar) -> None:
    """F_x at the driven rear axle at most a share of its friction."""
    share = p["share"]
    top = now.mu_r * now.fz_r
    now.fx = min(max(now.fx, -share * top), share * top)


@hook("limit", first=True)
def speed_controller(now: Instant, p: Parameters, car: BaseCar) -> None:
    """The controller's force, in proportion to the error of the speed, between two bounds."""
    now.fx = min(max(now.fx, -p["backward_force"]), p["forward_force"])


@hook("body")
def rolling_resistance(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Constant force against the motion."""
    now.push_x -= p["force"] * math.tanh(now.vx / STICTION_MPS)


@hook("body")
def aerodynamic_drag(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Resistance quadratic in speed."""
    now.push_x -= p["coefficient"] * now.vx * abs(now.vx)


@hook("body")
def cornering_drag(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Resistance that grows with the wheel angle."""
    now.push_x -= p["coefficient"] * abs(now.d) * math.tanh(now.vx / STICTION_MPS)


@hook("body")
def yaw_damping(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Moment that opposes the yaw rate."""
    now.moment -= p["coefficient"] * now.r


@hook("body")
def torque_steer(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Moment proportional to the throttle."""
    now.moment += p["coefficient"] * now.u


@hook("body")
def lateral_bias(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Constant side force at the centre of mass."""
    now.push_y += p["force"]


@hook("body")
def road_slope(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Weight down the slope; ``direction`` is the world heading of steepest ascent."""
    force, direction = car.mass * GRAVITY_MPS2 * math.sin(p["angle"]), p["direction"]
    now.push_x -= force * math.cos(direction - now.psi)
    now.push_y -= force * math.sin(direction - now.psi)


def force_limit(size: float, draw: Draw) -> dict[str, float]:
    """A share of the largest drive force [N]."""
    return {"force": draw.car.drive_gain * math.exp(-size)}


def friction_share(size: float, draw: Draw) -> dict[str, float]:
    """A share of the friction of the rear axle; at size 0 twice what the largest drive force needs."""
    return {"share": (2.0 * draw.car.drive_gain / (draw.car.mu_rear * draw.car.load_rear)) * math.exp(-size)}


def controller_forces(size: float, draw: Draw) -> dict[str, float]:
    """Shares of twice the largest drive force [N]: forwards, and 0.6 to 1 of it backwards."""
    forward = 2.0 * draw.car.drive_gain * math.exp(-size)
    return {"forward_force": forward, "backward_force": (0.6 + 0.4 * draw.shares[0]) * forward}


FORMS = (
    Form("motor_saturation", "catalogue", force_limit, motor_saturation, 0.7, 3.0),
    Form("traction_limit", "catalogue", friction_share, traction_limit, 1.2, 3.5, fixed={"axle": "rear"}),
    Form("speed_controller", "catalogue", controller_forces, speed_controller, 1.2, 3.5),
    Form("drag_brake", "catalogue", plain("force"), drag_brake, 0.3, 20.0),
    Form("brake_asymmetry", "catalogue", factor("gain_ratio"), brake_asymmetry, 0.1, 1.5),
    Form("battery_sag", "catalogue", plain("rate"), battery_sag, 0.0004, 0.008),
    Form("rolling_resistance", "catalogue", plain("force"), rolling_resistance, 0.05, 2.0),
    Form("aerodynamic_drag", "catalogue", plain("coefficient"), aerodynamic_drag, 0.05, 1.5),
    Form("cornering_drag", "catalogue", plain("coefficient"), cornering_drag, 0.2, 8.0),
    Form("yaw_damping", "catalogue", plain("coefficient"), yaw_damping, 0.005, 0.5),
    Form("torque_steer", "catalogue", signed("coefficient"), torque_steer, 0.01, 0.6),
    Form("lateral_bias", "catalogue", signed("force"), lateral_bias, 0.1, 3.0),
    Form("road_slope", "catalogue", heading("angle", "direction"), road_slope, 0.005, 0.2),
)
