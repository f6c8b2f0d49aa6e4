"""Physics outside the catalogue: the correct answer is "unexplained" with channel and class.

``class_words``: a class statement is correct if it contains at least one word of each group.
"""

from __future__ import annotations

import math

import numpy as np

from carlab.benchmark.effects.catalogue import Draw, Form, FormName, Parameters, heading, hook, plain, signed
from carlab.benchmark.effects.command_forms import play
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.physics import Instant, World
from carlab.benchmark.world.simulation import FloatArray

OUTSIDE: FormName = "outside"


@hook("body")
def wind(now: Instant, p: Parameters, car: BaseCar) -> None:
    """A steady wind over the floor: drag of the air's speed less that in still air."""
    c, speed, heading = 0.15, p["speed"], p["heading"]
    air_x = now.vx - speed * math.cos(heading - now.psi)
    air_y = now.vy - speed * math.sin(heading - now.psi)
    fast, still = math.hypot(air_x, air_y), math.hypot(now.vx, now.vy)
    now.push_x -= c * (fast * air_x - still * now.vx)
    now.push_y -= 2.0 * c * (fast * air_y - still * now.vy)


@hook("tyre")
def camber(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Toe and camber: side force of the front axle alone, in proportion to its load."""
    force = p["share"] * car.load_front
    now.ff += force * math.tanh(abs(now.vx) / 0.2)


@hook("body")
def locked_differential(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Two rear wheels of one speed: a moment that falls with speed, -k r / max(|vx|, 0.3)."""
    now.moment -= p["moment"] * math.tanh(now.r / max(abs(now.vx), 0.3))


def warm_up(world: World, p: Parameters) -> None:
    """Tyres whose grip rises with dissipated work and falls by cooling."""
    gain = p["gain"]
    k = world.add_state()

    def heat(now: Instant) -> None:
        work = abs(now.ff * now.alpha_f * now.vx) + abs(now.fr * now.alpha_r * now.vx)
        now.rates[k] = work / 2.0 - now.extra[k] / 4.0

    def grip(now: Instant) -> None:
        more = 1.0 + gain * math.tanh(now.extra[k])
        now.mu_f *= more
        now.mu_r *= more

    world.hooks["grip"].append(grip)
    world.hooks["tyre"].append(heat)


def imbalance(world: World, p: Parameters) -> None:
    """A bent wheel: a side force at the front that rotates with the wheel (radius 0.06 m) and grows with speed."""
    force, k = p["force"], world.add_state()

    def shake(now: Instant) -> None:
        now.rates[k] = now.vx / 0.06
        now.ff += force * abs(now.vx) * math.sin(now.extra[k])

    world.hooks["tyre"].append(shake)


def quantised(world: World, p: Parameters) -> None:
    """A servo with quantised positions."""
    step = p["step"]
    if step > 0.0:
        world.steering_maps.append(lambda d: step * math.floor(d / step + 0.5))


def stretched_motion_capture(world: World, p: Parameters) -> None:
    """Motion capture with a scale error along one axis of the world."""
    scale = np.array([1.0 + p["scale"], 1.0, 1.0])

    def stretch(t: FloatArray, pose: FloatArray) -> FloatArray:
        return np.asarray(pose * scale, dtype=np.float64)

    world.pose_changes.append(stretch)


@hook("body")
def cable(now: Instant, p: Parameters, car: BaseCar) -> None:
    """A cable that pulls the car's tail towards a point like a soft spring."""
    k, x, y = p["stiffness"], p["x"], p["y"]
    cos, sin = math.cos(now.psi), math.sin(now.psi)
    dx, dy = x - (now.x - car.rear_axle * cos), y - (now.y - car.rear_axle * sin)
    along, across = k * (dx * cos + dy * sin), k * (dy * cos - dx * sin)
    now.push_x += along
    now.push_y += across
    now.moment -= car.rear_axle * across


def motor_hysteresis(world: World, p: Parameters) -> None:
    """A motor controller that holds its throttle until the command changes by more than half a width."""
    world.throttle_maps.append(play(p["width"]))


def compliance_steer(world: World, p: Parameters) -> None:
    """Compliant steering: the side force reduces the wheel angle with a lag of 30 ms."""
    softness, k = p["softness"], world.add_state()

    def bend(now: Instant) -> None:
        now.d -= softness * now.extra[k]

    def feel(now: Instant) -> None:
        now.rates[k] = (now.ff - now.extra[k]) / 0.03

    world.hooks["steer"].append(bend)
    world.hooks["tyre"].append(feel)


def sagging_servo(world: World, p: Parameters) -> None:
    """A servo whose supply voltage falls with the throttle, which reduces its angular velocity."""
    lag = p["lag"]
    if lag <= 0.0:
        return
    k = world.add_state()

    def servo(now: Instant) -> None:
        now.rates[k] = (now.d - now.extra[k]) / (1e-3 + lag * min(abs(world_throttle[0]), 1.0))
        now.d = now.extra[k]

    world_throttle = [0.0]
    world.switch_listeners.append(lambda t, angle, throttle: world_throttle.__setitem__(0, throttle))
    world.hooks["steer"].append(servo)


@hook("body")
def bumpy_floor(now: Instant, p: Parameters, car: BaseCar) -> None:
    """Joints between floor plates every 0.8 m that brake the car."""
    joint = math.cos(math.pi * now.x / 0.8) ** 8 + math.cos(math.pi * now.y / 0.8) ** 8
    now.push_x -= p["force"] * joint * math.tanh(now.vx / 0.05)


def cable_parameters(size: float, draw: Draw) -> dict[str, float]:
    """Stiffness of the cable [N/m], and its fixed end within 1 m of the origin in x and y."""
    return {"stiffness": size, "x": 2.0 * draw.shares[0] - 1.0, "y": 2.0 * draw.shares[1] - 1.0}


FORMS = (
    Form("wind", OUTSIDE, heading("speed", "heading"), wind, 0.3, 8.0,
         class_words=(("heading", "direction", "world", "wind"),)),
    Form("camber", OUTSIDE, signed("share"), camber, 0.01, 0.4,
         class_words=(("constant", "even", "bias", "steering"),)),
    Form("locked_differential", OUTSIDE, plain("moment"), locked_differential, 0.02, 2.0,
         class_words=(("odd", "yaw rate", "yaw_rate", "curvature", "steering"),)),
    Form("tyre_warm_up", OUTSIDE, signed("gain"), warm_up, 0.05, 0.6,
         class_words=(("odd", "slip", "history", "state", "lateral", "time", "steering"),)),
    Form("wheel_imbalance", OUTSIDE, plain("force"), imbalance, 0.2, 6.0,
         class_words=(("period", "frequen", "oscillat", "vibrat", "speed"),)),
    Form("command_quantisation", OUTSIDE, plain("step"), quantised, 0.03, 0.5, class_words=(("steering",),)),
    Form("mocap_stretch", OUTSIDE, signed("scale"), stretched_motion_capture, 0.005, 0.2,
         class_words=(("heading", "direction", "world", "place", "position", "location"),)),
    Form("cable_pull", OUTSIDE, cable_parameters, cable, 0.02, 1.0, class_words=(("place", "position", "location"),)),
    Form("motor_hysteresis", OUTSIDE, plain("width"), motor_hysteresis, 0.03, 0.6,
         class_words=(("throttle", "history", "hysteresis", "state"),)),
    Form("compliance_steer", OUTSIDE, plain("softness"), compliance_steer, 0.005, 0.15,
         class_words=(("odd", "lateral", "steering", "force"),)),
    Form("sagging_servo", OUTSIDE, plain("lag"), sagging_servo, 0.05, 1.5,
         class_words=(("steering", "rate", "history", "lag"), ("throttle", "lag", "state", "history"))),
    Form("floor_joints", OUTSIDE, plain("force"), bumpy_floor, 0.2, 5.0,
         class_words=(("place", "position", "location"),)),
)  # fmt: skip
