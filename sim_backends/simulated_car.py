"""A simulated car with the interface of a real car, on a simulated or a real clock."""

from __future__ import annotations

import math
from dataclasses import astuple

from carlab.core.angles import wrap
from carlab.core.car import Car
from carlab.core.clock import Clock, SimulatedClock
from carlab.core.errors import ActuatorFaultError, CarlabError, ConfigError, NotArmedError, NotOpenError, PoseLostError
from carlab.core.planar import arc, to_world
from carlab.core.quantities import NEUTRAL, Action, ActionLimits, CarState, Health, Observation, PoseSample, Reality
from carlab.core.state_estimator import StateEstimator
from sim_backends.array_ops import FLOATS
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.measurement import MeasurementModel, State, filter_step
from sim_backends.plant import Plant, Pose
from sim_backends.sensor import MocapSensor

MAX_SPEED_MPS = 100.0
"""Speed beyond which a simulation has diverged; the fastest remote-controlled cars reach about 90 m/s."""
MAX_YAW_RATE_RADPS = 200.0
"""32 turns a second; spinning model cars reach about 30 rad/s."""


def diverged(car: str) -> ConfigError:
    """The error for a car whose simulation diverged."""
    return ConfigError(
        f"The simulation of car '{car}' diverged: its motion changes faster than the integration step resolves. Check "
        "mass, yaw_inertia, damping and the tyres' B in the car file (SI units)."
    )


def is_physical(state: CarState) -> bool:
    """Whether a state is finite and within the limits."""
    return (
        all(map(math.isfinite, astuple(state)))
        and state.speed_mps <= MAX_SPEED_MPS
        and abs(state.yaw_rate_radps) <= MAX_YAW_RATE_RADPS
    )


class _Approach:
    """A tracked point with constant body velocity that reaches ``state`` at ``t_s``, for samples before placing."""

    def __init__(self, config: SimulatorConfig, state: CarState, t_s: float) -> None:
        self._measurement = MeasurementModel(FLOATS, config.values(), config.effects)
        self._state, self._t_s = state, t_s

    def measured_pose(self, t_s: float) -> Pose:
        x, y, yaw, vx, vy, yaw_rate = self._state.to_array()
        ahead, left, turn = arc(vx, vy, yaw_rate, t_s - self._t_s)
        dx, dy = to_world(ahead, left, yaw)
        seen = self._measurement.observe(tuple(map(float, (x + dx, y + dy, wrap(yaw + turn), vx, vy, yaw_rate))))
        return Pose(seen[0], seen[1], wrap(seen[2]))


class SimulatedCar(Car):
    """Physics, motion capture and state estimator in one process.

    Time advances by the clock; ``observe`` simulates up to the clock's time. Results are reproducible by the seed.

    Args:
        config: The simulator; by default ``SimulatorConfig()``.
        seed: Seed of the sensor's noise.
        start: State of the car after opening.
        clock: By default a simulated clock; with a ``MonotonicClock`` the car runs in real time.
        limits: Largest commands.
        watchdog_s: Time without a new command after which the car gets neutral [s].
        window_s: Window of the velocity fit [s].
    """

    reality = Reality.SIMULATED

    def __init__(
        self,
        config: SimulatorConfig | None = None,
        *,
        seed: int = 0,
        start: CarState | None = None,
        clock: Clock | None = None,
        limits: ActionLimits | None = None,
        watchdog_s: float = 0.15,
        window_s: float = 0.05,
        name: str = "sim",
    ) -> None:
        self.name = name
        self.config = SimulatorConfig() if config is None else config
        self.clock = SimulatedClock() if clock is None else clock
        self.limits = ActionLimits() if limits is None else limits
        self.watchdog_s = watchdog_s
        self._start = CarState() if start is None else start
        self._plant = Plant(self.config)
        self._sensor = MocapSensor(self.config, seed)
        self._estimator = StateEstimator(window_s)
        self._velocities = _MeasuredVelocities(self.config)
        self._open = self._armed = False
        self._fault: str | None = None
        self._fresh_until_s: float | None = None
        self._watchdog_trips = 0
        self._new_poses: list[PoseSample] = []

    def open(self) -> None:
        """Put the car at its start; the clock advances until the velocity window is filled."""
        if self._open:
            return
        self._open, self._armed, self._fault = True, False, None
        self._watchdog_trips = 0
        self.place(self._start)

    def place(self, state: CarState) -> bool:
        """Put the car at ``state`` with neutral acting and no command pending; takes about 0.1 s of the clock.

        The car is at ``state`` when this returns. The preceding samples are those of a motion with the velocities of
        ``state``, so that the estimated velocities are correct at once. Raises NotOpenError when closed.
        """
        self._require_open()
        begin_s = self.clock.now_s()
        arrive_s = begin_s + self._sensor.settling_time_s(self._estimator.window_s)
        self._estimator.reset()
        self._velocities.reset()
        self._sensor.reset(begin_s)
        self._new_poses.clear()
        self._fresh_until_s = None
        self._take_in(self._sensor.samples_until(arrive_s, _Approach(self.config, state, arrive_s)))
        self._plant.reset(state, arrive_s)
        self.clock.sleep_until(arrive_s)
        return True

    def seed_noise(self, seed: int) -> None:
        """Restart the random numbers of the motion capture with a seed."""
        self._sensor.seed(seed)

    @property
    def watchdog_trips(self) -> int:
        """Number of times since ``open`` that the watchdog has set neutral."""
        return self._watchdog_trips

    @property
    def true_state(self) -> CarState:
        """True state at the clock's time (simulation only). Raises NotOpenError when closed."""
        self._require_open()
        self._run_to(self.clock.now_s())
        return self._plant.state

    def observe(self) -> Observation:
        """Newest state that has arrived.

        Raises:
            PoseLostError: before the first pose.
            NotOpenError: the car is closed.
            ConfigError: the simulation diverged.
        """
        self._require_open()
        self._run_to(self.clock.now_s())
        estimate, newest = self._estimator.estimate(), self._estimator.newest
        poses = tuple(self._new_poses)
        self._new_poses.clear()
        if estimate is None or newest is None:
            raise PoseLostError("No pose has arrived yet; lower [mocap] dropout or wait after open().")
        state, velocity_delay_s = estimate
        return Observation(
            state=self._velocities.state(state),
            t_capture_s=newest.t_capture_s,
            t_receive_s=newest.t_receive_s,
            sequence=newest.sequence,
            tracked=True,
            velocity_delay_s=velocity_delay_s,
            poses=poses,
        )

    def arm(self) -> None:
        """Enable commands. Raises ActuatorFaultError while a fault is latched, NotOpenError when closed."""
        self._require_open()
        self._require_no_fault()
        self._armed = True

    def command(self, action: Action) -> Action:
        """Issue a command. Raises ActionOutOfRangeError, NotArmedError, ActuatorFaultError or NotOpenError."""
        self._require_open()
        self._require_no_fault()
        self.check(action)
        if not self._armed and not action.is_neutral:
            raise NotArmedError(f"Car '{self.name}' is not armed and accepts only neutral; call arm() first.")
        self._send(action)
        return action

    def stop(self, *, planned: bool) -> None:
        """Send neutral and disarm."""
        if not self._open:
            return
        self._armed = False
        if not planned:
            self._fault = self._fault or "it was stopped for a fault"
        self._send(NEUTRAL)

    def reset_fault(self) -> None:
        """Clear a latched fault."""
        self._fault = None
        self._armed = False

    def health(self) -> Health:
        """Whether the car is open and free of faults; age and losses of its poses."""
        problems = []
        if not self._open:
            problems.append("closed; call open()")
        if self._fault is not None:
            problems.append(f"fault latched: {self._fault}; call reset_fault() and arm()")
        readings = {
            "mocap_rate_hz": self._sensor.rate_hz,
            "mocap_latency_s": self._sensor.latency_s,
            "mocap_lost_frames": float(self._sensor.lost),
            "pose_dropped_samples": float(self._estimator.dropped),
            "armed": float(self._armed),
        }
        if self._open and (newest := self._estimator.newest) is not None:
            readings["pose_age_s"] = self.clock.now_s() - newest.t_capture_s
        return Health(ready=not problems, problems=tuple(problems), readings=readings)

    def close(self) -> None:
        """Send neutral and close the car."""
        self.stop(planned=True)
        self._open = False

    def _require_open(self) -> None:
        if not self._open:
            raise NotOpenError(f"Car '{self.name}' is not open; use it inside 'with car:' or call open() first.")

    def _require_no_fault(self) -> None:
        if self._fault is not None:
            raise ActuatorFaultError(f"Car '{self.name}' is stopped: {self._fault}; call reset_fault() and arm().")

    def _send(self, action: Action) -> None:
        now_s = self.clock.now_s()
        self._run_watchdog(now_s)
        self._plant.command(now_s, action)
        self._fresh_until_s = None if action.is_neutral else now_s + self.watchdog_s

    def _run_watchdog(self, now_s: float) -> None:
        if self._fresh_until_s is not None and now_s >= self._fresh_until_s:
            self._plant.command(self._fresh_until_s, NEUTRAL)
            self._fresh_until_s = None
            self._watchdog_trips += 1

    def _run_to(self, now_s: float) -> None:
        """Simulate up to a time [s]. Raises ConfigError if the simulation diverges."""
        self._run_watchdog(now_s)
        try:
            samples = self._sensor.samples_until(now_s, self._plant)
            state = self._plant.advance(now_s)
        except (OverflowError, ValueError) as error:  # Functions of infinite numbers, such as their sine.
            if isinstance(error, CarlabError):
                raise
            raise diverged(self.name) from error
        if not is_physical(state):
            raise diverged(self.name)
        self._take_in(samples)

    def _take_in(self, samples: list[PoseSample]) -> None:
        for sample in samples:
            self._estimator.update(sample)
            self._velocities.update(self._estimator)
        self._new_poses.extend(samples)


class _MeasuredVelocities:
    """The measurement model for estimated velocities: its effects on velocities and its filter."""

    def __init__(self, config: SimulatorConfig) -> None:
        self._model = MeasurementModel(FLOATS, config.values(), config.effects)
        self._t_s: float | None = None
        self._input: State = (0.0, 0.0, 0.0)
        self._output: State = (0.0, 0.0, 0.0)

    def reset(self) -> None:
        self._t_s = None

    def update(self, estimator: StateEstimator) -> None:
        lag_s = self._model.velocity_time_constant_s
        estimate, newest = estimator.estimate() if lag_s is not None else None, estimator.newest
        if estimate is None or newest is None or not estimator.velocity_valid:
            return
        velocity = self._model.observe_velocities(astuple(estimate[0]))[3:]
        if self._t_s is None:
            self._output = velocity
        elif newest.t_capture_s > self._t_s:
            step_s = newest.t_capture_s - self._t_s
            self._output = filter_step(FLOATS, self._output, self._input, velocity, step_s, lag_s)
        self._t_s, self._input = newest.t_capture_s, velocity

    def state(self, state: CarState) -> CarState:
        """The reported state for an estimated state."""
        if self._t_s is None:
            return CarState(*self._model.observe_velocities(astuple(state)))
        return CarState(state.x_m, state.y_m, state.yaw_rad, *self._output)
