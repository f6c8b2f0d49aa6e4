"""Alternative forms of force effects: exact, smoother, or from another textbook."""

from __future__ import annotations

import math
from collections.abc import Callable

from carlab.benchmark.effects.alternative_command_forms import soft_dead_band
from carlab.benchmark.effects.catalogue import Draw, Form, Parameters, factor, heading, hook, plain, signed
from carlab.benchmark.effects.force_forms import STICTION_MPS
from carlab.benchmark.effects.tyre_forms import (
    driven_front,
    driven_wheels,
    front_wheels_with_play,
    limit_over_grip,
    other_tyres,
    placed,
    saturating,
    slipping,
    spinning_wheels,
)
from carlab.benchmark.world.base_car import GRAVITY_MPS2, BaseCar
from carlab.benchmark.world.physics import Instant, World


@hook("drive")
def soft_motor(now: Instant, p: Parameters, car: BaseCar) -> None:
    """A current limit that closes softly."""
    top = p["force"]
    now.drive = top * math.tanh(now.drive / top)


def charge_sag(world: World, p: Parameters) -> None:
    """The battery voltage falls with the charge drawn, not with time (mean throttle about 0.3)."""
    rate = p["rate"] / 0.3
    k = world.add_state()

    def sag(now: Instant) -> None:
        now.rates[k] = abs(now.u)
        now.drive *= 1.0 - rate * now.extra[k]

    world.hooks["drive"].append(sag)


@hook("drive")
def soft_brake(now: Instant, p: Parameters, car: BaseCar) -> None:
    """The gain changes smoothly over 0.2 m/s."""
    against = 0.5 - 0.5 * math.tanh(math.copysign(1.0, now.drive) * now.vx / 0.2)
    now.drive *= 1.0 + (p["gain_ratio"] - 1.0) * against


@hook("limit")
def soft_traction(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Grip that saturates gradually."""
    top = p["share"] * now.mu_r * now.fz_r
    now.fx = top * math.tanh(now.fx / top)


@hook("limit", first=True)
def soft_controller(now: Instant, p: Parameters, car: BaseCar) -> None:
    """A speed controller whose current approaches its limit gradually, in each direction."""
    top = p["forward_force"] if now.fx > 0.0 else p["backward_force"]
    now.fx = top * math.tanh(now.fx / top)


@hook("drive")
def shorted_motor(now: Instant, p: Parameters, car: BaseCar) -> None:
    """A shorted motor: it brakes little at walking pace, and less and less with the first throttle."""
    released = math.exp(-((now.u / 0.03) ** 2))
    now.drive -= p["force"] * released * math.tanh(now.vx / 0.3)


@hook("body")
def stribeck(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Bearing friction that is larger at low speed."""
    now.push_x -= p["force"] * (1.0 + 0.6 * math.exp(-abs(now.vx) / 0.3)) * math.tanh(now.vx / STICTION_MPS)


@hook("body")
def powered_drag(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Drag with an exponent slightly different from two."""
    now.push_x -= p["coefficient"] * math.copysign(abs(now.vx) ** p["exponent"], now.vx)


@hook("body")
def scrub(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Toe scrub of two front wheels: grows with the tangent of the wheel angle."""
    now.push_x -= p["coefficient"] * abs(math.tan(now.d)) * math.tanh(now.vx / 0.1)


def brush_shape(b: float, c: float) -> Callable[[float], float]:
    """Brush tyre with the slope B C at zero slip; parabolic pressure, full sliding at 3 / (B C).

    Source: Pacejka, "Tyre and Vehicle Dynamics", section 3.2.
    """
    slope = b * c

    def shape(a: float) -> float:
        z = slope * a / 3.0
        if abs(z) >= 1.0:
            return math.copysign(1.0, z)
        return 3.0 * z - 3.0 * z * abs(z) + z**3

    return shape


def slipping_clutch(fx: float, share: float, car: BaseCar) -> float:
    """A clutch before the front axle that slips gradually; its torque is limited to half of full throttle's."""
    top = 0.5 * share * car.drive_gain
    return top * math.tanh(share * fx / top) if top > 0.0 else 0.0


@hook("tyre")
def combined_slip(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Side force times cos(atan(k)), k = scale F_x / (mu F_z).

    This is the form of the magic formula's weighting function for combined slip (Pacejka 2012, "Tire and Vehicle
    Dynamics", section 4.3.2), with force in place of slip.
    """
    now.fr /= math.hypot(1.0, p["scale"] * (now.fx - now.fx_f) / (now.mu_r * now.fz_r))
    now.ff /= math.hypot(1.0, p["scale"] * now.fx_f / (now.mu_f * now.fz_f))


def slip_relaxation(world: World, p: Parameters) -> None:
    """Stretched string: the slip angles relax, not the forces."""
    length = p["length"]
    if length <= 0.0:
        return
    front, rear = world.add_state(), world.add_state()

    def relax(now: Instant) -> None:
        rate = max(abs(now.vx), 0.3) / length
        now.rates[front] = (now.alpha_f - now.extra[front]) * rate
        now.rates[rear] = (now.alpha_r - now.extra[rear]) * rate
        now.ff = -now.mu_f * now.fz_f * world.shape_front(now.extra[front])
        now.fr = -now.mu_r * now.fz_r * world.shape_rear(now.extra[rear])

    world.hooks["tyre"].append(relax)


def pitching(world: World, p: Parameters) -> None:
    """Load transfer through springs: the body pitches at 4 Hz, damped, and the load follows it."""
    ratio, w, z = p["height"] / world.car.wheelbase, 2 * math.pi * 4.0, 0.7
    load, rate = world.add_state(), world.add_state()

    def shift(now: Instant) -> None:
        drag = now.mu_f * now.fz_f * now.shape_f * now.sin_d
        now.rates[load] = now.extra[rate]
        now.rates[rate] = w * w * (ratio * (now.fx + drag) - now.extra[load]) - 2 * z * w * now.extra[rate]
        total = now.fz_f + now.fz_r
        now.fz_f = min(max(now.fz_f - now.extra[load], 0.02 * total), 0.98 * total)
        now.fz_r = total - now.fz_f

    world.hooks["load"].append(shift)


@hook("grip")
def settling_grip(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Grip that changes exponentially within two minutes."""
    change = 120.0 * p["rate"]
    grip = 1.0 + change * (1.0 - math.exp(-now.t / 120.0))
    now.mu_f *= grip
    now.mu_r *= grip


@hook("grip")
def soft_patch(now: Instant, p: Parameters, car: BaseCar) -> None:
    """A patch with a soft edge that acts on each axle separately."""
    x, y, radius, loss = p["x"], p["y"], p["radius"], p["loss"]
    cos, sin = math.cos(now.psi), math.sin(now.psi)
    for along in (car.front_axle, -car.rear_axle):
        away = math.hypot(now.x + along * cos - x, now.y + along * sin - y)
        grip_share = 1.0 - 0.5 * loss * (1.0 - math.tanh((away - radius) / 0.08))
        if along > 0.0:
            now.mu_f *= grip_share
        else:
            now.mu_r *= grip_share


@hook("load", first=True)
def wing(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Downforce behind the centre of mass: a tenth more on the rear axle than the static split."""
    rear_share = car.front_axle / car.wheelbase + 0.1
    force = p["coefficient"] * now.vx * now.vx
    now.fz_f += (1.0 - rear_share) * force
    now.fz_r += rear_share * force


@hook("body")
def viscous_yaw(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Damping that grows a little with the yaw rate."""
    now.moment -= p["coefficient"] * now.r * (1.0 + 0.1 * abs(now.r))


@hook("body")
def torque_by_force(now: Instant, p: Parameters, car: BaseCar) -> None:
    """The line of action of the axle force misses the centre of mass; the lever grows with the force."""
    share = now.fx / car.drive_gain
    now.moment += p["coefficient"] * share * (0.5 + abs(share))


@hook("body")
def gusty_side(now: Instant, p: Parameters, car: BaseCar) -> None:
    """A lateral bias force through the tyres, proportional to the axle loads, weak at standstill."""
    now.push_y += p["force"] * math.tanh(abs(now.vx) / 0.2)


@hook("body")
def bowl(now: Instant, p: Parameters, car: BaseCar) -> None:
    """A floor that rises along a line with increasing slope."""
    weight, direction, angle = car.mass * GRAVITY_MPS2, p["direction"], p["angle"]
    cos, sin = math.cos(direction), math.sin(direction)
    force = weight * math.sin(angle * (1.0 + 0.08 * (now.x * cos + now.y * sin)))
    now.push_x -= force * math.cos(direction - now.psi)
    now.push_y -= force * math.sin(direction - now.psi)


def force_limit(size: float, draw: Draw) -> dict[str, float]:
    """A multiple of the largest drive force [N]."""
    return {"force": draw.car.drive_gain / max(size, 1e-6)}


def controller_forces(size: float, draw: Draw) -> dict[str, float]:
    """Multiples of the largest drive force [N]: forwards, and 0.6 to 1 of it backwards."""
    forward = draw.car.drive_gain / max(size, 1e-6)
    return {"forward_force": forward, "backward_force": (0.6 + 0.4 * draw.shares[0]) * forward}


def drag_parameters(size: float, draw: Draw) -> dict[str, float]:
    """Coefficient, and an exponent from 1.8 to 2.2."""
    return {"coefficient": size, "exponent": 1.8 + 0.4 * draw.shares[0]}


FORMS = (
    Form("motor_saturation", "other", force_limit, soft_motor, 0.3, 3.0),
    Form("traction_limit", "other", limit_over_grip("share"), soft_traction, 0.3, 3.0, fixed={"axle": "rear"}),
    Form("speed_controller", "other", controller_forces, soft_controller, 0.3, 3.0),
    Form("drag_brake", "other", plain("force"), shorted_motor, 0.3, 20.0),
    Form("battery_sag", "other", plain("rate"), charge_sag, 0.0004, 0.008),
    Form("brake_asymmetry", "other", factor("gain_ratio"), soft_brake, 0.1, 1.5),
    Form("rolling_resistance", "other", plain("force"), stribeck, 0.05, 2.0),
    Form("aerodynamic_drag", "other", drag_parameters, powered_drag, 0.05, 1.5),
    Form("cornering_drag", "other", plain("coefficient"), scrub, 0.2, 8.0),
    Form("tyre_saturation", "other", saturating, other_tyres(brush_shape), 0.5, 1.6, nominal_kind="linear_tyre"),
    Form("front_wheel_play", "other", plain("angle"), front_wheels_with_play(soft_dead_band), 0.01, 0.2),
    Form("all_wheel_drive", "other", plain("share"), driven_front(slipping_clutch), 0.1, 1.0),
    Form("friction_ellipse", "other", plain("scale"), combined_slip, 0.6, 4.0),
    Form("combined_slip", "other", limit_over_grip("grip_ratio"), spinning_wheels(brush_shape(1.0, 1.0)), 0.6, 3.0),
    Form("longitudinal_slip", "other", slipping, driven_wheels(brush_shape(1.0, 1.0)), 1.0, 8.0, smallest=0.5),
    Form("tyre_relaxation", "other", plain("length"), slip_relaxation, 0.03, 1.0),
    Form("load_transfer", "other", plain("height"), pitching, 0.02, 0.2),
    Form("friction_drift", "other", signed("rate"), settling_grip, 0.0006, 0.007),
    Form("low_friction_patch", "other", placed, soft_patch, 0.3, 0.9),
    Form("aerodynamic_downforce", "other", plain("coefficient"), wing, 0.2, 6.0),
    Form("yaw_damping", "other", plain("coefficient"), viscous_yaw, 0.005, 0.5),
    Form("torque_steer", "other", signed("coefficient"), torque_by_force, 0.01, 0.6),
    Form("lateral_bias", "other", signed("force"), gusty_side, 0.1, 3.0),
    Form("road_slope", "other", heading("angle", "direction"), bowl, 0.005, 0.2),
)
