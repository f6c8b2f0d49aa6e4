"""A car with an actuator and motion capture: real, or emulated at the wire."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from carlab.core.car import Car
from carlab.core.clock import Clock, MonotonicClock
from carlab.core.errors import NotOpenError, NotReadyError, PoseLostError
from carlab.core.pose_source import PoseSource
from carlab.core.quantities import Action, ActionLimits, CarState, Health, Observation, PoseSample, Reality
from carlab.core.state_estimator import StateEstimator
from drivers.actuator import Actuator
from drivers.config import HardwareConfig

MAX_POSES = 4096
PLACE_TIMEOUT_S = 1.0
ARM_WAIT_S = 0.5
"""Longest time that arming waits for enough fresh poses for a speed estimate [s]."""
CAPTURE_STAMP_ERROR_S = 0.005
"""Largest error of a capture stamp that was converted from the camera's clock to the host's [s]."""


class HardwareCar(Car):
    """Actuator, pose source and state estimator behind the ``Car`` interface.

    Args:
        name: Name of the car.
        actuator: Receives the commands.
        pose_source: Delivers the poses; opened and closed with the car.
        estimator: Estimates states from poses.
        config: Conditions for arming.
        reality: REAL, or EMULATED if emulators are at the other end of the wire.
        limits: Largest commands that are accepted.
        clock: Clock of poses and commands; by default the host's monotonic clock.
        place: Moves an emulated car to a state; returns whether it succeeded.
    """

    def __init__(
        self,
        name: str,
        actuator: Actuator,
        pose_source: PoseSource,
        estimator: StateEstimator,
        *,
        config: HardwareConfig | None = None,
        reality: Reality = Reality.REAL,
        limits: ActionLimits | None = None,
        clock: Clock | None = None,
        place: Callable[[CarState], bool] | None = None,
    ) -> None:
        self.name = name
        self.actuator = actuator
        self.pose_source = pose_source
        self.estimator = estimator
        self.config = HardwareConfig() if config is None else config
        self.reality = reality
        self.limits = ActionLimits() if limits is None else limits
        self.clock: Clock = MonotonicClock() if clock is None else clock
        self._place = place
        self._is_open = False
        self._placed_s = float("-inf")
        self._sequence = -1
        self._newest: PoseSample | None = None
        self._new_poses: deque[PoseSample] = deque(maxlen=MAX_POSES)

    def open(self) -> None:
        """Open motion capture and actuator. Raises NotReadyError with the reasons of both."""
        if self._is_open:
            return
        reasons: list[str] = []
        for part in (self.pose_source, self.actuator):
            try:
                part.open()
            except NotReadyError as error:
                reasons.append(str(error))
        if reasons:
            self.close()
            raise NotReadyError(f"{self.name} is not ready", reasons)
        self.estimator.reset()
        self._placed_s = float("-inf")
        self._sequence = -1
        self._newest = None
        self._new_poses.clear()
        self._is_open = True

    def observe(self) -> Observation:
        """Newest state and the raw poses since the last call; ``tracked`` belongs to the newest sample.

        Raises PoseLostError before the first pose, NotOpenError when closed.
        """
        self._require_open()
        self._take_poses()
        estimate = self.estimator.estimate()
        newest, seen = self._newest, self.estimator.newest
        if estimate is None or newest is None or seen is None:
            remedy = " ".join(self.pose_problems()) or "check that its markers are visible and its id is right."
            raise PoseLostError(f"Motion capture has not seen the body yet; {remedy}")
        state, delay_s = estimate
        poses = tuple(self._new_poses)
        self._new_poses.clear()
        return Observation(
            state,
            seen.t_capture_s,
            seen.t_receive_s,
            seen.sequence,
            newest.tracked,
            delay_s,
            poses,
            self.estimator.velocity_valid,
            self._motor_is_turning(),
        )

    def arm(self) -> None:
        """Arm the actuator if actuator and motion capture are ready and the car is at rest.

        Waits half a second at most for late telemetry, and as long for late poses (a busy host). Raises NotReadyError
        with all reasons, ActuatorFaultError while a fault is latched, NotOpenError when closed.
        """
        self._require_open()
        self.actuator.require_no_fault()
        self.actuator.await_telemetry(ARM_WAIT_S)
        self._await_poses()
        reasons = [*self.actuator.problems(), *self._pose_reasons()]
        estimate = self.estimator.estimate()
        if estimate is not None and not self.estimator.velocity_valid:
            reasons.append("too few poses arrived to estimate the speed; try again.")
        elif estimate is not None and not (speed_mps := estimate[0].speed_mps) <= self.config.arm_max_speed_mps:
            reasons.append(f"the car moves at {speed_mps:.2f} m/s; wait until it is at rest.")
        erpm = abs(self.actuator.status().erpm)
        if math.isnan(erpm):
            reasons.append("the motor controller reports no motor speed; check its app settings.")
        elif erpm > self.config.arm_max_erpm:
            reasons.append(f"the motor turns at {erpm:.0f} eRPM; wait until it is at rest.")
        if reasons:
            raise NotReadyError(f"{self.name} cannot be armed", reasons)
        self.actuator.arm()

    def command(self, action: Action) -> Action:
        """Check and post a command; returns the command on the wire.

        Raises ActionOutOfRangeError (nothing is sent), NotArmedError, ActuatorFaultError and NotOpenError.
        """
        self._require_open()
        self.check(action)
        return self.actuator.command(action)

    def stop(self, *, planned: bool) -> None:
        """Send neutral at least three times, and disarm."""
        self.actuator.stop(planned=planned)

    def reset_fault(self) -> None:
        """Clear a latched fault. Raises ActuatorFaultError if the cause persists, NotOpenError when closed."""
        self._require_open()
        self.actuator.reset_fault()

    def health(self) -> Health:
        """Condition of actuator, firmware and motion capture."""
        if not self._is_open:
            return Health(False, (f"{self.name} is not open; call open() first.",))
        actuator = self.actuator.health()
        problems = (*actuator.problems, *self._pose_reasons())
        readings = {**actuator.readings, **{f"mocap_{k}": v for k, v in self.pose_source.statistics().items()}}
        return Health(not problems, problems, readings, actuator.warnings)

    def measure_motor_timeout(self) -> None:
        """Measure the time-out of the motor controller, without motion; ``health`` has the result.

        Raises NotOpenError, ActuatorFaultError.
        """
        self._require_open()
        self.actuator.measure_motor_timeout()

    @property
    def watchdog_trips(self) -> int:
        """Trips of the sender's watchdog since ``open``; 0 when closed."""
        return self.actuator.status().watchdog_trips if self._is_open else 0

    def pose_problems(self) -> tuple[str, ...]:
        """Suspected errors of motion capture while poses arrive; empty if there are none."""
        return tuple(self.pose_source.problems())

    def place(self, state: CarState) -> bool:
        """Move an emulated car to ``state`` and wait for a pose captured afterwards (a second at most).

        Poses captured before are discarded, and the estimator is reset. Returns False for a real car.
        """
        if self._place is None or not self._place(state):
            return False
        self._placed_s = self.clock.now_s() + CAPTURE_STAMP_ERROR_S
        self.estimator.reset()
        sequence, until_s = self._sequence, self.clock.now_s() + PLACE_TIMEOUT_S
        while (left_s := until_s - self.clock.now_s()) > 0.0:
            sample = self.pose_source.wait_for(sequence, left_s)
            if sample is None or sample.t_capture_s > self._placed_s:
                break
            sequence = sample.sequence
        return True

    def close(self) -> None:
        """Send neutral, then disconnect actuator and motion capture, each even if closing the other one fails."""
        self._is_open = False
        try:
            self.actuator.close()
        finally:
            self.pose_source.close()

    def _motor_is_turning(self) -> bool | None:
        """Whether the measured motor speed exceeds the limit for arming; None without fresh telemetry of it."""
        status = self.actuator.status()
        is_fresh = self.clock.now_s() - status.t_telemetry_s <= self.actuator.config.telemetry_stale_s
        return abs(status.erpm) > self.config.arm_max_erpm if is_fresh and not math.isnan(status.erpm) else None

    def _await_poses(self) -> None:
        """Read poses until the speed can be estimated, ``ARM_WAIT_S`` at most."""
        until_s = self.clock.now_s() + ARM_WAIT_S
        self._take_poses()
        while self._pose_reasons() or not self.estimator.velocity_valid:
            left_s = until_s - self.clock.now_s()
            if left_s <= 0.0 or self.pose_source.wait_for(self._sequence, left_s) is None:
                break
            self._take_poses()

    def _take_poses(self) -> None:
        """Update the estimator with the poses that have arrived, also after the source has restarted its count."""
        latest = self.pose_source.latest()
        if latest is not None and latest.sequence < self._sequence:
            self._sequence = latest.sequence - 1
        for sample in self.pose_source.since(self._sequence):
            if sample.t_capture_s > self._placed_s:
                self.estimator.update(sample)
            self._new_poses.append(sample)
            self._sequence = sample.sequence
            self._newest = sample

    def _pose_reasons(self) -> list[str]:
        """Reasons not to arm: no fresh tracked pose, and the problems that the pose source reports."""
        problems = list(self.pose_problems())
        newest = self.pose_source.latest()
        if newest is None:
            return [
                "motion capture has sent no pose yet; check its software, the network and the body's id.",
                *problems,
            ]
        age_s = self.clock.now_s() - newest.t_receive_s
        if age_s > self.config.arm_max_pose_age_s:
            stale = f"the newest pose is {age_s:.1f} s old; check the motion-capture software and the network."
            return [stale, *problems]
        if not newest.tracked and not problems:
            return ["motion capture does not see the body; check its markers and the capture volume."]
        return problems

    def _require_open(self) -> None:
        if not self._is_open:
            raise NotOpenError(f"{self.name} is not open; call open() first, or use it in a with block.")
