"""Least-squares refit of a single-track model by the generator, used to size the concealed effects.

Windows start from states estimated from the recording (a local cubic over nine poses). The noise floor of a channel is
the error of the true car from the same initial states: its noise-free state plus the propagated error of the initial
state, against the noisy recording.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlab.benchmark.world.base_car import GRAVITY_MPS2, BaseCar
from carlab.benchmark.world.measurement import Recording, local_fit, to_body
from carlab.benchmark.world.simulation import FloatArray
from carlab.core import planar

HORIZON_S = 1.0
PRIOR_SHARE = 0.15
_SUBSTEPS_PER_PERIOD = 4
# Change of the fine command series: (steering and throttle (n, 2), step lengths (n,) [s]) -> changed series.
CommandChange = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class Windows:
    """M windows of S substeps.

    Attributes:
        car: propagates errors of the initial states.
        steps_s: lengths of the substeps (S,) [s].
        starts: initial states (M, 6).
        commands: mean commands of the substeps (M, S, 2).
        recorded: final states (M, 6).
        floor_errors: errors of the true car (M, 6), whose root mean square is the noise floor.
    """

    car: BaseCar
    steps_s: FloatArray
    starts: FloatArray
    commands: FloatArray
    recorded: FloatArray
    floor_errors: FloatArray

    @property
    def floor(self) -> FloatArray:
        """Noise floor of the six channels (6,)."""
        return np.asarray(np.sqrt((self.floor_errors**2).mean(axis=0)), dtype=np.float64)

    def with_floor(self, floor: FloatArray) -> Windows:
        """The windows with a given noise floor (6,)."""
        return replace(self, floor_errors=np.repeat(floor[None], len(self.starts), axis=0))


@dataclass(frozen=True)
class Refit:
    """Fitted base parameters; on held-out windows, the nominal car's score and the fitted car's scores by channel."""

    values: dict[str, float]
    nominal_score: float
    channels: tuple[float, ...]

    @property
    def score(self) -> float:
        """Root mean square of the scores of the channels."""
        return _root_mean_square(np.array(self.channels))

    @property
    def excess(self) -> float:
        """sqrt(score^2 - 1), 0 for a score below 1."""
        return float(np.sqrt(max(self.score**2 - 1.0, 0.0)))


def fine_commands(
    recording: Recording, car: BaseCar, changes: Sequence[CommandChange] = ()
) -> tuple[FloatArray, FloatArray]:
    """Mean acting commands over every substep, at the times of the captured states (N n, 2), and substeps of a period.

    A command issued at t acts at t + command_delay; the row's state is latency older than the row. Substeps end where
    commands switch.
    """
    period = car.control_period
    age = car.command_delay + car.latency
    switch = age % period
    before = max(1, round(_SUBSTEPS_PER_PERIOD * switch / period)) if switch > 1e-6 else 0
    after = max(1, _SUBSTEPS_PER_PERIOD - before)
    parts = [np.linspace(0.0, switch, before, endpoint=False), np.linspace(switch, period, after, endpoint=False)]
    edges = np.concatenate(parts) if before else np.linspace(0.0, period, after, endpoint=False)
    steps = np.diff(np.append(edges, period))
    knots = np.append(recording.t_s, recording.t_s[-1] + period)
    integral = np.concatenate([np.zeros((1, 2)), np.cumsum(recording.commands * np.diff(knots)[:, None], axis=0)])
    fine = np.append((recording.t_s[:, None] + edges).ravel(), knots[-1])
    at = np.stack([np.interp(fine - age, knots, integral[:, k]) for k in range(2)], axis=1)
    lengths = np.tile(steps, len(recording.t_s))
    series = np.diff(at, axis=0) / lengths[:, None]
    for change in changes:
        series = change(series, lengths)
    return series, steps


def cut_windows(
    recording: Recording,
    car: BaseCar,
    *,
    every_s: float = 0.5,
    horizon_s: float = HORIZON_S,
    changes: Sequence[CommandChange] = (),
) -> Windows:
    """Cut a recording into windows; ``car`` propagates the errors of initial states over the horizon."""
    period = car.control_period
    steps, stride = round(horizon_s / period), max(1, round(every_s / period))
    first = np.arange(5, len(recording.t_s) - steps, stride)
    last = first + steps
    window = 9 if period > 0.02 else 2 * round(0.133 / period) + 1
    clean = recording.clean
    pose, slope = local_fit(recording.measured[:, :3], window, 3, period)
    starts = np.concatenate([pose, to_body(pose[:, 2], slope)], axis=1)[first]
    fine, parts = fine_commands(recording, car, changes)
    commands = fine[first[:, None] * len(parts) + np.arange(steps * len(parts))]
    steps_s = np.tile(parts, steps)
    grown = roll(car, car.free(), starts, commands, steps_s) - roll(car, car.free(), clean[first], commands, steps_s)
    measured_error = in_start_frame(clean[last] - recording.measured[last], starts)
    floor_errors = measured_error + in_start_frame(grown, starts)
    return Windows(car, steps_s, starts, commands, recording.measured[last], floor_errors)


def in_start_frame(errors: FloatArray, starts: FloatArray) -> FloatArray:
    """Errors (M, 6) with x, y rotated into the body frame of each initial state."""
    return np.stack([*planar.to_body(errors[:, 0], errors[:, 1], starts[:, 2]), *errors[:, 2:].T], axis=1)


def channel_scores(windows: Windows, values: Mapping[str, float]) -> FloatArray:
    """Root mean square over windows of every channel's error after the horizon, in noise floors, (6,)."""
    ends = roll(windows.car, values, windows.starts, windows.commands, windows.steps_s)
    errors = in_start_frame(ends - windows.recorded, windows.starts) / windows.floor
    return np.asarray(np.sqrt((errors**2).mean(axis=0)), dtype=np.float64)


def score(windows: Windows, values: Mapping[str, float]) -> float:
    """Root mean square over windows and channels of the error after the horizon, in noise floors."""
    return _root_mean_square(channel_scores(windows, values))


def _root_mean_square(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


def refit(fit: Windows, held_out: Windows, nominal: BaseCar, iterations: int = 10) -> Refit:
    """Fit the base parameters by Levenberg and Marquardt's method with weak priors around the nominal car."""
    names = list(nominal.free())
    centre = np.array([nominal.free()[name] for name in names])
    logs = np.zeros(len(names))
    floor = fit.floor
    prior = 1.0 / PRIOR_SHARE
    damping, best = 1e-3, np.inf
    residual, jacobian = _linearise(fit, names, centre, logs, floor)
    best = float(residual @ residual + prior**2 * logs @ logs)
    for _ in range(iterations):
        normal = jacobian.T @ jacobian + prior**2 * np.eye(len(names))
        gradient = jacobian.T @ residual + prior**2 * logs
        step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
        trial = logs + np.clip(step, -0.3, 0.3)
        new_residual, new_jacobian = _linearise(fit, names, centre, trial, floor)
        cost = float(new_residual @ new_residual + prior**2 * trial @ trial)
        if cost < best:
            gain, best = best - cost, cost
            logs, residual, jacobian, damping = trial, new_residual, new_jacobian, damping / 5
            if gain < 1e-3 * best:
                break
        else:
            damping *= 10
    values = dict(zip(names, (centre * np.exp(logs)).tolist(), strict=True))
    channels = tuple(channel_scores(held_out, values).tolist())
    return Refit(values, score(held_out, nominal.free()), channels)


def _linearise(
    windows: Windows, names: list[str], centre: FloatArray, logs: FloatArray, floor: FloatArray
) -> tuple[FloatArray, FloatArray]:
    lanes, count = len(names) + 1, len(windows.starts)
    delta = 1e-4
    table = np.repeat(logs[None], lanes, axis=0)
    table[1:] += delta * np.eye(len(names))
    values = {name: np.repeat(column, count) for name, column in zip(names, (centre * np.exp(table)).T, strict=True)}
    ends = roll(
        windows.car,
        values,
        np.tile(windows.starts, (lanes, 1)),
        np.tile(windows.commands, (lanes, 1, 1)),
        windows.steps_s,
    )
    ends = ends.reshape(lanes, count, 6)
    errors = np.stack([in_start_frame(e - windows.recorded, windows.starts) / floor for e in ends]).reshape(lanes, -1)
    return errors[0], (errors[1:] - errors[0]).T / delta


def roll(
    car: BaseCar, values: Mapping[str, object], starts: FloatArray, commands: FloatArray, steps_s: FloatArray
) -> FloatArray:
    """Final states (M, 6) of M windows of the base model by the classical Runge-Kutta method with fixed steps.

    ``values`` holds the base parameters by dotted name, numbers or arrays (M,).
    """
    p = {name if name.startswith("tyre") else name.split(".")[-1]: value for name, value in values.items()}
    state = [column.copy() for column in starts.T]
    count = len(starts)
    angles = np.ascontiguousarray(commands[:, :, 0].T)
    pushes = np.ascontiguousarray(commands[:, :, 1].T)
    steps = commands.shape[1]
    for k in range(steps):
        step_s = float(steps_s[k])
        d = p["max_angle"] * angles[k]
        force = p["drive_gain"] * pushes[k]
        held = (d, np.sin(d), np.cos(d), force)
        k1 = _rates(car, p, state, held)
        k2 = _rates(car, p, [s + 0.5 * step_s * r for s, r in zip(state, k1, strict=True)], held)
        k3 = _rates(car, p, [s + 0.5 * step_s * r for s, r in zip(state, k2, strict=True)], held)
        k4 = _rates(car, p, [s + step_s * r for s, r in zip(state, k3, strict=True)], held)
        state = [
            s + step_s / 6.0 * (a + 2.0 * (b + c) + e) for s, a, b, c, e in zip(state, k1, k2, k3, k4, strict=True)
        ]
    return np.stack(state, axis=1).reshape(count, 6)


def _rates(
    car: BaseCar, p: dict[str, object], state: list[FloatArray], held: tuple[FloatArray, ...]
) -> list[FloatArray]:
    q: dict[str, FloatArray] = p  # type: ignore[assignment]
    _, _, psi, vx, vy, r = state
    d, sin_d, cos_d, force = held
    lf, lr, m = car.front_axle, car.rear_axle, car.mass
    push = force - q["damping"] * vx
    sin_psi, cos_psi = np.sin(psi), np.cos(psi)
    travel = [vx * cos_psi - vy * sin_psi, vx * sin_psi + vy * cos_psi, r]
    front = vy + lf * r
    slip_f = np.arctan2(front * cos_d - vx * sin_d, np.maximum(np.abs(vx * cos_d + front * sin_d), 0.3))
    slip_r = np.arctan2(vy - lr * r, np.maximum(np.abs(vx), 0.3))
    load = m * GRAVITY_MPS2 / (lf + lr)
    if car.kind == "linear_tyre":
        ff = -q["tyre.front.mu"] * load * lr * q["tyre.front.B"] * q["tyre.front.C"] * slip_f
        fr = -q["tyre.rear.mu"] * load * lf * q["tyre.rear.B"] * q["tyre.rear.C"] * slip_r
    else:
        ff = -q["tyre.front.mu"] * load * lr * np.sin(q["tyre.front.C"] * np.arctan(q["tyre.front.B"] * slip_f))
        fr = -q["tyre.rear.mu"] * load * lf * np.sin(q["tyre.rear.C"] * np.arctan(q["tyre.rear.B"] * slip_r))
    rates = [
        (push - ff * sin_d) / m + vy * r,
        (fr + ff * cos_d) / m - vx * r,
        (lf * ff * cos_d - lr * fr) / q["yaw_inertia"],
    ]
    if car.kind in ("kinematic", "blend"):
        turn = vx * np.tan(d) / (lf + lr)
        slow = [push / m, (lr * turn - vy) / 0.05, (turn - r) / 0.05]
        share = np.clip((np.hypot(vx, vy) - 0.3) / 0.2, 0.0, 1.0) if car.kind == "blend" else 0.0
        rates = [share * a + (1.0 - share) * b for a, b in zip(rates, slow, strict=True)]
    return travel + rates
