"""Independent simulator: models of the package commonroad-vehicle-models, scaled to a 1:10 car by similarity.

The package (Althoff and Würsching, "CommonRoad: Vehicle models (version 2020a)", TU Munich) has two models with
tyre forces and wheel spin: ``multi_body`` (29 states: body, axles and four wheels, Magic Formula with combined slip)
and ``drift`` (9 states: single track, load transfer, wheel spin). Equations and numbers are the package's. This
module adds the command interface, a driver, and motion capture.

Scaling: lengths by 1/10, times by its square root, masses by its cube, so that accelerations are unchanged (Froude
similarity: equal density and gravity). Each number of the vehicle is scaled by its dimension. The tyre's coefficients
are dimensionless and unchanged, except ``p_vx1``: the package multiplies it by the load inside a sine, so its unit is
1/N.

Interface: the inputs of the package are a steering rate and a longitudinal acceleration (drive torque over mass and
wheel radius). The requested rate reaches the commanded angle in one control period; the package limits it. The
requested acceleration is FULL_THROTTLE_MPS2 times the throttle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np
from scipy.integrate import solve_ivp

from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.driver import HumanDriver, Track
from carlab.benchmark.world.measurement import Noise, Recording, record
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import Drive, FloatArray
from carlab.core.errors import ConfigError, DataError
from carlab.core.extras import install_hint

Model = Literal["multi_body", "drift"]
VEHICLE = 2  # BMW 320i, driven by its rear wheels
SCALE = 0.1
MAX_ANGLE_RAD = 0.5
FULL_THROTTLE_MPS2 = 6.0
START_MPS = 1.0
COMMAND_DELAY_S = 0.05  # from a command to the inputs of the package
ROLLING_MPS = 0.7  # below 0.1 m/s the package has no tyre and wheel dynamics
DRIVER_GRIP = 0.75  # share of the tyres' grip that the driver uses; beyond it inner wheels lift, which is not modelled
RTOL = 1e-6
MAX_SIDE_SLIP_RAD = 1.4
MAX_RATE_CALLS = 1500
SMALL_STEP_S = 2e-4

# Powers of the length scale: length 1, time 1/2, mass 3.
_VEHICLE_POWERS = {
    **dict.fromkeys(("l", "w", "a", "b", "T_f", "T_r", "h_cg", "h_raf", "h_rar", "h_s", "R_w"), 1.0),
    **dict.fromkeys(("m", "m_s", "m_uf", "m_ur"), 3.0),
    **dict.fromkeys(("I_Phi_s", "I_y_s", "I_z", "I_xz_s", "I_uf", "I_ur", "I_y_w"), 5.0),
    **dict.fromkeys(("K_sf", "K_sr", "K_ras", "K_zt"), 2.0),  # N/m
    **dict.fromkeys(("K_sdf", "K_sdr", "K_rad"), 2.5),  # N s/m
    **dict.fromkeys(("K_tsf", "K_tsr"), 4.0),  # N m/rad
    **dict.fromkeys(("D_f", "D_r"), -1.0),  # rad/m
    **dict.fromkeys(("K_lt", "E_f", "E_r"), -2.0),  # m/N, rad/m2
}
_STEERING_POWERS = {"v_min": -0.5, "v_max": -0.5, "kappa_dot_max": -1.5, "kappa_dot_dot_max": -2.0}
_LONGITUDINAL_POWERS = {"v_min": 0.5, "v_max": 0.5, "v_switch": 0.5, "j_max": -0.5, "j_dot_max": -1.0}
_TYRE_POWERS = {"p_vx1": -3.0}


def require_public_simulator() -> None:
    """Raise ConfigError if the package is not installed."""
    if find_spec("vehiclemodels") is None:
        raise ConfigError(f"The public simulator needs commonroad-vehicle-models; {install_hint('studies')}.")


def parameters(scale: float = SCALE) -> Any:
    """The package's vehicle, scaled by dynamic similarity; 1.0 is the original."""
    require_public_simulator()
    from vehiclemodels.vehicle_parameters import setup_vehicle_parameters

    p = setup_vehicle_parameters(VEHICLE)
    parts = ((p, _VEHICLE_POWERS), (p.steering, _STEERING_POWERS), (p.longitudinal, _LONGITUDINAL_POWERS))
    for part, powers in (*parts, (p.tire, _TYRE_POWERS)):
        for name, power in powers.items():
            setattr(part, name, getattr(part, name) * scale**power)
    return p


class PublicCar:
    """A model of the package, and an equivalent base car for the driver.

    Args:
        model: Model of the package.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.p = parameters()
        if model == "multi_body":
            from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb as rates
        else:
            from vehiclemodels.vehicle_dynamics_std import vehicle_dynamics_std as rates
        self._spins = range(23, 27) if model == "multi_body" else range(7, 9)
        self._rates: Callable[[list[float], list[float], Any], list[float]] = rates
        p = self.p
        grip = DRIVER_GRIP * p.tire.p_dy1
        # Used by the driver only.
        self.car = BaseCar(
            mass=p.m, yaw_inertia=p.I_z, front_axle=p.a, rear_axle=p.b, mu_front=grip, mu_rear=grip,
            drive_gain=FULL_THROTTLE_MPS2 * p.m, damping=0.0, max_angle=MAX_ANGLE_RAD, command_delay=COMMAND_DELAY_S,
        )  # fmt: skip

    def start(self, x: float, y: float, yaw: float, speed: float) -> FloatArray:
        """State (n,) of the package at a pose [m, rad], rolling straight ahead at ``speed`` [m/s]."""
        core = [x, y, 0.0, speed, yaw, 0.0, 0.0]
        if self.model == "multi_body":
            from vehiclemodels.init_mb import init_mb as init
        else:
            from vehiclemodels.init_std import init_std as init
        return np.array(init(core, self.p), dtype=np.float64)

    def rates(self, state: FloatArray, inputs: Sequence[float]) -> list[float]:
        """Rates of a state (n,) by the package; inputs are the requested steering rate [rad/s] and acceleration [m/s2].

        The package changes a negative wheel speed in the state of its caller, and sets its rate to 0. An integrator
        does not see this change, so a wheel with a slightly negative speed would stay locked. Therefore negative wheel
        speeds are set to 0 before the call, and their rates are not negative after it.
        """
        x = state.tolist()
        locked = [i for i in self._spins if x[i] <= 0.0]
        for i in locked:
            x[i] = 0.0
        found = self._rates(x, list(inputs), self.p)
        for i in locked:
            found[i] = max(found[i], 0.0)
        return found

    def motion(self, states: FloatArray) -> FloatArray:
        """x, y, yaw, vx, vy, yaw_rate at the centre of mass, (N, 6), of states (N, n)."""
        x, y, yaw, rate = states[:, 0], states[:, 1], states[:, 4], states[:, 5]
        if self.model == "multi_body":
            vx, vy = states[:, 3], states[:, 10]
        else:
            vx, vy = states[:, 3] * np.cos(states[:, 6]), states[:, 3] * np.sin(states[:, 6])
        return np.stack([x, y, yaw, vx, vy, rate], axis=1)

    def rear_slip(self, states: FloatArray) -> FloatArray:
        """Longitudinal slip of the rear wheels, their mean where there are two, (N,); positive when braking."""
        spin = states[:, 25:27].mean(axis=1) if self.model == "multi_body" else states[:, 8]
        slip: FloatArray = 1.0 - self.p.R_w * spin / np.maximum(self.motion(states)[:, 3], 0.1)
        return slip


class RollingDriver(HumanDriver):
    """A driver that keeps the car rolling forwards and avoids spins.

    The tyre models of the package are not valid at standstill, in reverse, and at side slip angles above 90 degrees.
    """

    def __call__(self, t: float, state: FloatArray) -> tuple[float, float]:
        """Steering and throttle in [-1, 1] for the tick at t [s]; the state (6,) is that of the newest capture."""
        steering, throttle = super().__call__(t, state)
        speed = math.hypot(state[3], state[4])
        max_steering = math.atan(self._car.wheelbase * self._grip / max(speed, 0.3) ** 2) / self._car.max_angle
        if state[3] < ROLLING_MPS:
            throttle = max(throttle, 0.3)
        return float(np.clip(steering, -max_steering, max_steering)), throttle

    def _choose_mode(self, t: float, off: float) -> None:
        super()._choose_mode(t, off)
        while self._mode in ("stand", "reverse"):
            super()._choose_mode(t, off)


@dataclass(frozen=True)
class PublicDrive:
    """A drive of the public car: its recording, and the noise-free states (N, n) of the package at the captures."""

    recording: Recording
    drive: Drive
    states: FloatArray


class AbandonedError(Exception):
    """A drive was stopped on request."""


def drive_public(
    car: PublicCar, seed: int, part: int, duration_s: float, abandon: Callable[[], bool] = lambda: False
) -> PublicDrive:
    """Drive and record; ``part`` numbers the recordings of a seed. Equal arguments give equal drives.

    Raises:
        AbandonedError: ``abandon``, called at every tick, returned true.
        DataError: the package cannot be integrated, or the car has spun.
    """
    track = Track(np.random.default_rng((seed, 1)))
    human = RollingDriver(car.car, track, np.random.default_rng((seed, 2, part)))
    x, y, yaw = human.start()[:3]
    driven, states = _integrate(car, human, duration_s, car.start(x, y, yaw, START_MPS), abandon)
    noise = Noise(car.car.position_std, car.car.yaw_std)
    recording = record(driven, World(car.car), noise, np.random.default_rng((seed, 3, part)))
    return PublicDrive(recording, driven, states)


def _integrate(
    car: PublicCar, driver: Callable[[float, FloatArray], tuple[float, float]], duration_s: float, state: FloatArray,
    abandon: Callable[[], bool],
) -> tuple[Drive, FloatArray]:  # fmt: skip
    """The drive from a state (n,) of the package at time 0, and its states (N, n) at the captures."""
    base = car.car
    period, per_row = base.control_period, round(base.control_period * base.mocap_rate)
    row_s = np.arange(round(duration_s / period) + 1, dtype=np.float64) * period
    capture_s = np.arange((len(row_s) - 1) * per_row + 1, dtype=np.float64) * (period / per_row) - base.latency
    run = _Integration(car, state, capture_s)
    commands = np.empty((len(row_s), 2))
    for tick in range(len(row_s)):
        if abandon():
            raise AbandonedError
        commands[tick] = driver(tick * period, car.motion(run.newest_capture)[0])
        run.issue(tick * period, *commands[tick].tolist())
        run.advance((tick + 1) * period)
    return Drive(row_s, commands, capture_s, car.motion(run.states), per_row), run.states


class _Integration:
    """Integration of the package's model with delayed commands, which stops where a command begins to act.

    Args:
        car: The car.
        state: State (n,) of the package at time 0; before it the car rolls straight on at ``START_MPS``.
        capture_s: Times of the captures (N,) [s].

    Attributes:
        states: States (N, n) at the captures.
    """

    def __init__(self, car: PublicCar, state: FloatArray, capture_s: FloatArray) -> None:
        self._car, self._state, self._t_s, self._capture_s = car, state, 0.0, capture_s
        self._acting = (0.0, 0.0)
        self._pending: list[tuple[float, tuple[float, float]]] = []
        self._n_captured = int(np.searchsorted(capture_s, 0.0, side="right"))
        self.states = np.empty((len(capture_s), len(state)))
        self.states[: self._n_captured] = state
        direction = np.array([math.cos(state[4]), math.sin(state[4])])
        self.states[: self._n_captured, :2] += capture_s[: self._n_captured, None] * START_MPS * direction

    @property
    def newest_capture(self) -> FloatArray:
        """State (1, n) at the newest capture."""
        return self.states[self._n_captured - 1 : self._n_captured]

    def issue(self, t_s: float, steering: float, throttle: float) -> None:
        """Issue a command, which acts after the car's command delay."""
        inputs = self._car.car.max_angle * steering, FULL_THROTTLE_MPS2 * throttle
        self._pending.append((t_s + self._car.car.command_delay, inputs))

    def advance(self, end_s: float) -> None:
        """Integrate up to a time [s]."""
        while self._t_s < end_s:
            until_s = min(end_s, self._pending[0][0]) if self._pending else end_s
            if until_s > self._t_s + 1e-12:
                self._integrate_held(until_s)
            self._t_s = until_s
            if self._pending and self._pending[0][0] <= self._t_s + 1e-12:
                self._acting = self._pending.pop(0)[1]

    def _integrate_held(self, until_s: float) -> None:
        """Integrate with the acting inputs up to a time [s], and store the captures on the way."""
        n_captured = int(np.searchsorted(self._capture_s, until_s, side="right"))
        at = np.append(self._capture_s[self._n_captured : n_captured], until_s)
        period_s = self._car.car.control_period
        found = _segment(self._car, self._acting, period_s, (self._t_s, until_s), self._state, at)
        self.states[self._n_captured : n_captured], self._state = found[:-1], found[-1]
        self._n_captured = n_captured


def _segment(
    car: PublicCar, acting: tuple[float, float], period: float, span: tuple[float, float], state: FloatArray,
    at: FloatArray,
) -> FloatArray:  # fmt: skip
    """States (k, n) at ascending times ``at`` (k,), for a constant wheel angle [rad] and acceleration [m/s2]."""
    calls = 0

    def rates(_: float, x: FloatArray) -> list[float]:
        nonlocal calls
        calls += 1
        if calls > MAX_RATE_CALLS:
            raise _ChatteringError
        return car.rates(x, ((acting[0] - x[2]) / period, acting[1]))

    # A capture at the end is returned twice.
    once = np.unique(at)
    try:
        try:
            solved = solve_ivp(rates, span, state, "LSODA", once, rtol=RTOL, atol=0.1 * RTOL)
            found = solved.y.T if solved.success else np.full((len(once), len(state)), np.nan)
        except _ChatteringError:
            calls = -(10**9)
            found = _small_steps(rates, span[0], state, once)
    except (ZeroDivisionError, ValueError, OverflowError) as error:
        raise DataError(
            f"The package's {car.model} model failed at {span[0]:.2f} s ({error}); use another seed."
        ) from error
    if not np.isfinite(found).all():
        raise DataError(
            f"The package's {car.model} model cannot be integrated beyond {span[0]:.2f} s; use another seed."
        )
    motion = car.motion(found)
    if (np.abs(np.arctan2(motion[:, 4], motion[:, 3])) > MAX_SIDE_SLIP_RAD).any():
        raise DataError(f"The car has spun at {span[0]:.2f} s, which the package does not model; use another seed.")
    return np.asarray(found[np.searchsorted(once, at)], dtype=np.float64)


class _ChatteringError(Exception):
    """The step control fails at a discontinuity of the right-hand side."""


def _small_steps(
    rates: Callable[[float, FloatArray], list[float]], t: float, x: FloatArray, at: FloatArray
) -> FloatArray:
    """States (k, n) at times ``at`` (k,) by the classical Runge-Kutta method with steps of at most ``SMALL_STEP_S``.

    The package's tyre force jumps where a wheel's camber changes its sign. An adaptive step would become arbitrarily
    small there. Steps of 0.2 ms are stable for the wheel slip, the fastest mode (6000 1/s at walking pace).
    """
    found = np.empty((len(at), len(x)))
    for row, until in enumerate(at):
        count = max(1, math.ceil((until - t) / SMALL_STEP_S))
        h = (until - t) / count
        for _ in range(count):
            k1 = np.array(rates(t, x))
            k2 = np.array(rates(t, x + 0.5 * h * k1))
            k3 = np.array(rates(t, x + 0.5 * h * k2))
            k4 = np.array(rates(t, x + h * k3))
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        found[row], t = x, until
    return found
