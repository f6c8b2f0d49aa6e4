"""Equations of motion, independent of the simulator; concealed effects are hooks of their stages.

Kinematic, dynamic and blended single track after Kabzan et al., "AMZ Driverless"; tyres after Pacejka and Bakker,
"The magic formula tyre model". Without a hook this is the base model and nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from carlab.benchmark.world.base_car import BaseCar

Hook = Callable[["Instant"], None]
STAGES = ("steer", "throttle", "drive", "load", "grip", "limit", "tyre", "body")
SLIP_FLOOR_MPS = 0.3
RELAX_S = 0.05
BLEND_FROM_MPS = 0.3
BLEND_OVER_MPS = 0.2


@dataclass(init=False, eq=False, repr=False, slots=True)
class Instant:
    """All variables at one time; hooks read and change them stage by stage.

    Stages: ``steer`` (front wheel angle d), ``throttle`` (u), ``drive`` (drive force), ``load`` (axle loads), ``grip``
    (mu), ``limit`` (fx, the force of the driven axles; fx_f, its part at the front wheels), ``tyre`` (lateral axle
    forces), ``body`` (push_x, push_y [N] in the body frame and moment [N m]). Angles are in rad, velocities in m/s and
    rad/s, forces and loads in N. Hidden states of hooks are ``extra``, their rates go to ``rates``.
    """

    t: float
    x: float
    y: float
    psi: float
    vx: float
    vy: float
    r: float
    d: float
    u: float
    sin_d: float
    cos_d: float
    drive: float
    fx: float
    fx_f: float
    fz_f: float
    fz_r: float
    mu_f: float
    mu_r: float
    alpha_f: float
    alpha_r: float
    shape_f: float
    shape_r: float
    ff: float
    fr: float
    push_x: float
    push_y: float
    moment: float
    extra: list[float]
    rates: list[float]


def pacejka_shape(b: float, c: float) -> Callable[[float], float]:
    """sin(C atan(B a)): lateral force over mu times load, without its sign."""
    sin, atan = math.sin, math.atan
    return lambda a: sin(c * atan(b * a))


def linear_shape(b: float, c: float) -> Callable[[float], float]:
    """The slope of the magic formula at zero slip."""
    slope = b * c
    return lambda a: slope * a


class World:
    """A true car: base parameters and hooks of the concealed effects."""

    def __init__(self, car: BaseCar) -> None:
        self.car = car
        shape = linear_shape if car.kind == "linear_tyre" else pacejka_shape
        self.shape_front = shape(car.b_front, car.c_front)
        self.shape_rear = shape(car.b_rear, car.c_rear)
        self.hooks: dict[str, list[Hook]] = {stage: [] for stage in STAGES}
        self._rolling: list[bool] = []
        # Time at which a command acts by time of issue, one function per channel (steering, throttle).
        self.arrival: list[Callable[[float], float]] = [lambda t: t + car.command_delay] * 2
        # Maps of a command when it starts to act, in order, may have memory. Steering in rad, throttle in 1.
        self.steering_maps: list[Callable[[float], float]] = []
        self.throttle_maps: list[Callable[[float], float]] = []
        # Called when a command starts to act: (t, desired wheel angle, desired throttle).
        self.switch_listeners: list[Callable[[float, float, float], None]] = []
        # Observation: extra age of every channel [s], and changes of pose and velocity columns (see measurement).
        self.extra_latency_s = 0.0
        self.pose_changes: list[Callable[[Any, Any], Any]] = []
        self.velocity_changes: list[Callable[[Any, Any], Any]] = []

    def add_state(self, *, rolling: bool = False) -> int:
        """Add a hidden state that starts at 0 or at the car's speed; returns its index in ``extra`` and ``rates``."""
        self._rolling.append(rolling)
        return len(self._rolling) - 1

    def hidden(self, start_speed_mps: float) -> list[float]:
        """The hidden states at the start."""
        return [start_speed_mps if rolling else 0.0 for rolling in self._rolling]

    def derivative(self) -> Derivative:
        """The right-hand side with all hooks in place."""
        return Derivative(self)


class Derivative:
    """dy/dt for y = [x, y, psi, vx, vy, r, hidden ...] under the commands ``angle`` [rad] and ``throttle``."""

    def __init__(self, world: World) -> None:
        car = world.car
        self.angle = 0.0
        self.throttle = 0.0
        self._now = Instant()
        self._hooks = [tuple(world.hooks[stage]) for stage in STAGES]
        self._no_rates = [0.0] * len(world.hidden(0.0))
        # Read once: a car computes its loads anew, and this function is most of the time of a case.
        self._base = car.drive_gain, car.damping, car.mass, car.yaw_inertia, car.front_axle, car.rear_axle
        self._tyres = world.shape_front, world.shape_rear, car.load_front, car.load_rear, car.mu_front, car.mu_rear
        self._wheelbase = car.wheelbase
        self._kind = car.kind

    def __call__(self, t: float, state: list[float]) -> list[float]:
        """Evaluate at time t [s]."""
        now, sin, cos, atan2 = self._now, math.sin, math.cos, math.atan2
        steer, throttle, drive, load, grip, limit, tyre, body = self._hooks
        gain, damping, m, inertia, front_axle, rear_axle = self._base
        shape_front, shape_rear, now.fz_f, now.fz_r, now.mu_f, now.mu_r = self._tyres
        now.t = t
        now.x, now.y, psi, vx, vy, r, *now.extra = state
        now.psi, now.vx, now.vy, now.r = psi, vx, vy, r
        now.rates = rates = self._no_rates.copy()
        now.d = self.angle
        for hook in steer:
            hook(now)
        now.u = self.throttle
        for hook in throttle:
            hook(now)
        now.sin_d = sin_d = sin(now.d)
        now.cos_d = cos_d = cos(now.d)
        now.drive = gain * now.u
        for hook in drive:
            hook(now)
        now.fx = now.drive - damping * vx
        front_y = vy + front_axle * r
        rolling_f, rolling_r = abs(vx * cos_d + front_y * sin_d), abs(vx)
        now.alpha_f = alpha_f = atan2(
            front_y * cos_d - vx * sin_d, rolling_f if rolling_f > SLIP_FLOOR_MPS else SLIP_FLOOR_MPS
        )
        now.alpha_r = alpha_r = atan2(vy - rear_axle * r, rolling_r if rolling_r > SLIP_FLOOR_MPS else SLIP_FLOOR_MPS)
        now.shape_f = shape_front(alpha_f)
        now.shape_r = shape_rear(alpha_r)
        for stage in (load, grip, limit):
            for hook in stage:
                hook(now)
        now.ff = -now.mu_f * now.fz_f * now.shape_f
        now.fr = -now.mu_r * now.fz_r * now.shape_r
        now.fx_f = now.push_x = now.push_y = now.moment = 0.0
        for stage in (tyre, body):
            for hook in stage:
                hook(now)
        ff, fr = now.ff, now.fr
        side = ff * cos_d
        dynamic = (
            (now.fx - ff * sin_d + now.push_x) / m + vy * r,
            (fr + side + now.push_y) / m - vx * r,
            (front_axle * side - rear_axle * fr + now.moment) / inertia,
        )
        sin_psi, cos_psi = sin(psi), cos(psi)
        forward, left = vx * cos_psi - vy * sin_psi, vx * sin_psi + vy * cos_psi
        if self._kind == "kinematic" or self._kind == "blend":
            dynamic = self._at_low_speed(now, dynamic)
        return [forward, left, r, *dynamic, *rates]

    def _at_low_speed(self, now: Instant, dynamic: tuple[float, float, float]) -> tuple[float, float, float]:
        """Rates of vx, vy and yaw rate of the kinematic model, or of its blend with the dynamic model."""
        _, _, m, _, _, rear_axle = self._base
        turn = now.vx * (now.sin_d / now.cos_d) / self._wheelbase
        slow = (now.fx + now.push_x) / m, (rear_axle * turn - now.vy) / RELAX_S, (turn - now.r) / RELAX_S
        if self._kind == "kinematic":
            return slow
        share = min(max((math.hypot(now.vx, now.vy) - BLEND_FROM_MPS) / BLEND_OVER_MPS, 0.0), 1.0)
        ahead, across, about = (share * a + (1.0 - share) * b for a, b in zip(dynamic, slow, strict=True))
        return ahead, across, about
