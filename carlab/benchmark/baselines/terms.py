"""Library of terms for regressions on the discrepancy: one or several terms for each effect.

A term is the residual acceleration (M, 3) of its effect at a moderate size in the refitted model. The library maps the
dominant term of a regression to an effect of the catalogue; an effect may have several terms (a slope has two
directions, a patch eight places). Exact signatures are more favourable than the usual products of states.

Effects without a term: mocap_latency (the same column as command_delay), traction_limit (with constant axle loads the
same as motor_saturation), roll_dynamics (a hidden state of its own).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from carlab.benchmark.baselines.data import Prepared, Steps
from carlab.benchmark.cases.refit import CommandChange
from carlab.benchmark.cases.set_check import COMMAND_EFFECTS, mapped
from carlab.benchmark.world.base_car import GRAVITY_MPS2, BaseCar
from carlab.benchmark.world.simulation import FloatArray

Term = Callable[[Steps], FloatArray]
PATCHES = 8
AT_END_ONLY = ("velocity_filter_lag",)
MOCAP_EFFECT_SIZE = 0.01
"""Size of the effects of motion capture [m, rad, s]."""
# Moderate sizes of changes of the commands for a 1:10 car.
_SIZES = {
    "command_delay": 0.02, "steering_delay": 0.02, "throttle_delay": 0.02, "steering_lag": 0.04, "motor_lag": 0.05,
    "steering_deadband": 0.03, "steering_offset": 0.02, "steering_asymmetry": 0.05, "throttle_deadband": 0.03,
    "throttle_nonlinearity": 1.1, "throttle_asymmetry": 1.1,
}  # fmt: skip


def library(data: Prepared) -> dict[str, Term]:
    """All terms by ``id`` or ``id:part``, for one case."""
    car = data.car
    terms: dict[str, Term] = {name: _command_term(COMMAND_EFFECTS[name][0](size, car)) for name, size in _SIZES.items()}
    terms |= {name: _command_term(change) for name, change in _other_commands(data).items()}
    terms |= {
        "rolling_resistance": _force(lambda s, v: (-np.tanh(v[:, 3] / 0.05), 0.0, 0.0)),
        "aerodynamic_drag": _force(lambda s, v: (-v[:, 3] * np.abs(v[:, 3]), 0.0, 0.0)),
        "brake_asymmetry": _force(lambda s, v: (_further_braking(s, v), 0.0, 0.0)),
        "drag_brake": _force(lambda s, v: (-_released(s) * np.tanh(v[:, 3] / 0.05), 0.0, 0.0)),
        "speed_controller": _force(lambda s, v: (_lost_force(s, v), 0.0, 0.0)),
        "cornering_drag": _force(lambda s, v: (-np.abs(_angle(s)) * np.tanh(v[:, 3] / 0.05), 0.0, 0.0)),
        "all_wheel_drive": _force(lambda s, v: _front_drive(s, v, 0.3)),
        "yaw_damping": _force(lambda s, v: (0.0, 0.0, -0.01 * v[:, 5])),
        "torque_steer": _force(lambda s, v: (0.0, 0.0, 0.01 * _throttle(s))),
        "lateral_bias": _force(lambda s, v: (0.0, np.ones(len(v)), 0.0)),
        "road_slope:east": _force(lambda s, v: (-np.cos(v[:, 2]), np.sin(v[:, 2]), 0.0)),
        "road_slope:north": _force(lambda s, v: (-np.sin(v[:, 2]), -np.cos(v[:, 2]), 0.0)),
        "longitudinal_slip": _force(lambda s, v: (-_forward_acceleration(s), 0.0, 0.0)),
        "tyre_relaxation": _relaxation,
        "battery_sag": _command_term_of_time(lambda t: 1.0 - 0.002 * t),
        "friction_drift": _grip(lambda s: (1.0 + 0.002 * s.t_s, 1.0 + 0.002 * s.t_s)),
        "wheelbase": _axles(lambda car: (0.02 * car.front_axle, 0.02 * car.rear_axle)),
        "centre_of_mass": _axles(lambda car: (-0.02 * car.wheelbase, 0.02 * car.wheelbase)),
        "front_wheel_play": _grip(lambda s: (_slip_beyond_play(s, 0.02), 1.0)),
        "friction_ellipse": _grip(lambda s: (1.0, _combined(s, 0.3))),
        "combined_slip": _spinning,
        "load_transfer": _grip(lambda s: _transfer(s, 0.05)),
        "aerodynamic_downforce": _grip(lambda s: (_pressed(s), _pressed(s))),
        "marker_offset:ahead": _observed(lambda v, rate: np.stack([0 * v[:, 2], v[:, 2], 0 * v[:, 2]], axis=1)),
        "marker_offset:left": _observed(lambda v, rate: np.stack([-v[:, 2], 0 * v[:, 2], 0 * v[:, 2]], axis=1)),
        "mocap_yaw_misalignment": _observed(lambda v, rate: np.stack([v[:, 1], -v[:, 0], 0 * v[:, 0]], axis=1)),
        "velocity_filter_lag": _observed(lambda v, rate: -rate),
    }  # fmt: skip
    for k, (x, y, radius) in enumerate(_places(data)):
        terms[f"low_friction_patch:{k}"] = _patch(x, y, radius)
    if car.kind == "linear_tyre":
        terms["tyre_saturation"] = _saturated
    return terms


def effect_of(term: str) -> str:
    """Effect id of a term."""
    return term.partition(":")[0]


def _command_term(change: CommandChange) -> Term:
    made: dict[int, FloatArray] = {}

    def term(s: Steps) -> FloatArray:
        key = id(s.fine)
        if key not in made:
            made.clear()
            made[key] = change(s.fine, np.tile(s.parts, len(s.fine) // len(s.parts)))
        return _gained(s, s.rolled(series=made[key]))

    return term


def _command_term_of_time(factor: Callable[[FloatArray], FloatArray]) -> Term:
    def change(series: FloatArray, lengths: FloatArray) -> FloatArray:
        out = series.copy()
        out[:, 1] *= factor(np.cumsum(lengths))
        return out

    return _command_term(change)


def _gained(s: Steps, ends: FloatArray) -> FloatArray:
    return np.asarray((ends - s.ends)[:, 3:] / s.length_s)


def _force(forces: Callable[[Steps, FloatArray], tuple[object, object, object]]) -> Term:
    """Forces in N and a moment in N m, for steps and their middle states."""

    def term(s: Steps) -> FloatArray:
        along, across, moment = (np.broadcast_to(np.asarray(f), len(s.starts)) for f in forces(s, s.middle))
        return np.stack([along / s.car.mass, across / s.car.mass, moment / s.car.yaw_inertia], axis=1)

    return term


def _grip(factors: Callable[[Steps], tuple[object, object]]) -> Term:
    """Scaled friction of the front and the rear axle."""

    def term(s: Steps) -> FloatArray:
        front, rear = (np.broadcast_to(np.asarray(f), len(s.starts)) for f in factors(s))
        return _gained(s, s.rolled(scaled={"tyre.front.mu": front, "tyre.rear.mu": rear}))

    return term


def _axles(moves_m: Callable[[BaseCar], tuple[float, float]]) -> Term:
    """Front and rear axle further from the centre of mass by some distances [m]."""

    def term(s: Steps) -> FloatArray:
        front_m, rear_m = moves_m(s.car)
        car = dataclasses.replace(s.car, front_axle=s.car.front_axle + front_m, rear_axle=s.car.rear_axle + rear_m)
        return _gained(s, dataclasses.replace(s, car=car).rolled())

    return term


def _observed(seen: Callable[[FloatArray, FloatArray], FloatArray]) -> Term:
    """Measured velocity v + MOCAP_EFFECT_SIZE seen(v, rate), inverted at the start and applied at the end."""

    def term(s: Steps) -> FloatArray:
        starts = s.starts.copy()
        starts[:, 3:] -= MOCAP_EFFECT_SIZE * seen(s.starts[:, 3:], s.rates(at_end=False))
        ends = s.rolled(starts=starts)
        ends[:, 3:] += MOCAP_EFFECT_SIZE * seen(s.ends[:, 3:], s.rates(at_end=True))
        return _gained(s, ends)

    return term


def _angle(s: Steps) -> FloatArray:
    return np.asarray(s.car.max_angle * s.commands()[:, :, 0].mean(axis=1))


def _throttle(s: Steps) -> FloatArray:
    return np.asarray(s.commands()[:, :, 1].mean(axis=1))


def _further_braking(s: Steps, middle: FloatArray) -> FloatArray:
    """A tenth of the motor's force where it opposes the motion [N]."""
    throttle = _throttle(s)
    return np.where(throttle * middle[:, 3] < 0.0, 0.1 * s.car.drive_gain * throttle, 0.0)


def _released(s: Steps) -> FloatArray:
    """1 without throttle, 0 from a twentieth of full throttle on."""
    return np.asarray(np.maximum(1.0 - np.abs(_throttle(s)) / 0.05, 0.0))


def _lost_force(s: Steps, middle: FloatArray) -> FloatArray:
    """Change of the motor's force [N] by limits of 0.8 (forwards) and 0.6 (backwards) of its largest size."""
    force = s.car.drive_gain * _throttle(s) - s.car.damping * middle[:, 3]
    largest = float(np.quantile(np.abs(force), 0.99))
    return np.asarray(np.clip(force, -0.6 * largest, 0.8 * largest) - force)


def _front_drive(s: Steps, middle: FloatArray, share: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Change of the forces [N] and of the moment [N m] by a share of the motor's force at the front wheels."""
    force, angle = share * (s.car.drive_gain * _throttle(s) - s.car.damping * middle[:, 3]), _angle(s)
    across = force * np.sin(angle)
    return force * (np.cos(angle) - 1.0), across, s.car.front_axle * across


def _slip_beyond_play(s: Steps, play: float) -> FloatArray:
    """Share of the front's slip angle beyond the play [rad]."""
    ahead = np.maximum(np.abs(s.middle[:, 3]), 0.3)
    slip = np.abs(np.arctan2(s.middle[:, 4] + s.car.front_axle * s.middle[:, 5], ahead) - _angle(s))
    return np.asarray(np.maximum(slip - play, 0.0) / np.maximum(slip, 1e-6))


def _combined(s: Steps, scale: float) -> FloatArray:
    drive_n = s.car.drive_gain * _throttle(s)
    share = np.clip(scale * drive_n / (s.car.mu_rear * s.car.load_rear), -0.9, 0.9)
    return np.asarray(np.sqrt(1.0 - share**2))


def _spinning(s: Steps) -> FloatArray:
    """Driven wheels that transmit 0.8 of the largest force of the motor, and lose side force near this limit."""
    force = s.car.drive_gain * _throttle(s) - s.car.damping * s.middle[:, 3]
    limit = 0.8 * float(np.quantile(np.abs(force), 0.99))
    transmitted = np.clip(force, -0.9 * limit, 0.9 * limit)
    lost = np.stack([transmitted - force, 0.0 * force, 0.0 * force], axis=1) / s.car.mass
    return np.asarray(lost + _grip(lambda _: (1.0, np.sqrt(1.0 - (transmitted / limit) ** 2)))(s))


def _forward_acceleration(s: Steps) -> FloatArray:
    turned = (s.ends - s.starts)[:, 3] / s.length_s
    return np.asarray(turned - s.middle[:, 4] * s.middle[:, 5])


def _transfer(s: Steps, height: float) -> tuple[FloatArray, FloatArray]:
    moved = s.car.mass * _forward_acceleration(s) * height / s.car.wheelbase
    return 1.0 - moved / s.car.load_front, 1.0 + moved / s.car.load_rear


def _pressed(s: Steps) -> FloatArray:
    return np.asarray(1.0 + 0.1 * s.middle[:, 3] ** 2 / (s.car.mass * GRAVITY_MPS2))


def _sides(car: BaseCar, state: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lateral forces of the two axles by the model's tyres."""
    vx, vy, r = state[:, 3], state[:, 4], state[:, 5]
    front = np.arctan2(vy + car.front_axle * r, np.maximum(np.abs(vx), 0.3)) - d
    rear = np.arctan2(vy - car.rear_axle * r, np.maximum(np.abs(vx), 0.3))
    if car.kind == "linear_tyre":
        return (-car.mu_front * car.load_front * car.b_front * car.c_front * front,
                -car.mu_rear * car.load_rear * car.b_rear * car.c_rear * rear)  # fmt: skip
    return (-car.mu_front * car.load_front * np.sin(car.c_front * np.arctan(car.b_front * front)),
            -car.mu_rear * car.load_rear * np.sin(car.c_rear * np.arctan(car.b_rear * rear)))  # fmt: skip


def _by_sides(car: BaseCar, front: FloatArray, rear: FloatArray, d: FloatArray) -> FloatArray:
    """Accelerations (M, 3) by lateral forces at the axles."""
    moment = car.front_axle * front * np.cos(d) - car.rear_axle * rear
    across = (front * np.cos(d) + rear) / car.mass
    return np.stack([-front * np.sin(d) / car.mass, across, moment / car.yaw_inertia], axis=1)


def _relaxation(s: Steps) -> FloatArray:
    """Tyre relaxation over 0.05 m: F = F_steady - (length / vx) dF_steady/dt."""
    angles = s.car.max_angle * s.commands()[:, :, 0]
    begin, end = _sides(s.car, s.starts, angles[:, 0]), _sides(s.car, s.ends, angles[:, -1])
    late = 0.05 / np.maximum(np.abs(s.middle[:, 3]), 0.3) / s.length_s
    front, rear = (-late * (b - a) for a, b in zip(begin, end, strict=True))
    d = angles.mean(axis=1)
    return _by_sides(s.car, front, rear, d)


def _saturated(s: Steps) -> FloatArray:
    """The Pacejka tyre in place of the linear one, with the same numbers."""
    d = _angle(s)
    curved = dataclasses.replace(s.car, kind="dynamic")
    front, rear = (a - b for a, b in zip(_sides(curved, s.middle, d), _sides(s.car, s.middle, d), strict=True))
    return _by_sides(s.car, front, rear, d)


def _places(data: Prepared) -> list[tuple[float, float, float]]:
    """Discs along the driven path at maximum mutual distance."""
    points = data.fit.measured[::5, :2]
    chosen = [points[0]]
    while len(chosen) < PATCHES:
        gaps = np.min([np.hypot(*(points - c).T) for c in chosen], axis=0)
        chosen.append(points[int(gaps.argmax())])
    apart = float(np.min([np.hypot(*(points - c).T) for c in chosen], axis=0).max())
    return [(float(x), float(y), max(apart, 0.1)) for x, y in chosen]


def _patch(x: float, y: float, radius: float) -> Term:
    def factors(s: Steps) -> tuple[object, object]:
        inside = np.hypot(s.middle[:, 0] - x, s.middle[:, 1] - y) < radius
        return 1.0 - 0.1 * inside, 1.0 - 0.1 * inside

    return _grip(factors)


def _other_commands(data: Prepared) -> dict[str, CommandChange]:
    """Changes of the acting commands with sizes that depend on the recorded commands."""
    steering, throttle = data.fit.commands.T
    top_rate = float(np.quantile(np.abs(np.diff(steering)), 0.99)) / data.nominal.control_period
    limit = 0.6 * max(top_rate, 0.1)
    play = 0.03 / data.car.max_angle
    ceiling = 0.8 * max(float(np.quantile(np.abs(throttle), 0.99)), 0.05)

    def rate_limited(series: FloatArray, lengths: FloatArray) -> FloatArray:
        out, state = series.copy(), float(series[0, 0])
        for k, (wanted, step_s) in enumerate(zip(series[:, 0].tolist(), lengths.tolist(), strict=True)):
            state += min(max(wanted - state, -limit * step_s), limit * step_s)
            out[k, 0] = state
        return out

    def with_play(series: FloatArray, lengths: FloatArray) -> FloatArray:
        out, state = series.copy(), float(series[0, 0])
        for k, wanted in enumerate(series[:, 0].tolist()):
            state = min(max(state, wanted - 0.5 * play), wanted + 0.5 * play)
            out[k, 0] = state
        return out

    return {
        "steering_rate_limit": rate_limited,
        "steering_backlash": with_play,
        "steering_nonlinearity": mapped(0, lambda u: 1.5 * np.tanh(u / 1.5)),
        "motor_saturation": mapped(1, lambda u: np.clip(u, -ceiling, ceiling)),
    }
