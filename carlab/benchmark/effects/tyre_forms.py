"""Tyres, axle loads and grip in the catalogue's form (and roll, for which the catalogue has no equation)."""

from __future__ import annotations

import math
from collections.abc import Callable

from scipy.optimize import brentq

from carlab.benchmark.effects.catalogue import Attach, Draw, Form, Parameters, hook, plain, signed
from carlab.benchmark.effects.command_forms import dead_band
from carlab.benchmark.world.base_car import GRAVITY_MPS2, BaseCar
from carlab.benchmark.world.physics import SLIP_FLOOR_MPS, Instant, World, pacejka_shape

WHEEL_RADIUS_M = 0.033  # the catalogue and the car file give none; that of a 1:10 touring car


def saturating(size: float, draw: Draw) -> dict[str, float]:
    """Pacejka numbers with the slope of the linear tyre; the larger the size, the earlier the knee."""
    car, b = draw.car, max(size, 1e-4)
    return {
        "B_front": b * car.b_front,
        "C_front": car.c_front,
        "mu_front": car.mu_front / b,
        "B_rear": b * car.b_rear,
        "C_rear": car.c_rear,
        "mu_rear": car.mu_rear / b,
    }


def other_tyres(shape: Callable[[float, float], Callable[[float], float]]) -> Attach:
    """Other tyres on both axles instead of the linear ones: a curve by B and C, and their friction."""

    def attach(world: World, p: Parameters) -> None:
        world.shape_front = shape(p["B_front"], p["C_front"])
        world.shape_rear = shape(p["B_rear"], p["C_rear"])

        def grip(now: Instant) -> None:
            now.mu_f, now.mu_r = p["mu_front"], p["mu_rear"]

        world.hooks["grip"].insert(0, grip)

    return attach


def front_wheels_with_play(tyre_slip: Callable[[float, float], float]) -> Attach:
    """``tyre_slip`` gives the slip angle of the tyres from that of wheels at the servo's angle, and the play."""

    def attach(world: World, p: Parameters) -> None:
        def take_up_play(now: Instant) -> None:
            now.shape_f = world.shape_front(tyre_slip(now.alpha_f, p["angle"]))

        world.hooks["load"].insert(0, take_up_play)

    return attach


def driven_front(front_force: Callable[[float, float, BaseCar], float]) -> Attach:
    """A part of F_x acts at the front wheels, along them; ``front_force`` gives it from F_x, the share and the car."""

    def attach(world: World, p: Parameters) -> None:
        arm = world.car.front_axle

        def pull(now: Instant) -> None:
            now.push_x += now.fx_f * (now.cos_d - 1.0)
            now.push_y += now.fx_f * now.sin_d
            now.moment += arm * now.fx_f * now.sin_d

        def split(now: Instant) -> None:
            now.fx_f = front_force(now.fx, p["share"], world.car)

        world.hooks["tyre"].insert(0, split)
        world.hooks["body"].append(pull)

    return attach


@hook("tyre")
def friction_ellipse(now: Instant, p: Parameters, car: BaseCar) -> None:
    """The longitudinal force of an axle reduces its side force."""
    rear = min(max(p["scale"] * (now.fx - now.fx_f) / (now.mu_r * now.fz_r), -0.98), 0.98)
    front = min(max(p["scale"] * now.fx_f / (now.mu_f * now.fz_f), -0.98), 0.98)
    now.fr *= math.sqrt(1.0 - rear * rear)
    now.ff *= math.sqrt(1.0 - front * front)


def driven_wheels(curve: Callable[[float], float]) -> Attach:
    """Wheel speed as a state: J dw/dt = T - R F_x; slope ``stiffness`` at zero slip, friction of the axle at most.

    The catalogue leaves F_x(slip) open; ``curve`` goes from slope one at no slip to one at the limit.
    """

    def attach(world: World, p: Parameters) -> None:
        inertia, stiffness = p["inertia"] / WHEEL_RADIUS_M**2, p["stiffness"]
        k = world.add_state(rolling=True)

        def spin(now: Instant) -> None:
            slip = (now.extra[k] - now.vx) / max(abs(now.vx), 0.3)
            top = now.mu_r * now.fz_r
            force = top * curve(stiffness * slip / top)
            now.rates[k] = (now.fx - force) / inertia
            now.fx = force

        world.hooks["limit"].append(spin)

    return attach


def spinning_wheels(shape: Callable[[float], float]) -> Attach:
    """Driven wheels without inertia whose tyres' force points along their slip.

    ``shape`` goes from slope one at no slip to one at the limit. The wheels turn at the speed at which the forces of
    motor and tyres are equal; a limit of the motor that acts later makes them slower.
    """
    hypot = math.hypot

    def attach(world: World, p: Parameters) -> None:
        car = world.car
        slope = car.b_rear * car.c_rear
        at_wheels = [0.0, 0.0]

        def balance(now: Instant, motor_force: float, damping: float) -> tuple[float, float]:
            """Scaled slip along the car, and the tyres' force [N] where it equals the motor's."""
            per_speed = slope / max(abs(now.vx), SLIP_FLOOR_MPS)
            across = per_speed * (now.vy - car.rear_axle * now.r)
            top, motor_slope = p["grip_ratio"] * now.mu_r * now.fz_r, damping / per_speed

            def force(along: float) -> float:
                size = hypot(along, across)
                return top * shape(size) * along / size

            max_slip = motor_force * per_speed / car.damping
            if max_slip < 1e-9:
                return 0.0, 0.0
            along = brentq(lambda k: motor_slope * k + force(k) - motor_force, 1e-12, max_slip, xtol=1e-12)
            return along, force(along)

        def spin(now: Instant) -> None:
            at_wheels[:] = balance(now, abs(now.fx), car.damping)
            now.fx = math.copysign(at_wheels[1], now.fx)

        def reduce_side_force(now: Instant) -> None:
            along, force = at_wheels
            if abs(now.fx) < (1.0 - 1e-9) * force:
                along, _ = balance(now, abs(now.fx), 0.0)
            across = slope * max(abs(now.vy - car.rear_axle * now.r), 1e-9) / max(abs(now.vx), SLIP_FLOOR_MPS)
            size = hypot(along, across)
            now.fr *= shape(size) / size * across / shape(across)

        world.hooks["limit"].insert(0, spin)
        world.hooks["tyre"].insert(0, reduce_side_force)

    return attach


def tyre_relaxation(world: World, p: Parameters) -> None:
    """Side forces of both axles follow the slip over a relaxation length."""
    length = p["length"]
    if length <= 0.0:
        return
    front, rear = world.add_state(), world.add_state()

    def relax(now: Instant) -> None:
        rate = max(abs(now.vx), 0.3) / length
        now.rates[front] = (now.ff - now.extra[front]) * rate
        now.rates[rear] = (now.fr - now.extra[rear]) * rate
        now.ff, now.fr = now.extra[front], now.extra[rear]

    world.hooks["tyre"].append(relax)


@hook("load")
def load_transfer(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Load moves to the rear with m ax h / L; ax holds all tyre forces (solved exactly: they are linear in load)."""
    ratio = p["height"] / car.wheelbase
    drag = now.mu_f * now.shape_f * now.sin_d  # -F_front sin d = drag * F_z,front
    front = (now.fz_f - ratio * now.fx) / (1.0 + ratio * drag)
    total = now.fz_f + now.fz_r
    now.fz_f = min(max(front, 0.02 * total), 0.98 * total)
    now.fz_r = total - now.fz_f


def roll_dynamics(world: World, p: Parameters) -> None:
    """Second-order roll angle after lateral acceleration; the load it shifts between the sides costs both axles grip.

    The catalogue gives no equation: grip falls with the square of roll (in g), by ``loss``.
    """
    w, z, loss = 2 * math.pi * p["frequency"], p["damping"], p["loss"]
    angle, rate = world.add_state(), world.add_state()

    def roll(now: Instant) -> None:
        grip_share = max(1.0 - loss * now.extra[angle] ** 2, 0.2)
        now.ff *= grip_share
        now.fr *= grip_share
        side = (now.ff * now.cos_d + now.fr) / (world.car.mass * GRAVITY_MPS2)
        now.rates[angle] = now.extra[rate]
        now.rates[rate] = w * w * (side - now.extra[angle]) - 2 * z * w * now.extra[rate]

    world.hooks["tyre"].append(roll)


@hook("grip")
def friction_drift(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Grip of both axles drifts with time since the first row."""
    rate = p["rate"]
    now.mu_f *= 1.0 + rate * now.t
    now.mu_r *= 1.0 + rate * now.t


@hook("grip")
def low_friction_patch(now: Instant, p: Parameters, car: BaseCar) -> None:
    """A disc of low friction on the floor, on which the centre of mass is."""
    if (now.x - p["x"]) ** 2 + (now.y - p["y"]) ** 2 < p["radius"] * p["radius"]:
        now.mu_f *= 1.0 - p["loss"]
        now.mu_r *= 1.0 - p["loss"]


@hook("load", first=True)
def aerodynamic_downforce(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Load grows with speed squared, split like the static loads."""
    c = p["coefficient"] / (car.mass * GRAVITY_MPS2)
    more = 1.0 + c * now.vx * now.vx
    now.fz_f *= more
    now.fz_r *= more


def placed(size: float, draw: Draw) -> dict[str, float]:
    """A disc around a place on the track."""
    return {"x": draw.place[0], "y": draw.place[1], "radius": 0.5 + 0.5 * draw.shares[0], "loss": min(size, 0.9)}


def slipping(size: float, draw: Draw) -> dict[str, float]:
    """Inertia of the driven wheels [kg m^2] and longitudinal stiffness of their tyres [N]."""
    return {"inertia": 2e-4 * size, "stiffness": 40.0 / max(size, 1e-9)}


def limit_over_grip(key: str) -> Callable[[float, Draw], dict[str, float]]:
    """A limit over the grip of the rear axle; the limit is the largest drive force over the size."""
    return lambda size, draw: {key: draw.car.drive_gain / (draw.car.mu_rear * draw.car.load_rear) / max(size, 1e-6)}


def roll_parameters(size: float, draw: Draw) -> dict[str, float]:
    """Natural frequency [Hz], damping ratio and loss of grip."""
    return {"frequency": 1.5 + 2.5 * draw.shares[0], "damping": 0.2 + 0.4 * draw.shares[1], "loss": size}


FORMS = (
    Form("tyre_saturation", "catalogue", saturating, other_tyres(pacejka_shape), 0.5, 1.6, nominal_kind="linear_tyre"),
    Form("front_wheel_play", "catalogue", plain("angle"), front_wheels_with_play(dead_band), 0.01, 0.2),
    Form("all_wheel_drive", "catalogue", plain("share"), driven_front(lambda fx, share, car: share * fx), 0.1, 1.0),
    Form("friction_ellipse", "catalogue", plain("scale"), friction_ellipse, 0.6, 2.5),
    Form(
        "combined_slip", "catalogue", limit_over_grip("grip_ratio"), spinning_wheels(pacejka_shape(1.0, 1.0)), 0.6, 3.0
    ),
    Form("longitudinal_slip", "catalogue", slipping, driven_wheels(math.tanh), 1.0, 8.0, smallest=0.5),
    Form("tyre_relaxation", "catalogue", plain("length"), tyre_relaxation, 0.03, 1.0),
    Form("load_transfer", "catalogue", plain("height"), load_transfer, 0.02, 0.2),
    Form("roll_dynamics", "other", roll_parameters, roll_dynamics, 0.3, 4.0),
    Form("friction_drift", "catalogue", signed("rate"), friction_drift, 0.0006, 0.007),
    Form("low_friction_patch", "catalogue", placed, low_friction_patch, 0.3, 0.9),
    Form("aerodynamic_downforce", "catalogue", plain("coefficient"), aerodynamic_downforce, 0.2, 6.0),
)
